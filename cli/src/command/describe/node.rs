//! A node: what it has, what is reserved, who drives, where it is, what runs on it.

use jiff::Timestamp;
use muster_api::condition::{BATTERY, ConditionStatus, READY};
use muster_api::kind::node::image::ImagePhase;
use muster_api::kind::node::upkeep::{MaintenanceWindow, Moment};
use muster_api::kind::node::{Node, NodeStatus};
use muster_api::kind::task::Task;
use muster_api::name::FunctionName;
use muster_api::resource::Compute;

use super::{begin, condition_table, when};
use crate::client::Selection;
use crate::output::columns::task as columns;
use crate::output::human;
use crate::output::sheet::Sheet;
use crate::output::style::Mood;
use crate::output::table::{Cell, Table};

/// The tasks that are on the node.
pub(super) fn on_it(node: &Node) -> Selection {
    let name = node.metadata.name.as_deref().unwrap_or_default();
    Selection { labels: None, fields: Some(format!("status.node={name}")) }
}

pub(super) fn describe(sheet: &mut Sheet, node: &Node, tasks: &[Task], now: Timestamp) {
    begin(sheet, &node.metadata, now);
    sheet.field("Kind", format!("{:?}", node.spec.kind));
    if node.spec.unschedulable {
        sheet.field("Cordoned", Cell::new("yes; nothing new is placed here", Mood::Warn));
    }
    if let Some(lock) = node.mission_lock() {
        let text = format!("by {}: {}; its tasks stay as they are", lock.holder, lock.reason);
        sheet.field("Mission lock", Cell::new(text, Mood::Warn));
    }
    let taints = node.spec.taints.iter();
    sheet.list("Taints", taints.map(|t| format!("{}={}:{:?}", t.key, t.value, t.effect)));
    sheet.maybe("Speed", node.spec.speed.map(|s| format!("{s} m/s")));
    sheet.maybe("Least battery", node.spec.min_battery.map(|percent| format!("{percent} %")));
    sheet.list("Maintenance", node.spec.maintenance.iter().map(|window| maintenance(window, now)));
    let Some(status) = &node.status else {
        sheet.field("Ready", Cell::new("no agent has joined under this name yet", Mood::Warn));
        return;
    };
    state(sheet, status, now);
    sheet.table("Computation (CR)", compute_table(status));
    sheet.table("Sensors (SR), shared", sensor_table(status, tasks));
    sheet.table("Actuators (AR), one holder", actuator_table(status));
    sheet.table("Runtimes", runtime_table(status));
    if !status.images.is_empty() {
        sheet.table("Images that rollouts want", image_table(status));
    }
    sheet.table("Tasks", task_table(tasks));
    sheet.table("Conditions", condition_table(&status.conditions, now));
}

fn state(sheet: &mut Sheet, status: &NodeStatus, now: Timestamp) {
    let ready = match status.condition(READY) {
        Some(c) if c.status == ConditionStatus::True => Cell::new("True", Mood::Good),
        Some(c) if c.message.is_empty() => Cell::new(format!("{:?}", c.status), Mood::Bad),
        Some(c) => Cell::new(format!("{:?}: {}", c.status, c.message), Mood::Bad),
        None => Cell::new("no agent has joined under this name yet", Mood::Warn),
    };
    sheet.field("Ready", ready);
    // What is written down of it is old while the node is connected, and would look like a fault.
    if !status.is_ready() {
        sheet.maybe("Last heard", status.last_seen.as_ref().map(|t| when(t.0, now)));
    }
    if let Some(pose) = &status.pose {
        let mut text = format!("{:.2},{:.2}", pose.x, pose.y);
        if pose.z != 0.0 {
            text.push_str(&format!(",{:.2}", pose.z));
        }
        text.push_str(&format!(" in {:?}", pose.map));
        if pose.yaw != 0.0 {
            text.push_str(&format!(", heading {:.0}°", pose.yaw.to_degrees()));
        }
        if !pose.source.is_empty() {
            text.push_str(&format!(", from {}", pose.source));
        }
        if let Some(stamp) = &pose.stamp {
            text.push_str(&format!(", {} ago", human::age(stamp.0, now)));
        }
        if let Some(covariance) = &pose.covariance {
            text.push_str(&format!(", ±{:.2} m", covariance.deviation()));
        }
        let mood = if pose.localized { Mood::Plain } else { Mood::Bad };
        if !pose.localized {
            text.push_str(" (the robot does not know where it is)");
        }
        sheet.field("Pose", Cell::new(text, mood));
    }
    if let Some(battery) = status.battery {
        let low = status.condition(BATTERY).is_some_and(|c| c.status == ConditionStatus::False);
        let charging = if battery.charging { ", charging" } else { "" };
        let mood = if low { Mood::Bad } else { Mood::Plain };
        sheet.field("Battery", Cell::new(format!("{} %{charging}", battery.percent), mood));
    }
    let some = |text: &String| Some(text.clone()).filter(|t| !t.is_empty());
    sheet.maybe("Agent", some(&status.agent_version));
    sheet.maybe("Address", some(&status.address));
}

/// `2026-03-01T02:00:00Z for 2h every 24h: new wheels (open until …)`.
fn maintenance(window: &MaintenanceWindow, now: Timestamp) -> String {
    let mut text = format!("{} for {}", window.start.0, window.lasts);
    if let Some(every) = window.every {
        text.push_str(&format!(" every {every}"));
    }
    if window.drain {
        text.push_str(", drains");
    }
    if !window.reason.is_empty() {
        text.push_str(&format!(": {}", window.reason));
    }
    match window.at(now) {
        Moment::Open { until } => text.push_str(&format!(" (open until {until})")),
        Moment::Closed { next: Some(next) } => text.push_str(&format!(" (next at {next})")),
        Moment::Closed { next: None } => text.push_str(" (over)"),
    }
    text
}

fn compute_table(status: &NodeStatus) -> Table {
    let mut table = Table::new(["", "FREE", "USED", "ALLOCATABLE", "CAPACITY"]);
    let all = [&status.free, &status.used, &status.allocatable, &status.capacity];
    let row = |name: &str, value: &dyn Fn(&Compute) -> String| {
        std::iter::once(name.to_owned()).chain(all.iter().map(|c| value(c))).collect::<Vec<_>>()
    };
    table.push(row("cpu", &|c| human::cores(c.cpu)));
    table.push(row("memory", &|c| human::bytes(c.memory)));
    for name in status.capacity.extended.keys() {
        table.push(row(name, &|c| c.extended.get(name).copied().unwrap_or(0).to_string()));
    }
    table
}

fn sensor_table(status: &NodeStatus, tasks: &[Task]) -> Table {
    let mut table = Table::new(["SENSOR", "SHARED BY"]);
    for sensor in &status.sensors {
        let users = tasks.iter().filter(|t| t.spec.resources.sensors.contains(sensor)).count();
        table.push([sensor.to_string(), human::count(users, "task")]);
    }
    table
}

fn actuator_table(status: &NodeStatus) -> Table {
    let mut table = Table::new(["ACTUATOR", "GROUP", "EPOCH", "HOLDER"]);
    let row = |actuator: &FunctionName, lease: Option<&muster_api::kind::node::NodeLease>| {
        let holder = match lease {
            None => Cell::from("-"),
            Some(lease) => match &lease.holder {
                Some(holder) => holder.to_string().into(),
                None => Cell::new("free", Mood::Good),
            },
        };
        [
            actuator.to_string().into(),
            lease.map(|l| l.group.clone()).unwrap_or_default().into(),
            lease.map(|l| l.epoch.to_string()).unwrap_or_default().into(),
            holder,
        ]
    };
    // Which group an actuator is in matters only where there are several; the Lease objects say it.
    let only = match &status.leases[..] {
        [only] => Some(only),
        _ => None,
    };
    for actuator in &status.actuators {
        table.push(row(actuator, only));
    }
    if only.is_none() {
        for lease in &status.leases {
            let holder = lease.holder.as_ref().map(ToString::to_string);
            table.push([
                "(group)".to_owned(),
                lease.group.clone(),
                lease.epoch.to_string(),
                holder.unwrap_or_else(|| "free".to_owned()),
            ]);
        }
    }
    table
}

fn runtime_table(status: &NodeStatus) -> Table {
    let mut table = Table::new(["RUNTIME", "USABLE", "VERSION", "MESSAGE"]);
    for runtime in &status.runtimes {
        let usable = match runtime.available {
            true => Cell::new("yes", Mood::Good),
            false => Cell::new("no", Mood::Warn),
        };
        table.push([
            Cell::from(&runtime.name),
            usable,
            Cell::from(&runtime.version),
            Cell::from(&runtime.message),
        ]);
    }
    table
}

fn image_table(status: &NodeStatus) -> Table {
    let mut table = Table::new(["IMAGE", "POLICY", "STATE", "FAILED", "MESSAGE"]);
    for image in &status.images {
        let mood = match image.phase {
            ImagePhase::Pulled => Mood::Good,
            ImagePhase::BackOff => Mood::Bad,
            ImagePhase::Waiting | ImagePhase::Pulling => Mood::Plain,
        };
        table.push([
            Cell::from(&image.wish.image),
            format!("{:?}", image.wish.pull_policy).into(),
            Cell::new(image.phase.as_str(), mood),
            image.failures.to_string().into(),
            Cell::from(&image.message),
        ]);
    }
    table
}

fn task_table(tasks: &[Task]) -> Table {
    let mut table = Table::new(["NAMESPACE", "NAME", "PHASE", "CLASS", "CPU", "MEMORY", "EPOCH"]);
    for task in tasks {
        let status = task.status.clone().unwrap_or_default();
        let resources = &task.spec.resources;
        table.push([
            Cell::from(task.metadata.namespace.as_deref().unwrap_or_default()),
            Cell::from(task.metadata.name.as_deref().unwrap_or_default()),
            Cell::new(status.phase.as_str(), columns::mood(status.phase)),
            resources.class().into(),
            resources.cpu.map(human::cores).unwrap_or_default().into(),
            resources.memory.map(human::bytes).unwrap_or_default().into(),
            status.lease.map(|l| l.epoch.to_string()).unwrap_or_default().into(),
        ]);
    }
    table
}
