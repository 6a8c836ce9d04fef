//! Waiting until objects are gone, with a row for each that is still there.

use std::collections::BTreeMap;
use std::time::Duration;

use muster_api::kind::KindInfo;
use muster_api::kind::task::Task;
use serde_json::Value;
use tokio::time::Instant;

use crate::client::Selection;
use crate::error::CliError;
use crate::output::human;
use crate::output::objects::full_name;
use crate::session::Session;
use crate::successor;
use crate::watch::{Change, Follow, merged};

/// An object whose end is waited for. A later one of the same name is another object, but for a task that is tried on
/// another node.
#[derive(Debug, Clone)]
pub(crate) struct Doomed {
    pub(crate) info: &'static KindInfo,
    pub(crate) namespace: Option<String>,
    pub(crate) uid: String,
    /// As it was last seen.
    pub(crate) object: Value,
}

impl Doomed {
    pub(crate) fn new(info: &'static KindInfo, object: Value) -> Self {
        let text = |f: &str| object.pointer(f).and_then(Value::as_str).map(str::to_owned);
        Doomed {
            info,
            namespace: text("/metadata/namespace").filter(|_| info.namespaced),
            uid: text("/metadata/uid").unwrap_or_default(),
            object,
        }
    }
}

/// Waits until none of them is left.
pub(crate) async fn until_gone(
    doomed: Vec<Doomed>,
    timeout: Option<Duration>,
    session: &mut Session,
) -> Result<(), CliError> {
    let mut left: BTreeMap<String, Doomed> =
        doomed.into_iter().map(|d| (d.uid.clone(), d)).collect();
    let mut places: Vec<(&'static KindInfo, Option<String>)> = Vec::new();
    for d in left.values() {
        if !places.iter().any(|(info, ns)| info.kind == d.info.kind && *ns == d.namespace) {
            places.push((d.info, d.namespace.clone()));
        }
    }
    let follow = |(info, ns): &(&'static KindInfo, Option<String>)| {
        Follow::new(&session.client, info, ns.as_deref(), Selection::default())
    };
    let mut changes = merged(places.iter().map(follow));
    // Each collection's first list shows what of it is gone already.
    let mut unlisted = places.len();
    let mut seen: Vec<String> = Vec::new();
    let mut progress = session.ui.progress();
    let started = Instant::now();
    let never = Duration::from_secs(365 * 24 * 3600);
    let deadline = started + timeout.unwrap_or(never);
    while !left.is_empty() {
        let change = match tokio::time::timeout_at(deadline, changes.recv()).await {
            Ok(change) => change?,
            Err(_) => {
                progress.end(false);
                return Err(timed_out(&left, started.elapsed()));
            }
        };
        match change {
            Change::Applied(object) => {
                let Some((uid, before)) = successor::claim(&mut left, &object) else { continue };
                before.iter().for_each(|before| progress.drop_row(before));
                if let Some(doomed) = left.get_mut(&uid) {
                    progress.show(&uid, &waiting(doomed.info, &object));
                    doomed.object = object;
                    seen.push(uid);
                }
            }
            // Another of its name follows at once.
            Change::Deleted(object) if successor::is_tried_again(&object) => {}
            Change::Deleted(object) => {
                let uid = uid(&object);
                left.remove(&uid);
                progress.drop_row(&uid);
            }
            Change::Synced => {
                unlisted = unlisted.saturating_sub(1);
                if unlisted == 0 {
                    left.retain(|uid, _| seen.contains(uid));
                }
            }
        }
    }
    progress.end(false);
    Ok(())
}

fn uid(object: &Value) -> String {
    object.pointer("/metadata/uid").and_then(Value::as_str).unwrap_or_default().to_owned()
}

/// What keeps an object from going.
fn waiting(info: &KindInfo, object: &Value) -> String {
    let mut text = format!("{} is ending", full_name(info, object));
    if info.kind == "Task"
        && let Ok(task) = serde_json::from_value::<Task>(object.clone())
    {
        let status = task.status.unwrap_or_default();
        text.push_str(&format!(": {}", status.phase));
        if let Some(node) = &status.node {
            text.push_str(&format!(" on {node}"));
        }
        if let Some(lease) = status.lease.as_ref().filter(|_| !status.phase.is_terminal()) {
            text.push_str(&format!(", holds {} (epoch {})", lease.name, lease.epoch));
        }
        let grace = object.pointer("/metadata/deletionGracePeriodSeconds").and_then(Value::as_u64);
        let grace = grace.unwrap_or_else(|| task.spec.grace_period_seconds.into());
        text.push_str(&format!(", grace {}", human::duration(Duration::from_secs(grace))));
    }
    let finalizers = object.pointer("/metadata/finalizers").and_then(Value::as_array);
    if let Some(finalizers) = finalizers.filter(|f| !f.is_empty()) {
        let names: Vec<&str> = finalizers.iter().filter_map(Value::as_str).collect();
        text.push_str(&format!(", held by finalizers {}", names.join(", ")));
    }
    text
}

fn timed_out(left: &BTreeMap<String, Doomed>, after: Duration) -> CliError {
    let all: Vec<String> = left.values().map(|d| waiting(d.info, &d.object)).collect();
    let unknown =
        left.values().any(|d| d.object.pointer("/status/phase").is_some_and(|p| p == "Unknown"));
    let hint = match unknown {
        true => {
            "a task in phase Unknown ends when its node is heard again, or is fenced: `muster get nodes`"
        }
        false => "the deletion goes on; `muster get` shows what is left",
    };
    CliError::Timeout { what: all.join("; "), after, hint: Some(hint.to_owned()) }
}
