//! What an agent says of a task → the Task object, and the lease that ends with it.
//!
//! A report is the whole state. It is applied when its sequence is newer than what is written, so a
//! repeated one changes nothing; it is acknowledged after it is durable. The end of a task and the
//! end of its lease are one transaction: the agent says "ended" only after the kernel showed that no
//! process is left (invariant 1).

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use muster_api::kind::task::{LIVENESS_FAILED, NOT_READY, STARTUP_FAILED, Task, TaskStatus};
use muster_api::name::NodeName;
use muster_api::phase::TaskPhase;
use muster_api::wire::WireError;
use muster_api::wire::agent::v1 as wire;
use muster_api::wire::agent_session::{phase_from_wire, timestamp_from_wire};

use super::Sessions;
use crate::context::Context;
use crate::objects;
use crate::store::StoreError;

/// What an agent says of a task that ended because it was told to.
const STOPPED: &str = "Stopped";

/// Why a report is not applied.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ReportError {
    #[error("a task report means nothing")]
    Wire(#[from] WireError),
    #[error("a task report is not written")]
    Store(#[from] StoreError),
}

/// Applies a report of an agent; returns when it is durable, or was already, or is about a task that
/// is not this node's.
pub(crate) async fn apply(
    context: &Context,
    sessions: &Sessions,
    node: &NodeName,
    report: &wire::TaskReport,
) -> Result<(), ReportError> {
    let phase = phase_from_wire(report.phase)?;
    let started = report
        .started_at
        .as_ref()
        .map(|t| timestamp_from_wire("task.started_at", t))
        .transpose()?;
    let finished = report
        .finished_at
        .as_ref()
        .map(|t| timestamp_from_wire("task.finished_at", t))
        .transpose()?;
    let Some((placed_on, key)) = sessions.board().find(&report.uid) else { return Ok(()) };
    if placed_on != *node {
        tracing::warn!(uid = report.uid, %node, %placed_on, "a report about another node's task is ignored");
        return Ok(());
    }
    let mut told = None;
    objects::change(&context.store, &key, |stored, mut task: Task| {
        told = None;
        let status = task.status.get_or_insert_default();
        if *stored.uid != *report.uid || !is_news(status, phase, report.sequence) {
            return None;
        }
        let before = status.clone();
        status.phase = phase;
        status.attempt = report.attempt;
        status.exit_code = report.exit_code;
        status.signal = report.signal;
        status.reason.clone_from(&report.reason);
        status.message.clone_from(&report.message);
        status.started_at.clone_from(&started);
        status.finished_at.clone_from(&finished);
        status.report_sequence = report.sequence;
        status.failed_attempts = report.failed_attempts;
        status.set_ready(report.ready, MicroTime(context.clock.now()));
        // One that was finished, or failed, before the order came to it has an end of its own.
        let by_order = phase.is_terminal() && report.reason == STOPPED;
        if let Some(stop) = status.stop.clone().filter(|_| by_order) {
            status.phase = TaskPhase::Failed;
            (status.reason, status.message) = (stop.reason, stop.message);
        }
        let lease = status.lease.clone().filter(|_| phase.is_terminal());
        let mut ops = vec![objects::replace(stored, &task)];
        ops.extend(
            lease.and_then(|l| objects::release_lease(&context.store, &l.name, &stored.uid)),
        );
        told = Some((before, task));
        Some(ops)
    })
    .await?;
    if let Some((before, task)) = told {
        tell(context, &before, &task);
    }
    Ok(())
}

/// Whether a report says something that is not written yet. A task that was lost with its node is
/// told again by a report that was applied before. An end stays as it was written first: what an agent
/// says of the end of a task that a person fenced is not why it ended.
fn is_news(status: &TaskStatus, phase: TaskPhase, sequence: u64) -> bool {
    let newer = sequence > status.report_sequence;
    let again = sequence == status.report_sequence && status.phase == TaskPhase::Unknown;
    (newer || again) && !status.phase.is_terminal() && status.phase.may_become(phase)
}

/// Puts what a person should see into an Event.
fn tell(context: &Context, before: &TaskStatus, task: &Task) {
    let Some(status) = &task.status else { return };
    tell_probes(context, before, status, task);
    let message = if status.message.is_empty() {
        format!("{}", status.phase)
    } else {
        status.message.clone()
    };
    match status.phase {
        TaskPhase::Running if before.phase != TaskPhase::Running => {
            context.events.task(task, "Started", format!("attempt {} runs", status.attempt));
        }
        TaskPhase::Succeeded => context.events.task(task, "Completed", message),
        TaskPhase::Failed => {
            context.events.warn_task(task, "Failed", format!("{}: {message}", status.reason))
        }
        TaskPhase::Starting if status.attempt > 1 => {
            context.events.warn_task(task, "Restarting", message)
        }
        _ => {}
    }
}

/// What its probes say that they did not say before.
fn tell_probes(context: &Context, before: &TaskStatus, status: &TaskStatus, task: &Task) {
    let events = &context.events;
    let is_news = |reason: &str| status.reason == reason && before.reason != reason;
    if is_news(LIVENESS_FAILED) {
        events.warn_task(task, LIVENESS_FAILED, status.message.clone());
    } else if is_news(STARTUP_FAILED) {
        events.warn_task(task, STARTUP_FAILED, status.message.clone());
    }
    match (status.ready, before.ready) {
        (Some(true), Some(false) | None) => {
            events.task(task, "Ready", format!("attempt {} is ready", status.attempt));
        }
        // One that ends is not ready either, and its end is told.
        (Some(false), Some(true)) if status.phase == TaskPhase::Running => {
            events.warn_task(task, NOT_READY, status.message.clone());
        }
        _ => {}
    }
}

/// After a session began: tasks that were lost with the node and of which the agent said nothing are
/// placed and not started yet.
pub(crate) async fn unsaid(
    context: &Context,
    sessions: &Sessions,
    node: &NodeName,
) -> Result<(), StoreError> {
    for key in sessions.board().tasks_on(node) {
        objects::change(&context.store, &key, |stored, mut task: Task| {
            let status = task.status.get_or_insert_default();
            if status.phase != TaskPhase::Unknown || status.node.as_deref() != Some(node.as_str()) {
                return None;
            }
            status.phase = TaskPhase::Bound;
            status.reason = "NodeReturned".to_owned();
            status.message =
                "the node is back and has not said anything of the task yet".to_owned();
            Some(vec![objects::replace(stored, &task)])
        })
        .await?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status(phase: TaskPhase, report_sequence: u64) -> TaskStatus {
        TaskStatus { phase, report_sequence, ..TaskStatus::default() }
    }

    #[test]
    fn a_report_is_applied_once() {
        use TaskPhase::{Failed, Running, Succeeded, Unknown};
        assert!(is_news(&status(Running, 3), Running, 4));
        assert!(!is_news(&status(Running, 3), Running, 3));
        assert!(!is_news(&status(Running, 3), Running, 2));
        assert!(
            is_news(&status(Unknown, 3), Running, 3),
            "a node that comes back says the same again"
        );
        assert!(!is_news(&status(Succeeded, 3), Failed, 9), "an end stays");
        assert!(!is_news(&status(Failed, 3), Failed, 9), "and so does why");
    }
}
