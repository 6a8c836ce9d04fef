//! Which ROS a task belongs to.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::TaskSpec;
use super::probe::{is_master, is_topic};
use crate::validate::Violations;

/// The word for the master of the node that the task is on.
const ROBOT: &str = "Robot";

/// What the environment of a task's program says of ROS 1: `ROS_MASTER_URI`, `ROS_NAMESPACE`, and `ROS_IP` or `ROS_HOSTNAME`
/// where its network is the node's. What the task sets itself goes first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct RosSpec {
    /// `Robot`: the master that the node's agent knows (`--ros-master`); or `http://HOST:PORT`.
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
    /// The master's address; none: that which the node knows.
    #[must_use]
    pub fn uri(&self) -> Option<&str> {
        (self.master != ROBOT).then_some(&*self.master)
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
            .suggest("Robot for the master of the task's node, or http://HOST:PORT");
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
