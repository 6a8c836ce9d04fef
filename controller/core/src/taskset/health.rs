//! Whether a task is ready, available, or has failed its template. The one place that probes plug into.
//!
//! A task is *ready* when it runs and its probes, if it has some, say so; *available* when it has been that for
//! `minReadySeconds` as well. The time it runs is by its node's clock, so a clock that is ahead makes it available late;
//! with `minReadySeconds: 0` no clock is looked at.

use std::fmt;
use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::task::reschedule::OUT_OF_RANGE;
use muster_api::kind::task::{DEADLINE_EXCEEDED, NODE_MAINTENANCE, PREEMPTED, PREEMPTING};
use muster_api::phase::TaskPhase;

use super::after;
use super::view::{NodeView, TaskView};

/// How well a task is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Health {
    /// It serves.
    Available,
    /// It runs and is ready, and serves from then on.
    Ready {
        /// When.
        available_at: Timestamp,
    },
    /// It does not serve.
    NotReady,
}

/// How well a task is as of `now`.
#[must_use]
pub fn health(task: &TaskView, min_ready: Duration, now: Timestamp) -> Health {
    if task.phase != TaskPhase::Running || task.ready == Some(false) {
        return Health::NotReady;
    }
    let runs_since = task.started.unwrap_or(task.created);
    let since = task.ready_since.map_or(runs_since, |ready| ready.max(runs_since));
    let available_at = after(since, min_ready);
    if min_ready.is_zero() || available_at <= now {
        Health::Available
    } else {
        Health::Ready { available_at }
    }
}

/// What a task did that its template is blamed for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fault {
    /// Its program ended, or could not be started.
    Crashed {
        /// What its node says about it.
        message: String,
    },
    /// It runs, and its probes did not say that it is ready in time.
    ProbeFailed {
        /// How long it had, seconds.
        deadline: u64,
        /// What the probe said.
        message: String,
    },
    /// It was not begun, because its node did not have its image in time.
    ImageNotThere {
        /// The image.
        image: String,
        /// The node.
        node: String,
        /// How long there was, seconds.
        deadline: u64,
        /// Why the last pull failed; empty: none has.
        message: String,
    },
    /// It did not get as far as running in time.
    DeadlineExceeded {
        /// How long it had, seconds.
        deadline: u64,
        /// Where it was then.
        phase: TaskPhase,
        /// What is said about that.
        message: String,
    },
}

impl Fault {
    /// The fault as one word, for programs.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        match self {
            Fault::Crashed { .. } => "Crashed",
            Fault::ProbeFailed { .. } => "ProbeFailed",
            Fault::ImageNotThere { .. } => "ImagePullFailed",
            Fault::DeadlineExceeded { .. } => "ProgressDeadlineExceeded",
        }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Fault::Crashed { message } if message.is_empty() => f.write_str("ended by itself"),
            Fault::Crashed { message } => write!(f, "crashed: {message}"),
            Fault::ProbeFailed { deadline, message } => {
                write!(f, "ran and was not ready within {deadline} s")?;
                if message.is_empty() { Ok(()) } else { write!(f, ": {message}") }
            }
            Fault::ImageNotThere { image, node, deadline, message } => {
                write!(f, "was left as it was: {node} did not have {image} within {deadline} s")?;
                if message.is_empty() { Ok(()) } else { write!(f, ": {message}") }
            }
            Fault::DeadlineExceeded { deadline, phase, message } => {
                write!(f, "was still {phase} after {deadline} s")?;
                if message.is_empty() { Ok(()) } else { write!(f, ": {message}") }
            }
        }
    }
}

/// Ends that say nothing about the template: somebody else brought them about.
const NOT_ITS_FAULT: [&str; 11] = [
    PREEMPTED,
    OUT_OF_RANGE,
    NODE_MAINTENANCE,
    DEADLINE_EXCEEDED,
    "NodeFenced",
    "Disconnected",
    "NodeRebooted",
    "ShimLost",
    "ContainerLost",
    "Stopped",
    "AssignmentUnreadable",
];

/// What a task of a new template did wrong as of `now`. `node`: where it is or waits to be.
#[must_use]
pub fn fault(
    task: &TaskView,
    node: Option<&NodeView>,
    deadline: Duration,
    now: Timestamp,
) -> Option<Fault> {
    use TaskPhase::{Bound, Failed, Pending, Running, Starting, Stopping, Succeeded, Unknown};
    let crashed = || Some(Fault::Crashed { message: task.message.clone() });
    match task.phase {
        // It is ending, or nobody knows.
        Stopping | Unknown => return None,
        Failed | Succeeded if NOT_ITS_FAULT.contains(&task.reason.as_str()) => return None,
        Failed | Succeeded => return crashed(),
        // Back-off follows a crash and a start that failed; an attempt after one that exited, a crash that is over.
        Starting if task.reason == "BackOff" => return crashed(),
        // What that one says is not how the one before it ended.
        Starting | Running if task.attempt > 1 && task.exited.is_some() => {
            return Some(Fault::Crashed { message: task.exited.clone().unwrap_or_default() });
        }
        Starting | Running | Bound | Pending => {}
    }
    if is_excused(task) || due(task, node, deadline) > now {
        return None;
    }
    let deadline = deadline.as_secs();
    match task.phase {
        Running if task.ready == Some(false) => {
            Some(Fault::ProbeFailed { deadline, message: task.message.clone() })
        }
        // It may be young: its node was away for long.
        Running => None,
        phase => Some(Fault::DeadlineExceeded { deadline, phase, message: task.message.clone() }),
    }
}

/// Until when a task has time to become available. While its node could not be reached it had none.
#[must_use]
pub fn due(task: &TaskView, node: Option<&NodeView>, deadline: Duration) -> Timestamp {
    let begun = task.bound.unwrap_or(task.created);
    after(node.and_then(|n| n.ready_since).map_or(begun, |ready| ready.max(begun)), deadline)
}

/// Refusals because another task is there.
const TAKEN: [&str; 5] = ["LeaseHeld", "Apart", "KeptForAnother", "LeftToFramework", PREEMPTING];
/// Refusals because the node takes nothing now.
const SHUT: [&str; 4] = ["NotReady", "Cordoned", "OutOfService", "BatteryLow"];

/// It has no place and gets none before another task ends: it never had one, or another task was faster. One that was
/// just created may be placed at once, and one whose node is away goes back there.
#[must_use]
pub fn is_stranded(task: &TaskView) -> bool {
    let taken = task.refusal.as_ref().is_some_and(|r| TAKEN.contains(&r.as_str()));
    task.phase == TaskPhase::Pending && (task.prefer.is_none() || taken)
}

/// It waits for something that its template has nothing to do with: a first place, a node that was taken from it, or a task
/// that it depends on.
#[must_use]
pub fn is_excused(task: &TaskView) -> bool {
    if task.phase == TaskPhase::Starting && task.reason == "AwaitingDependency" {
        return true;
    }
    let others = |r: &String| TAKEN.iter().chain(&SHUT).any(|word| r == word);
    let blamed = task.refusal.as_ref().is_some_and(|r| !others(r));
    task.phase == TaskPhase::Pending && !blamed
}
