//! Frameworks that are away: what they have stays until their failover timeout has passed, then they are removed, and the
//! collector of garbage ends their tasks.
//!
//! Also: a framework that is gone acknowledges nothing any more, so its tasks lose the finalizer that waits for it; and the
//! numbers in Framework status are brought up to date here, a few seconds late.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use muster_api::kind::framework::Framework;
use tokio::time::{MissedTickBehavior, interval};

use super::desk::View;
use crate::context::Context;
use crate::objects::{self, FRAMEWORKS};
use crate::session::frameworks::{Frameworks, let_go, write_away};
use crate::store::{Key, StoreError};

/// How often everything is looked at. A failover timeout is exact to this; the numbers are as old as this.
const EVERY: Duration = Duration::from_secs(1);
/// A changed share is written when it differs by this: a number that moves with every task would write without end.
const SHARE_STEP: f64 = 0.01;

/// Works until dropped.
pub async fn run(context: Arc<Context>, frameworks: Arc<Frameworks>) {
    let mut tick = interval(EVERY);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tick.tick().await;
        if let Err(error) = look(&context, &frameworks).await {
            // The next look does it again.
            tracing::warn!(error = crate::app::chain(&error), "frameworks are not looked after");
        }
    }
}

async fn look(context: &Context, frameworks: &Frameworks) -> Result<(), StoreError> {
    // Before the objects: who is at the desk and has no object then has none any more.
    let views = frameworks.look().await;
    let mut present = BTreeSet::new();
    for stored in context.store.list(FRAMEWORKS, None).items {
        let Some(object) = objects::read::<Framework>(&stored) else { continue };
        present.insert(stored.uid.clone());
        if !frameworks.is_connected(&stored.uid) {
            consider_absent(context, &stored.key, &stored.uid, &object).await?;
        }
    }
    let tasks = frameworks.roster().holding();
    for view in &views {
        let key = Key::namespaced(FRAMEWORKS, view.namespace.as_str(), view.name.as_str());
        if present.contains(&*view.uid) {
            let held = tasks.get(&view.uid).copied().unwrap_or_default();
            write_view(context, &key, view, held).await?;
        } else {
            tracing::info!(framework = %key, "framework is gone");
            frameworks.cut(&view.uid);
            frameworks.remove(&view.uid).await;
        }
    }
    let orphans = frameworks.roster().orphans(|uid| present.contains(uid));
    if orphans.is_empty() {
        return Ok(());
    }
    // Looked at again after the tasks: a framework that came meanwhile may have launched some already.
    let items = context.store.list(FRAMEWORKS, None).items;
    let present: BTreeSet<&str> = items.iter().map(|stored| stored.uid.as_ref()).collect();
    for (key, uid, framework) in orphans {
        // Nobody is left to acknowledge its end.
        if framework.is_none_or(|framework| !present.contains(&*framework)) {
            let_go(&context.store, &key, &uid).await?;
        }
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
