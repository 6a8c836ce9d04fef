//! Task: one run of one program on one node, the unit that is placed.

use std::collections::BTreeMap;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::node::{NodeKind, Taint, TaintEffect};
use super::{KindInfo, admit_spec};
use crate::duration::Span;
use crate::id::Epoch;
use crate::name::{FunctionName, check_name};
use crate::phase::TaskPhase;
use crate::pose::OperationPosition;
use crate::quantity::{Bytes, MilliCpu};
use crate::resource::Compute;
use crate::selector::LabelSelector;
use crate::validate::{Violations, element_path, member_path};

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
    /// Where the task may run.
    #[serde(default)]
    pub placement: Placement,
    /// What it needs there.
    #[serde(default)]
    pub resources: Resources,
    /// The program.
    #[serde(default)]
    pub run: Run,
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
    /// Which kind of node.
    pub on: NodeChoice,
    /// Labels the node must have.
    #[serde(skip_serializing_if = "LabelSelector::is_empty")]
    pub selector: LabelSelector,
    /// The one node it may run on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub node: Option<String>,
    /// Taints it puts up with.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tolerations: Vec<Toleration>,
    /// How robots are scored; the lowest score wins.
    pub cost: Cost,
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
    pub sensors: Vec<FunctionName>,
    /// AR: actuator functions, for this task alone.
    #[serde(skip_serializing_if = "Vec::is_empty")]
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

/// The program: exactly one of the two.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Run {
    /// A container of the node's Docker Engine.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub container: Option<ContainerRun>,
    /// A process of the node itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub process: Option<ProcessRun>,
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
    pub env: Vec<EnvVar>,
    /// Working directory in the container.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub working_dir: Option<String>,
    /// Directories of the node that the container sees.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub mounts: Vec<Mount>,
    /// The container's network.
    #[serde(default)]
    pub network: Network,
    /// When the image is pulled.
    #[serde(default)]
    pub pull_policy: PullPolicy,
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
    pub env: Vec<EnvVar>,
    /// Working directory; none: a directory of the task's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub working_dir: Option<String>,
    /// The user it runs as, a name or a number; none: the agent's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
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
#[serde(rename_all = "camelCase", default)]
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
    /// Number of the agent's newest report that is in here: reports are applied once.
    #[serde(skip_serializing_if = "is_zero")]
    pub report_sequence: u64,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes references")]
fn is_zero(n: &u64) -> bool {
    *n == 0
}

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

fn rules(spec: &TaskSpec, violations: &mut Violations) {
    placement_rules(spec, violations);
    resource_rules(&spec.resources, violations);
    run_rules(&spec.run, violations);
    if spec.grace_period_seconds > MAX_GRACE_SECONDS {
        let reason = format!(
            "{} is more than the longest allowed, {MAX_GRACE_SECONDS}",
            spec.grace_period_seconds
        );
        violations.invalid("spec.gracePeriodSeconds", reason);
    }
    if let Some(OnDisconnect { policy: DisconnectPolicy::Keep, after: Some(_) }) =
        spec.on_disconnect
    {
        violations
            .forbidden("spec.onDisconnect.after", "means nothing with the policy Keep")
            .suggest("leave it out, or set policy: Stop");
    }
}

fn placement_rules(spec: &TaskSpec, violations: &mut Violations) {
    let placement = &spec.placement;
    if let Some(within) = placement.within {
        if !(within >= 0.0 && within.is_finite()) {
            violations
                .invalid("spec.placement.within", format!("{within} is not a radius in metres"));
        }
        if placement.at.is_none() {
            violations
                .required("spec.placement.at")
                .suggest("`within` needs the position it is around: at: {x: 3.0, y: 4.0}");
        }
    }
    if let Some(at) = &placement.at {
        for (axis, value) in [("x", at.x), ("y", at.y), ("z", at.z)] {
            if !value.is_finite() {
                violations.invalid(
                    format!("spec.placement.at.{axis}"),
                    format!("{value} is not a number of metres"),
                );
            }
        }
    }
    if placement.cost == Cost::TravelTime && placement.at.is_none() {
        violations
            .required("spec.placement.at")
            .suggest("the cost TravelTime needs the position to travel to");
    }
    if placement.on == NodeChoice::Cloud && !spec.resources.is_compute_only() {
        violations
            .invalid(
                "spec.placement.on",
                "a Cloud node has no sensors or actuators, and the task asks for some",
            )
            .suggest("set on: Robot");
    }
    if let Some(node) = &placement.node
        && let Err(error) = check_name(node)
    {
        violations.invalid("spec.placement.node", error.to_string());
    }
    placement.selector.validate("spec.placement.selector", violations);
    for (i, toleration) in placement.tolerations.iter().enumerate() {
        let path = element_path("spec.placement.tolerations", i);
        if toleration.key.is_empty() && toleration.operator == TolerationOperator::Equal {
            violations
                .required(format!("{path}.key"))
                .suggest("or set operator: Exists to tolerate every taint");
        }
        if !toleration.value.is_empty() && toleration.operator == TolerationOperator::Exists {
            violations.forbidden(format!("{path}.value"), "means nothing with the operator Exists");
        }
    }
}

/// Below this a memory limit kills any program while it starts; Docker refuses less, too.
const MIN_MEMORY: Bytes = Bytes(6 << 20);
/// The kernel gives no quota finer than 1 ms in a period of 100 ms.
const MIN_CPU: MilliCpu = MilliCpu(10);

fn resource_rules(resources: &Resources, violations: &mut Violations) {
    if let Some(cpu) = resources.cpu.filter(|c| *c < MIN_CPU) {
        violations
            .invalid(
                "spec.resources.cpu",
                format!("{cpu} is less than the smallest quota, {MIN_CPU}"),
            )
            .suggest("leave it out to reserve nothing");
    }
    if let Some(memory) = resources.memory.filter(|m| *m < MIN_MEMORY) {
        violations
            .invalid(
                "spec.resources.memory",
                format!("{memory} is less than any program needs, {MIN_MEMORY}"),
            )
            .suggest(format!("did you mean {:?}?", format!("{}Mi", memory.0.max(6))));
    }
    if resources.pids == Some(0) {
        violations.invalid("spec.resources.pids", "0 lets nothing run");
    }
    if let Some(io) = &resources.io {
        for (field, limit) in [("readBps", io.read_bps), ("writeBps", io.write_bps)] {
            if limit == Some(Bytes(0)) {
                violations
                    .invalid(format!("spec.resources.io.{field}"), "0 lets nothing through")
                    .suggest("leave it out for no limit");
            }
        }
    }
    for (field, functions) in [("sensors", &resources.sensors), ("actuators", &resources.actuators)]
    {
        for (i, function) in functions.iter().enumerate() {
            if functions[..i].contains(function) {
                violations.duplicate(
                    element_path(&member_path("spec.resources", field), i),
                    format!("{:?} is there twice", function.to_string()),
                );
            }
        }
    }
}

fn run_rules(run: &Run, violations: &mut Violations) {
    match (&run.container, &run.process) {
        (None, None) => {
            violations.required("spec.run").suggest("give `container` or `process`");
        }
        (Some(_), Some(_)) => {
            violations
                .forbidden("spec.run", "has both `container` and `process`")
                .suggest("keep one of them");
        }
        (Some(container), None) => {
            if container.image.trim().is_empty() {
                violations.required("spec.run.container.image");
            }
            env_rules(&container.env, "spec.run.container.env", violations);
            absolute("spec.run.container.workingDir", container.working_dir.as_deref(), violations);
            for (i, mount) in container.mounts.iter().enumerate() {
                let path = element_path("spec.run.container.mounts", i);
                absolute(&format!("{path}.hostPath"), Some(&mount.host_path), violations);
                absolute(&format!("{path}.mountPath"), Some(&mount.mount_path), violations);
            }
        }
        (None, Some(process)) => {
            if process.command.first().is_none_or(|c| c.is_empty()) {
                violations
                    .required("spec.run.process.command")
                    .suggest("for example [\"/usr/bin/env\"]");
            }
            env_rules(&process.env, "spec.run.process.env", violations);
            absolute("spec.run.process.workingDir", process.working_dir.as_deref(), violations);
        }
    }
}

fn absolute(path: &str, given: Option<&str>, violations: &mut Violations) {
    if let Some(given) = given.filter(|g| !g.starts_with('/')) {
        violations
            .invalid(path, format!("{given:?} is not an absolute path"))
            .suggest("begin it with '/'");
    }
}

fn env_rules(env: &[EnvVar], path: &str, violations: &mut Violations) {
    for (i, var) in env.iter().enumerate() {
        let path = format!("{}.name", element_path(path, i));
        if var.name.is_empty() || var.name.contains(['=', '\0']) {
            violations.invalid(&path, format!("{:?} is not the name of a variable", var.name));
        }
        if env[..i].iter().any(|v| v.name == var.name) {
            violations.duplicate(path, format!("{:?} is there twice", var.name));
        }
    }
}

/// What of a spec may change while the task exists: nothing that would need another process.
const MUTABLE: [&str; 2] = ["priority", "gracePeriodSeconds"];

fn change_rules(old: &Value, new: &Value, violations: &mut Violations) {
    let empty = serde_json::Map::new();
    let spec =
        |object: &Value| object.get("spec").and_then(Value::as_object).cloned().unwrap_or_default();
    let (mut old, mut new) = (spec(old), spec(new));
    for spec in [&mut old, &mut new] {
        spec.retain(|key, _| !MUTABLE.contains(&key.as_str()));
        if let Some(placement) = spec.get_mut("placement").and_then(Value::as_object_mut) {
            placement.remove("tolerations");
        }
    }
    differences(&Value::Object(old), &Value::Object(new), "spec", &empty, violations);
}

/// Names the deepest fields that differ, so that the message points at what was changed.
fn differences(
    old: &Value,
    new: &Value,
    path: &str,
    empty: &serde_json::Map<String, Value>,
    violations: &mut Violations,
) {
    if old == new {
        return;
    }
    let as_members = |v: &Value| match v {
        Value::Object(members) => Some(members.clone()),
        Value::Null => Some(empty.clone()),
        _ => None,
    };
    match (as_members(old), as_members(new)) {
        (Some(a), Some(b)) if !(a.is_empty() && b.is_empty()) => {
            let keys: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
            for key in keys {
                let null = Value::Null;
                let (a, b) = (a.get(key).unwrap_or(&null), b.get(key).unwrap_or(&null));
                differences(a, b, &member_path(path, key), empty, violations);
            }
        }
        _ => {
            violations
                .forbidden(path, "cannot change while the task exists")
                .suggest("delete the task and create it again; only priority, gracePeriodSeconds and placement.tolerations may change");
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
    selectable: &["status.phase", "status.node", "spec.placement.node", "spec.priority"],
    admit_body: |object, violations| admit_spec::<TaskSpec>(object, violations, rules),
    admit_change: change_rules,
};

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::kind::{admit, admit_change, find};

    use super::*;

    fn task(spec: Value) -> Value {
        json!({"apiVersion": crate::API_VERSION, "kind": "Task", "metadata": {"name": "t"}, "spec": spec})
    }

    fn sleep(mut spec: Value) -> Value {
        spec["run"] = json!({"process": {"command": ["sleep", "1"]}});
        task(spec)
    }

    fn problems(object: &Value) -> Vec<String> {
        match admit(object) {
            Ok(_) => Vec::new(),
            Err(violations) => violations.iter().map(ToString::to_string).collect(),
        }
    }

    #[test]
    fn a_small_task_gets_its_defaults() {
        let admitted = admit(&sleep(json!({"resources": {"cpu": 0.5, "memory": "1073741824"}})))
            .expect("good");
        assert_eq!(
            admitted["spec"],
            json!({
                "priority": 0,
                "placement": {"on": "Any", "cost": "Distance"},
                "resources": {"cpu": "500m", "memory": "1Gi"},
                "run": {"process": {"command": ["sleep", "1"]}},
                "restartPolicy": "Never",
                "gracePeriodSeconds": 10,
            })
        );
        assert_eq!(admit(&admitted), Ok(admitted.clone()), "admission is idempotent");
    }

    #[test]
    fn exactly_one_program() {
        assert_eq!(
            problems(&task(json!({"run": {}}))),
            ["spec.run: is required; give `container` or `process`"]
        );
        assert_eq!(
            problems(&task(
                json!({"run": {"container": {"image": "a"}, "process": {"command": ["a"]}}})
            )),
            ["spec.run: has both `container` and `process`; keep one of them"]
        );
        assert_eq!(
            problems(&task(json!({"run": {"process": {"command": []}}}))),
            ["spec.run.process.command: is required; for example [\"/usr/bin/env\"]"]
        );
    }

    #[test]
    fn what_can_never_be_placed_is_refused() {
        assert_eq!(
            problems(&sleep(
                json!({"placement": {"within": -1, "on": "Cloud"}, "resources": {"sensors": ["a:b", "a:b"]}})
            )),
            [
                "spec.placement.within: -1 is not a radius in metres",
                "spec.placement.at: is required; `within` needs the position it is around: at: {x: 3.0, y: 4.0}",
                "spec.placement.on: a Cloud node has no sensors or actuators, and the task asks for some; set on: Robot",
                "spec.resources.sensors[1]: \"a:b\" is there twice",
            ]
        );
    }

    #[test]
    fn only_priority_grace_and_tolerations_may_change() {
        let info = find(crate::API_VERSION, "Task").expect("served");
        let old = admit(&sleep(json!({"resources": {"cpu": 1}}))).expect("good");
        let mut new = old.clone();
        new["spec"]["priority"] = json!(5);
        new["spec"]["gracePeriodSeconds"] = json!(1);
        new["spec"]["placement"]["tolerations"] = json!([{"operator": "Exists"}]);
        admit_change(info, &old, &new).expect("these may change");
        new["spec"]["resources"]["cpu"] = json!("2");
        new["spec"]["placement"]["node"] = json!("r1");
        let paths: Vec<String> = admit_change(info, &old, &new)
            .expect_err("these may not")
            .iter()
            .map(|v| v.path.clone())
            .collect();
        assert_eq!(paths, ["spec.placement.node", "spec.resources.cpu"]);
    }

    #[test]
    fn tolerations_match_as_in_kubernetes() {
        let taint = |value: &str| Taint {
            key: "battery".into(),
            value: value.into(),
            effect: TaintEffect::NoSchedule,
        };
        let toleration = |key: &str, operator, value: &str, effect| Toleration {
            key: key.into(),
            operator,
            value: value.into(),
            effect,
        };
        use TolerationOperator::{Equal, Exists};
        for (t, tolerates) in [
            (toleration("battery", Equal, "low", None), true),
            (toleration("battery", Equal, "full", None), false),
            (toleration("battery", Exists, "", None), true),
            (toleration("", Exists, "", None), true),
            (toleration("other", Exists, "", None), false),
            (toleration("battery", Exists, "", Some(TaintEffect::PreferNoSchedule)), false),
        ] {
            assert_eq!(t.tolerates(&taint("low")), tolerates, "{t:?}");
        }
    }

    #[test]
    fn a_task_with_actuators_stops_without_contact_unless_it_says_otherwise() {
        let spec = |extra: Value| -> TaskSpec {
            let mut full = json!({"run": {"process": {"command": ["a"]}}});
            full.as_object_mut().expect("a map").extend(extra.as_object().expect("a map").clone());
            serde_json::from_value(full).expect("a spec")
        };
        let drive = json!({"resources": {"actuators": ["base:Drive"]}});
        assert_eq!(spec(json!({})).stop_after_disconnect(), None);
        assert_eq!(spec(drive).stop_after_disconnect(), Some(DEFAULT_STOP_AFTER));
        let stop = json!({"onDisconnect": {"policy": "Stop", "after": "5s"}});
        assert_eq!(spec(stop).stop_after_disconnect(), Some(Span::from_secs(5)));
    }

    #[test]
    fn classes_are_written_as_in_the_paper() {
        let class = |r: Value| serde_json::from_value::<Resources>(r).expect("resources").class();
        assert_eq!(class(json!({"cpu": 1, "sensors": ["k:I"], "actuators": ["b:D"]})), "AR-CR-SR");
        assert_eq!(class(json!({"sensors": ["k:I"]})), "SR");
        assert_eq!(class(json!({})), "none");
    }
}
