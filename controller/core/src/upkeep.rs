//! When a node is out of service for a while: its battery is low, or people work on it.
//!
//! What is decided becomes conditions of the Node; the conditions put taints on it ([`passing_taints`]), and placement and
//! offers go by those. A task that tolerates the taint is placed all the same: a drive to the charger, a test run.
//!
//! [`passing_taints`]: muster_api::kind::node::upkeep::passing_taints

use jiff::Timestamp;
use muster_api::condition::{BATTERY, Condition, ConditionStatus, MAINTENANCE};
use muster_api::kind::node::upkeep::{
    BATTERY_MARGIN, DEFAULT_MIN_BATTERY, MAINTENANCE_TAINT, MaintenanceWindow, Moment,
    passing_taint,
};
use muster_api::kind::node::{Node, NodeStatus};
use muster_api::kind::task::TaskSpec;

/// What is so of a node now.
#[derive(Debug, Clone, PartialEq)]
pub struct Upkeep {
    /// The conditions that are ours, without transition times; one that is not here does not apply.
    pub conditions: Vec<Condition>,
    /// Tasks that do not tolerate it are to end: the sentence that says why.
    pub drain: Option<String>,
    /// When to look again, if nothing changes before.
    pub look_again: Option<Timestamp>,
}

/// Looks at a node.
#[must_use]
pub fn upkeep(node: &Node, now: Timestamp) -> Upkeep {
    let nothing = NodeStatus::default();
    let status = node.status.as_ref().unwrap_or(&nothing);
    let mut upkeep = Upkeep { conditions: Vec::new(), drain: None, look_again: None };
    upkeep.conditions.extend(battery(node, status));
    let windows = &node.spec.maintenance;
    if windows.is_empty() {
        return upkeep;
    }
    let mut open: Option<(Timestamp, &MaintenanceWindow)> = None;
    // Of those that drain, the one that ends first: until then at least it is so.
    let mut drain: Option<(Timestamp, &MaintenanceWindow)> = None;
    for window in windows {
        let (until, next) = match window.at(now) {
            Moment::Open { until } => (Some(until), Some(until)),
            Moment::Closed { next } => (None, next),
        };
        if let Some(until) = until {
            if window.drain && drain.is_none_or(|(first, _)| until < first) {
                drain = Some((until, window));
            }
            if open.is_none_or(|(latest, _)| until > latest) {
                open = Some((until, window));
            }
        }
        upkeep.look_again = upkeep.look_again.into_iter().chain(next).min();
    }
    if node.mission_lock().is_none() {
        upkeep.drain = drain.map(|of| format!("its node is in maintenance {}", until(of)));
    }
    upkeep.conditions.push(match open.map(until) {
        Some(message) => Condition::new(MAINTENANCE, true, "WindowOpen", message),
        None => Condition::new(MAINTENANCE, false, "WindowClosed", String::new()),
    });
    upkeep
}

fn until((end, window): (Timestamp, &MaintenanceWindow)) -> String {
    match window.reason.is_empty() {
        true => format!("until {end}"),
        false => format!("until {end}: {}", window.reason),
    }
}

/// Low below the least, and until it is a margin above it.
fn battery(node: &Node, status: &NodeStatus) -> Option<Condition> {
    let battery = status.battery?;
    let least = node.spec.min_battery.unwrap_or(DEFAULT_MIN_BATTERY);
    let was_low = status.condition(BATTERY).is_some_and(|c| c.status == ConditionStatus::False);
    let margin = if was_low { BATTERY_MARGIN } else { 0 };
    // The least that a full battery must have is never above full.
    let enough = battery.percent >= least.saturating_add(margin).min(100);
    let message = format!("nothing new begins here below {least} %");
    Some(if enough {
        Condition::new(BATTERY, true, "Charged", String::new())
    } else {
        Condition::new(BATTERY, false, "BatteryLow", message)
    })
}

/// Whether a task stays on a node that is drained for maintenance.
#[must_use]
pub fn stays(task: &TaskSpec) -> bool {
    let taint = passing_taint(MAINTENANCE_TAINT);
    task.placement.tolerations.iter().any(|toleration| toleration.tolerates(&taint))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use muster_api::kind::node::upkeep::Battery;
    use muster_api::kind::node::{MISSION_LOCK, NodeKind, NodeSpec};
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    fn at(text: &str) -> Timestamp {
        text.parse().expect("a time")
    }

    fn robot() -> Node {
        Node::new("r", NodeSpec::new(NodeKind::Robot))
    }

    fn holds(upkeep: &Upkeep, r#type: &str) -> Option<bool> {
        let condition = upkeep.conditions.iter().find(|c| c.r#type == r#type);
        condition.map(|c| c.status == ConditionStatus::True)
    }

    #[test]
    fn a_node_of_which_nothing_is_said_has_no_such_conditions() {
        let nothing = Upkeep { conditions: Vec::new(), drain: None, look_again: None };
        assert_eq!(upkeep(&robot(), at("2026-01-01T00:00:00Z")), nothing);
    }

    #[test]
    fn a_window_drains_unless_the_robot_is_on_a_mission() {
        let mut node = robot();
        let window = |start: &str, lasts: &str, drain: bool, reason: &str| {
            serde_json::from_value(
                json!({"start": start, "lasts": lasts, "drain": drain, "reason": reason}),
            )
            .expect("a window")
        };
        node.spec.maintenance = vec![
            window("2026-03-01T02:00:00Z", "2h", true, "new wheels"),
            window("2026-03-01T03:00:00Z", "4h", false, ""),
        ];
        let before = upkeep(&node, at("2026-03-01T01:00:00Z"));
        assert_eq!(holds(&before, MAINTENANCE), Some(false));
        assert_eq!(before.look_again, Some(at("2026-03-01T02:00:00Z")));
        let first = upkeep(&node, at("2026-03-01T02:30:00Z"));
        assert_eq!(holds(&first, MAINTENANCE), Some(true));
        assert_eq!(
            first.drain.as_deref(),
            Some("its node is in maintenance until 2026-03-01T04:00:00Z: new wheels")
        );
        assert_eq!(first.look_again, Some(at("2026-03-01T03:00:00Z")));
        let both = upkeep(&node, at("2026-03-01T03:30:00Z"));
        let maintenance =
            both.conditions.iter().find(|c| c.r#type == MAINTENANCE).map(|c| &*c.message);
        assert_eq!(
            maintenance,
            Some("until 2026-03-01T07:00:00Z"),
            "it lasts until the last one ends"
        );
        assert_eq!(
            both.drain, first.drain,
            "the window that drains is named, not one that does not"
        );
        let note = BTreeMap::from([(MISSION_LOCK.to_owned(), "anna: far away".to_owned())]);
        node.metadata.annotations = Some(note);
        let locked = upkeep(&node, at("2026-03-01T02:30:00Z"));
        assert_eq!((holds(&locked, MAINTENANCE), locked.drain), (Some(true), None));
        let second = upkeep(&node, at("2026-03-01T05:00:00Z"));
        assert_eq!((holds(&second, MAINTENANCE), second.drain), (Some(true), None));
        let over = upkeep(&node, at("2026-03-01T07:00:00Z"));
        assert_eq!((holds(&over, MAINTENANCE), over.look_again), (Some(false), None));
    }

    #[test]
    fn who_tolerates_maintenance_stays() {
        let task = |tolerations: serde_json::Value| {
            let spec = json!({"placement": {"tolerations": tolerations}});
            serde_json::from_value::<TaskSpec>(spec).expect("a task")
        };
        assert!(!stays(&task(json!([]))));
        assert!(!stays(&task(json!([{"key": "other", "operator": "Exists"}]))));
        assert!(stays(&task(json!([{"key": MAINTENANCE_TAINT, "operator": "Exists"}]))));
        assert!(stays(&task(json!([{"operator": "Exists"}]))));
    }

    proptest! {
        /// However the charge goes: never in service below the least, always in service a margin above it, and between the
        /// two as before.
        #[test]
        fn a_battery_does_not_flap(least in 0_u8..=100, charges in proptest::collection::vec(0_u8..=100, 1..40)) {
            let mut node = robot();
            node.spec.min_battery = Some(least);
            let now = at("2026-01-01T00:00:00Z");
            let mut before = None;
            for percent in charges {
                let status = node.status.get_or_insert_default();
                status.battery = Some(Battery { percent, charging: false });
                let upkeep = upkeep(&node, now);
                let is = holds(&upkeep, BATTERY).expect("it has a battery");
                node.status.as_mut().expect("set above").conditions = upkeep.conditions;
                if percent < least {
                    prop_assert!(!is);
                } else if percent >= least.saturating_add(BATTERY_MARGIN) || percent == 100 {
                    prop_assert!(is);
                } else {
                    prop_assert_eq!(is, before.unwrap_or(true));
                }
                before = Some(is);
            }
        }
    }
}
