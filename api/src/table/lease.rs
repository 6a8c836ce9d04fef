//! Leases: who drives.

use crate::kind::lease::{Lease, LeaseStatus};

use super::Cell;
use super::Column;
use super::Mood;
use super::human;

pub(super) const COLUMNS: &[Column<Lease>] = &[
    Column::new("NODE", |lease, _| lease.spec.node.as_str().into()),
    Column::new("GROUP", |lease, _| lease.spec.group.as_str().into()),
    Column::new("EPOCH", |lease, _| status(lease, |s| s.epoch.to_string())),
    Column::new("HOLDER", |lease, _| match lease.status.as_ref().and_then(|s| s.holder.as_ref()) {
        Some(holder) => holder.to_string().into(),
        None => Cell::new("free", Mood::Dim),
    }),
    Column::new("ACQUIRED", |lease, now| {
        status(lease, |s| s.acquired.as_ref().map(|t| human::age(t.0, now)).unwrap_or_default())
    }),
    Column::wide("RENEWED", |lease, now| {
        status(lease, |s| s.renewed.as_ref().map(|t| human::age(t.0, now)).unwrap_or_default())
    }),
    Column::wide("ACTUATORS", |lease, _| {
        let all = lease.spec.actuators.iter().cloned().collect();
        crate::resource::format_function_list(&all).into()
    }),
];

fn status(lease: &Lease, text: impl Fn(&LeaseStatus) -> String) -> Cell {
    lease.status.as_ref().map(text).unwrap_or_default().into()
}
