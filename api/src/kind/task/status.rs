//! What has become of a task, and the words for it.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{MicroTime, Time};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::reschedule::EarlierTry;
use crate::condition::{self, Condition};
use crate::id::Epoch;
use crate::phase::TaskPhase;
use crate::quantity::{Bytes, MilliCpu};

/// What has become of a task.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default, remote = "Self")]
pub struct TaskStatus {
    /// Where it is in its life.
    pub phase: TaskPhase,
    /// The node it is placed on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub node: Option<String>,
    /// The score of that node when it was placed: metres or seconds, by `placement.cost`; none for
    /// a cloud node or a task without an operation position.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub score: Option<f64>,
    /// The lease that came with the placement.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lease: Option<TaskLease>,
    /// Whether its start-up and readiness probes say that it can serve, true only while it runs; none: it has neither.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ready: Option<bool>,
    /// Since when `ready` is true, by the controller's clock.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ready_at: Option<MicroTime>,
    /// Number of the current attempt; 1 is the first, 0: none yet.
    pub attempt: u32,
    /// How the last attempt that ended ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exit_code: Option<i32>,
    /// The signal that ended it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub signal: Option<i32>,
    /// Why the task is in this phase, one CamelCase word.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub reason: String,
    /// Why, in a sentence.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub message: String,
    /// When it was placed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bound_at: Option<MicroTime>,
    /// When the current or last attempt started.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub started_at: Option<MicroTime>,
    /// When the last attempt ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub finished_at: Option<MicroTime>,
    /// What it uses, read from the kernel, as far as it is written down.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub usage: Option<TaskUsage>,
    /// Why it is not placed, per node (invariant 6).
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub why: Vec<NodeRefusal>,
    /// The node where tasks are being ended to make room for this one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nominated_node: Option<String>,
    /// The controller wants the task to end, and keeps its object.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stop: Option<StopOrder>,
    /// Number of the agent's newest report that is in here: reports are applied once.
    #[serde(skip_serializing_if = "is_zero")]
    pub report_sequence: u64,
    /// How many attempts have failed on this node.
    #[serde(skip_serializing_if = "is_none_yet")]
    pub failed_attempts: u32,
    /// The nodes that were tried before, the last one last; of many the newest ten.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub earlier: Vec<EarlierTry>,
    /// How many attempts have failed on all nodes before this one.
    #[serde(skip_serializing_if = "is_none_yet")]
    pub attempts_used: u32,
    /// When it was placed for the first time, where it has been on other nodes before.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first_bound_at: Option<MicroTime>,
    /// It is not placed before.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub not_before: Option<MicroTime>,
    /// `Placed`, `Ready`; of a task that has ended `Complete` or `Failed`. They follow from the other fields: they are
    /// written whenever those are, and not read back (see [`TaskStatus::conditions`]).
    #[serde(skip_deserializing, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["type"]))]
    pub conditions: Vec<Condition>,
}

impl Serialize for TaskStatus {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        // The derived function, with what follows from the rest.
        let shown = TaskStatus { conditions: self.conditions(), ..self.clone() };
        TaskStatus::serialize(&shown, serializer)
    }
}

impl<'de> Deserialize<'de> for TaskStatus {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        TaskStatus::deserialize(deserializer)
    }
}

impl TaskStatus {
    /// What the status says, as conditions: for clients that wait for these.
    #[must_use]
    pub fn conditions(&self) -> Vec<Condition> {
        let since = |time: &Option<MicroTime>| {
            time.as_ref().map(|t| Time(Timestamp::from_second(t.0.as_second()).unwrap_or(t.0)))
        };
        let of = |r#type: &str, holds: bool, reason: &str, time: &Option<MicroTime>| Condition {
            last_transition_time: since(time),
            ..Condition::new(r#type, holds, reason, "")
        };
        let ready = self.is_ready();
        let reason =
            if ready || !self.reason.is_empty() { &*self.reason } else { self.phase.as_str() };
        let times = if ready {
            [&self.ready_at, &self.started_at]
        } else {
            [&self.finished_at, &self.bound_at]
        };
        let [first, second] = times;
        let time = if first.is_some() { first } else { second };
        let mut conditions = vec![
            of(PLACED, self.node.is_some(), "", &self.bound_at),
            of(condition::READY, ready, reason, time),
        ];
        match self.phase {
            TaskPhase::Succeeded => {
                conditions.push(of(COMPLETE, true, &self.reason, &self.finished_at))
            }
            TaskPhase::Failed => conditions.push(of(FAILED, true, &self.reason, &self.finished_at)),
            _ => {}
        }
        conditions
    }

    /// Whether the task serves: it runs, and its probes, if it has some, say so.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        self.phase == TaskPhase::Running && self.ready != Some(false)
    }

    /// Takes what its node says of its probes, in the phase that it has now.
    pub fn set_ready(&mut self, ready: Option<bool>, now: MicroTime) {
        self.ready = ready.map(|ready| ready && self.phase == TaskPhase::Running);
        match self.ready {
            Some(true) => drop(self.ready_at.get_or_insert(now)),
            Some(false) | None => self.ready_at = None,
        }
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes references")]
fn is_zero(n: &u64) -> bool {
    *n == 0
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes references")]
fn is_none_yet(n: &u32) -> bool {
    *n == 0
}

/// An order of the controller to end a task; it is never taken back.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct StopOrder {
    /// Why, one CamelCase word; the reason of the task's end.
    pub reason: String,
    /// Why, in a sentence.
    pub message: String,
    /// When it was given.
    pub at: MicroTime,
}

/// Condition of a task that is on a node.
pub const PLACED: &str = "Placed";
/// Condition of a task that has ended with success.
pub const COMPLETE: &str = "Complete";
/// Condition of a task that has ended without success.
pub const FAILED: &str = "Failed";

/// Reason of a task that waits until others have ended to make room for it.
pub const PREEMPTING: &str = "Preempting";
/// Reason of a task that was ended to make room for one of more priority.
pub const PREEMPTED: &str = "Preempted";
/// Reason of a task whose node is in a maintenance window that drains it.
pub const NODE_MAINTENANCE: &str = "NodeMaintenance";
/// Reason of a task whose `activeDeadlineSeconds` have passed.
pub const DEADLINE_EXCEEDED: &str = "DeadlineExceeded";
/// Reason of a running task whose start-up probe has not succeeded yet.
pub const STARTING_UP: &str = "StartingUp";
/// Reason of a running task whose readiness probe does not succeed.
pub const NOT_READY: &str = "NotReady";
/// Reason of an attempt that is or was ended because its liveness probe failed.
pub const LIVENESS_FAILED: &str = "LivenessFailed";
/// Reason of an attempt that is or was ended because its start-up probe failed.
pub const STARTUP_FAILED: &str = "StartupFailed";

/// The lease that a task holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct TaskLease {
    /// Name of the Lease object.
    pub name: String,
    /// Number of the grant.
    pub epoch: Epoch,
}

/// What a task uses.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct TaskUsage {
    /// Mean over the last sampling window.
    pub cpu: MilliCpu,
    /// Now.
    pub memory: Bytes,
}

/// Why one node does not take a task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct NodeRefusal {
    /// The node; empty: said of the whole cluster.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub node: String,
    /// The filter that refuses it, one CamelCase word.
    pub reason: String,
    /// What would have to change, in a sentence.
    pub message: String,
}
