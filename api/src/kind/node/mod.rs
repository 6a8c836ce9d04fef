//! Node: a robot or a cloud server that runs an agent.

pub mod estop;
pub mod image;
pub mod upkeep;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{KindInfo, admit_spec};
use crate::condition::{self, Condition, ConditionStatus};
use crate::id::{Epoch, Incarnation};
use crate::kind::lease::LeaseHolder;
use crate::name::FunctionName;
use crate::pose::Pose;
use crate::resource::Compute;
use crate::validate::{Violations, element_path};
use estop::{EStopStatus, EStopTier};
use image::ImageStatus;
use upkeep::{Battery, MaintenanceWindow};

/// What a node is.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema,
)]
pub enum NodeKind {
    /// Has a pose, and may have sensors and actuators.
    Robot,
    /// Computation only; has no pose, and no range filter drops it.
    Cloud,
}

/// What an operator decides about a node.
#[derive(CustomResource, Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[kube(
    group = "muster.dev",
    version = "v1alpha1",
    kind = "Node",
    plural = "nodes",
    status = "NodeStatus",
    derive = "PartialEq",
    shortname = "no"
)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct NodeSpec {
    /// What the node is.
    pub kind: NodeKind,
    /// True: nothing new is placed here (`muster cordon`); what runs goes on.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub unschedulable: bool,
    /// Marks that keep tasks away which do not tolerate them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["key", "effect"]))]
    pub taints: Vec<Taint>,
    /// Usual speed of a robot, metres per second; the cost `TravelTime` needs it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<f64>,
    /// Below how much charge nothing new begins on the robot, percent; tasks that tolerate `muster.dev/battery-low` (a
    /// drive to the charger) do. None: 10.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_battery: Option<u8>,
    /// When people work on it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub maintenance: Vec<MaintenanceWindow>,
    /// How far the robot is to be stopped, whoever holds it (`muster estop`).
    #[serde(default, skip_serializing_if = "EStopTier::is_none")]
    pub estop: EStopTier,
    /// A person has released the robot's own stops up to this number (see `status.estop.number`).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub estop_release: Option<u64>,
}

impl NodeSpec {
    /// A node of this kind of which nothing else is said.
    #[must_use]
    pub fn new(kind: NodeKind) -> Self {
        NodeSpec {
            kind,
            unschedulable: false,
            taints: Vec::new(),
            speed: None,
            min_battery: None,
            maintenance: Vec::new(),
            estop: EStopTier::None,
            estop_release: None,
        }
    }
}

/// Annotation of a Node that is in the middle of a mission, `HOLDER: REASON`: no TaskSet ends a task there.
pub const MISSION_LOCK: &str = "muster.dev/mission-lock";

/// Why nothing is to be changed on a node now.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct MissionLock {
    /// The person or task that set it.
    pub holder: String,
    /// What they say about it; may be empty.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub reason: String,
}

impl Node {
    /// The mission that the node is on, by the annotation or else by what its agent says. The one place where a lock is
    /// read.
    #[must_use]
    pub fn mission_lock(&self) -> Option<MissionLock> {
        let local = || self.status.as_ref()?.mission_locks.first().cloned();
        self.annotated_lock().or_else(local)
    }

    /// The lock that is set through the controller.
    #[must_use]
    pub fn annotated_lock(&self) -> Option<MissionLock> {
        let text = self.metadata.annotations.as_ref()?.get(MISSION_LOCK)?;
        let (holder, reason) = text.split_once(':').unwrap_or((text, ""));
        Some(MissionLock { holder: holder.trim().to_owned(), reason: reason.trim().to_owned() })
    }
}

/// A mark on a node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Taint {
    /// The mark.
    pub key: String,
    /// Its value.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub value: String,
    /// What it does.
    pub effect: TaintEffect,
}

/// What a taint does to tasks that do not tolerate it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum TaintEffect {
    /// They are not placed here.
    NoSchedule,
    /// They are placed here only when there is no better node.
    PreferNoSchedule,
}

/// What a node has and does, as its agent reports it and the controller accounts it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct NodeStatus {
    /// CR of the machine.
    pub capacity: Compute,
    /// CR that tasks may reserve: capacity less what the system needs.
    pub allocatable: Compute,
    /// CR that tasks have reserved (the paper's *used*).
    pub used: Compute,
    /// CR that is left (the paper's *allocatable*).
    pub free: Compute,
    /// SR: always allocatable, any number of tasks share them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub sensors: Vec<FunctionName>,
    /// AR: one task at a time.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub actuators: Vec<FunctionName>,
    /// The leases of the node's actuators.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub leases: Vec<NodeLease>,
    /// A coarse checkpoint of where the robot is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pose: Option<Pose>,
    /// The charge of its battery; none: it has none, or does not tell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub battery: Option<Battery>,
    /// Mission locks that are set on the node itself, by its tasks or by people there.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub mission_locks: Vec<MissionLock>,
    /// What stops the robot; none: nothing stands before its drivers.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub estop: Option<EStopStatus>,
    /// Facts about the node; `Ready`, `Fenced`, `Battery` and `Maintenance` are the controller's, the others are the
    /// agent's.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["type"]))]
    pub conditions: Vec<Condition>,
    /// Images that rollouts want there before a task is ended for them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub images: Vec<ImageStatus>,
    /// How tasks can be run there.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub runtimes: Vec<RuntimeStatus>,
    /// When the agent was last heard, as far as it is written down.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub last_seen: Option<MicroTime>,
    /// Of the home of parts that are away: when a controller started that has not heard it so far. How long the agent has
    /// been silent before that is not known. None: the controller that heard it last has not ended since.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unheard_since: Option<MicroTime>,
    /// The life of the agent that reported all this.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub incarnation: Option<Incarnation>,
    /// SHA-256 of the public keys with which an agent may speak for this node, newest first; none: no
    /// agent has joined.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub agent_keys: Vec<String>,
    /// The agent's version.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub agent_version: String,
    /// The machine's address as the controller sees it.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub address: String,
}

/// The state of one conflict group of a robot's actuators.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct NodeLease {
    /// The conflict group.
    pub group: String,
    /// The number of the newest grant.
    pub epoch: Epoch,
    /// The holder; none: free.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub holder: Option<LeaseHolder>,
}

/// A way to run tasks on a node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct RuntimeStatus {
    /// `process` or `docker`.
    pub name: String,
    /// Whether it can be used now.
    pub available: bool,
    /// Its version.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub version: String,
    /// Why it cannot be used.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub message: String,
}

impl NodeStatus {
    /// The condition of this type.
    #[must_use]
    pub fn condition(&self, r#type: &str) -> Option<&Condition> {
        self.conditions.iter().find(|c| c.r#type == r#type)
    }

    /// The agent has been heard within the detection time.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        self.condition(condition::READY).is_some_and(|c| c.status == ConditionStatus::True)
    }
}

fn rules(spec: &NodeSpec, violations: &mut Violations) {
    if let Some(speed) = spec.speed.filter(|s| !(*s > 0.0 && s.is_finite())) {
        violations
            .invalid("spec.speed", format!("{speed} is not a speed in m/s"))
            .suggest("try 0.5");
    }
    for (i, taint) in spec.taints.iter().enumerate() {
        let path = element_path("spec.taints", i);
        if taint.key.is_empty() {
            violations.required(format!("{path}.key"));
        }
        if spec.taints[..i].iter().any(|t| t.key == taint.key && t.effect == taint.effect) {
            violations
                .duplicate(path, format!("{:?} is there twice with the same effect", taint.key));
        }
    }
    if spec.kind == NodeKind::Cloud && spec.speed.is_some() {
        violations.forbidden("spec.speed", "a Cloud node does not move").suggest("leave it out");
    }
    if spec.kind == NodeKind::Cloud && !spec.estop.is_none() {
        violations.forbidden("spec.estop", "a Cloud node does not move").suggest("leave it out");
    }
    upkeep::rules(spec, violations);
}

fn kind_stays(old: &serde_json::Value, new: &serde_json::Value, violations: &mut Violations) {
    let kind = |object: &serde_json::Value| object.pointer("/spec/kind").cloned();
    if kind(old) != kind(new) {
        violations
            .forbidden("spec.kind", "a node stays what it joined as")
            .suggest("delete the node and let its agent join again");
    }
}

pub(super) const INFO: KindInfo = KindInfo {
    group: crate::GROUP,
    version: crate::VERSION,
    kind: "Node",
    plural: "nodes",
    singular: "node",
    short_names: &["no"],
    namespaced: false,
    has_status: true,
    selectable: &["spec.kind", "spec.unschedulable"],
    schema: |g| g.subschema_for::<Node>(),
    admit_body: |object, violations| admit_spec::<NodeSpec>(object, violations, rules),
    admit_change: kind_stays,
};

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::kind::{admit, admit_change, find};

    #[test]
    fn windows_and_batteries_make_sense() {
        let window = json!({"start": "2026-03-01T02:00:00.000000Z", "lasts": "2h", "every": "1h"});
        let spec = json!({"kind": "Cloud", "minBattery": 101, "maintenance": [window]});
        let node = json!({"apiVersion": crate::API_VERSION, "kind": "Node", "metadata": {"name": "n"}, "spec": spec});
        let said: Vec<String> =
            admit(&node).expect_err("no").iter().map(ToString::to_string).collect();
        assert_eq!(
            said,
            [
                "spec.minBattery: 101 is more than a full battery; percent, 0 to 100",
                "spec.minBattery: a Cloud node has no battery; leave it out",
                "spec.maintenance[0].every: 1h is not longer than the window itself, 2h; \
                 from one beginning to the next; 24h for every day",
            ]
        );
    }

    #[test]
    fn a_node_keeps_its_kind() {
        let node = |kind: &str| {
            admit(&json!({"apiVersion": crate::API_VERSION, "kind": "Node", "metadata": {"name": "n"}, "spec": {"kind": kind}}))
                .expect("a node")
        };
        let info = find(crate::API_VERSION, "Node").expect("served");
        admit_change(info, &node("Robot"), &node("Robot")).expect("the same");
        let error = admit_change(info, &node("Robot"), &node("Cloud")).expect_err("another kind");
        assert!(error.to_string().starts_with("spec.kind: "), "{error}");
    }
}
