//! Objects as rows: the columns of each kind, one file a kind, as `muster get` and the controller's `as=Table` show them.
//! A kind without a file has only its name and age.

mod access;
pub mod application;
pub mod event;
pub mod framework;
pub mod human;
mod keyed;
mod lease;
mod namespace;
mod node;
mod projected;
mod quota;
mod site;
pub mod task;
pub mod taskset;
mod taskset_revision;

use std::fmt;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::kind::KindInfo;

/// What a piece of text means to the reader.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Mood {
    /// Nothing in particular.
    #[default]
    Plain,
    /// As it should be.
    Good,
    /// Waits, or needs somebody to look.
    Warn,
    /// Wrong.
    Bad,
    /// Less important.
    Dim,
}

/// A cell.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Cell {
    text: String,
    mood: Mood,
}

impl Cell {
    /// A cell in a mood. Control characters are made harmless, no text is `-`.
    #[must_use]
    pub fn new(text: impl AsRef<str>, mood: Mood) -> Self {
        Cell { text: human::or_dash(text.as_ref()), mood }
    }

    /// The text.
    #[must_use]
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The mood.
    #[must_use]
    pub fn mood(&self) -> Mood {
        self.mood
    }
}

impl<T: AsRef<str>> From<T> for Cell {
    fn from(text: T) -> Self {
        Cell::new(text, Mood::Plain)
    }
}

/// The head of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Head {
    /// In capitals, as it is printed.
    pub name: &'static str,
    /// Only with `-o wide`.
    pub wide: bool,
}

/// A column of a kind `T`.
struct Column<T> {
    head: Head,
    cell: fn(&T, Timestamp) -> Cell,
}

impl<T> Column<T> {
    const fn new(name: &'static str, cell: fn(&T, Timestamp) -> Cell) -> Self {
        Column { head: Head { name, wide: false }, cell }
    }

    const fn wide(name: &'static str, cell: fn(&T, Timestamp) -> Cell) -> Self {
        Column { head: Head { name, wide: true }, cell }
    }
}

/// The columns of one kind, all but the object's name.
pub trait Columns: fmt::Debug + Sync {
    /// Their heads, in order.
    fn heads(&self) -> Vec<Head>;
    /// The cells of an object, one for each head. An object that a newer controller wrote may not fit; its name is still
    /// worth a row, and its cells are `?`.
    fn cells(&self, object: &Value, now: Timestamp) -> Vec<Cell>;
}

struct Of<T: 'static>(&'static [Column<T>]);

impl<T> fmt::Debug for Of<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.0.iter().map(|column| column.head.name)).finish()
    }
}

impl<T: DeserializeOwned> Columns for Of<T> {
    fn heads(&self) -> Vec<Head> {
        self.0.iter().map(|column| column.head).collect()
    }

    fn cells(&self, object: &Value, now: Timestamp) -> Vec<Cell> {
        match T::deserialize(object) {
            Ok(typed) => self.0.iter().map(|column| (column.cell)(&typed, now)).collect(),
            Err(_) => self.0.iter().map(|_| Cell::new("?", Mood::Dim)).collect(),
        }
    }
}

/// The columns of a kind.
#[must_use]
pub fn columns(info: &KindInfo) -> &'static dyn Columns {
    match (info.group, info.kind) {
        ("", "Pod") => &Of(projected::POD),
        ("", "Node") => &Of(projected::NODE),
        (_, "Node") => &Of(node::COLUMNS),
        (_, "Task") => &Of(task::COLUMNS),
        (_, "TaskSet") => &Of(taskset::COLUMNS),
        (_, "Application") => &Of(application::COLUMNS),
        (_, "TaskSetRevision") => &Of(taskset_revision::COLUMNS),
        (_, "Lease") => &Of(lease::COLUMNS),
        (_, "Framework") => &Of(framework::COLUMNS),
        (_, "Quota") => &Of(quota::COLUMNS),
        (_, "Site") => &Of(site::COLUMNS),
        (_, "Access") => &Of(access::COLUMNS),
        (_, "ConfigMap") => &Of(keyed::CONFIG_MAP),
        (_, "Secret") => &Of(keyed::SECRET),
        (_, "Namespace") => &Of(namespace::COLUMNS),
        (_, "Event") => &Of(event::COLUMNS),
        _ => &Of(AGE),
    }
}

/// Whether a row begins with the object's name. The names of events are made up; what they are about has a column.
#[must_use]
pub fn is_named(info: &KindInfo) -> bool {
    info.kind != "Event"
}

const AGE: &[Column<Aged>] =
    &[Column::new("AGE", |object, now| age(object.metadata.creation_timestamp.as_ref(), now))];

#[derive(serde::Deserialize)]
struct Aged {
    metadata: k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta,
}

/// How old something is.
#[must_use]
pub fn age(created: Option<&Time>, now: Timestamp) -> Cell {
    created.map(|t| human::age(t.0, now)).unwrap_or_default().into()
}
