//! Frameworks: who is there, where it works, what it has.

use crate::kind::framework::{Framework, FrameworkStatus, OfferFilter};
use crate::kind::task::NodeChoice;

use super::Cell;
use super::Mood;
use super::human;
use super::{Column, age};

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
pub fn share(value: f64) -> String {
    format!("{value:.2}")
}

/// What the filter asks for, a part each; none: everything passes.
pub fn filter(filter: &OfferFilter) -> Vec<String> {
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
