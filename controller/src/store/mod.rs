//! Revisioned objects with durable writes and exact watches.
//!
//! ```text
//!  writers ──Vec<Op>──▶ bounded mpsc ──▶ Writer task ──one commit a batch──▶ Backend (sqlite | memory)
//!                                          │ after the commit, in revision order
//!                                          ▼
//!  readers ◀── get / list / list_at ── Shared { map of live objects, ring of recent events }
//!  watchers ◀── Watcher (a cursor over the ring, woken by the published revision)
//! ```
//!
//! | module | is |
//! |---|---|
//! | `handle` | [`Store`], the cloneable front that everybody holds |
//! | `writer` | the one task that admits, commits and publishes; run and joined by whoever opened the store |
//! | `pending` | preconditions against what the batch being gathered will leave behind |
//! | `state` | what readers see: the map and the ring |
//! | `watch` | cursors over the ring |
//! | `document` | JSON with its resourceVersion spliced in |
//! | `backend`, [`sqlite`], [`memory`] | where a batch becomes durable |
//! | [`seal`] | Secrets are encrypted before they reach a disk |
//! | `contract` | the one suite that both backends pass |
//!
//! Reads never touch the disk: every live object is in memory as the JSON that was committed. A write is answered
//! only after its batch is durable, and is visible to reads and watches before it is answered.

mod backend;
#[cfg(test)]
mod contract;
mod document;
mod error;
mod handle;
mod key;
pub mod memory;
mod pending;
#[cfg(test)]
mod properties;
pub mod seal;
pub mod sqlite;
mod state;
mod watch;
mod writer;

use std::fmt;
use std::sync::{Arc, OnceLock};

use bytes::Bytes;
use muster_api::selector::Labels;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use serde_json::value::RawValue;

pub use backend::BackendError;
pub use document::{DEEPEST, LARGEST, is_deeper};
pub use error::{OpenError, StoreError, UpdateError};
pub use handle::Store;
pub use key::{Key, Resource};
pub use state::{Expired, Snapshot};
pub use watch::{WatchEnd, WatchError, Watcher};
pub use writer::Writer;

/// One object as it was committed. What is in it is not shown in logs.
#[derive(Clone, PartialEq, Eq)]
pub struct Stored {
    /// Where the object lives.
    pub key: Key,
    /// The revision that wrote this state; equal to `metadata.resourceVersion` in `bytes`.
    pub revision: u64,
    /// `metadata.uid`, or empty for internal records that carry none.
    pub uid: Box<str>,
    /// The object as JSON, ready to be sent.
    pub bytes: Bytes,
    /// Its labels, read once: a thousand watchers may each ask for them.
    labels: OnceLock<Box<Labels>>,
    /// The same with what a view of it adds.
    shown: OnceLock<Box<Labels>>,
    /// The fields that it can be selected by, read once for each way in which it is shown.
    fields: OnceLock<Box<[OnceLock<Fields>; SHOWN]>>,
}

/// Values of fields, in an order that their reader knows.
type Fields = Box<[Box<str>]>;
/// In how many ways an object is shown: as it is, and as another kind.
pub const SHOWN: usize = 2;

impl fmt::Debug for Stored {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Stored")
            .field("key", &self.key)
            .field("revision", &self.revision)
            .field("uid", &self.uid)
            .finish_non_exhaustive()
    }
}

/// The part of an object that has its labels.
#[derive(Deserialize)]
struct Labelled {
    metadata: LabelledMetadata,
}

#[derive(Deserialize)]
struct LabelledMetadata {
    #[serde(default)]
    labels: Option<Labels>,
}

impl Stored {
    /// An object at a revision.
    #[must_use]
    pub fn new(key: Key, revision: u64, uid: Box<str>, bytes: Bytes) -> Self {
        let (labels, shown, fields) = (OnceLock::new(), OnceLock::new(), OnceLock::new());
        Self { key, revision, uid, bytes, labels, shown, fields }
    }

    /// The same object as if it had been written at `revision`: the last that somebody sees of it who does not see what it
    /// became.
    #[must_use]
    pub fn at(&self, revision: u64) -> Self {
        let bytes = document::Template::again(self).at(revision);
        Self::new(self.key.clone(), revision, self.uid.clone(), bytes)
    }

    /// Its labels.
    #[must_use]
    pub fn labels(&self) -> &Labels {
        self.labels.get_or_init(|| {
            let labels = self.parse::<Labelled>().ok().and_then(|object| object.metadata.labels);
            Box::new(labels.unwrap_or_default())
        })
    }

    /// Its labels with what its view adds, which `add` says the first time.
    #[must_use]
    pub fn labels_shown(&self, add: impl FnOnce(&Labels) -> Labels) -> &Labels {
        self.shown.get_or_init(|| Box::new(add(self.labels())))
    }

    /// What `read` finds in it the first time it is asked for as it is shown in the way `shown`, one of [`SHOWN`].
    ///
    /// # Panics
    /// When there is no such way.
    #[must_use]
    pub fn fields(&self, shown: usize, read: impl FnOnce() -> Vec<String>) -> &[Box<str>] {
        let all = self.fields.get_or_init(Box::default);
        all[shown].get_or_init(|| read().into_iter().map(String::into_boxed_str).collect())
    }

    /// Whether a field of this name can be in the object. A cheap look at the text, so that most objects
    /// need not be read to see that they do not concern a caller; true may be a word of a value.
    #[must_use]
    pub fn mentions(&self, field: &str) -> bool {
        let (field, bytes) = (field.as_bytes(), &self.bytes[..]);
        let mut rest = bytes;
        while let Some(quote) = rest.iter().position(|b| *b == b'"') {
            rest = &rest[quote + 1..];
            if rest.starts_with(field) && rest.get(field.len()) == Some(&b'"') {
                return true;
            }
        }
        false
    }

    /// The object as a JSON tree.
    ///
    /// # Panics
    /// Never for an object of a store: only JSON that serde_json produced, and no deeper than it reads, is stored.
    #[must_use]
    pub fn value(&self) -> Value {
        serde_json::from_slice(&self.bytes).expect("stored bytes were rendered from JSON")
    }

    /// The object as a typed resource.
    ///
    /// # Errors
    /// When the stored JSON does not have the shape of `T`.
    pub fn parse<T: DeserializeOwned>(&self) -> Result<T, serde_json::Error> {
        serde_json::from_slice(&self.bytes)
    }
}

/// What must hold of the present object for an operation to be admitted.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Precondition {
    /// Nothing. A put creates or replaces; a delete still needs an object.
    #[default]
    Any,
    /// No live object has this key.
    Absent,
    /// A live object has this key and is the named one.
    Match {
        /// Its present revision.
        revision: Option<u64>,
        /// Its uid, which tells an object from a namesake created after it.
        uid: Option<String>,
    },
}

impl Precondition {
    /// The object exists, whatever it is.
    pub const PRESENT: Self = Self::Match { revision: None, uid: None };

    /// The object exists at exactly this revision.
    #[must_use]
    pub fn revision(revision: u64) -> Self {
        Self::Match { revision: Some(revision), uid: None }
    }

    /// The object exists and has this uid.
    #[must_use]
    pub fn uid(uid: impl Into<String>) -> Self {
        Self::Match { revision: None, uid: Some(uid.into()) }
    }
}

/// One change of one object. A transaction is a `Vec<Op>` and is applied whole or not at all. As with [`Stored`], what
/// is written is not shown.
#[derive(Clone)]
pub enum Op {
    /// Create or replace an object. `metadata.resourceVersion` in `value` is ignored and set by the store.
    Put {
        /// Where the object lives.
        key: Key,
        /// The whole object; `metadata` must be a JSON object.
        value: Value,
        /// What must hold.
        precondition: Precondition,
    },
    /// Replace the `status` of an object, and nothing else of it, while it is at the revision of `of`.
    Status {
        /// The object as it was read.
        of: Arc<Stored>,
        /// Its new status.
        status: Box<RawValue>,
    },
    /// Change nothing, but let the transaction pass only while this holds of another object.
    Check {
        /// The object that the transaction relies on.
        key: Key,
        /// What must hold.
        precondition: Precondition,
    },
    /// Change nothing, but let the transaction pass only while no object of these resources was written after a revision.
    /// Only what the transaction itself did before this counts as well.
    Still {
        /// Everything up to it is known.
        revision: u64,
        /// Of which resources.
        of: &'static [Resource],
    },
    /// Remove an object.
    Delete {
        /// Where the object lives.
        key: Key,
        /// What must hold.
        precondition: Precondition,
    },
}

impl fmt::Debug for Op {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (what, key) = match self {
            Op::Put { key, .. } => ("Put", key),
            Op::Status { of, .. } => ("Status", &of.key),
            Op::Check { key, .. } => ("Check", key),
            Op::Delete { key, .. } => ("Delete", key),
            Op::Still { revision, .. } => {
                return f.debug_tuple("Still").field(revision).finish();
            }
        };
        f.debug_tuple(what).field(key).finish()
    }
}

impl Op {
    /// A put that fails when the object already exists.
    #[must_use]
    pub fn create(key: Key, value: Value) -> Self {
        Self::Put { key, value, precondition: Precondition::Absent }
    }

    /// A put that fails unless the object is still at `revision`.
    #[must_use]
    pub fn replace(key: Key, value: Value, revision: u64) -> Self {
        Self::Put { key, value, precondition: Precondition::revision(revision) }
    }

    /// A new status for an object, that fails unless the object is still what was read.
    ///
    /// # Panics
    /// When `status` does not serialize, which the types of resources do.
    #[must_use]
    pub fn status<T: Serialize>(of: &Arc<Stored>, status: &T) -> Self {
        let status = serde_json::value::to_raw_value(status).expect("a status serializes to JSON");
        Self::Status { of: Arc::clone(of), status }
    }

    /// A removal that fails unless the object is still at `revision`.
    #[must_use]
    pub fn remove(key: Key, revision: u64) -> Self {
        Self::Delete { key, precondition: Precondition::revision(revision) }
    }
}

/// What an event did to its object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    /// Created or replaced; `previous` tells which.
    Put,
    /// Removed.
    Delete,
}

/// One committed change.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Event {
    /// What happened.
    pub change: Change,
    /// The new state; for a removal the last state with the removal's revision as its resourceVersion.
    pub object: Arc<Stored>,
    /// The state before, so that a selector can tell "no longer matches" from "never matched".
    pub previous: Option<Arc<Stored>>,
}

impl Event {
    /// The revision of this change.
    #[must_use]
    pub fn revision(&self) -> u64 {
        self.object.revision
    }
}
