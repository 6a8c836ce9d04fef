//! A quota: what the namespace may have, and what it has.

use jiff::Timestamp;
use muster_api::kind::quota::{Excess, Limits, Quota, QuotaStatus, TaskDefaults, Used};

use super::begin;
use crate::output::human;
use crate::output::sheet::Sheet;
use crate::output::table::{Cell, Table};

pub(super) fn describe(sheet: &mut Sheet, quota: &Quota, now: Timestamp) {
    begin(sheet, &quota.metadata, now);
    sheet.field("Weight", quota.spec.weight.to_string());
    sheet.field(
        "Excess",
        match quota.spec.excess {
            Excess::Refuse => "Refuse: what is not left is refused",
            Excess::Wait => "Wait: what is not left waits",
        },
    );
    let TaskDefaults { cpu, memory, pids } = &quota.spec.defaults;
    let defaults = [
        cpu.map(|cpu| format!("cpu {}", human::cores(cpu))),
        memory.map(|memory| format!("memory {}", human::bytes(memory))),
        pids.map(|pids| format!("pids {pids}")),
    ];
    let defaults: Vec<String> = defaults.into_iter().flatten().collect();
    if !defaults.is_empty() {
        sheet.field("Defaults", defaults.join(", "));
    }
    sheet.table("Resources", table(&quota.spec.hard, quota.status.as_ref()));
}

/// `status`: none before the controller has counted for the first time.
fn table(hard: &Limits, status: Option<&QuotaStatus>) -> Table {
    let mut table = Table::new(["", "USED", "REQUESTED", "HARD"]);
    let mut row = |name: &str, of: &dyn Fn(&Used) -> String, hard: Option<String>| {
        let cell = |text: Option<String>| Cell::from(text.unwrap_or_default());
        let (used, asked) = (status.map(|s| of(&s.used)), status.map(|s| of(&s.requested)));
        table.push([name.into(), cell(used), cell(asked), cell(hard)]);
    };
    row("cpu", &|u| human::cores(u.cpu), hard.cpu.map(human::cores));
    row("memory", &|u| human::bytes(u.memory), hard.memory.map(human::bytes));
    row("leases", &|u| u.leases.to_string(), hard.leases.map(|n| n.to_string()));
    row("tasks", &|u| u.tasks.to_string(), hard.tasks.map(|n| n.to_string()));
    for (name, most) in &hard.extended {
        let of = |u: &Used| u.extended.get(name).copied().unwrap_or_default().to_string();
        row(name, &of, Some(most.to_string()));
    }
    table
}
