//! Conversions of the agent session's messages.

use std::collections::BTreeMap;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use k8s_openapi::jiff::Timestamp;

use super::WireError;
use super::agent::v1 as proto;
use crate::condition::{Condition, ConditionStatus};
use crate::kind::node::estop::{EStopDemand, EStopStatus, EStopTier};
use crate::kind::node::image::ImageStatus;
use crate::kind::node::upkeep::Battery;
use crate::kind::node::{MissionLock, NodeKind, NodeSpec, RuntimeStatus};
use crate::kind::task::depend::DependencyCondition;
use crate::kind::task::{TaskSpec, TaskUsage};
use crate::name::FunctionName;
use crate::phase::TaskPhase;
use crate::pose::{Covariance, Pose};
use crate::quantity::{Bytes, MilliCpu};
use crate::resource::Compute;

/// A point in time → its wire form.
#[must_use]
pub fn timestamp_to_wire(time: &MicroTime) -> prost_types::Timestamp {
    prost_types::Timestamp { seconds: time.0.as_second(), nanos: time.0.subsec_nanosecond() }
}

/// Wire form → a point in time.
///
/// # Errors
///
/// When it is no time between the years −9999 and 9999.
pub fn timestamp_from_wire(
    field: &'static str,
    time: &prost_types::Timestamp,
) -> Result<MicroTime, WireError> {
    Timestamp::new(time.seconds, time.nanos)
        .map(MicroTime)
        .map_err(|e| WireError::invalid(field, e))
}

impl From<DependencyCondition> for proto::DependencyCondition {
    fn from(condition: DependencyCondition) -> Self {
        match condition {
            DependencyCondition::Running => proto::DependencyCondition::Running,
            DependencyCondition::Ready => proto::DependencyCondition::Ready,
            DependencyCondition::Succeeded => proto::DependencyCondition::Succeeded,
        }
    }
}

/// How far a task must have come.
///
/// # Errors
///
/// When it is unspecified or not known.
pub fn dependency_condition_from_wire(value: i32) -> Result<DependencyCondition, WireError> {
    use proto::DependencyCondition as Wire;
    match Wire::try_from(value) {
        Ok(Wire::Running) => Ok(DependencyCondition::Running),
        Ok(Wire::Ready) => Ok(DependencyCondition::Ready),
        Ok(Wire::Succeeded) => Ok(DependencyCondition::Succeeded),
        Ok(Wire::Unspecified) | Err(_) => {
            Err(WireError::invalid("dependency.condition", format!("{value} is no condition")))
        }
    }
}

impl From<NodeKind> for proto::NodeKind {
    fn from(kind: NodeKind) -> Self {
        match kind {
            NodeKind::Robot => proto::NodeKind::Robot,
            NodeKind::Cloud => proto::NodeKind::Cloud,
        }
    }
}

/// Wire form → a node's kind.
///
/// # Errors
///
/// When it is unspecified or not known.
pub fn node_kind_from_wire(value: i32) -> Result<NodeKind, WireError> {
    match proto::NodeKind::try_from(value) {
        Ok(proto::NodeKind::Robot) => Ok(NodeKind::Robot),
        Ok(proto::NodeKind::Cloud) => Ok(NodeKind::Cloud),
        Ok(proto::NodeKind::Unspecified) | Err(_) => {
            Err(WireError::UnknownEnum { field: "state.kind", value })
        }
    }
}

impl From<&Compute> for proto::Compute {
    fn from(compute: &Compute) -> Self {
        proto::Compute {
            cpu_millis: compute.cpu.0,
            memory_bytes: compute.memory.0,
            extended: compute.extended.clone().into_iter().collect(),
        }
    }
}

impl From<&proto::Compute> for Compute {
    fn from(compute: &proto::Compute) -> Self {
        Compute {
            cpu: MilliCpu(compute.cpu_millis),
            memory: Bytes(compute.memory_bytes),
            extended: compute.extended.clone().into_iter().collect::<BTreeMap<_, _>>(),
        }
    }
}

impl From<&Pose> for proto::Pose {
    fn from(pose: &Pose) -> Self {
        proto::Pose {
            map: pose.map.clone(),
            x: pose.x,
            y: pose.y,
            z: pose.z,
            yaw: pose.yaw,
            stamp: pose.stamp.as_ref().map(timestamp_to_wire),
            source: pose.source.clone(),
            localized: pose.localized,
            covariance: pose.covariance.map(|c| proto::Covariance {
                xx: c.xx,
                xy: c.xy,
                yy: c.yy,
                yaw: c.yaw,
            }),
        }
    }
}

impl TryFrom<&proto::Pose> for Pose {
    type Error = WireError;

    fn try_from(pose: &proto::Pose) -> Result<Self, WireError> {
        if ![pose.x, pose.y, pose.z, pose.yaw].iter().all(|n| n.is_finite()) {
            return Err(WireError::invalid("pose", "a coordinate is not a finite number"));
        }
        if pose.map.is_empty() {
            return Err(WireError::Missing("pose.map"));
        }
        Ok(Pose {
            map: pose.map.clone(),
            x: pose.x,
            y: pose.y,
            z: pose.z,
            yaw: pose.yaw,
            stamp: pose.stamp.as_ref().map(|s| timestamp_from_wire("pose.stamp", s)).transpose()?,
            source: pose.source.clone(),
            localized: pose.localized,
            covariance: pose.covariance.as_ref().map(covariance).transpose()?,
        })
    }
}

fn covariance(of: &proto::Covariance) -> Result<Covariance, WireError> {
    let proto::Covariance { xx, xy, yy, yaw } = *of;
    if ![xx, xy, yy, yaw].iter().all(|n| n.is_finite()) {
        return Err(WireError::invalid("pose.covariance", "a variance is not a finite number"));
    }
    Ok(Covariance { xx, xy, yy, yaw })
}

impl From<&RuntimeStatus> for proto::Runtime {
    fn from(runtime: &RuntimeStatus) -> Self {
        proto::Runtime {
            name: runtime.name.clone(),
            available: runtime.available,
            version: runtime.version.clone(),
            message: runtime.message.clone(),
        }
    }
}

impl From<&proto::Runtime> for RuntimeStatus {
    fn from(runtime: &proto::Runtime) -> Self {
        RuntimeStatus {
            name: runtime.name.clone(),
            available: runtime.available,
            version: runtime.version.clone(),
            message: runtime.message.clone(),
        }
    }
}

impl From<&proto::Condition> for Condition {
    fn from(condition: &proto::Condition) -> Self {
        Condition {
            r#type: condition.r#type.clone(),
            status: ConditionStatus::from(condition.status),
            reason: condition.reason.clone(),
            message: condition.message.clone(),
            last_transition_time: None,
        }
    }
}

/// What an agent says of its node, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeReport {
    /// What the node is.
    pub kind: NodeKind,
    /// Labels that the agent sets.
    pub labels: BTreeMap<String, String>,
    /// CR of the machine.
    pub capacity: Compute,
    /// CR that tasks may reserve.
    pub allocatable: Compute,
    /// SR.
    pub sensors: Vec<FunctionName>,
    /// AR.
    pub actuators: Vec<FunctionName>,
    /// Where the robot is.
    pub pose: Option<Pose>,
    /// How tasks can be run.
    pub runtimes: Vec<RuntimeStatus>,
    /// Facts that the agent knows.
    pub conditions: Vec<Condition>,
    /// Usual speed, m/s.
    pub speed: Option<f64>,
    /// The machine's address.
    pub address: String,
    /// The charge of its battery.
    pub battery: Option<Battery>,
    /// Mission locks that are set on the node itself.
    pub mission_locks: Vec<MissionLock>,
    /// What stops the robot; none: nothing stands before its drivers.
    pub estop: Option<EStopStatus>,
    /// Images that it was asked to have.
    pub images: Vec<ImageStatus>,
}

impl TryFrom<&proto::NodeState> for NodeReport {
    type Error = WireError;

    fn try_from(state: &proto::NodeState) -> Result<Self, WireError> {
        let functions = |field: &'static str, list: &[String]| {
            let parsed: Result<Vec<FunctionName>, _> = list.iter().map(|t| t.parse()).collect();
            parsed.map_err(|e| WireError::invalid(field, e))
        };
        let compute = |field, c: &Option<proto::Compute>| {
            c.as_ref().map(Compute::from).ok_or(WireError::Missing(field))
        };
        Ok(NodeReport {
            kind: node_kind_from_wire(state.kind)?,
            labels: state.labels.clone().into_iter().collect(),
            capacity: compute("state.capacity", &state.capacity)?,
            allocatable: compute("state.allocatable", &state.allocatable)?,
            sensors: functions("state.sensors", &state.sensors)?,
            actuators: functions("state.actuators", &state.actuators)?,
            pose: state.pose.as_ref().map(Pose::try_from).transpose()?,
            runtimes: state.runtimes.iter().map(RuntimeStatus::from).collect(),
            conditions: state.conditions.iter().map(Condition::from).collect(),
            speed: (state.speed_mps > 0.0 && state.speed_mps.is_finite())
                .then_some(state.speed_mps),
            address: state.address.clone(),
            battery: state.battery.as_ref().map(|battery| Battery {
                percent: u8::try_from(battery.percent).unwrap_or(u8::MAX).min(100),
                charging: battery.charging,
            }),
            mission_locks: state
                .mission_locks
                .iter()
                .map(|lock| MissionLock {
                    holder: lock.holder.clone(),
                    reason: lock.reason.clone(),
                })
                .collect(),
            estop: state.estop.as_ref().map(EStopStatus::from),
            images: state.images.iter().map(ImageStatus::try_from).collect::<Result<_, _>>()?,
        })
    }
}

impl From<&proto::EStop> for EStopStatus {
    fn from(wire: &proto::EStop) -> Self {
        let demand = |demand: &proto::EStopDemand| EStopDemand {
            source: demand.source.clone(),
            tier: EStopTier::from_number(demand.tier),
        };
        EStopStatus {
            tier: EStopTier::from_number(wire.tier),
            number: wire.number,
            demands: wire.demands.iter().map(demand).collect(),
        }
    }
}

impl From<&EStopStatus> for proto::EStop {
    fn from(status: &EStopStatus) -> Self {
        let demand = |demand: &EStopDemand| proto::EStopDemand {
            source: demand.source.clone(),
            tier: demand.tier.number(),
        };
        proto::EStop {
            tier: status.tier.number(),
            number: status.number,
            demands: status.demands.iter().map(demand).collect(),
        }
    }
}

/// What people decide about a node that its agent must know.
#[must_use]
pub fn node_order(spec: &NodeSpec) -> proto::NodeOrder {
    proto::NodeOrder {
        estop_tier: spec.estop.number(),
        estop_release: spec.estop_release.unwrap_or_default(),
        ..proto::NodeOrder::default()
    }
}

impl From<&NodeReport> for proto::NodeState {
    fn from(report: &NodeReport) -> Self {
        let texts = |list: &[FunctionName]| list.iter().map(ToString::to_string).collect();
        proto::NodeState {
            kind: proto::NodeKind::from(report.kind).into(),
            labels: report.labels.clone().into_iter().collect(),
            capacity: Some((&report.capacity).into()),
            allocatable: Some((&report.allocatable).into()),
            sensors: texts(&report.sensors),
            actuators: texts(&report.actuators),
            pose: report.pose.as_ref().map(proto::Pose::from),
            runtimes: report.runtimes.iter().map(proto::Runtime::from).collect(),
            conditions: report
                .conditions
                .iter()
                .map(|c| proto::Condition {
                    r#type: c.r#type.clone(),
                    status: c.status == ConditionStatus::True,
                    reason: c.reason.clone(),
                    message: c.message.clone(),
                })
                .collect(),
            speed_mps: report.speed.unwrap_or(0.0),
            boot_id: String::new(),
            address: report.address.clone(),
            battery: report.battery.map(|battery| proto::Battery {
                percent: battery.percent.into(),
                charging: battery.charging,
            }),
            mission_locks: report
                .mission_locks
                .iter()
                .map(|lock| proto::MissionLock {
                    holder: lock.holder.clone(),
                    reason: lock.reason.clone(),
                })
                .collect(),
            estop: report.estop.as_ref().map(proto::EStop::from),
            person_epoch: 0,
            images: report.images.iter().map(proto::ImageState::from).collect(),
        }
    }
}

/// The phase that an agent reports → a task's phase.
///
/// # Errors
///
/// When it is unspecified or not known.
pub fn phase_from_wire(value: i32) -> Result<TaskPhase, WireError> {
    use proto::TaskPhase as Wire;
    match Wire::try_from(value) {
        Ok(Wire::Starting) => Ok(TaskPhase::Starting),
        Ok(Wire::Running) => Ok(TaskPhase::Running),
        Ok(Wire::Stopping) => Ok(TaskPhase::Stopping),
        Ok(Wire::Succeeded) => Ok(TaskPhase::Succeeded),
        Ok(Wire::Failed) => Ok(TaskPhase::Failed),
        Ok(Wire::Unspecified) | Err(_) => {
            Err(WireError::UnknownEnum { field: "task.phase", value })
        }
    }
}

/// Reads the spec that an assignment carries.
///
/// # Errors
///
/// With the field at which it cannot be read.
pub fn spec_from_wire(bytes: &[u8]) -> Result<TaskSpec, WireError> {
    let mut deserializer = serde_json::Deserializer::from_slice(bytes);
    serde_path_to_error::deserialize(&mut deserializer)
        .map_err(|e| WireError::invalid("assignment.spec", format!("{}: {}", e.path(), e.inner())))
}

/// The spec as an assignment carries it.
#[must_use]
pub fn spec_to_wire(spec: &TaskSpec) -> Vec<u8> {
    serde_json::to_vec(spec).expect("a spec's fields are texts, numbers, lists and maps")
}

impl From<&proto::Usage> for TaskUsage {
    fn from(usage: &proto::Usage) -> Self {
        TaskUsage { cpu: MilliCpu(usage.cpu_millis), memory: Bytes(usage.memory_bytes) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kind::node::image::{ImagePhase, ImageWish};
    use crate::kind::task::PullPolicy;

    fn report() -> NodeReport {
        NodeReport {
            kind: NodeKind::Robot,
            labels: BTreeMap::from([("a".to_owned(), "b".to_owned())]),
            capacity: Compute::new(MilliCpu(2000), Bytes(1 << 30)),
            allocatable: Compute::new(MilliCpu(1500), Bytes(1 << 29)),
            sensors: vec!["kinect:ImageGen".parse().expect("a name")],
            actuators: vec!["base:Drive".parse().expect("a name")],
            pose: Some(Pose {
                map: "lab".to_owned(),
                x: 1.0,
                y: 2.0,
                z: 0.0,
                yaw: 0.5,
                stamp: Some(MicroTime(Timestamp::from_second(5).expect("in range"))),
                source: "static".to_owned(),
                localized: true,
                covariance: Some(Covariance { xx: 0.25, xy: 0.01, yy: 0.5, yaw: 0.1 }),
            }),
            runtimes: Vec::new(),
            conditions: Vec::new(),
            speed: Some(0.5),
            address: "127.0.0.1".to_owned(),
            battery: Some(Battery { percent: 83, charging: true }),
            mission_locks: vec![MissionLock {
                holder: "task default/patrol".to_owned(),
                reason: "carries a tray".to_owned(),
            }],
            estop: Some(EStopStatus {
                tier: EStopTier::Cut,
                number: 3,
                demands: vec![EStopDemand {
                    source: "button on the robot".to_owned(),
                    tier: EStopTier::Cut,
                }],
            }),
            images: vec![ImageStatus {
                wish: ImageWish {
                    image: "lab/detector:2".to_owned(),
                    pull_policy: PullPolicy::Always,
                    since: MicroTime(Timestamp::from_second(7).expect("in range")),
                },
                phase: ImagePhase::BackOff,
                reason: "ImagePullFailed".to_owned(),
                message: "no such image".to_owned(),
                failures: 2,
            }],
        }
    }

    #[test]
    fn a_node_report_survives_the_wire() {
        let wire = proto::NodeState::from(&report());
        assert_eq!(NodeReport::try_from(&wire), Ok(report()));
    }

    #[test]
    fn what_is_missing_or_unspecified_is_named() {
        let mut wire = proto::NodeState::from(&report());
        wire.kind = 0;
        assert_eq!(
            NodeReport::try_from(&wire),
            Err(WireError::UnknownEnum { field: "state.kind", value: 0 })
        );
        wire = proto::NodeState::from(&report());
        wire.capacity = None;
        assert_eq!(NodeReport::try_from(&wire), Err(WireError::Missing("state.capacity")));
        wire = proto::NodeState::from(&report());
        wire.pose.as_mut().expect("set above").x = f64::NAN;
        assert!(NodeReport::try_from(&wire).is_err());
        assert!(phase_from_wire(0).is_err() && phase_from_wire(99).is_err());
    }
}
