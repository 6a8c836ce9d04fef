//! Which ROS a task belongs to.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::probe::{is_master, is_topic};
use super::{Network, TaskSpec};
use crate::validate::Violations;

/// The word for the master of the node that the task is on.
const ROBOT: &str = "Robot";

/// The word for a master of the task's own.
const VIEW: &str = "View";

/// What the environment of a task's program says of ROS 1: `ROS_MASTER_URI`, `ROS_NAMESPACE`, and `ROS_IP` or `ROS_HOSTNAME`
/// where its network is the node's. What the task sets itself goes first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct RosSpec {
    /// `Robot`: the master that the node's agent knows (`--ros-master`); `http://HOST:PORT`; or `View`: one of the task's own, in
    /// a network of its own (`network: None`), with the sensors that the task asks for and, if it has the robot's lease, the
    /// actuators that are topics.
    pub master: String,
    /// The namespace of its nodes' names; none: what the node's agent says (`--ros-namespace`).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub namespace: Option<String>,
}

impl Default for RosSpec {
    fn default() -> Self {
        RosSpec { master: ROBOT.to_owned(), namespace: None }
    }
}

impl RosSpec {
    /// The master's address; none: that which the node knows, or the task's own.
    #[must_use]
    pub fn uri(&self) -> Option<&str> {
        (self.master != ROBOT && !self.is_view()).then_some(&*self.master)
    }

    /// Whether it has a master of its own.
    #[must_use]
    pub fn is_view(&self) -> bool {
        self.master == VIEW
    }
}

pub(super) fn rules(spec: &TaskSpec, violations: &mut Violations) {
    let Some(ros) = &spec.ros else { return };
    if spec.run.executor.is_some() {
        violations
            .forbidden("spec.ros", "an executor's work has the environment of its executor")
            .suggest("say it in the executor's own task");
    }
    if let Some(master) = ros.uri().filter(|master| !is_master(master)) {
        violations
            .invalid("spec.ros.master", format!("{master:?} is not the address of a ROS master"))
            .suggest(
                "Robot for the master of the task's node, View for its own, or http://HOST:PORT",
            );
    }
    if ros.is_view() {
        view_rules(spec, violations);
    }
    if let Some(namespace) = &ros.namespace
        && namespace != "/"
        && !is_topic(namespace)
    {
        violations
            .invalid("spec.ros.namespace", format!("{namespace:?} is not a namespace of ROS"))
            .suggest("letters, digits, _ and /, as in /robot1");
    }
}

fn view_rules(spec: &TaskSpec, violations: &mut Violations) {
    let container = spec.run.container.as_ref();
    if container.is_some_and(|run| run.network == Network::Bridge) {
        let reason = "a task with a ROS master of its own has no other network";
        violations
            .forbidden("spec.run.container.network", reason)
            .suggest("leave it out, or say None");
    }
    let probes =
        [("startup", &spec.startup), ("readiness", &spec.readiness), ("liveness", &spec.liveness)];
    for (role, probe) in probes {
        let topic = probe.as_ref().and_then(|probe| probe.topic.as_ref());
        if topic.is_some_and(|topic| topic.master.is_none()) {
            let reason = "the agent does not look into a graph that is the task's own";
            violations
                .forbidden(format!("spec.{role}.topic"), reason)
                .suggest("an exec probe, which runs inside of the task");
        }
    }
}
