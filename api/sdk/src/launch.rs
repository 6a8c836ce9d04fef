//! Tasks to launch on what was offered. The controller checks them whole and names every field that is wrong.

use std::collections::HashMap;

use muster_api::kind::task::{RestartPolicy, TaskSpec};
use muster_api::wire::framework::v1 as proto;
use muster_api::wire::framework_session::struct_of;
use serde_json::{Map, Value, json};

/// One task to launch.
///
/// ```
/// # let offer = muster_sdk::wire::Offer::default();
/// use muster_sdk::Launch;
/// let launch = Launch::process(["rosrun", "nav", "goal"])
///     .cpu("500m")
///     .memory("64Mi")
///     .actuators(["base:Drive"])
///     .on(&offer);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Launch {
    offer: String,
    name: String,
    labels: HashMap<String, String>,
    /// An object.
    spec: Value,
}

impl Launch {
    fn new(spec: Value) -> Self {
        Launch { offer: String::new(), name: String::new(), labels: HashMap::new(), spec }
    }

    /// A process of the node.
    pub fn process<S: Into<String>>(command: impl IntoIterator<Item = S>) -> Self {
        let command: Vec<String> = command.into_iter().map(Into::into).collect();
        Launch::new(json!({"run": {"process": {"command": command}}}))
    }

    /// A container with its image's own command.
    pub fn container(image: impl Into<String>) -> Self {
        Launch::new(json!({"run": {"container": {"image": image.into()}}}))
    }

    /// A task for the executor that runs as the task `executor`; `data` says what it is to do.
    pub fn executor(executor: impl Into<String>, data: Map<String, Value>) -> Self {
        Launch::new(json!({"run": {"executor": {"task": executor.into(), "data": data}}}))
    }

    /// A task as its spec says; leave `placement.node` out, the offer decides it.
    #[must_use]
    pub fn spec(spec: &TaskSpec) -> Self {
        let spec = serde_json::to_value(spec);
        Launch::new(spec.expect("a spec's keys are strings and its numbers are finite"))
    }

    /// Where: the node that was offered.
    #[must_use]
    pub fn on(mut self, offer: &proto::Offer) -> Self {
        self.offer.clone_from(&offer.id);
        self
    }

    /// The Task object's name; without one, it is made from the framework's.
    #[must_use]
    pub fn name(mut self, name: impl Into<String>) -> Self {
        self.name = name.into();
        self
    }

    /// A label of the Task object.
    #[must_use]
    pub fn label(mut self, key: impl Into<String>, value: impl Into<String>) -> Self {
        self.labels.insert(key.into(), value.into());
        self
    }

    /// CPU that is reserved and not exceeded: `500m`, `2`.
    #[must_use]
    pub fn cpu(self, cpu: impl Into<String>) -> Self {
        self.resource("cpu", cpu.into().into())
    }

    /// Memory that is reserved and not exceeded: `64Mi`.
    #[must_use]
    pub fn memory(self, memory: impl Into<String>) -> Self {
        self.resource("memory", memory.into().into())
    }

    /// Sensor functions it reads, with others: `kinect:LaserGen`.
    #[must_use]
    pub fn sensors<S: Into<String>>(self, sensors: impl IntoIterator<Item = S>) -> Self {
        self.resource("sensors", sensors.into_iter().map(Into::into).collect())
    }

    /// Actuator functions that it alone drives: `base:Drive`.
    #[must_use]
    pub fn actuators<S: Into<String>>(self, actuators: impl IntoIterator<Item = S>) -> Self {
        self.resource("actuators", actuators.into_iter().map(Into::into).collect())
    }

    /// Whether the node starts it again when it ends.
    #[must_use]
    pub fn restart(mut self, policy: RestartPolicy) -> Self {
        let policy = serde_json::to_value(policy).expect("a policy is a word");
        self.spec["restartPolicy"] = policy;
        self
    }

    fn resource(mut self, field: &str, value: Value) -> Self {
        self.spec["resources"][field] = value;
        self
    }

    /// The id of the offer it is on; empty: none was named.
    pub(crate) fn offer(&self) -> &str {
        &self.offer
    }

    pub(crate) fn into_wire(self) -> proto::Launch {
        proto::Launch {
            offer: self.offer,
            name: self.name,
            labels: self.labels,
            annotations: HashMap::new(),
            spec: self.spec.as_object().map(struct_of),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(launch: Launch) -> TaskSpec {
        let fields = launch.into_wire().spec.expect("a spec");
        let json = muster_api::wire::framework_session::json_of(&fields);
        serde_json::from_value(Value::Object(json)).expect("what the controller reads")
    }

    #[test]
    fn what_is_built_is_what_the_controller_reads() {
        let launch = Launch::process(["nav", "1.5"])
            .cpu("500m")
            .memory("64Mi")
            .sensors(["kinect:LaserGen"])
            .actuators(["base:Drive"])
            .restart(RestartPolicy::Never);
        let built = spec(launch);
        assert_eq!(built.run.process.as_ref().expect("a process").command, ["nav", "1.5"]);
        assert_eq!(built.resources.cpu, Some("500m".parse().expect("cpu")));
        assert_eq!(built.resources.actuators[0].to_string(), "base:Drive");
        assert_eq!(built.restart_policy, RestartPolicy::Never);
        assert_eq!(spec(Launch::spec(&built)), built);
        let data = Map::from_iter([("goal".to_owned(), json!([1, 2]))]);
        let executor = spec(Launch::executor("driver", data.clone())).run.executor;
        let executor = executor.expect("an executor");
        assert_eq!((executor.task.as_str(), executor.data), ("driver", data));
    }
}
