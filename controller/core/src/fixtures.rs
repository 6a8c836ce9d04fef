//! Nodes for tests.

use muster_api::condition::{self, Condition, ConditionStatus};
use muster_api::kind::node::{Node, NodeKind, NodeSpec, NodeStatus, RuntimeStatus};
use muster_api::name::NodeName;
use muster_api::pose::Pose;
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::{Compute, parse_function_list};

/// A node's name.
pub(crate) fn name(text: &str) -> NodeName {
    NodeName::new(text).expect("a name")
}

/// A ready node with 1 GiB; a robot has a camera, a base and an arm.
pub(crate) fn node(kind: NodeKind, cpu: u64, at: Option<(f64, f64)>) -> Node {
    let mut node = Node::new("n", NodeSpec::new(kind));
    let robot = kind == NodeKind::Robot;
    let functions = |text| parse_function_list(text).expect("functions").into_iter().collect();
    node.status = Some(NodeStatus {
        allocatable: Compute::new(MilliCpu(cpu), Bytes(1 << 30)),
        sensors: if robot { functions("kinect:ImageGen,LaserGen") } else { Vec::new() },
        actuators: if robot { functions("base:Drive;arm:Grasp") } else { Vec::new() },
        pose: at.map(|(x, y)| Pose {
            map: "map".to_owned(),
            x,
            y,
            z: 0.0,
            yaw: 0.0,
            stamp: None,
            source: String::new(),
            localized: true,
            covariance: None,
        }),
        conditions: vec![Condition {
            r#type: condition::READY.to_owned(),
            status: ConditionStatus::True,
            reason: String::new(),
            message: String::new(),
            last_transition_time: None,
        }],
        runtimes: vec![RuntimeStatus {
            name: "process".to_owned(),
            available: true,
            version: String::new(),
            message: String::new(),
        }],
        ..NodeStatus::default()
    });
    node
}
