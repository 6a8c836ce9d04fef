//! The life of a task as an enum, and which step may follow which.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Where a task is in its life.
#[derive(
    Debug,
    Clone,
    Copy,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    JsonSchema,
)]
pub enum TaskPhase {
    /// Not placed. The scheduler acts: it binds the task or says per node why it cannot.
    #[default]
    Pending,
    /// Placed on a node; its resources and lease are reserved. The node's agent acts.
    Bound,
    /// The agent prepares or starts an attempt (image pull, back-off between attempts included).
    Starting,
    /// A process of the task runs.
    Running,
    /// The task is being ended; processes may still run, and the lease is still held.
    Stopping,
    /// Ended with success; no process is left.
    Succeeded,
    /// Ended without success; no process is left.
    Failed,
    /// The node cannot be reached; what the task does there is not known. Reservation and lease
    /// stay until the node returns or is fenced.
    Unknown,
}

impl TaskPhase {
    /// Succeeded or Failed: nothing will run again under this uid.
    #[must_use]
    pub fn is_terminal(self) -> bool {
        matches!(self, TaskPhase::Succeeded | TaskPhase::Failed)
    }

    /// The task holds resources of a node.
    #[must_use]
    pub fn holds_node(self) -> bool {
        !matches!(self, TaskPhase::Pending | TaskPhase::Succeeded | TaskPhase::Failed)
    }

    /// Whether a task may go from `self` to `next`. A terminal phase is never left; nothing goes
    /// back to Pending, because another placement of the same uid could run twice (invariant 4).
    #[must_use]
    pub fn may_become(self, next: TaskPhase) -> bool {
        use TaskPhase::{Bound, Failed, Pending, Succeeded};
        match (self, next) {
            (Succeeded | Failed, _) => self == next,
            (Pending, Bound | Failed) => true,
            (Pending, _) => next == Pending,
            (_, Pending) => false,
            (_, Bound) => self == Bound || self == TaskPhase::Unknown,
            (_, _) => true,
        }
    }

    /// The phase's name as the API spells it.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            TaskPhase::Pending => "Pending",
            TaskPhase::Bound => "Bound",
            TaskPhase::Starting => "Starting",
            TaskPhase::Running => "Running",
            TaskPhase::Stopping => "Stopping",
            TaskPhase::Succeeded => "Succeeded",
            TaskPhase::Failed => "Failed",
            TaskPhase::Unknown => "Unknown",
        }
    }
}

impl fmt::Display for TaskPhase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::TaskPhase::*;
    use super::*;

    const ALL: [TaskPhase; 8] =
        [Pending, Bound, Starting, Running, Stopping, Succeeded, Failed, Unknown];

    #[test]
    fn an_ended_task_never_lives_again() {
        for end in [Succeeded, Failed] {
            for next in ALL {
                assert_eq!(end.may_become(next), end == next, "{end} to {next}");
            }
        }
    }

    #[test]
    fn a_placed_task_is_never_placed_again() {
        for phase in ALL.into_iter().filter(|p| *p != Pending) {
            assert!(!phase.may_become(Pending), "{phase}");
        }
    }

    #[test]
    fn a_task_of_a_lost_node_may_be_anything_when_the_node_returns() {
        for next in [Bound, Starting, Running, Stopping, Succeeded, Failed] {
            assert!(Unknown.may_become(next), "{next}");
        }
    }

    #[test]
    fn phases_print_as_serde_spells_them() {
        for phase in ALL {
            let json = serde_json::to_value(phase).expect("an enum of units");
            assert_eq!(json, serde_json::Value::from(phase.as_str()));
        }
    }
}
