//! Removes tasks that are being deleted, once nothing of them runs any more.
//!
//! A delete of a placed task only marks it. Its agent is told to stop it (see
//! [`crate::session::board`]), reports the end after the last process is gone, and then the object
//! goes here, if no finalizer holds it.

use std::collections::BTreeSet;
use std::sync::Arc;

use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;

use super::{again, next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, TASKS};
use crate::store::{Change, Key, Op, StoreError};

/// Works until dropped.
pub async fn run(context: Arc<Context>) {
    again(&context, "deleted tasks are not removed yet", follow).await;
}

/// Looks at every task, then at what changes; ends when it must begin anew.
async fn follow(context: &Context) -> Result<(), StoreError> {
    let mut watcher = watch_from_now(&context.store).await;
    for stored in
        context.store.list(TASKS, None).items.iter().filter(|s| s.mentions("deletionTimestamp"))
    {
        consider(context, &stored.key).await?;
    }
    while let Some(events) = next_events(&mut watcher).await {
        let keys: BTreeSet<Key> = events
            .iter()
            .filter(|e| {
                e.change == Change::Put
                    && e.object.key.resource == TASKS
                    && e.object.mentions("deletionTimestamp")
            })
            .map(|e| e.object.key.clone())
            .collect();
        for key in keys {
            consider(context, &key).await?;
        }
    }
    Ok(())
}

async fn consider(context: &Context, key: &Key) -> Result<(), StoreError> {
    objects::change_watched(&context.store, key, |stored, task: Task| {
        let phase = task.status.as_ref().map_or(TaskPhase::Pending, |s| s.phase);
        let over = phase.is_terminal() || phase == TaskPhase::Pending;
        let deleting = task.metadata.deletion_timestamp.is_some();
        let held = task.metadata.finalizers.as_ref().is_some_and(|f| !f.is_empty());
        (deleting && over && !held).then(|| vec![Op::remove(stored.key.clone(), stored.revision)])
    })
    .await
    .map(drop)
}
