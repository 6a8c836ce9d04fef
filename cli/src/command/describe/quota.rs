//! A quota: what the namespace may have, and what it has.

use jiff::Timestamp;
use muster_api::kind::quota::Quota;
use muster_api::kind::task::Task;
use muster_api::resource::Compute;

use super::begin;
use crate::output::human;
use crate::output::sheet::Sheet;
use crate::output::table::{Cell, Table};

/// `tasks`: those of the namespace that hold something of a node. They are counted here because they say what is so
/// now; a number in the status would be as old as its last writing.
pub(super) fn describe(sheet: &mut Sheet, quota: &Quota, tasks: &[Task], now: Timestamp) {
    begin(sheet, &quota.metadata, now);
    sheet.field("Weight", quota.spec.weight.to_string());
    sheet.table("Resources", table(quota, tasks));
}

fn table(quota: &Quota, tasks: &[Task]) -> Table {
    let mut used = Compute::default();
    for task in tasks {
        used.add(&task.spec.resources.reserved());
    }
    let leases =
        tasks.iter().filter(|t| t.status.as_ref().is_some_and(|s| s.lease.is_some())).count();
    let hard = &quota.spec.hard;
    let mut table = Table::new(["", "USED", "HARD"]);
    let mut row = |name: &str, used: String, hard: Option<String>| {
        table.push([name.into(), used.into(), Cell::from(hard.unwrap_or_default())]);
    };
    row("cpu", human::cores(used.cpu), hard.cpu.map(human::cores));
    row("memory", human::bytes(used.memory), hard.memory.map(human::bytes));
    row("leases", leases.to_string(), hard.leases.map(|n| n.to_string()));
    for (name, most) in &hard.extended {
        let used = used.extended.get(name).copied().unwrap_or_default();
        row(name, used.to_string(), Some(most.to_string()));
    }
    table
}
