//! What a node must have to be offered at all.

use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::wire::framework::v1 as proto;

/// A filter of nodes; everything it names must hold. The controller checks names and selectors.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Filter(pub(crate) proto::Filter);

impl Filter {
    /// Any node.
    #[must_use]
    pub fn any() -> Self {
        Filter::default()
    }

    /// Robots only.
    #[must_use]
    pub fn robots() -> Self {
        Filter::kind(proto::NodeKind::Robot)
    }

    /// Cloud servers only.
    #[must_use]
    pub fn clouds() -> Self {
        Filter::kind(proto::NodeKind::Cloud)
    }

    fn kind(kind: proto::NodeKind) -> Self {
        Filter(proto::Filter { kind: kind.into(), ..proto::Filter::default() })
    }

    /// Nodes whose labels match, in Kubernetes' grammar: `arch=amd64,floor in (1,2)`.
    #[must_use]
    pub fn selector(mut self, selector: impl Into<String>) -> Self {
        self.0.selector = selector.into();
        self
    }

    /// At least so much free.
    #[must_use]
    pub fn minimum(mut self, cpu: MilliCpu, memory: Bytes) -> Self {
        let minimum = self.0.minimum.get_or_insert_default();
        (minimum.cpu_millis, minimum.memory_bytes) = (cpu.0, memory.0);
        self
    }

    /// Each of these sensor functions, `kinect:LaserGen`.
    #[must_use]
    pub fn sensors<S: Into<String>>(mut self, sensors: impl IntoIterator<Item = S>) -> Self {
        self.0.sensors.extend(sensors.into_iter().map(Into::into));
        self
    }

    /// Each of these actuator functions, and free: `base:Drive`.
    #[must_use]
    pub fn actuators<S: Into<String>>(mut self, actuators: impl IntoIterator<Item = S>) -> Self {
        self.0.actuators.extend(actuators.into_iter().map(Into::into));
        self
    }

    /// Some actuator that nobody holds.
    #[must_use]
    pub fn free_actuators(mut self) -> Self {
        self.0.any_actuator = true;
        self
    }

    /// At most so many offers at once, the closest first.
    #[must_use]
    pub fn most(mut self, most: u32) -> Self {
        self.0.most = most;
        self
    }
}
