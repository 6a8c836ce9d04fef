//! Task: one run of one program on one node, the unit that is placed.

pub mod config;
pub mod depend;
pub mod probe;
pub mod reschedule;
pub mod ros;
pub(super) mod rules;
mod run;
mod status;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use config::{EnvFrom, EnvSource, Files};
pub use reschedule::{EarlierTry, Outlook, Over, Reschedule};
pub use ros::RosSpec;
pub use run::{
    ContainerRun, EnvVar, ExecutorRun, Mount, Network, ProcessNetwork, ProcessRun, PullPolicy, Run,
    StopSignal,
};
pub use status::{
    COMPLETE, DEADLINE_EXCEEDED, FAILED, LIVENESS_FAILED, NODE_MAINTENANCE, NOT_READY, NodeRefusal,
    PLACED, PREEMPTED, PREEMPTING, STARTING_UP, STARTUP_FAILED, StopOrder, TaskLease, TaskStatus,
    TaskUsage,
};

use super::node::{NodeKind, Taint, TaintEffect};
use super::{KindInfo, admit_spec};
use crate::duration::Span;
use crate::name::FunctionName;
use crate::pose::OperationPosition;
use crate::quantity::{Bytes, MilliCpu};
use crate::resource::Compute;
use crate::selector::LabelSelector;

/// What is to run, where it may run and what it needs.
#[derive(CustomResource, Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[kube(
    group = "muster.dev",
    version = "v1alpha1",
    kind = "Task",
    plural = "tasks",
    namespaced,
    status = "TaskStatus",
    derive = "PartialEq",
    shortname = "tk"
)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct TaskSpec {
    /// More is more important; placed first.
    #[serde(default)]
    pub priority: i32,
    /// Whether tasks of less priority may be ended to make room for this one.
    #[serde(default, skip_serializing_if = "Preemption::is_default")]
    pub preemption: Preemption,
    /// Where the task may run.
    #[serde(default)]
    pub placement: Placement,
    /// What it needs there.
    #[serde(default)]
    pub resources: Resources,
    /// The program.
    #[serde(default)]
    pub run: Run,
    /// The ROS that it belongs to; none: its environment says nothing of ROS.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ros: Option<RosSpec>,
    /// Tells whether it can serve: it is Ready while this succeeds. None: it is Ready when it runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub readiness: Option<probe::Probe>,
    /// Tells whether it is alive: when this fails, the attempt is ended and counts as a failure for `restartPolicy`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub liveness: Option<probe::Probe>,
    /// Tells whether it has started: until this has succeeded once it is not Ready and the other probes are not made;
    /// when this fails, the attempt is ended as by `liveness`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub startup: Option<probe::Probe>,
    /// What happens when the program ends.
    #[serde(default)]
    pub restart_policy: RestartPolicy,
    /// Seconds between asking the task to end and killing it.
    #[serde(default = "default_grace")]
    pub grace_period_seconds: u32,
    /// The signal that asks it to end, to every process of it. SIGINT is what nodes of ROS 1 leave their master at; what a
    /// shell has started in the background does not hear it.
    #[serde(default, skip_serializing_if = "StopSignal::is_default")]
    pub stop_signal: StopSignal,
    /// What happens when the node loses the controller; the default is Stop after 30 s for a task
    /// with actuators and Keep for others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_disconnect: Option<OnDisconnect>,
    /// Tasks that must have come so far before an attempt of this one begins, also after a reboot of its node. Until all
    /// have, it is not placed.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["task"]))]
    pub depends_on: Vec<depend::DependsOn>,
    /// How long the task may be on its node, seconds from when it was placed; then it is stopped, and has Failed with
    /// the reason DeadlineExceeded. The controller keeps the time: a node without contact is told when it is back. With
    /// `reschedule` it counts from the first placement, over all nodes and the waits between them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub active_deadline_seconds: Option<u32>,
    /// How long the object stays after the task has ended, seconds; none: until somebody deletes it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ttl_seconds_after_finished: Option<u32>,
    /// How it is tried on other nodes when it has failed on one; none: its first failure that `restartPolicy` does not
    /// answer is its end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reschedule: Option<Reschedule>,
    /// It stands by: it is placed, and what it needs is kept for it, but it is not begun. It may be taken away, and begins
    /// then; nothing puts it back.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub standby: Option<Standby>,
}

/// When a task that stands by begins, if nobody says so before.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Standby {
    /// Its node begins it by itself when it has had no contact with the controller for so long.
    pub after: Span,
}

/// What a task that finds no room may do about it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Preemption {
    /// Tasks of less priority are ended, gracefully, when that makes room.
    #[default]
    LowerPriority,
    /// It waits.
    Never,
}

impl Preemption {
    fn is_default(&self) -> bool {
        *self == Preemption::default()
    }
}

fn default_grace() -> u32 {
    DEFAULT_GRACE_SECONDS
}

/// Grace of a task that names none. Shorter than Kubernetes' 30 s: a robot's operator waits for it.
pub const DEFAULT_GRACE_SECONDS: u32 = 10;
/// Longest grace. A task that needs more than an hour to stop blocks its robot.
pub const MAX_GRACE_SECONDS: u32 = 3600;
/// How long a task with actuators may run without contact when it says nothing itself.
pub const DEFAULT_STOP_AFTER: Span = Span::from_secs(30);

/// Where a task may run (Avalon, III-C).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Placement {
    /// The operation position.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at: Option<OperationPosition>,
    /// How far from it a robot may be, metres; the rim is inside. None: any distance.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub within: Option<f64>,
    /// What happens when the robot leaves the radius while the task runs.
    #[serde(skip_serializing_if = "OutOfRange::is_default")]
    pub on_out_of_range: OutOfRange,
    /// Which kind of node.
    pub on: NodeChoice,
    /// Labels the node must have.
    #[serde(skip_serializing_if = "LabelSelector::is_empty")]
    pub selector: LabelSelector,
    /// The one node it may run on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub node: Option<String>,
    /// The node that is tried first, before any better one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prefer: Option<String>,
    /// Tasks of the namespace that say the same word here are on different nodes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub apart: Option<String>,
    /// Taints it puts up with.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tolerations: Vec<Toleration>,
    /// How robots are scored; the lowest score wins.
    pub cost: Cost,
    /// The least charge of a robot's battery, percent; a node without a battery has enough. Beside it, a robot whose
    /// battery is below its own `spec.minBattery` takes only tasks that tolerate `muster.dev/battery-low`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_battery: Option<u8>,
    /// What each percent that a robot's battery lacks of a full one adds to its score, metres or seconds as `cost` has
    /// it: of two robots the fuller one, unless it is that much farther away. None: only of equally good ones.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub battery_cost: Option<f64>,
}

/// What happens to a placed task when its robot leaves the radius around the operation position.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum OutOfRange {
    /// It goes on: the radius counts when the task is placed.
    #[default]
    Ignore,
    /// It is ended, gracefully, and waits for another place under another uid. Not while the node has a mission lock.
    Reschedule,
}

impl OutOfRange {
    fn is_default(&self) -> bool {
        *self == OutOfRange::default()
    }
}

/// Which kind of node a task may run on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum NodeChoice {
    /// A robot or a cloud node; a task that needs no SR or AR prefers the cloud.
    #[default]
    Any,
    /// Robots only.
    Robot,
    /// Cloud nodes only.
    Cloud,
}

/// How a robot is scored for a task; lower is better.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Cost {
    /// Metres from the robot to the operation position.
    #[default]
    Distance,
    /// Seconds the robot needs to the operation position at its speed, in a straight line.
    TravelTime,
}

/// A taint that a task puts up with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Toleration {
    /// The taint's key; empty with `Exists`: every taint.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub key: String,
    /// How the taint's value is compared.
    #[serde(default)]
    pub operator: TolerationOperator,
    /// What it is compared with.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub value: String,
    /// The effect that is tolerated; none: every effect.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effect: Option<TaintEffect>,
}

/// How a toleration compares a taint's value.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum TolerationOperator {
    /// The values are the same.
    #[default]
    Equal,
    /// Any value.
    Exists,
}

impl Toleration {
    /// Whether this tolerates `taint` (Kubernetes' rules).
    #[must_use]
    pub fn tolerates(&self, taint: &Taint) -> bool {
        self.effect.is_none_or(|e| e == taint.effect)
            && match self.operator {
                TolerationOperator::Exists => self.key.is_empty() || self.key == taint.key,
                TolerationOperator::Equal => self.key == taint.key && self.value == taint.value,
            }
    }
}

/// What a task needs on its node.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Resources {
    /// Cpu reserved and the most it can use; none: reserves nothing, runs at minimum weight.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpu: Option<MilliCpu>,
    /// Memory reserved and the most it can use; none: reserves nothing, capped at what the node
    /// has unreserved.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Bytes>,
    /// Counted extras, `gpu: 1`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub extended: BTreeMap<String, u64>,
    /// Limits of block I/O on the disk under the task's work directory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub io: Option<IoLimits>,
    /// Most processes and threads at once.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pids: Option<u64>,
    /// SR: sensor functions, shared with others.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "set"))]
    pub sensors: Vec<FunctionName>,
    /// AR: actuator functions, for this task alone.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "set"))]
    pub actuators: Vec<FunctionName>,
}

impl Resources {
    /// The CR that placing the task reserves.
    #[must_use]
    pub fn reserved(&self) -> Compute {
        Compute {
            cpu: self.cpu.unwrap_or_default(),
            memory: self.memory.unwrap_or_default(),
            extended: self.extended.clone(),
        }
    }

    /// Needs computation only: any node will do, and the cloud is better.
    #[must_use]
    pub fn is_compute_only(&self) -> bool {
        self.sensors.is_empty() && self.actuators.is_empty()
    }

    /// The resource classes as the paper writes them, `AR-CR-SR`.
    #[must_use]
    pub fn class(&self) -> String {
        let mut parts = Vec::new();
        if !self.actuators.is_empty() {
            parts.push("AR");
        }
        if self.cpu.is_some() || self.memory.is_some() || !self.extended.is_empty() {
            parts.push("CR");
        }
        if !self.sensors.is_empty() {
            parts.push("SR");
        }
        if parts.is_empty() { "none".to_owned() } else { parts.join("-") }
    }
}

/// Limits of block I/O, bytes per second.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct IoLimits {
    /// Reading.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub read_bps: Option<Bytes>,
    /// Writing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub write_bps: Option<Bytes>,
}

/// What happens when the program ends.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum RestartPolicy {
    /// The task has ended.
    #[default]
    Never,
    /// Run again when it failed.
    OnFailure,
    /// Run again.
    Always,
}

/// What happens to a task when its node loses the controller.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct OnDisconnect {
    /// What happens.
    pub policy: DisconnectPolicy,
    /// With Stop: how long without contact first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after: Option<Span>,
}

/// What happens to a task without contact.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum DisconnectPolicy {
    /// It goes on.
    Keep,
    /// It is stopped.
    Stop,
}

impl TaskSpec {
    /// After how long without contact the node ends the task by itself; none: never.
    #[must_use]
    pub fn stop_after_disconnect(&self) -> Option<Span> {
        match &self.on_disconnect {
            Some(OnDisconnect { policy: DisconnectPolicy::Keep, .. }) => None,
            Some(OnDisconnect { policy: DisconnectPolicy::Stop, after }) => {
                Some(after.unwrap_or(DEFAULT_STOP_AFTER))
            }
            None => (!self.resources.actuators.is_empty()).then_some(DEFAULT_STOP_AFTER),
        }
    }

    /// Whether nodes of this kind can be meant at all.
    #[must_use]
    pub fn allows_kind(&self, kind: NodeKind) -> bool {
        match self.placement.on {
            NodeChoice::Any => kind == NodeKind::Robot || self.resources.is_compute_only(),
            NodeChoice::Robot => kind == NodeKind::Robot,
            NodeChoice::Cloud => kind == NodeKind::Cloud,
        }
    }
}

pub(super) const INFO: KindInfo = KindInfo {
    group: crate::GROUP,
    version: crate::VERSION,
    kind: "Task",
    plural: "tasks",
    singular: "task",
    short_names: &["tk"],
    namespaced: true,
    has_status: true,
    selectable: &[
        "spec.node",
        "spec.placement.node",
        "spec.priority",
        "spec.restartPolicy",
        "status.node",
        "status.phase",
    ],
    schema: |g| g.subschema_for::<Task>(),
    admit_body: |object, violations| admit_spec::<TaskSpec>(object, violations, rules::rules),
    admit_change: rules::change_rules,
};
