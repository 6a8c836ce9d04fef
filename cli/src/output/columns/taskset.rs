//! Sets of tasks: how many there should be, are, and serve.

use muster_api::condition::{ConditionStatus, PROGRESSING};
use muster_api::kind::taskset::{TaskSet, TaskSetStatus};

use super::{Column, age};
use crate::output::style::Mood;
use crate::output::table::Cell;

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
pub(crate) fn desired(set: &TaskSet) -> String {
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
pub(crate) fn rollout(status: Option<&TaskSetStatus>) -> Cell {
    let Some(said) = status.and_then(|s| s.condition(PROGRESSING)) else { return Cell::from("") };
    let mood = match (said.status, said.reason.as_str()) {
        (ConditionStatus::False, _) => Mood::Bad,
        (_, "Complete") => Mood::Good,
        _ => Mood::Warn,
    };
    Cell::new(&said.reason, mood)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::fake::taskset;
    use crate::output::columns::{Layout, table};
    use crate::output::style::Styles;

    #[test]
    fn a_row_says_how_many_serve_and_what_the_rollout_does() {
        let info = muster_api::kind::find_by_word("ts").expect("served");
        let now = jiff::Timestamp::UNIX_EPOCH;
        let layout = Layout { wide: false, namespaces: false, kinds: false, now };
        let status = json!({
            "desiredReplicas": 3, "replicas": 3, "updatedReplicas": 1, "availableReplicas": 2, "unavailableReplicas": 1,
            "conditions": [{"type": "Progressing", "status": "True", "reason": "Canary"}],
        });
        assert_eq!(
            table(info, &[taskset("a", status), taskset("b", json!(null))], layout)
                .text(&Styles::default()),
            "NAME   DESIRED   CURRENT   UPDATED   AVAILABLE   ROLLOUT   AGE\n\
             a      3         3         1         2           Canary    -\n\
             b      3         -         -         -           -         -\n"
        );
    }
}
