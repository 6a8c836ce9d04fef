//! Which parts never leave their robot, and why (AnyScale III-B, "critical nodes").
//!
//! It follows from the spec alone, so mappings that would break it are pruned before any is ever considered.

use std::fmt;

use super::{ApplicationSpec, Part, Runs};
use crate::name::FunctionName;

/// One reason why a part stays at home.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Pin {
    /// A connection of it tolerates no pause, and no network promises that.
    NoTolerance {
        /// The topic.
        topic: String,
        /// The part at its other end.
        other: String,
    },
    /// It reads the robot's sensor.
    Sensor {
        /// Which.
        function: FunctionName,
    },
    /// It drives the robot's actuator.
    Actuator {
        /// Which.
        function: FunctionName,
    },
    /// It gives its data once and is done; there is nothing to gain elsewhere.
    Once,
}

impl Pin {
    /// The reason as one word, for programs.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        match self {
            Pin::NoTolerance { .. } => "NoTolerance",
            Pin::Sensor { .. } => "Sensor",
            Pin::Actuator { .. } => "Actuator",
            Pin::Once => "Once",
        }
    }
}

impl fmt::Display for Pin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Pin::NoTolerance { topic, other } => {
                write!(f, "its connection {topic} with {other} tolerates no pause")
            }
            Pin::Sensor { function } => write!(f, "it reads the sensor {function}"),
            Pin::Actuator { function } => write!(f, "it drives the actuator {function}"),
            Pin::Once => f.write_str("it runs once, and would gain nothing elsewhere"),
        }
    }
}

/// Every reason why `part` stays at home; none: it may move.
#[must_use]
pub fn pins(spec: &ApplicationSpec, part: &Part) -> Vec<Pin> {
    let resources = &part.template.spec.resources;
    let mut pins = Vec::new();
    pins.extend((part.runs == Runs::Once).then_some(Pin::Once));
    pins.extend(resources.sensors.iter().cloned().map(|function| Pin::Sensor { function }));
    pins.extend(resources.actuators.iter().cloned().map(|function| Pin::Actuator { function }));
    for connection in &spec.connections {
        let other = match part.name.as_str() {
            name if name == connection.from => &connection.to,
            name if name == connection.to => &connection.from,
            _ => continue,
        };
        // Without a threshold there is no frequency that a pause could break.
        if connection.min_hz.is_some() && connection.tolerance.as_duration().is_zero() {
            let (topic, other) = (connection.topic.clone(), other.clone());
            pins.push(Pin::NoTolerance { topic, other });
        }
    }
    pins
}
