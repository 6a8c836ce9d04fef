//! Frameworks: who is there, where it works, what it has.

use muster_api::kind::framework::{Framework, FrameworkStatus, OfferFilter};
use muster_api::kind::task::NodeChoice;

use super::{Column, age};
use crate::output::human;
use crate::output::style::Mood;
use crate::output::table::Cell;

pub(super) const COLUMNS: &[Column<Framework>] = &[
    Column::new("CONNECTED", |framework, _| connected(framework)),
    Column::new("POSITION", |framework, _| {
        framework.spec.position.as_ref().map(human::place).unwrap_or_default().into()
    }),
    Column::new("RADIUS", |framework, _| {
        framework.spec.radius.map(|r| format!("{r}m")).unwrap_or_default().into()
    }),
    Column::new("OFFERS", |framework, _| status(framework, |s| s.offers.to_string())),
    Column::new("TASKS", |framework, _| status(framework, |s| s.tasks.to_string())),
    Column::new("SHARE", |framework, _| status(framework, |s| share(s.share))),
    Column::new("AGE", |framework, now| age(framework.metadata.creation_timestamp.as_ref(), now)),
    Column::wide("FILTER", |framework, _| filter(&framework.spec.filter).join("; ").into()),
    Column::wide("FAILOVER TIMEOUT", |framework, _| {
        framework.spec.failover_timeout.0.to_string().into()
    }),
    Column::wide("ID", |framework, _| framework.metadata.uid.as_deref().unwrap_or_default().into()),
];

fn status(framework: &Framework, text: impl Fn(&FrameworkStatus) -> String) -> Cell {
    framework.status.as_ref().map(text).unwrap_or_default().into()
}

fn connected(framework: &Framework) -> Cell {
    match framework.status.as_ref() {
        None => Cell::from(""),
        Some(s) if !s.connected => Cell::new("False", Mood::Bad),
        Some(s) if s.suppressed => Cell::new("True,Suppressed", Mood::Warn),
        Some(_) => Cell::new("True", Mood::Good),
    }
}

/// A weighted share. No percentage: with a weight below 1 it may be above 1.
pub(crate) fn share(value: f64) -> String {
    format!("{value:.2}")
}

/// What the filter asks for, a part each; none: everything passes.
pub(crate) fn filter(filter: &OfferFilter) -> Vec<String> {
    let OfferFilter { on, selector, minimum, sensors, actuators, any_actuator, most } = filter;
    let mut parts = Vec::new();
    if *on != NodeChoice::Any {
        parts.push(format!("{on:?}"));
    }
    if !selector.is_empty() {
        parts.push(selector.to_string());
    }
    if minimum.cpu.0 > 0 {
        parts.push(format!("cpu≥{}", human::cores(minimum.cpu)));
    }
    if minimum.memory.0 > 0 {
        parts.push(format!("memory≥{}", human::bytes(minimum.memory)));
    }
    parts.extend(minimum.extended.iter().map(|(name, n)| format!("{name}≥{n}")));
    parts.extend(sensors.iter().chain(actuators).map(ToString::to_string));
    if *any_actuator {
        parts.push("any actuator".to_owned());
    }
    if *most > 0 {
        parts.push(format!("most {most}"));
    }
    parts
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use serde_json::json;

    use crate::output::columns::{Layout, table};
    use crate::output::style::Styles;

    #[test]
    fn a_framework_shows_where_it_works_and_what_it_has() {
        let info = muster_api::kind::find_by_word("fw").expect("served");
        let framework = |name: &str, spec, status| {
            json!({
                "apiVersion": "muster.dev/v1alpha1", "kind": "Framework",
                "metadata": {"name": name, "uid": "u-1", "creationTimestamp": "1970-01-01T00:00:00Z"},
                "spec": spec, "status": status,
            })
        };
        let objects = [
            framework(
                "deliver",
                json!({
                    "position": {"x": 3, "y": 4.5}, "radius": 8.5,
                    "filter": {"on": "Robot", "minimum": {"cpu": "500m"}, "anyActuator": true, "most": 2},
                }),
                json!({"connected": true, "offers": 2, "tasks": 1, "share": 0.25}),
            ),
            framework("idle", json!({}), json!({"connected": true, "suppressed": true})),
            framework("lost", json!({"failoverTimeout": "5m"}), json!({"connected": false})),
        ];
        let text = |wide| {
            let now = Timestamp::from_second(65).expect("in range");
            let layout = Layout { wide, namespaces: false, kinds: false, now };
            table(info, &objects, layout).text(&Styles::default())
        };
        assert_eq!(
            text(false),
            "NAME      CONNECTED         POSITION    RADIUS   OFFERS   TASKS   SHARE   AGE\n\
             deliver   True              3.00,4.50   8.5m     2        1       0.25    65s\n\
             idle      True,Suppressed   -           -        0        0       0.00    65s\n\
             lost      False             -           -        0        0       0.00    65s\n"
        );
        let wide = text(true);
        for part in ["FILTER", "Robot; cpu≥0.5; any actuator; most 2", "5m", "u-1"] {
            assert!(wide.contains(part), "{part:?} is not in\n{wide}");
        }
    }
}
