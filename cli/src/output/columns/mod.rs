//! The columns of each kind: one file a kind. A kind without a file gets NAME and AGE.

pub(crate) mod application;
pub(crate) mod event;
pub(crate) mod framework;
mod keyed;
mod lease;
mod namespace;
mod node;
mod quota;
pub(crate) mod task;
pub(crate) mod taskset;
mod taskset_revision;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use muster_api::kind::KindInfo;
use muster_api::kind::application::Application;
use muster_api::kind::config_map::ConfigMap;
use muster_api::kind::event::Event;
use muster_api::kind::framework::Framework;
use muster_api::kind::lease::Lease;
use muster_api::kind::namespace::Namespace;
use muster_api::kind::node::Node;
use muster_api::kind::quota::Quota;
use muster_api::kind::secret::Secret;
use muster_api::kind::task::Task;
use muster_api::kind::taskset::TaskSet;
use muster_api::kind::taskset_revision::TaskSetRevision;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::human;
use super::style::Mood;
use super::table::{Cell, Table};

/// A column of a kind `T`.
pub(crate) struct Column<T> {
    head: &'static str,
    /// Only with `-o wide`.
    wide: bool,
    cell: fn(&T, Timestamp) -> Cell,
}

impl<T> Column<T> {
    const fn new(head: &'static str, cell: fn(&T, Timestamp) -> Cell) -> Self {
        Column { head, wide: false, cell }
    }

    const fn wide(head: &'static str, cell: fn(&T, Timestamp) -> Cell) -> Self {
        Column { head, wide: true, cell }
    }
}

/// How a table of objects is to look.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Layout {
    /// Every column.
    pub(crate) wide: bool,
    /// The namespace first.
    pub(crate) namespaces: bool,
    /// `task/x` instead of `x`, where kinds are mixed.
    pub(crate) kinds: bool,
    /// What ages are counted from.
    pub(crate) now: Timestamp,
}

/// A table of objects of one kind.
pub(crate) fn table(info: &KindInfo, objects: &[Value], layout: Layout) -> Table {
    match info.kind {
        "Node" => typed::<Node>(node::COLUMNS, info, objects, layout),
        "Task" => typed::<Task>(task::COLUMNS, info, objects, layout),
        "TaskSet" => typed::<TaskSet>(taskset::COLUMNS, info, objects, layout),
        "Application" => typed::<Application>(application::COLUMNS, info, objects, layout),
        "TaskSetRevision" => {
            typed::<TaskSetRevision>(taskset_revision::COLUMNS, info, objects, layout)
        }
        "Lease" => typed::<Lease>(lease::COLUMNS, info, objects, layout),
        "Framework" => typed::<Framework>(framework::COLUMNS, info, objects, layout),
        "Quota" => typed::<Quota>(quota::COLUMNS, info, objects, layout),
        "ConfigMap" => typed::<ConfigMap>(keyed::CONFIG_MAP, info, objects, layout),
        "Secret" => typed::<Secret>(keyed::SECRET, info, objects, layout),
        "Namespace" => typed::<Namespace>(namespace::COLUMNS, info, objects, layout),
        "Event" => typed::<Event>(event::COLUMNS, info, &event::by_time(objects), layout),
        _ => generic(info, objects, layout),
    }
}

fn typed<T: DeserializeOwned>(
    columns: &[Column<T>],
    info: &KindInfo,
    objects: &[Value],
    layout: Layout,
) -> Table {
    let columns: Vec<&Column<T>> = columns.iter().filter(|c| layout.wide || !c.wide).collect();
    // The names of events are made up; what they are about has a column.
    let named = info.kind != "Event";
    let heads = columns.iter().map(|c| c.head);
    let mut table = Table::new(named.then_some("NAME").into_iter().chain(heads));
    for object in objects {
        let mut row: Vec<Cell> = named.then(|| name(info, object, layout)).into_iter().collect();
        // An object that a newer controller wrote may not fit; its name is still worth a row.
        match serde_json::from_value::<T>(object.clone()) {
            Ok(typed) => row.extend(columns.iter().map(|c| (c.cell)(&typed, layout.now))),
            Err(_) => row.extend(columns.iter().map(|_| Cell::new("?", Mood::Dim))),
        }
        table.push(row);
    }
    with_namespaces(table, info, objects, layout)
}

fn generic(info: &KindInfo, objects: &[Value], layout: Layout) -> Table {
    let mut table = Table::new(["NAME", "AGE"]);
    for object in objects {
        let created = object.pointer("/metadata/creationTimestamp").cloned().unwrap_or_default();
        let created: Option<Time> = serde_json::from_value(created).ok();
        table.push([name(info, object, layout), age(created.as_ref(), layout.now)]);
    }
    with_namespaces(table, info, objects, layout)
}

fn name(info: &KindInfo, object: &Value, layout: Layout) -> Cell {
    let name = object.pointer("/metadata/name").and_then(Value::as_str).unwrap_or_default();
    if layout.kinds { format!("{}/{name}", info.singular).into() } else { name.into() }
}

fn with_namespaces(mut table: Table, info: &KindInfo, objects: &[Value], layout: Layout) -> Table {
    if layout.namespaces && info.namespaced {
        let of = |o: &Value| {
            o.pointer("/metadata/namespace").and_then(Value::as_str).unwrap_or_default().to_owned()
        };
        table.prepend("NAMESPACE", objects.iter().map(of));
    }
    table
}

/// How old something is.
pub(crate) fn age(created: Option<&Time>, now: Timestamp) -> Cell {
    created.map(|t| human::age(t.0, now)).unwrap_or_default().into()
}
