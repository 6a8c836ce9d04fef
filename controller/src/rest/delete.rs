//! DELETE: at once, or a wish that others fulfil.
//!
//! An object stays, with `deletionTimestamp`, while it has finalizers, and a Task also while it may have processes: the
//! reconciler removes it once the agent has confirmed that they are gone. Even a grace of 0 only tells the agent to hurry:
//! removing the object would free what the processes still use. For the same reason a Node that tasks hold is not
//! deleted at all.

use std::sync::Arc;

use axum::response::Response;
use futures::{StreamExt as _, stream};
use http::StatusCode;
use jiff::Timestamp;
use muster_api::kind::node::Node;
use muster_api::kind::node::estop::EStopTier;
use muster_api::kind::task::DEFAULT_GRACE_SECONDS;
use muster_api::name::NodeName;
use muster_api::phase::TaskPhase;
use muster_controller_core::deletion::{Deletion, deletion};
use serde::{Deserialize, Deserializer};
use serde_json::{Value, json};

use super::path::Object;
use super::registry::Entry;
use super::selector::Selection;
use super::{Answer, Call, body, failure::Failure, form::Form, list, metadata};
use crate::audit::Named;
use crate::context::Context;
use crate::objects;
use crate::store::{Key, Op, Resource, StoreError, Stored};

/// Objects of a collection that are ended at once: they share commits, and ten thousand of them take no minute.
const AT_ONCE: usize = 64;

/// `DeleteOptions`.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct Options {
    grace_period_seconds: Option<i64>,
    propagation_policy: Option<String>,
    #[serde(deserialize_with = "or_default")]
    preconditions: Preconditions,
    #[serde(deserialize_with = "or_default")]
    dry_run: Vec<String>,
}

/// What is null is as good as left out.
fn or_default<'de, D: Deserializer<'de>, T: Deserialize<'de> + Default>(
    from: D,
) -> Result<T, D::Error> {
    Option::deserialize(from).map(Option::unwrap_or_default)
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct Preconditions {
    uid: Option<String>,
    resource_version: Option<String>,
}

/// Whether the object must wait for somebody to confirm that what it stands for is over: a Task that was given to a
/// node and has not ended.
#[must_use]
pub fn is_held(resource: Resource, object: &Value) -> bool {
    if resource.as_str() != "tasks" {
        return false;
    }
    let status = &object["status"];
    let given = status["node"].as_str().is_some_and(|node| !node.is_empty());
    let phase = serde_json::from_value::<TaskPhase>(status["phase"].clone());
    given && !phase.is_ok_and(TaskPhase::is_terminal)
}

/// Whether the object ends already, and it is for others to do something before it goes: to delete it once more is of no use.
#[must_use]
pub fn waits_for_others(stored: &Stored) -> bool {
    if !stored.mentions("deletionTimestamp") {
        return false;
    }
    let object = stored.value();
    let waits = metadata::has_finalizers(&object) || is_held(stored.key.resource, &object);
    metadata::is_ending(&object) && waits
}

/// Whether the object ends, nobody has anything to do before it goes, and it is there all the same: something kept it from
/// going. A Task's reconciler, and a Namespace's, look after their own.
#[must_use]
pub fn is_left_over(stored: &Stored) -> bool {
    let resource = stored.key.resource;
    if resource == objects::TASKS || super::namespace::is_ours_to_end(resource) {
        return false;
    }
    let object = stored.value();
    metadata::is_ending(&object) && !metadata::has_finalizers(&object)
}

/// Deletes an object in this process, as a client's DELETE does: at once where nobody has to confirm anything.
/// Returns the last state, or the state with its `deletionTimestamp`.
///
/// # Errors
/// What a client would be told.
pub async fn delete_object(context: &Context, key: &Key) -> Result<Arc<Stored>, Failure> {
    delete_with_grace(context, key, None).await
}

/// As [`delete_object`], if the object is still what `seen` shows.
///
/// # Errors
/// What a client would be told: 409 when it has changed.
pub(crate) async fn delete_as_seen(context: &Context, seen: &Stored) -> Result<(), Failure> {
    let entry = super::registry::of(seen.key.resource)
        .ok_or_else(|| Failure::internal(format!("{} is not served", seen.key.resource)))?;
    let preconditions = Preconditions {
        uid: Some(seen.uid.to_string()),
        resource_version: Some(seen.revision.to_string()),
    };
    let options = Options { preconditions, ..Options::default() };
    end(context, entry, &seen.key, &options).await.map(drop)
}

/// As [`delete_object`], with the grace period that a client would name, seconds.
///
/// # Errors
/// What a client would be told.
pub(crate) async fn delete_with_grace(
    context: &Context,
    key: &Key,
    grace_period_seconds: Option<i64>,
) -> Result<Arc<Stored>, Failure> {
    let entry = super::registry::of(key.resource)
        .ok_or_else(|| Failure::internal(format!("{} is not served", key.resource)))?;
    let options = Options { grace_period_seconds, ..Options::default() };
    match end(context, entry, key, &options).await? {
        Ended::Gone(stored) | Ended::Waiting(stored) => Ok(stored),
    }
}

/// What else must hold for an object to be ended, looked at anew before each try: a condition for the transaction, none, or
/// why it is not ended.
pub(super) type Guard<'a> = dyn Fn(&Stored) -> Result<Option<Op>, Failure> + Sync + 'a;

/// Ends this object and no other of its name, as long as the guard lets it.
pub(super) async fn end_this(
    context: &Context,
    stored: &Stored,
    grace_period_seconds: Option<i64>,
    guard: &Guard<'_>,
) -> Result<(), Failure> {
    let entry = super::registry::of(stored.key.resource)
        .ok_or_else(|| Failure::internal(format!("{} is not served", stored.key.resource)))?;
    let uid = Some(stored.uid.to_string());
    let preconditions = Preconditions { uid, ..Preconditions::default() };
    let options = Options { grace_period_seconds, preconditions, ..Options::default() };
    end_guarded(context, entry, &stored.key, &options, guard).await.map(drop)
}

/// The deletion of an object as a part of a transaction: at once where nobody has to confirm anything, else the wish.
pub(crate) fn operation(now: Timestamp, present: &Stored) -> Op {
    let (object, key) = (present.value(), present.key.clone());
    let waits = metadata::has_finalizers(&object) || is_held(key.resource, &object);
    if !waits && !super::namespace::is_ours_to_end(key.resource) {
        return Op::remove(key, present.revision);
    }
    Op::replace(key, wish(now, &object, &Options::default(), None), present.revision)
}

pub(super) async fn delete(call: Call, target: Object) -> Answer {
    let (context, options) = read(call).await?;
    let key = target.key()?;
    let ended = end(&context, target.entry, &key, &options).await?;
    Ok(match ended {
        Ended::Waiting(stored) => super::raw(StatusCode::OK, target.entry.render(&stored)),
        Ended::Gone(stored) => gone(target.entry, &stored),
    })
}

pub(super) async fn collection(call: Call, target: Object) -> Answer {
    let selection = Selection::read(target.entry, target.namespace.as_deref(), &call.query)?;
    let (context, options) = read(call).await?;
    let snapshot = context.store.list(target.entry.resource, target.namespace.as_deref());
    let (items, _) = list::select(&selection, snapshot.items, None).await;
    let (of, with) = (&*context, &options);
    let end = |stored: Arc<Stored>| async move {
        match end(of, target.entry, &stored.key, with).await {
            Ok(_) => Ok(Some(named(target.entry, &stored))),
            // Gone: somebody else was faster.
            Err(failure) if failure.code() == 404 => Ok(None),
            Err(failure) => Err(failure),
        }
    };
    // Every one is tried, and the first refusal is told.
    let mut ends = stream::iter(items.clone()).map(end).buffer_unordered(AT_ONCE);
    let (mut ended, mut refused) = (Vec::new(), None);
    while let Some(one) = ends.next().await {
        match one {
            Ok(one) => ended.extend(one),
            Err(failure) => refused = refused.or(Some(failure)),
        }
    }
    drop(ends);
    if let Some(refused) = refused {
        return Err(refused.having_ended(ended));
    }
    let revision = context.store.revision().to_string();
    list::answer(&context, (&revision, ""), items, (Form::Whole, target.entry)).await
}

fn named(entry: &Entry, stored: &Stored) -> Named {
    Named {
        kind: Some(entry.info.kind.to_owned()),
        namespace: stored.key.namespace().map(str::to_owned),
        name: Some(stored.key.name.to_string()),
        uid: Some(stored.uid.to_string()),
    }
}

async fn read(call: Call) -> Result<(Arc<Context>, Options), Failure> {
    let Call { context, query, request, .. } = call;
    let dry = query.dry_run()?;
    let (parts, body) = request.into_parts();
    let body = body::optional_json(&parts.headers, body).await?;
    let mut options: Options = match body {
        Value::Null => Options::default(),
        body => serde_json::from_value(body)
            .map_err(|error| Failure::bad_request(format!("DeleteOptions: {error}")))?,
    };
    if let Some(grace) = query.parse("gracePeriodSeconds")? {
        options.grace_period_seconds = Some(grace);
    }
    if let Some(policy) = query.text("propagationPolicy") {
        options.propagation_policy = Some(policy.to_owned());
    }
    if dry {
        options.dry_run = vec!["All".to_owned()];
    }
    if options.grace_period_seconds.is_some_and(|grace| grace < 0) {
        return Err(Failure::bad_request("gracePeriodSeconds must not be negative"));
    }
    match options.propagation_policy.as_deref() {
        None | Some("Background" | "Foreground" | "Orphan") => Ok((context, options)),
        Some(other) => Err(Failure::bad_request(format!(
            "propagationPolicy: {other:?} is not Background, Foreground or Orphan"
        ))),
    }
}

enum Ended {
    /// The last state.
    Gone(Arc<Stored>),
    /// It has its `deletionTimestamp` and waits.
    Waiting(Arc<Stored>),
}

async fn end(
    context: &Context,
    entry: &'static Entry,
    key: &Key,
    options: &Options,
) -> Result<Ended, Failure> {
    end_guarded(context, entry, key, options, &|_| Ok(None)).await
}

async fn end_guarded(
    context: &Context,
    entry: &'static Entry,
    key: &Key,
    options: &Options,
    guard: &Guard<'_>,
) -> Result<Ended, Failure> {
    let name = &*key.name;
    if entry.info.kind == "Namespace" && name == muster_api::kind::namespace::DEFAULT {
        return Err(Failure::denied(format!(
            "namespaces {name:?} is forbidden: this namespace may not be deleted"
        ))
        .about(entry, name));
    }
    // A node must not come back, nor take a task from a session that begins, while this is decided.
    let live = context.live().filter(|_| entry.info.kind == "Node");
    let _no_session_begins = match live {
        Some(live) => Some(live.sessions.hold_back().await),
        None => None,
    };
    // And none is given to it.
    let _nothing_is_placed = match live {
        Some(_) => Some(context.placing.write().await),
        None => None,
    };
    loop {
        let Some(present) = context.store.get(key) else {
            match context.store.apply(vec![objects::absent(key)]).await {
                Ok(_) => return Err(Failure::not_found(entry, name)),
                // Its creation seemed to fail, or was under way.
                Err(StoreError::AlreadyExists { .. }) => continue,
                Err(error) => return Err(Failure::of_store(entry, name, &error)),
            }
        };
        if entry.info.kind == "Node" {
            refuse_in_use(context, entry, name)?;
            refuse_stopped(entry, &present)?;
        }
        check(entry, &present, &options.preconditions)?;
        let relied_on = guard(&present)?;
        let object = present.value();
        let finalizer = finalizer(options);
        let waits = metadata::has_finalizers(&object)
            || is_held(key.resource, &object)
            || super::namespace::is_ours_to_end(key.resource)
            || finalizer.is_some();
        let wish = waits.then(|| wish(context.clock.now(), &object, options, finalizer));
        if !options.dry_run.is_empty() {
            return Ok(if waits { Ended::Waiting(present) } else { Ended::Gone(present) });
        }
        let (op, ended): (Op, fn(Arc<Stored>) -> Ended) = match wish {
            None => (Op::remove(key.clone(), present.revision), Ended::Gone),
            // It already ends, and no sooner for this.
            Some(wish) if wish == object => return Ok(Ended::Waiting(present)),
            Some(wish) => (Op::replace(key.clone(), wish, present.revision), Ended::Waiting),
        };
        let ops: Vec<Op> = relied_on.into_iter().chain([op]).collect();
        match context.store.apply(ops).await {
            Ok(mut stored) => {
                // A condition changes nothing, so there is one change.
                let ended = ended(stored.pop().unwrap_or(present));
                // Its agent's session ends at once, and its certificate admits it no more.
                if let (Some(live), Ok(name)) = (live, NodeName::new(name)) {
                    live.sessions.kick(&name);
                }
                return Ok(ended);
            }
            Err(StoreError::Conflict { .. }) => {}
            // What was relied on came or went meanwhile.
            Err(StoreError::AlreadyExists { key: other } | StoreError::NotFound { key: other })
                if other != *key => {}
            Err(error) => return Err(Failure::of_store(entry, name, &error)),
        }
    }
}

/// 409 while tasks hold resources of a node: without the object nobody could end them.
fn refuse_in_use(context: &Context, entry: &Entry, node: &str) -> Result<(), Failure> {
    let holding = objects::tasks_holding(&context.store, node);
    if holding.is_empty() {
        return Ok(());
    }
    let names: Vec<String> = holding
        .iter()
        .map(|(stored, _)| {
            format!("{}/{}", stored.key.namespace().unwrap_or_default(), stored.key.name)
        })
        .collect();
    let why = format!(
        "node {node} is in use, {} on it: {}; end them first (`muster drain {node}`, or `muster node fence {node}` when the node is off)",
        if names.len() == 1 { "a task is" } else { "tasks are" },
        names.join(", ")
    );
    Err(Failure::new(StatusCode::CONFLICT, "NodeInUse", why).about(entry, node))
}

/// 409 while a person has stopped the robot: without the object nobody demands that any more, and it would move.
fn refuse_stopped(entry: &Entry, present: &Stored) -> Result<(), Failure> {
    let tier = objects::read::<Node>(present).map_or(EStopTier::None, |node| node.spec.estop);
    if tier.is_none() {
        return Ok(());
    }
    let name = &*present.key.name;
    let why = format!(
        "node {name} is stopped ({tier}), and would move again without its object; release it first (`muster estop {name} --release`)"
    );
    Err(Failure::new(StatusCode::CONFLICT, "NodeStopped", why).about(entry, name))
}

/// Who has to act before the object goes, because of how it is deleted.
fn finalizer(options: &Options) -> Option<&'static str> {
    match options.propagation_policy.as_deref() {
        Some("Foreground") => Some("foregroundDeletion"),
        Some("Orphan") => Some("orphan"),
        _ => None,
    }
}

fn check(entry: &Entry, present: &Stored, preconditions: &Preconditions) -> Result<(), Failure> {
    let name = &*present.key.name;
    if let Some(uid) = &preconditions.uid
        && **uid != *present.uid
    {
        let why = format!(
            "Precondition failed: UID in precondition: {uid}, UID in object meta: {}",
            present.uid
        );
        return Err(Failure::conflict(entry, name, why));
    }
    if let Some(version) = &preconditions.resource_version
        && *version != present.revision.to_string()
    {
        let why = format!(
            "Precondition failed: ResourceVersion in precondition: {version}, ResourceVersion in object meta: {}",
            present.revision
        );
        return Err(Failure::conflict(entry, name, why));
    }
    Ok(())
}

/// The object with the wish that it goes.
fn wish(now: Timestamp, object: &Value, options: &Options, finalizer: Option<&str>) -> Value {
    let mut object = object.clone();
    let (asked, own) = if object["kind"] == "Task" {
        let own = object["spec"]["gracePeriodSeconds"].as_i64();
        (options.grace_period_seconds, own.unwrap_or_else(|| DEFAULT_GRACE_SECONDS.into()))
    } else {
        // Nothing of it runs.
        (options.grace_period_seconds.map(|_| 0), 0)
    };
    let present = object["metadata"]["deletionTimestamp"].as_str();
    let present = present.and_then(|text| text.parse::<Timestamp>().ok());
    if let Some(Deletion { at, grace }) = deletion(now, asked, own, present) {
        let text = at.strftime("%Y-%m-%dT%H:%M:%SZ").to_string();
        object["metadata"]["deletionTimestamp"] = text.into();
        object["metadata"]["deletionGracePeriodSeconds"] = grace.into();
        super::namespace::terminate(&mut object);
    }
    if let Some(finalizer) = finalizer.filter(|_| present.is_none()) {
        let mut list = object["metadata"]["finalizers"].as_array().cloned().unwrap_or_default();
        if !list.iter().any(|present| present == finalizer) {
            list.push(finalizer.into());
        }
        object["metadata"]["finalizers"] = list.into();
    }
    object
}

fn gone(entry: &Entry, stored: &Stored) -> Response {
    let status = json!({
        "kind": "Status",
        "apiVersion": "v1",
        "metadata": {},
        "status": "Success",
        "details": {
            "name": &*stored.key.name,
            "group": entry.info.group,
            "kind": entry.info.plural,
            "uid": &*stored.uid,
        },
    });
    super::json(StatusCode::OK, &status)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::store::memory;

    #[tokio::test]
    async fn what_is_not_found_is_not_on_the_disk_either() {
        let dir = tempfile::tempdir().expect("a directory");
        let (store, failures) = memory::start_failing().await;
        let context = crate::context::for_tests(dir.path(), store);
        let key = Key::namespaced(Resource::new("configmaps"), "default", "m");
        failures.mislead_next(1);
        let value = json!({"metadata": {"name": "m", "namespace": "default", "uid": "u"}});
        context.store.create(key.clone(), value).await.expect_err("it seems to fail");
        let gone = delete_object(&context, &key).await.map_err(|failure| failure.code());
        assert_eq!(gone.map(|last| last.uid.to_string()), Ok("u".to_owned()));
        let gone = delete_object(&context, &key).await.map_err(|failure| failure.code());
        assert_eq!(gone.map(drop), Err(404));
    }
}
