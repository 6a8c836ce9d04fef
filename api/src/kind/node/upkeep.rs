//! What takes a node out of service for a while: an empty battery, and hours in which people work on it.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use k8s_openapi::jiff::{SignedDuration, Timestamp};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::estop::ESTOP_TAINT;
use super::{NodeKind, NodeSpec, Taint, TaintEffect};
use crate::condition::{self, ConditionStatus};
use crate::duration::Span;
use crate::kind::node::NodeStatus;
use crate::validate::{Violations, element_path};

/// Below how much charge nothing new begins on a robot whose operator says nothing, percent.
pub const DEFAULT_MIN_BATTERY: u8 = 10;
/// How much more than the least a low battery must have to count as charged again, percent: a battery under load shows
/// less than one at rest, and a robot would come and go.
pub const BATTERY_MARGIN: u8 = 5;
/// Most maintenance windows of a node.
const MAX_WINDOWS: usize = 32;

/// Taint of a node whose agent's disk is nearly full, while the condition `DiskPressure` holds.
pub const DISK_PRESSURE_TAINT: &str = "muster.dev/disk-pressure";
/// Taint of a node whose battery is low, while the condition `Battery` does not hold.
pub const BATTERY_LOW_TAINT: &str = "muster.dev/battery-low";
/// Taint of a node in a maintenance window, while the condition `Maintenance` holds.
pub const MAINTENANCE_TAINT: &str = "muster.dev/maintenance";

/// The charge of a robot's battery, as its agent reports it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct Battery {
    /// Percent of a full battery, 0 to 100.
    pub percent: u8,
    /// It is being charged.
    #[serde(default)]
    pub charging: bool,
}

/// Time in which people work on a node: nothing new begins there that does not tolerate `muster.dev/maintenance`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct MaintenanceWindow {
    /// When it begins for the first time.
    pub start: MicroTime,
    /// How long it lasts.
    pub lasts: Span,
    /// How often it comes again, from beginning to beginning, `24h`; none: once.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub every: Option<Span>,
    /// True: tasks that run there and do not tolerate it are ended when it begins; on a robot with a mission lock, when
    /// the lock is gone.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub drain: bool,
    /// What is done, for people.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub reason: String,
}

/// Where a moment lies in a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    /// Inside.
    Open {
        /// When the window closes.
        until: Timestamp,
    },
    /// Outside.
    Closed {
        /// When it opens next; none: never again.
        next: Option<Timestamp>,
    },
}

impl MaintenanceWindow {
    /// Where `now` lies. The beginning is inside, the end is not.
    #[must_use]
    pub fn at(&self, now: Timestamp) -> Moment {
        let signed = |span: Span| {
            SignedDuration::try_from(span.as_duration()).unwrap_or(SignedDuration::MAX)
        };
        let after = |from: Timestamp, span| from.checked_add(span).unwrap_or(Timestamp::MAX);
        let first = self.start.0;
        if now < first {
            return Moment::Closed { next: Some(first) };
        }
        let every = self.every.map(signed).filter(|every| every.is_positive());
        let begun = match every {
            None => first,
            Some(every) => {
                let past = now.duration_since(first).as_nanos() % every.as_nanos();
                let past =
                    i64::try_from(past).map_or(SignedDuration::MAX, SignedDuration::from_nanos);
                now.checked_sub(past).unwrap_or(first)
            }
        };
        let until = after(begun, signed(self.lasts));
        if now < until {
            return Moment::Open { until };
        }
        Moment::Closed { next: every.map(|every| after(begun, every)) }
    }
}

/// The taints that a node's conditions put on it. They come and go with the conditions, and are tolerated as others are.
#[must_use]
pub fn passing_taints(status: &NodeStatus) -> Vec<Taint> {
    let bad = [
        (condition::DISK_PRESSURE, ConditionStatus::True, DISK_PRESSURE_TAINT),
        (condition::BATTERY, ConditionStatus::False, BATTERY_LOW_TAINT),
        (condition::MAINTENANCE, ConditionStatus::True, MAINTENANCE_TAINT),
        (condition::EMERGENCY_STOP, ConditionStatus::True, ESTOP_TAINT),
    ];
    let is = |r#type: &str, bad| status.condition(r#type).is_some_and(|c| c.status == bad);
    let holds = bad.into_iter().filter(|(r#type, bad, _)| is(r#type, *bad));
    holds.map(|(_, _, key)| passing_taint(key)).collect()
}

/// One of them, by its key.
#[must_use]
pub fn passing_taint(key: &str) -> Taint {
    Taint { key: key.to_owned(), value: String::new(), effect: TaintEffect::NoSchedule }
}

pub(super) fn rules(spec: &NodeSpec, violations: &mut Violations) {
    if let Some(percent) = spec.min_battery.filter(|percent| *percent > 100) {
        violations
            .invalid("spec.minBattery", format!("{percent} is more than a full battery"))
            .suggest("percent, 0 to 100");
    }
    if spec.kind == NodeKind::Cloud && spec.min_battery.is_some() {
        violations
            .forbidden("spec.minBattery", "a Cloud node has no battery")
            .suggest("leave it out");
    }
    if spec.maintenance.len() > MAX_WINDOWS {
        violations.invalid(
            "spec.maintenance",
            format!("{} windows; at most {MAX_WINDOWS} are kept", spec.maintenance.len()),
        );
    }
    for (i, window) in spec.maintenance.iter().enumerate() {
        let path = element_path("spec.maintenance", i);
        if window.lasts.as_duration().is_zero() {
            violations
                .invalid(format!("{path}.lasts"), "a window lasts some time")
                .suggest("try 1h");
        }
        if let Some(every) = window.every.filter(|every| *every <= window.lasts) {
            violations
                .invalid(
                    format!("{path}.every"),
                    format!("{every} is not longer than the window itself, {}", window.lasts),
                )
                .suggest("from one beginning to the next; 24h for every day");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(text: &str) -> Timestamp {
        text.parse().expect("a time")
    }

    fn window(every: Option<&str>) -> MaintenanceWindow {
        MaintenanceWindow {
            start: MicroTime(at("2026-03-01T02:00:00Z")),
            lasts: "2h".parse().expect("a span"),
            every: every.map(|every| every.parse().expect("a span")),
            drain: false,
            reason: String::new(),
        }
    }

    #[test]
    fn a_window_is_open_from_its_beginning_to_before_its_end() {
        let once = window(None);
        let closed = |next: Option<&str>| Moment::Closed { next: next.map(at) };
        let open = |until: &str| Moment::Open { until: at(until) };
        assert_eq!(once.at(at("2026-03-01T01:59:59Z")), closed(Some("2026-03-01T02:00:00Z")));
        assert_eq!(once.at(at("2026-03-01T02:00:00Z")), open("2026-03-01T04:00:00Z"));
        assert_eq!(once.at(at("2026-03-01T03:59:59Z")), open("2026-03-01T04:00:00Z"));
        assert_eq!(once.at(at("2026-03-01T04:00:00Z")), closed(None));

        let daily = window(Some("24h"));
        assert_eq!(daily.at(at("2026-03-09T03:00:00Z")), open("2026-03-09T04:00:00Z"));
        assert_eq!(daily.at(at("2026-03-09T04:00:00Z")), closed(Some("2026-03-10T02:00:00Z")));
        assert_eq!(daily.at(at("2026-02-01T03:00:00Z")), closed(Some("2026-03-01T02:00:00Z")));
    }
}
