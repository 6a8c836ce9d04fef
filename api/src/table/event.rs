//! Events, as kubectl shows them.

use crate::kind::event::Event;
use jiff::Timestamp;
use serde_json::Value;

use super::Cell;
use super::Mood;
use super::human;
use super::{Column, age};

pub(super) const COLUMNS: &[Column<Event>] = &[
    Column::new("SEEN", seen),
    Column::new("TYPE", |event, _| kind(event)),
    Column::new("REASON", |event, _| event.reason.clone().unwrap_or_default().into()),
    Column::new("OBJECT", |event, _| {
        let about = &event.involved_object;
        let kind = about.kind.as_deref().unwrap_or_default().to_lowercase();
        format!("{kind}/{}", about.name.as_deref().unwrap_or_default()).into()
    }),
    Column::new("MESSAGE", |event, _| event.message.clone().unwrap_or_default().into()),
    Column::wide("COUNT", |event, _| event.count.unwrap_or(1).to_string().into()),
    Column::wide("SOURCE", |event, _| {
        event.source.as_ref().and_then(|s| s.component.clone()).unwrap_or_default().into()
    }),
];

/// When it happened last. Newer clients write `eventTime`, older ones `lastTimestamp`.
pub fn stamp(event: &Event) -> Option<Timestamp> {
    let last = event.last_timestamp.as_ref().map(|t| t.0);
    let series = event.series.as_ref().and_then(|s| s.last_observed_time.as_ref()).map(|t| t.0);
    let once = event.event_time.as_ref().map(|t| t.0);
    series.or(last).or(once)
}

/// Newest last: that is where the eye is after a command.
pub fn by_time(objects: &[Value]) -> Vec<Value> {
    let mut sorted = objects.to_vec();
    let of = |o: &Value| serde_json::from_value(o.clone()).ok().and_then(|e: Event| stamp(&e));
    sorted.sort_by_cached_key(of);
    sorted
}

fn seen(event: &Event, now: Timestamp) -> Cell {
    match stamp(event) {
        Some(then) => human::age(then, now).into(),
        None => age(event.metadata.creation_timestamp.as_ref(), now),
    }
}

fn kind(event: &Event) -> Cell {
    let text = event.type_.as_deref().unwrap_or_default();
    Cell::new(text, if text == "Warning" { Mood::Warn } else { Mood::Plain })
}
