//! What a node is, as its Node object says; what it has left is in its ledger.

use std::collections::BTreeSet;
use std::sync::Arc;

use muster_api::kind::lease::DEFAULT_GROUP;
use muster_api::kind::node::upkeep::passing_taints;
use muster_api::kind::node::{Node, NodeKind, NodeStatus, RuntimeStatus, Taint};
use muster_api::name::FunctionName;
use muster_api::pose::Pose;
use muster_api::selector::Labels;

use crate::recent::Recent;

/// Batteries that differ by less are equally full, percent.
pub(super) const BATTERY_STEP: u8 = 20;

/// What filters need to know of a node. What is mostly the same in a fleet is shared.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeFacts {
    /// Robot or cloud.
    pub kind: NodeKind,
    /// Its labels.
    pub labels: Labels,
    /// Cordoned.
    pub unschedulable: bool,
    /// Its taints.
    pub taints: Vec<Taint>,
    /// Metres per second.
    pub speed: Option<f64>,
    /// `None`: ready; otherwise what the Ready condition says.
    pub not_ready: Option<String>,
    /// SR.
    pub sensors: Arc<BTreeSet<FunctionName>>,
    /// AR.
    pub actuators: Arc<BTreeSet<FunctionName>>,
    /// Where it is.
    pub pose: Option<Pose>,
    /// How tasks can be run.
    pub runtimes: Arc<Vec<RuntimeStatus>>,
    /// Taints that its conditions put on it for now.
    pub passing: Vec<Taint>,
    /// Percent of a full battery; none: it has none, or does not tell.
    pub battery: Option<u8>,
}

impl NodeFacts {
    /// The facts of one node, by itself.
    #[must_use]
    pub fn of(node: &Node) -> Self {
        Models::default().facts(node)
    }

    /// The conflict groups that a task with these actuators takes: all of the robot's when it takes
    /// any (Avalon, III-B), none when it takes none.
    #[must_use]
    pub fn groups_for(&self, actuators: &[FunctionName]) -> Vec<String> {
        if actuators.is_empty() { Vec::new() } else { vec![DEFAULT_GROUP.to_owned()] }
    }

    /// Every conflict group of the robot; none when it has no actuators.
    #[must_use]
    pub fn groups(&self) -> Vec<String> {
        if self.actuators.is_empty() { Vec::new() } else { vec![DEFAULT_GROUP.to_owned()] }
    }

    /// What its battery lacks of a full one, percent; nothing without a battery.
    #[must_use]
    pub fn battery_lacks(&self) -> u8 {
        100_u8.saturating_sub(self.battery.unwrap_or(100))
    }

    /// Whether what is said of the node is the same, wherever in its map it is.
    #[must_use]
    pub(crate) fn same_but_for_pose(&self, other: &NodeFacts) -> bool {
        self.kind == other.kind
            && self.labels == other.labels
            && self.unschedulable == other.unschedulable
            && self.taints == other.taints
            && self.speed == other.speed
            && self.not_ready == other.not_ready
            && self.sensors == other.sensors
            && self.actuators == other.actuators
            && is_move(self.pose.as_ref(), other.pose.as_ref())
            && self.runtimes == other.runtimes
            && self.passing == other.passing
            && self.battery_lacks() / BATTERY_STEP == other.battery_lacks() / BATTERY_STEP
    }
}

/// From one to the other the robot only moves. Localized or not decides who is offered the robot, so it is more than
/// that.
pub(super) fn is_move(from: Option<&Pose>, to: Option<&Pose>) -> bool {
    match (from, to) {
        (Some(from), Some(to)) => from.map == to.map && from.localized == to.localized,
        (from, to) => from.is_none() && to.is_none(),
    }
}

/// What robots of one model have in common.
#[derive(Debug, Clone, Default)]
pub(super) struct Models {
    functions: Recent<BTreeSet<FunctionName>>,
    runtimes: Recent<Vec<RuntimeStatus>>,
}

impl Models {
    pub(super) fn facts(&mut self, node: &Node) -> NodeFacts {
        let nothing = NodeStatus::default();
        let status = node.status.as_ref().unwrap_or(&nothing);
        let not_ready = (!status.is_ready()).then(|| {
            let said = status.condition(muster_api::condition::READY);
            said.map_or_else(|| "its agent has not joined".to_owned(), |c| c.message.clone())
        });
        NodeFacts {
            kind: node.spec.kind,
            labels: node.metadata.labels.clone().unwrap_or_default(),
            unschedulable: node.spec.unschedulable,
            taints: node.spec.taints.clone(),
            speed: node.spec.speed,
            not_ready,
            sensors: self.functions.share(status.sensors.iter().cloned().collect()),
            actuators: self.functions.share(status.actuators.iter().cloned().collect()),
            pose: status.pose.clone(),
            runtimes: self.runtimes.share(status.runtimes.clone()),
            passing: passing_taints(status),
            battery: status.battery.map(|battery| battery.percent),
        }
    }
}
