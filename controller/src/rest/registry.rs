//! What is served: one entry a kind, made from `muster_api`'s list of kinds.

use std::sync::LazyLock;

use muster_api::kind::{self, KindInfo};

use super::path::Verb;
use crate::store::{Key, Resource};

const READ: &[Verb] = &[Verb::Get, Verb::List, Verb::Watch];
const READ_AND_REMOVE: &[Verb] =
    &[Verb::Delete, Verb::DeleteCollection, Verb::Get, Verb::List, Verb::Watch];
const ALL: &[Verb] = &[
    Verb::Create,
    Verb::Delete,
    Verb::DeleteCollection,
    Verb::Get,
    Verb::List,
    Verb::Patch,
    Verb::Update,
    Verb::Watch,
];

/// A column of the server-side table.
#[derive(Debug)]
pub(crate) struct Column {
    /// The head.
    #[expect(dead_code, reason = "tables are rendered by clients so far")]
    pub(crate) name: &'static str,
    /// The dotted path of the cell.
    #[expect(dead_code, reason = "tables are rendered by clients so far")]
    pub(crate) path: &'static str,
}

/// One kind as it is served.
#[derive(Debug)]
pub(crate) struct Entry {
    pub(crate) info: &'static KindInfo,
    pub(crate) resource: Resource,
    pub(crate) verbs: &'static [Verb],
    pub(crate) categories: &'static [&'static str],
    pub(crate) has_log: bool,
    /// `…/why` says why it waits.
    pub(crate) has_why: bool,
    #[expect(dead_code, reason = "tables are rendered by clients so far")]
    pub(crate) columns: &'static [Column],
}

impl Entry {
    pub(crate) fn key(&self, namespace: Option<&str>, name: &str) -> Key {
        let namespace = namespace.filter(|_| self.info.namespaced).map(Into::into);
        Key { resource: self.resource, namespace, name: name.into() }
    }

    /// `tasks.muster.dev`, or `namespaces` for core kinds.
    pub(crate) fn qualified(&self) -> String {
        with_group(self.info.plural, self.info.group)
    }

    /// `Task.muster.dev`, or `Namespace` for core kinds.
    pub(crate) fn kind_and_group(&self) -> String {
        with_group(self.info.kind, self.info.group)
    }
}

fn with_group(name: &str, group: &str) -> String {
    if group.is_empty() { name.to_owned() } else { format!("{name}.{group}") }
}

static ENTRIES: LazyLock<Vec<Entry>> = LazyLock::new(|| kind::ALL.iter().map(entry).collect());

fn entry(info: &'static KindInfo) -> Entry {
    Entry {
        info,
        resource: Resource::new(info.plural),
        verbs: match info.kind {
            // Given by the controller alone.
            "Lease" => READ,
            // Made when a framework subscribes.
            "Framework" => READ_AND_REMOVE,
            // Made by the controller; one that lost its set may be removed by hand.
            "TaskSetRevision" => READ_AND_REMOVE,
            _ => ALL,
        },
        categories: if info.group.is_empty() { &[] } else { &["muster"] },
        has_log: info.kind == "Task",
        has_why: matches!(info.kind, "Task" | "Framework"),
        columns: &[],
    }
}

/// Everything that is served.
pub(crate) fn all() -> &'static [Entry] {
    &ENTRIES
}

/// The entry of a plural in a group; the group is empty for core kinds.
pub(crate) fn find(group: &str, plural: &str) -> Option<&'static Entry> {
    ENTRIES.iter().find(|entry| entry.info.group == group && entry.info.plural == plural)
}

/// The entry of a stored resource.
pub(crate) fn of(resource: Resource) -> Option<&'static Entry> {
    ENTRIES.iter().find(|entry| entry.resource == resource)
}
