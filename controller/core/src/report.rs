//! Typed reasons: why a node does not take a task, in the order of how hard they are to change.
//!
//! Each says what is so and what would have to change. `reason()` is the word for programs,
//! `Display` the sentence for people.

use std::fmt;

use muster_api::kind::node::{NodeKind, Taint};
use muster_api::kind::task::NodeRefusal;
use muster_api::name::FunctionName;
use muster_api::resource::Shortage;

use crate::site::NoWay;

/// Why one node does not take one task.
#[derive(Debug, Clone, PartialEq)]
pub enum Refusal {
    /// The task is pinned to another node.
    PinnedElsewhere {
        /// The node it is pinned to.
        node: String,
    },
    /// The task may not run on this kind of node.
    WrongKind {
        /// What the node is.
        kind: NodeKind,
        /// Because of `placement.on`, or else because of the sensors and actuators it needs.
        by_choice: bool,
    },
    /// The node's labels do not match.
    SelectorMismatch {
        /// The selector.
        selector: String,
    },
    /// The node cannot run this form of program.
    NoRuntime {
        /// `process` or `docker`.
        runtime: &'static str,
        /// What the node says about it.
        message: String,
    },
    /// The task is work for an executor that is not there.
    NoExecutor {
        /// Name of the executor's task.
        task: String,
    },
    /// A task that this one is to be apart from is there.
    Apart {
        /// `namespace/name` of that task.
        task: String,
    },
    /// The robot has no such sensor functions.
    NoSensor {
        /// Those it has not.
        missing: Vec<FunctionName>,
    },
    /// The robot has no such actuator functions.
    NoActuator {
        /// Those it has not.
        missing: Vec<FunctionName>,
    },
    /// More is asked than the node has in all.
    TooSmall {
        /// Of what, with the node's whole allocatable as `left`.
        shortage: Shortage,
    },
    /// A taint is not tolerated.
    Tainted {
        /// The taint.
        taint: Taint,
    },
    /// What is wrong with the node for now puts a taint on it that is not tolerated.
    OutOfService {
        /// The taint.
        taint: Taint,
    },
    /// The node is cordoned.
    Cordoned,
    /// The agent is not heard, or has not cleaned up what it should not run.
    NotReady {
        /// What the Ready condition says.
        message: String,
    },
    /// The robot has not said where it is.
    NoPose,
    /// The robot does not know where it is.
    NotLocalized,
    /// The robot is in another map.
    OtherMap {
        /// The robot's.
        robot: String,
        /// The operation position's.
        wanted: String,
    },
    /// The robot is too far away.
    OutOfRange {
        /// Metres to the operation position.
        distance: f64,
        /// Metres allowed.
        within: f64,
    },
    /// Over the floor of its map's Site no way leads to the operation position.
    Unreachable {
        /// The Site.
        site: String,
        /// Why.
        why: NoWay,
    },
    /// The robot's battery has less charge than the task asks for.
    BatteryLow {
        /// What it has, percent.
        percent: u8,
        /// What the task asks for, percent.
        wanted: u8,
    },
    /// The cost TravelTime needs a speed.
    NoSpeed,
    /// Less is left than is asked.
    Exhausted {
        /// Of what.
        shortage: Shortage,
    },
    /// Another task holds the actuators.
    LeaseHeld {
        /// The conflict group.
        group: String,
        /// `namespace/name` of the holder.
        holder: String,
    },
    /// It would fit, but others are being ended there to make room for a task that is more important, or came first.
    Kept {
        /// For whom, `namespace/name`.
        title: String,
    },
    /// It would fit, and is left for a moment to a framework.
    Left {
        /// The framework's namespace, which has a smaller share of the pool.
        namespace: String,
    },
}

impl Refusal {
    /// The reason as one word, for programs.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        match self {
            Refusal::PinnedElsewhere { .. } => "PinnedElsewhere",
            Refusal::WrongKind { .. } => "WrongKind",
            Refusal::SelectorMismatch { .. } => "SelectorMismatch",
            Refusal::NoRuntime { .. } => "NoRuntime",
            Refusal::NoExecutor { .. } => "NoExecutor",
            Refusal::Apart { .. } => "Apart",
            Refusal::NoSensor { .. } => "NoSensor",
            Refusal::NoActuator { .. } => "NoActuator",
            Refusal::TooSmall { .. } => "TooSmall",
            Refusal::Tainted { .. } => "Tainted",
            Refusal::OutOfService { .. } => "OutOfService",
            Refusal::Cordoned => "Cordoned",
            Refusal::NotReady { .. } => "NotReady",
            Refusal::NoPose => "NoPose",
            Refusal::NotLocalized => "NotLocalized",
            Refusal::OtherMap { .. } => "OtherMap",
            Refusal::OutOfRange { .. } => "OutOfRange",
            Refusal::Unreachable { .. } => "Unreachable",
            Refusal::BatteryLow { .. } => "BatteryLow",
            Refusal::NoSpeed => "NoSpeed",
            Refusal::Exhausted { .. } => "Exhausted",
            Refusal::LeaseHeld { .. } => "LeaseHeld",
            Refusal::Kept { .. } => "KeptForAnother",
            Refusal::Left { .. } => "LeftToFramework",
        }
    }

    /// The refusal as a task's status carries it.
    #[must_use]
    pub fn of_node(&self, node: &str) -> NodeRefusal {
        NodeRefusal {
            node: node.to_owned(),
            reason: self.reason().to_owned(),
            message: self.to_string(),
        }
    }
}

fn list(functions: &[FunctionName]) -> String {
    functions.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

/// `asks 800m cpu, 200m of it …`: the numbers of a shortage, with what `left` means put in.
fn shortage(f: &mut fmt::Formatter<'_>, shortage: &Shortage, left_is: &str) -> fmt::Result {
    match shortage {
        Shortage::Cpu { asked, left } => write!(f, "asks for {asked} cpu, {left} {left_is}"),
        Shortage::Memory { asked, left } => write!(f, "asks for {asked} memory, {left} {left_is}"),
        Shortage::Extended { name, asked, left } => {
            write!(f, "asks for {asked} {name}, {left} {left_is}")
        }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Refusal::PinnedElsewhere { node } => {
                write!(f, "placement.node pins the task to {node}")
            }
            Refusal::WrongKind { kind, by_choice: true } => {
                write!(f, "is a {kind:?}; placement.on asks for another kind")
            }
            Refusal::WrongKind { kind, by_choice: false } => {
                write!(f, "is a {kind:?} and has no sensors or actuators; the task needs some")
            }
            Refusal::SelectorMismatch { selector } => write!(f, "has not the labels {selector}"),
            Refusal::NoRuntime { runtime, message } if message.is_empty() => {
                write!(f, "cannot run a {runtime} task")
            }
            Refusal::NoRuntime { runtime, message } => {
                write!(f, "cannot run a {runtime} task: {message}")
            }
            Refusal::NoExecutor { task } => {
                write!(f, "does not run the executor {task}")
            }
            Refusal::Apart { task } => {
                write!(f, "has {task}, from which placement.apart keeps the task away")
            }
            Refusal::NoSensor { missing } => write!(f, "has no sensor {}", list(missing)),
            Refusal::NoActuator { missing } if missing.is_empty() => {
                f.write_str("has no actuators")
            }
            Refusal::NoActuator { missing } => write!(f, "has no actuator {}", list(missing)),
            Refusal::TooSmall { shortage: s } => shortage(f, s, "is all the node has"),
            Refusal::Tainted { taint } => {
                write!(f, "has the taint {}", taint.key)?;
                if !taint.value.is_empty() {
                    write!(f, "={}", taint.value)?;
                }
                f.write_str(", which the task does not tolerate")
            }
            Refusal::OutOfService { taint } => {
                write!(
                    f,
                    "is out of service for now: {}, which the task does not tolerate",
                    taint.key
                )
            }
            Refusal::Cordoned => f.write_str("is cordoned; `muster uncordon` lets tasks in again"),
            Refusal::NotReady { message } if message.is_empty() => f.write_str("is not ready"),
            Refusal::NotReady { message } => write!(f, "is not ready: {message}"),
            Refusal::NoPose => {
                f.write_str("has not said where it is; the task has an operation position")
            }
            Refusal::NotLocalized => f.write_str("does not know where it is (not localized)"),
            Refusal::OtherMap { robot, wanted } => {
                write!(f, "is in the map {robot:?}, the work is in {wanted:?}")
            }
            Refusal::OutOfRange { distance, within } => {
                write!(
                    f,
                    "is {distance:.1} m from the operation position, at most {within:.1} m are allowed"
                )
            }
            Refusal::Unreachable { site, why: NoWay::Enclosed } => {
                write!(f, "has no way to the operation position over the floor of site {site}")
            }
            Refusal::Unreachable { site, why: NoWay::WorkOffFloor } => {
                write!(f, "has no way: the operation position is not on free floor of site {site}")
            }
            Refusal::Unreachable { site, why: NoWay::RobotOffFloor } => {
                write!(f, "has no way: it is not on free floor of site {site} itself")
            }
            Refusal::BatteryLow { percent, wanted } => {
                write!(
                    f,
                    "has {percent} % of its battery, placement.minBattery asks for {wanted} %"
                )
            }
            Refusal::NoSpeed => f.write_str(
                "has no speed, which the cost TravelTime needs; set spec.speed of the node",
            ),
            Refusal::Exhausted { shortage: s } => {
                shortage(f, s, "left; waits until other tasks free it")
            }
            // A person's holding has a uid and no task: `LeaseHolder::person`.
            Refusal::LeaseHeld { group, holder } if holder.starts_with("user ") => {
                write!(f, "actuators ({group}) are held by {holder}; waits until they are returned")
            }
            Refusal::LeaseHeld { group, holder } => {
                write!(
                    f,
                    "actuators ({group}) are held by {holder}; waits until its processes are gone"
                )
            }
            Refusal::Left { namespace } => write!(
                f,
                "is left for a moment to frameworks of namespace {namespace}, which has a smaller share"
            ),
            Refusal::Kept { title } => {
                write!(f, "what is left is kept for {title}, for which others are being ended")
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use muster_api::quantity::MilliCpu;

    use super::*;

    #[test]
    fn sentences_give_the_numbers_and_what_would_have_to_change() {
        let short = Shortage::Cpu { asked: MilliCpu(800), left: MilliCpu(200) };
        assert_eq!(
            Refusal::Exhausted { shortage: short.clone() }.to_string(),
            "asks for 800m cpu, 200m left; waits until other tasks free it"
        );
        assert_eq!(
            Refusal::TooSmall { shortage: short }.to_string(),
            "asks for 800m cpu, 200m is all the node has"
        );
        assert_eq!(
            Refusal::OutOfRange { distance: 21.26, within: 20.0 }.to_string(),
            "is 21.3 m from the operation position, at most 20.0 m are allowed"
        );
    }
}
