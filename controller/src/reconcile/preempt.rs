//! Writes the orders to end that make room for a more important task.
//!
//! The order stands in the victim's status, so that it outlives this process; its agent is told (see
//! [`crate::session::board`]), and the report of its end takes the order's reason.

use std::sync::Arc;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use muster_api::kind::task::{PREEMPTED, PREEMPTING, StopOrder, Task, TaskStatus};
use muster_controller_core::preempt::{Preemption, Victim};

use crate::context::Context;
use crate::objects::{self, TASKS};
use crate::store::{Key, Op, StoreError, Stored};

/// Writes what of a preemption is not written yet, as one transaction. Gives the nominated task as it is written; none:
/// everything was.
pub(super) async fn order(
    context: &Context,
    of: &Arc<Stored>,
    title: &str,
    preemption: &Preemption,
) -> Result<Option<Arc<Stored>>, StoreError> {
    let Some(mut task) = objects::read::<Task>(of) else { return Ok(None) };
    let status = task.status.get_or_insert_default();
    let nominated = status.nominated_node.as_deref() == Some(preemption.node.as_str());
    if nominated && preemption.victims.is_empty() {
        return Ok(None);
    }
    let status = TaskStatus {
        reason: PREEMPTING.to_owned(),
        nominated_node: Some(preemption.node.to_string()),
        ..std::mem::take(status)
    };
    let mut ops = vec![Op::status(of, &status)];
    let mut ended = Vec::new();
    for victim in &preemption.victims {
        if let Some((op, task)) = end(context, victim, (title, task.spec.priority))? {
            ops.push(op);
            ended.push(task);
        }
    }
    let written = context.store.apply(ops).await?.swap_remove(0);
    let node = &preemption.node;
    tracing::info!(task = title, %node, victims = ended.len(), "room is made by preemption");
    metrics::counter!("muster_preemptions_total").increment(ended.len() as u64);
    for victim in &ended {
        context.events.ordered_to_end(victim, PREEMPTED);
    }
    Ok(Some(written))
}

/// The order for one victim; none: it has ended, or has one.
///
/// # Errors
///
/// When it has become as important meanwhile: who ends is to be decided anew, for all of them.
fn end(
    context: &Context,
    victim: &Victim,
    (title, priority): (&str, i32),
) -> Result<Option<(Op, Task)>, StoreError> {
    let Some((namespace, name)) = victim.title.split_once('/') else { return Ok(None) };
    let key = Key::namespaced(TASKS, namespace, name);
    let stored = context.store.get(&key).filter(|stored| *stored.uid == *victim.uid.as_str());
    let Some(stored) = stored else { return Ok(None) };
    let Some(mut task) = objects::read::<Task>(&stored) else { return Ok(None) };
    let own = task.spec.priority;
    if own >= priority {
        let actual = stored.revision;
        return Err(StoreError::Conflict { key, expected: actual, actual });
    }
    let Some(status) = task.status.as_mut() else { return Ok(None) };
    if !status.phase.holds_node() || status.stop.is_some() {
        return Ok(None);
    }
    status.stop = Some(StopOrder {
        reason: PREEMPTED.to_owned(),
        message: format!("makes room for {title}, of priority {priority}; its own is {own}"),
        at: MicroTime(context.clock.now()),
    });
    let op = objects::replace(&stored, &task);
    Ok(Some((op, task)))
}
