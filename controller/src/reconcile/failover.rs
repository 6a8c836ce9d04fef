//! Frameworks that are away: what they have stays until their failover timeout has passed, then they are removed, and the
//! collector of garbage ends their tasks.
//!
//! Also: a framework that is gone acknowledges nothing any more, so its tasks lose the finalizer that waits for it; and the
//! numbers in Framework status are brought up to date here, a few seconds late.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use muster_api::kind::framework::{ACKNOWLEDGE_FINALIZER, Framework};
use muster_api::kind::task::Task;
use tokio::time::{MissedTickBehavior, interval};

use super::desk::View;
use crate::context::Context;
use crate::objects::{self, FRAMEWORKS, TASKS};
use crate::session::frameworks::{Frameworks, let_go, owner_of, write_away};
use crate::store::{Key, StoreError};

/// How often everything is looked at. A failover timeout is exact to this; the numbers are as old as this.
const EVERY: Duration = Duration::from_secs(1);
/// A changed share is written when it differs by this: a number that moves with every task would write without end.
const SHARE_STEP: f64 = 0.01;

/// Works until dropped.
pub async fn run(context: Arc<Context>, frameworks: Arc<Frameworks>) {
    let mut known: BTreeMap<String, Key> = BTreeMap::new();
    let mut tick = interval(EVERY);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tick.tick().await;
        if let Err(error) = look(&context, &frameworks, &mut known).await {
            // The next look does it again.
            tracing::warn!(error = crate::app::chain(&error), "frameworks are not looked after");
        }
    }
}

async fn look(
    context: &Context,
    frameworks: &Frameworks,
    known: &mut BTreeMap<String, Key>,
) -> Result<(), StoreError> {
    let mut present = BTreeMap::new();
    let mut away = false;
    for stored in context.store.list(FRAMEWORKS, None).items {
        let Some(object) = objects::read::<Framework>(&stored) else { continue };
        present.insert(stored.uid.to_string(), stored.key.clone());
        if frameworks.is_connected(&stored.uid) {
            continue;
        }
        away = true;
        consider_absent(context, &stored.key, &stored.uid, &object).await?;
    }
    for (uid, key) in &*known {
        if !present.contains_key(uid) {
            tracing::info!(framework = %key, "framework is gone");
            frameworks.cut(uid);
            frameworks.remove(uid).await;
        }
    }
    if *known != present || away {
        let_orphans_go(context, &present.keys().map(String::as_str).collect()).await?;
    }
    *known = present;
    if !known.is_empty() {
        write_numbers(context, frameworks).await?;
    }
    Ok(())
}

async fn consider_absent(
    context: &Context,
    key: &Key,
    uid: &str,
    object: &Framework,
) -> Result<(), StoreError> {
    let status = object.status.clone().unwrap_or_default();
    if status.connected {
        // Its session ended with an earlier life of the controller, or could not be written off.
        return write_away(context, key, uid).await;
    }
    let Some(since) = status.disconnected_at else { return Ok(()) };
    let timeout = object.spec.failover_timeout.0.as_duration();
    let gone_for = context.clock.now().duration_since(since.0);
    if gone_for.unsigned_abs() >= timeout && gone_for.is_positive() {
        tracing::info!(framework = %key, ?timeout, "framework did not come back; its tasks are ended");
        if let Err(failure) = crate::rest::delete::delete_object(context, key).await
            && failure.code() != 404
        {
            tracing::warn!(framework = %key, error = failure.message(), "a lost framework is not removed yet");
        }
    }
    Ok(())
}

/// Tasks whose framework is gone wait for nobody's acknowledgement.
async fn let_orphans_go(context: &Context, frameworks: &BTreeSet<&str>) -> Result<(), StoreError> {
    for stored in context.store.list(TASKS, None).items {
        if !stored.mentions(ACKNOWLEDGE_FINALIZER) {
            continue;
        }
        let Some(task) = objects::read::<Task>(&stored) else { continue };
        let owner = owner_of(&task.metadata);
        if owner.is_none_or(|uid| !frameworks.contains(&*uid)) {
            let_go(&context.store, &stored.key, &stored.uid).await?;
        }
    }
    Ok(())
}

async fn write_numbers(context: &Context, frameworks: &Frameworks) -> Result<(), StoreError> {
    let mut tasks: BTreeMap<Arc<str>, u32> = BTreeMap::new();
    for stored in context.store.list(TASKS, None).items {
        if !stored.mentions(muster_api::kind::framework::FRAMEWORK_LABEL) {
            continue;
        }
        let Some(task) = objects::read::<Task>(&stored) else { continue };
        let holds = task.status.as_ref().is_some_and(|s| s.phase.holds_node());
        if let (true, Some(owner)) = (holds, owner_of(&task.metadata)) {
            *tasks.entry(owner).or_default() += 1;
        }
    }
    for view in frameworks.look().await {
        let key = Key::namespaced(FRAMEWORKS, view.namespace.as_str(), view.name.as_str());
        let held = tasks.get(&view.uid).copied().unwrap_or_default();
        write_view(context, &key, &view, held).await?;
    }
    Ok(())
}

async fn write_view(
    context: &Context,
    key: &Key,
    view: &View,
    tasks: u32,
) -> Result<(), StoreError> {
    let offers = u32::try_from(view.offers.len()).unwrap_or(u32::MAX);
    objects::change(&context.store, key, |stored, mut object: Framework| {
        let status = object.status.get_or_insert_default();
        let same = status.offers == offers
            && status.tasks == tasks
            && status.suppressed == view.suppressed
            && (status.share - view.share).abs() < SHARE_STEP;
        if same || *stored.uid != *view.uid {
            return None;
        }
        (status.offers, status.tasks) = (offers, tasks);
        (status.suppressed, status.share) = (view.suppressed, view.share);
        Some(vec![objects::replace(stored, &object)])
    })
    .await
    .map(drop)
}
