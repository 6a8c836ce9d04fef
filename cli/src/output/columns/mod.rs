//! Tables of objects, laid out for a terminal. What stands in them is the API's to say (`muster_api::table`): the
//! controller shows the same to other clients.

#[cfg(test)]
mod tests;

use jiff::Timestamp;
use muster_api::kind::KindInfo;
pub(crate) use muster_api::table::{application, event, framework, task, taskset};
use muster_api::table::{columns, is_named};
use serde_json::Value;

use super::table::{Cell, Table};

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
    let sorted = (info.kind == "Event").then(|| event::by_time(objects));
    let objects = sorted.as_deref().unwrap_or(objects);
    let columns = columns(info);
    let shown: Vec<bool> = columns.heads().iter().map(|head| layout.wide || !head.wide).collect();
    let named = is_named(info);
    let heads = columns.heads().into_iter().filter(|head| layout.wide || !head.wide);
    let mut table = Table::new(named.then_some("NAME").into_iter().chain(heads.map(|h| h.name)));
    for object in objects {
        let mut row: Vec<Cell> = named.then(|| name(info, object, layout)).into_iter().collect();
        let cells = columns.cells(object, layout.now).into_iter().zip(&shown);
        row.extend(cells.filter(|(_, shown)| **shown).map(|(cell, _)| cell));
        table.push(row);
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
