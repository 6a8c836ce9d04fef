//! A framework: is it there, what does it want, what does it have.

use jiff::Timestamp;
use muster_api::kind::framework::{FRAMEWORK_LABEL, Framework, FrameworkSpec, FrameworkStatus};
use muster_api::kind::task::Task;

use super::{begin, position, scored_by, when, which_node};
use crate::client::Selection;
use crate::output::columns::framework::share;
use crate::output::columns::task as columns;
use crate::output::human;
use crate::output::sheet::Sheet;
use crate::output::style::Mood;
use crate::output::table::{Cell, Table};

/// Where its tasks are and what they have in common.
pub(super) fn its_tasks(framework: &Framework) -> (Option<&str>, Selection) {
    let name = framework.metadata.name.as_deref().unwrap_or_default();
    let labels = Some(format!("{FRAMEWORK_LABEL}={name}"));
    (framework.metadata.namespace.as_deref(), Selection { labels, fields: None })
}

pub(super) fn describe(sheet: &mut Sheet, framework: &Framework, tasks: &[Task], now: Timestamp) {
    begin(sheet, &framework.metadata, now);
    sheet.field("Id", framework.metadata.uid.as_deref().unwrap_or_default());
    let status = framework.status.clone().unwrap_or_default();
    state(sheet, &framework.spec, &status, now);
    wish(sheet, &framework.spec);
    sheet.table("Tasks", task_table(tasks));
}

fn state(sheet: &mut Sheet, spec: &FrameworkSpec, status: &FrameworkStatus, now: Timestamp) {
    let connected = match (status.connected, status.suppressed) {
        (true, false) => Cell::new("yes", Mood::Good),
        (true, true) => Cell::new("yes; it wants no offers until it calls Revive", Mood::Warn),
        (false, _) => Cell::new("no", Mood::Bad),
    };
    sheet.field("Connected", connected);
    sheet.maybe("Subscribed", status.subscribed_at.as_ref().map(|t| when(t.0, now)));
    let timeout = spec.failover_timeout.0;
    let away = status.disconnected_at.as_ref().filter(|_| !status.connected).map(|t| t.0);
    sheet.maybe("Disconnected", away.map(|t| when(t, now)));
    let timeout = match away {
        Some(since) => {
            let left = human::left(timeout.as_duration(), since, now);
            format!("{timeout}; its tasks are ended in {left} if it does not come back")
        }
        None => timeout.to_string(),
    };
    sheet.field("Away at most", timeout);
    sheet.field("Offers", status.offers.to_string());
    sheet.field("Share", share(status.share));
}

fn wish(sheet: &mut Sheet, spec: &FrameworkSpec) {
    sheet.heading("What it wants to be offered");
    sheet.maybe("At", spec.position.as_ref().map(position));
    sheet.maybe("Radius", spec.radius.map(|r| format!("{r} m")));
    if spec.position.is_some() {
        sheet.field("Scored by", scored_by(spec.cost));
    }
    let filter = &spec.filter;
    sheet.field("On", which_node(filter.on));
    if !filter.selector.is_empty() {
        sheet.field("With labels", filter.selector.to_string());
    }
    let minimum = &filter.minimum;
    let at_least = |text: String| format!("{text} free at least");
    sheet.maybe("Cpu", (minimum.cpu.0 > 0).then(|| at_least(human::cores(minimum.cpu))));
    sheet.maybe("Memory", (minimum.memory.0 > 0).then(|| at_least(human::bytes(minimum.memory))));
    let extended = minimum.extended.iter();
    sheet.list("Extended", extended.map(|(name, n)| at_least(format!("{name}: {n}"))));
    sheet.list("Sensors", filter.sensors.iter().map(ToString::to_string));
    let any = filter.any_actuator.then(|| "any that nobody holds".to_owned());
    sheet.list("Actuators", filter.actuators.iter().map(ToString::to_string).chain(any));
    sheet.field("At once", format!("{} at most", human::count(filter.limit(), "offer")));
}

fn task_table(tasks: &[Task]) -> Table {
    let mut table = Table::new(["NAME", "PHASE", "NODE", "CLASS", "EPOCH"]);
    for task in tasks {
        let status = task.status.clone().unwrap_or_default();
        table.push([
            Cell::from(task.metadata.name.as_deref().unwrap_or_default()),
            Cell::new(status.phase.as_str(), columns::mood(status.phase)),
            status.node.unwrap_or_default().into(),
            task.spec.resources.class().into(),
            status.lease.map(|l| l.epoch.to_string()).unwrap_or_default().into(),
        ]);
    }
    table
}
