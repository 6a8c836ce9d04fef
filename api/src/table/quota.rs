//! Quotas: what a namespace has of what it may have.

use crate::kind::quota::{Limits, Quota, Used};

use super::Cell;
use super::human;
use super::{Column, age};

pub(super) const COLUMNS: &[Column<Quota>] = &[
    Column::new("CPU", |quota, _| {
        of(quota, |used| human::cores(used.cpu), |hard| hard.cpu.map(human::cores))
    }),
    Column::new("MEMORY", |quota, _| {
        of(quota, |used| human::bytes(used.memory), |hard| hard.memory.map(human::bytes))
    }),
    Column::new("LEASES", |quota, _| {
        of(quota, |used| used.leases.to_string(), |hard| hard.leases.map(|n| n.to_string()))
    }),
    Column::new("TASKS", |quota, _| {
        of(quota, |used| used.tasks.to_string(), |hard| hard.tasks.map(|n| n.to_string()))
    }),
    Column::new("WEIGHT", |quota, _| quota.spec.weight.to_string().into()),
    Column::new("AGE", |quota, now| age(quota.metadata.creation_timestamp.as_ref(), now)),
    Column::wide("EXTENDED", |quota, _| extended(quota).into()),
];

/// `used/hard`. What is not limited has a dash behind; what is not counted yet, one before.
fn of(
    quota: &Quota,
    used: impl Fn(&Used) -> String,
    hard: impl Fn(&Limits) -> Option<String>,
) -> Cell {
    let used = quota.status.as_ref().map(|status| used(&status.used));
    match (used, hard(&quota.spec.hard)) {
        (None, None) => String::new().into(),
        (used, hard) => {
            let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".to_owned());
            format!("{}/{}", or_dash(used), or_dash(hard)).into()
        }
    }
}

fn extended(quota: &Quota) -> String {
    let used = |name: &String| {
        let status = quota.status.as_ref()?;
        Some(status.used.extended.get(name).copied().unwrap_or_default().to_string())
    };
    let one = |(name, hard): (&String, &u64)| {
        format!("{name}={}/{hard}", used(name).unwrap_or_else(|| "-".to_owned()))
    };
    quota.spec.hard.extended.iter().map(one).collect::<Vec<_>>().join(",")
}
