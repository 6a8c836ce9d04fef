//! What is served: one entry a kind, made from `muster_api`'s list of kinds; and the views of tasks and nodes as core
//! kinds.

use std::sync::LazyLock;

use bytes::Bytes;
use muster_api::kind::{self, KindInfo, projected};
use muster_controller_core::project;
use serde_json::Value;

use super::path::Verb;
use crate::objects::{NODES, TASKS};
use crate::store::{Key, Resource, Stored};

const READ: &[Verb] = &[Verb::Get, Verb::List, Verb::Watch];
const READ_AND_REMOVE: &[Verb] =
    &[Verb::Delete, Verb::DeleteCollection, Verb::Get, Verb::List, Verb::Watch];
const ALL_BUT_CREATE: &[Verb] = &[
    Verb::Delete,
    Verb::DeleteCollection,
    Verb::Get,
    Verb::List,
    Verb::Patch,
    Verb::Update,
    Verb::Watch,
];
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

/// How what is stored is shown as this kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum View {
    /// As it is.
    Stored,
    /// A Task as a core Pod.
    Pod,
    /// A Node as a core Node.
    Node,
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
    /// `resource` is where the objects are stored; this is how they are shown.
    pub(crate) view: View,
}

impl Entry {
    pub(crate) fn key(&self, namespace: Option<&str>, name: &str) -> Key {
        let namespace = namespace.filter(|_| self.info.namespaced).map(Into::into);
        Key { resource: self.resource, namespace, name: name.into() }
    }

    /// The object as it is shown. One that does not read as its kind is shown as it is stored.
    pub(crate) fn value(&self, stored: &Stored) -> Value {
        let object = stored.value();
        match self.view {
            View::Stored => object,
            View::Pod => match stored.parse() {
                Ok(task) => project::pod::pod(&object, &task),
                Err(_) => object,
            },
            View::Node => match stored.parse() {
                Ok(node) => project::node::node(&object, &node),
                Err(_) => object,
            },
        }
    }

    /// The same as JSON.
    pub(crate) fn render(&self, stored: &Stored) -> Bytes {
        match self.view {
            View::Stored => stored.bytes.clone(),
            View::Pod | View::Node => self.value(stored).to_string().into(),
        }
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

// What is stored comes first: an entry of a stored resource is found before its views.
static ENTRIES: LazyLock<Vec<Entry>> = LazyLock::new(|| {
    let stored = kind::ALL.iter().map(entry);
    let pods = Entry {
        resource: TASKS,
        verbs: ALL_BUT_CREATE,
        has_log: true,
        view: View::Pod,
        ..entry(&projected::POD)
    };
    let nodes = Entry {
        resource: NODES,
        verbs: ALL_BUT_CREATE,
        view: View::Node,
        ..entry(&projected::NODE)
    };
    let services = Entry { verbs: READ, ..entry(&projected::SERVICE) };
    stored.chain([pods, nodes, services]).collect()
});

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
        categories: match info.kind {
            "Task" | "TaskSet" => &["all", "muster"],
            "Pod" => &["all"],
            _ if info.group.is_empty() => &[],
            _ => &["muster"],
        },
        has_log: info.kind == "Task",
        has_why: matches!(info.kind, "Task" | "Framework"),
        view: View::Stored,
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
