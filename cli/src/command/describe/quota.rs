//! A quota: what the namespace may have, and what it has.

use jiff::Timestamp;
use muster_api::kind::quota::{Limits, Quota, Used};

use super::begin;
use crate::output::human;
use crate::output::sheet::Sheet;
use crate::output::table::{Cell, Table};

pub(super) fn describe(sheet: &mut Sheet, quota: &Quota, now: Timestamp) {
    begin(sheet, &quota.metadata, now);
    sheet.field("Weight", quota.spec.weight.to_string());
    let used = quota.status.as_ref().map(|status| &status.used);
    sheet.table("Resources", table(&quota.spec.hard, used));
}

/// `used`: none before the controller has counted for the first time.
fn table(hard: &Limits, used: Option<&Used>) -> Table {
    let mut table = Table::new(["", "USED", "HARD"]);
    let mut row = |name: &str, used: Option<String>, hard: Option<String>| {
        let cell = |text: Option<String>| Cell::from(text.unwrap_or_default());
        table.push([name.into(), cell(used), cell(hard)]);
    };
    row("cpu", used.map(|u| human::cores(u.cpu)), hard.cpu.map(human::cores));
    row("memory", used.map(|u| human::bytes(u.memory)), hard.memory.map(human::bytes));
    row("leases", used.map(|u| u.leases.to_string()), hard.leases.map(|n| n.to_string()));
    for (name, most) in &hard.extended {
        let used = used.map(|u| u.extended.get(name).copied().unwrap_or_default().to_string());
        row(name, used, Some(most.to_string()));
    }
    table
}
