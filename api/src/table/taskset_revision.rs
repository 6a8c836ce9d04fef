//! Revisions of sets.

use crate::kind::taskset::{CHANGE_CAUSE, SET_LABEL};
use crate::kind::taskset_revision::TaskSetRevision;

use super::{Column, age};

pub(super) const COLUMNS: &[Column<TaskSetRevision>] = &[
    Column::new("TASKSET", |revision, _| {
        let labels = revision.metadata.labels.as_ref();
        labels.and_then(|l| l.get(SET_LABEL)).cloned().unwrap_or_default().into()
    }),
    Column::new("REVISION", |revision, _| revision.spec.revision.to_string().into()),
    Column::new("CHANGE-CAUSE", |revision, _| {
        let notes = revision.metadata.annotations.as_ref();
        notes.and_then(|n| n.get(CHANGE_CAUSE)).cloned().unwrap_or_default().into()
    }),
    Column::new("AGE", |revision, now| age(revision.metadata.creation_timestamp.as_ref(), now)),
];
