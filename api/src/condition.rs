//! Conditions of an object, as Kubernetes writes them.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Whether a condition holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
pub enum ConditionStatus {
    /// It holds.
    True,
    /// It does not hold.
    False,
    /// Not known now.
    Unknown,
}

impl From<bool> for ConditionStatus {
    fn from(holds: bool) -> Self {
        if holds { ConditionStatus::True } else { ConditionStatus::False }
    }
}

/// One named fact about an object, with the reason it is so.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct Condition {
    /// Which fact, `Ready`.
    pub r#type: String,
    /// Whether it holds.
    pub status: ConditionStatus,
    /// Why, in one CamelCase word.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub reason: String,
    /// Why, in a sentence.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub message: String,
    /// When `status` last changed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last_transition_time: Option<Time>,
}

impl Condition {
    /// A condition as it is said; [`set_condition`] fills in since when.
    #[must_use]
    pub fn new(
        r#type: &str,
        status: impl Into<ConditionStatus>,
        reason: &str,
        message: impl Into<String>,
    ) -> Self {
        Condition {
            r#type: r#type.to_owned(),
            status: status.into(),
            reason: reason.to_owned(),
            message: message.into(),
            last_transition_time: None,
        }
    }
}

/// The node takes part: its agent has been heard within the detection time.
pub const READY: &str = "Ready";
/// A person confirmed that the node is off or that its processes are gone; what it held was given free.
pub const FENCED: &str = "Fenced";
/// The robot's battery has at least the charge below which nothing new begins there.
pub const BATTERY: &str = "Battery";
/// People work on the node (see `spec.maintenance`): nothing new begins there.
pub const MAINTENANCE: &str = "Maintenance";
/// The disk of the agent's data directory is nearly full: nothing new begins there.
pub const DISK_PRESSURE: &str = "DiskPressure";
/// Every actuator of the robot has a driver behind the gate, which is there: commands are checked, and stops reach it.
pub const ACTUATORS_FENCED: &str = "ActuatorsFenced";
/// An emergency stop is in force on the robot.
pub const EMERGENCY_STOP: &str = "EmergencyStop";
/// What the robot's pose is read from says something new in time.
pub const POSE_FRESH: &str = "PoseFresh";
/// The robot knows where it is.
pub const LOCALIZED: &str = "Localized";
/// Every sensor that a task of the node asked for, and that has a source, delivers.
pub const SENSORS_READY: &str = "SensorsReady";
/// Quotas of tasks are enforced by the kernel on this node (invariant 7).
pub const QUOTAS_ENFORCED: &str = "QuotasEnforced";

/// Of a TaskSet: enough of its tasks are available.
pub const AVAILABLE: &str = "Available";
/// Of a TaskSet: its tasks are, or are becoming, what the template says.
pub const PROGRESSING: &str = "Progressing";

/// Of a TaskSet: some of its tasks cannot be created.
pub const REPLICA_FAILURE: &str = "ReplicaFailure";

/// Of an Application: something about it is not as it should be, and its reason says what.
pub const DEGRADED: &str = "Degraded";
/// Of an Application: muster runs its parts and moves them.
pub const MANAGED: &str = "Managed";
/// Of an Application: what it is and where it may run has been worked out from the newest spec.
pub const CHARACTERISED: &str = "Characterised";
/// Of an Application: the node that is its home exists and holds all of its parts at once, as it must when every link is
/// lost.
pub const FITS_HOME: &str = "FitsHome";

/// Sets the condition of the same type, or adds it; the transition time moves only when the status
/// changes. Says whether anything changed.
pub fn set_condition(conditions: &mut Vec<Condition>, mut new: Condition, now: &Time) -> bool {
    let Some(old) = conditions.iter_mut().find(|c| c.r#type == new.r#type) else {
        new.last_transition_time = Some(now.clone());
        conditions.push(new);
        return true;
    };
    new.last_transition_time =
        if old.status == new.status { old.last_transition_time.clone() } else { Some(now.clone()) };
    let changed = *old != new;
    *old = new;
    changed
}

#[cfg(test)]
mod tests {
    use k8s_openapi::jiff::Timestamp;

    use super::*;

    fn ready(status: ConditionStatus, message: &str) -> Condition {
        Condition {
            r#type: READY.to_owned(),
            status,
            reason: String::new(),
            message: message.to_owned(),
            last_transition_time: None,
        }
    }

    #[test]
    fn the_transition_time_moves_only_with_the_status() {
        let at = |s| Time(Timestamp::from_second(s).expect("in range"));
        let mut all = Vec::new();
        assert!(set_condition(&mut all, ready(ConditionStatus::True, ""), &at(1)));
        assert!(set_condition(&mut all, ready(ConditionStatus::True, "still"), &at(2)));
        assert_eq!(all[0].last_transition_time, Some(at(1)));
        assert!(!set_condition(&mut all, ready(ConditionStatus::True, "still"), &at(3)));
        assert!(set_condition(&mut all, ready(ConditionStatus::Unknown, "still"), &at(4)));
        assert_eq!(all[0].last_transition_time, Some(at(4)));
        assert_eq!(all.len(), 1);
    }
}
