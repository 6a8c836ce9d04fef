//! Nodes: can it take tasks, what is left of it, who drives it, where it is.

use crate::condition::ConditionStatus;
use crate::kind::node::upkeep::{
    BATTERY_LOW_TAINT, Battery, DISK_PRESSURE_TAINT, MAINTENANCE_TAINT, passing_taints,
};
use crate::kind::node::{Node, NodeStatus};
use crate::name::FunctionName;
use crate::resource::{Compute, format_function_list};

use super::Cell;
use super::Mood;
use super::human;
use super::{Column, age};

pub(super) const COLUMNS: &[Column<Node>] = &[
    Column::new("KIND", |node, _| format!("{:?}", node.spec.kind).into()),
    Column::new("READY", |node, _| ready(node)),
    Column::new("CPU", |node, _| {
        of_compute(node, |free, whole| {
            format!("{}/{}", human::cores(free.cpu), human::cores(whole.cpu))
        })
    }),
    Column::new("MEMORY", |node, _| {
        of_compute(node, |free, whole| {
            format!("{}/{}", human::bytes(free.memory), human::bytes(whole.memory))
        })
    }),
    Column::new("LEASE", |node, _| status(node, holders)),
    Column::new("POSE", |node, _| status(node, pose)),
    Column::new("AGE", |node, now| age(node.metadata.creation_timestamp.as_ref(), now)),
    Column::wide("BATTERY", |node, _| status(node, battery)),
    Column::wide("SENSORS", |node, _| status(node, |s| functions(&s.sensors))),
    Column::wide("ACTUATORS", |node, _| status(node, |s| functions(&s.actuators))),
    Column::wide("RUNTIMES", |node, _| status(node, runtimes)),
    Column::wide("AGENT", |node, _| status(node, |s| s.agent_version.clone())),
    Column::wide("ADDRESS", |node, _| status(node, |s| s.address.clone())),
];

fn status(node: &Node, text: impl Fn(&NodeStatus) -> String) -> Cell {
    node.status.as_ref().map(text).unwrap_or_default().into()
}

/// Free and allocatable; nothing of a node whose agent has not said yet what it has.
fn of_compute(node: &Node, text: impl Fn(&Compute, &Compute) -> String) -> Cell {
    status(node, |s| match s.allocatable == Compute::default() {
        true => String::new(),
        false => text(&s.free, &s.allocatable),
    })
}

/// Whether the node takes tasks now. `cordoned` and readiness are two things, and both are shown.
fn ready(node: &Node) -> Cell {
    let condition = node.status.as_ref().and_then(|s| s.condition(crate::condition::READY));
    let (text, mood) = match condition.map(|c| c.status) {
        Some(ConditionStatus::True) => ("True", Mood::Good),
        Some(ConditionStatus::False) => ("False", Mood::Bad),
        Some(ConditionStatus::Unknown) => ("Unknown", Mood::Bad),
        // Registered; no agent has joined under this name yet.
        None => ("NotJoined", Mood::Warn),
    };
    let cordoned = node.spec.unschedulable.then_some("Cordoned");
    let passing = node.status.as_ref().map(passing_taints).unwrap_or_default();
    let passing = passing.iter().map(|taint| match taint.key.as_str() {
        BATTERY_LOW_TAINT => "BatteryLow",
        DISK_PRESSURE_TAINT => "DiskPressure",
        MAINTENANCE_TAINT => "Maintenance",
        other => other,
    });
    let words: Vec<&str> = std::iter::once(text).chain(cordoned).chain(passing).collect();
    match words.as_slice() {
        [only] => Cell::new(*only, mood),
        several => Cell::new(several.join(","), Mood::Warn),
    }
}

/// `83 %`, `12 %+` while it is being charged.
fn battery(status: &NodeStatus) -> String {
    let text = |battery: Battery| {
        format!("{} %{}", battery.percent, if battery.charging { "+" } else { "" })
    };
    status.battery.map(text).unwrap_or_default()
}

/// `gmapping` for the holder of the only group; with several groups `arm=grasp,body=-`.
fn holders(status: &NodeStatus) -> String {
    let of = |lease: &crate::kind::node::NodeLease| {
        lease.holder.as_ref().map_or_else(|| "-".to_owned(), ToString::to_string)
    };
    match &status.leases[..] {
        [] => String::new(),
        [only] if only.holder.is_none() => "free".to_owned(),
        [only] => of(only),
        several => {
            let all: Vec<String> =
                several.iter().map(|l| format!("{}={}", l.group, of(l))).collect();
            all.join(",")
        }
    }
}

fn pose(status: &NodeStatus) -> String {
    match &status.pose {
        None => String::new(),
        Some(pose) if pose.localized => pose.to_string(),
        Some(pose) => format!("{pose} (lost)"),
    }
}

fn functions(all: &[FunctionName]) -> String {
    format_function_list(&all.iter().cloned().collect())
}

fn runtimes(status: &NodeStatus) -> String {
    let usable: Vec<&str> =
        status.runtimes.iter().filter(|r| r.available).map(|r| r.name.as_str()).collect();
    usable.join(",")
}
