//! Sets of tasks: how many there should be, are, and serve.

use crate::condition::{ConditionStatus, PROGRESSING};
use crate::kind::taskset::{TaskSet, TaskSetStatus};

use super::Cell;
use super::Mood;
use super::{Column, age};

pub(super) const COLUMNS: &[Column<TaskSet>] = &[
    Column::new("DESIRED", |set, _| desired(set).into()),
    Column::new("CURRENT", |set, _| number(set, |s| s.replicas)),
    Column::new("UPDATED", |set, _| number(set, |s| s.updated_replicas)),
    Column::new("AVAILABLE", |set, _| available(set)),
    Column::new("ROLLOUT", |set, _| rollout(set.status.as_ref())),
    Column::new("AGE", |set, now| age(set.metadata.creation_timestamp.as_ref(), now)),
    Column::wide("REVISION", |set, _| {
        set.status.as_ref().map(|s| s.update_revision.clone()).unwrap_or_default().into()
    }),
    Column::wide("SELECTOR", |set, _| {
        set.status.as_ref().map(|s| s.selector.clone()).unwrap_or_default().into()
    }),
    Column::wide("MESSAGE", |set, _| {
        let said = set.status.as_ref().and_then(|s| s.condition(PROGRESSING));
        said.map(|c| c.message.clone()).unwrap_or_default().into()
    }),
];

/// `3`, or `each node` when nobody has counted them yet.
pub fn desired(set: &TaskSet) -> String {
    match (set.spec.replicas, &set.status) {
        (Some(replicas), _) => replicas.to_string(),
        (None, Some(status)) => status.desired_replicas.to_string(),
        (None, None) => "each node".to_owned(),
    }
}

fn number(set: &TaskSet, of: fn(&TaskSetStatus) -> u32) -> Cell {
    set.status.as_ref().map(|s| of(s).to_string()).unwrap_or_default().into()
}

fn available(set: &TaskSet) -> Cell {
    let Some(status) = &set.status else { return Cell::from("") };
    let mood = match status.unavailable_replicas {
        0 => Mood::Good,
        _ => Mood::Warn,
    };
    Cell::new(status.available_replicas.to_string(), mood)
}

/// Why the rollout is where it is.
pub fn rollout(status: Option<&TaskSetStatus>) -> Cell {
    let Some(said) = status.and_then(|s| s.condition(PROGRESSING)) else { return Cell::from("") };
    let mood = match (said.status, said.reason.as_str()) {
        (ConditionStatus::False, _) => Mood::Bad,
        (_, "Complete") => Mood::Good,
        _ => Mood::Warn,
    };
    Cell::new(&said.reason, mood)
}
