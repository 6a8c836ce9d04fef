//! When the time of a task has come that has `activeDeadlineSeconds` or `ttlSecondsAfterFinished`.
//!
//! Kubernetes' rules, of a Pod and of a Job, but for the start: a task's time counts from its placement, since it holds
//! its robot from then on. As with a Job, it is one time for all the nodes that are tried, and for the waits between them.

use jiff::{SignedDuration, Timestamp};
use muster_api::kind::task::Task;

/// What becomes of a task when its time has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Due {
    /// It has been on its node long enough, or on several, and is to end; one that waits for the next has nothing to end.
    Stop(Timestamp),
    /// It ended long ago.
    Remove(Timestamp),
}

impl Due {
    /// When.
    #[must_use]
    pub fn at(self) -> Timestamp {
        match self {
            Due::Stop(at) | Due::Remove(at) => at,
        }
    }
}

/// What waits for a task, and when; none: nothing.
#[must_use]
pub fn due(task: &Task) -> Option<Due> {
    let status = task.status.as_ref()?;
    let after = |from: Timestamp, seconds: u32| {
        from.checked_add(SignedDuration::from_secs(i64::from(seconds))).ok()
    };
    if task.metadata.deletion_timestamp.is_some() {
        return None;
    }
    let bound = status.bound_at.as_ref().map(|at| at.0);
    if status.phase.is_terminal() {
        if !task.outlook().is_over() {
            // Another node is about to be tried.
            return None;
        }
        // Its end is told by the node's clock, which may be wrong: it was not before its placement. One that was fenced
        // before it started has no end of its own.
        let ended = status.finished_at.as_ref().map(|at| at.0).max(bound)?;
        return after(ended, task.spec.ttl_seconds_after_finished?).map(Due::Remove);
    }
    if status.stop.is_some() {
        return None;
    }
    // One that was never placed has neither.
    let first = status.first_bound_at.as_ref().map(|at| at.0).or(bound);
    after(first?, task.spec.active_deadline_seconds?).map(Due::Stop)
}
