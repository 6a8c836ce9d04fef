//! Task: one run of one program on one node, the unit that is placed.

pub mod config;
pub mod depend;
pub mod probe;
pub mod reschedule;
pub mod ros;
pub(super) mod rules;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{MicroTime, Time};
use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use config::{EnvFrom, EnvSource, Files};
pub use reschedule::{EarlierTry, Outlook, Over, Reschedule};
pub use ros::RosSpec;

use super::node::{NodeKind, Taint, TaintEffect};
use super::{KindInfo, admit_spec};
use crate::condition::{self, Condition};
use crate::duration::Span;
use crate::id::Epoch;
use crate::name::FunctionName;
use crate::phase::TaskPhase;
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

/// The program: exactly one of the three.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Run {
    /// A container of the node's Docker Engine.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub container: Option<ContainerRun>,
    /// A process of the node itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub process: Option<ProcessRun>,
    /// Work that an executor does which runs on the node already.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub executor: Option<ExecutorRun>,
}

/// Work for an executor: a task of the same namespace that stays alive on the node and runs many tasks itself
/// (Avalon, IV-B). The agent hands the work over by the executor's Unix socket, and the executor's limits grow by
/// what this task reserves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ExecutorRun {
    /// Name of the executor's Task.
    pub task: String,
    /// What the executor is told; the controller does not look into it.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    pub data: serde_json::Map<String, serde_json::Value>,
}

/// A container.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ContainerRun {
    /// The image.
    pub image: String,
    /// Replaces the image's entry point.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub command: Vec<String>,
    /// Replaces the image's arguments.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub args: Vec<String>,
    /// Environment.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["name"]))]
    pub env: Vec<EnvVar>,
    /// Whole ConfigMaps and Secrets as environment.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub env_from: Vec<EnvFrom>,
    /// ConfigMaps and Secrets as files.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["mountPath"]))]
    pub files: Vec<Files>,
    /// Working directory in the container.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub working_dir: Option<String>,
    /// Directories of the node that the container sees.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["mountPath"]))]
    pub mounts: Vec<Mount>,
    /// The container's network.
    #[serde(default)]
    pub network: Network,
    /// When the image is pulled.
    #[serde(default)]
    pub pull_policy: PullPolicy,
    /// The user that it runs as, `UID` or `UID:GID`: names mean something inside of an image only. None: the image's, which
    /// is root where the image says nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
}

/// A process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ProcessRun {
    /// The program (looked up in PATH when it has no `/`) and its first arguments; passed as it
    /// is, without a shell.
    pub command: Vec<String>,
    /// More arguments.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub args: Vec<String>,
    /// Environment, beside the agent's PATH and the MUSTER_ variables.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["name"]))]
    pub env: Vec<EnvVar>,
    /// Whole ConfigMaps and Secrets as environment.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub env_from: Vec<EnvFrom>,
    /// ConfigMaps and Secrets as files.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["mountPath"]))]
    pub files: Vec<Files>,
    /// Working directory; none: a directory of the task's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub working_dir: Option<String>,
    /// The user it runs as, a name or a number; none: the agent's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// Its network: the node's, or none but a loopback of its own, so that it reaches nobody and is reached by nobody. A
    /// program that is to be held in needs a `user`, too: root can leave.
    #[serde(default, skip_serializing_if = "ProcessNetwork::is_default")]
    pub network: ProcessNetwork,
}

/// A program's network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum ProcessNetwork {
    /// The node's own network.
    #[default]
    Host,
    /// Loopback only; shared memory and message queues of System V are its own as well.
    None,
}

impl ProcessNetwork {
    fn is_default(&self) -> bool {
        *self == ProcessNetwork::default()
    }
}

/// A variable of a task's environment.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct EnvVar {
    /// Name.
    pub name: String,
    /// Value.
    #[serde(default)]
    pub value: String,
    /// Where the value comes from instead.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value_from: Option<EnvSource>,
}

/// A directory or file of the node that a container sees.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Mount {
    /// Absolute path on the node.
    pub host_path: String,
    /// Absolute path in the container.
    pub mount_path: String,
    /// The container cannot write to it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub read_only: bool,
}

/// A container's network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Network {
    /// The node's own network.
    #[default]
    Host,
    /// Loopback only.
    None,
    /// The engine's default bridge.
    Bridge,
}

/// When an image is pulled.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum PullPolicy {
    /// When the node does not have it.
    #[default]
    IfNotPresent,
    /// Before every start.
    Always,
    /// Not at all; the node must have it.
    Never,
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
