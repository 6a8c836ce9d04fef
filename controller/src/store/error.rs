//! Why the store refused or failed.

use std::path::PathBuf;
use std::sync::Arc;

use super::Key;
use super::backend::BackendError;

/// Why a transaction was not applied. Nothing of it was, unless the variant says otherwise.
#[derive(Debug, Clone, thiserror::Error)]
pub enum StoreError {
    /// The operation wanted no object and there is one.
    #[error("{key} already exists")]
    AlreadyExists {
        /// The object.
        key: Key,
    },
    /// The operation wanted an object and there is none.
    #[error("{key} not found")]
    NotFound {
        /// The missing object.
        key: Key,
    },
    /// The object changed since the caller read it.
    #[error("{key} is at revision {actual}, not at {expected}")]
    Conflict {
        /// The object.
        key: Key,
        /// What the caller thought.
        expected: u64,
        /// What it is.
        actual: u64,
    },
    /// Something was written since the caller looked.
    #[error("{} after revision {since}", changed(key.as_ref()))]
    Moved {
        /// When the caller looked.
        since: u64,
        /// What was written first; none: history does not reach back so far.
        key: Option<Key>,
    },
    /// Another object has this name now.
    #[error("{key} has uid {actual:?}, not {expected:?}")]
    UidMismatch {
        /// The name.
        key: Key,
        /// The object that the caller meant.
        expected: String,
        /// The one that is there.
        actual: String,
    },
    /// The value is not an object with an object in `metadata`, or it is too deep or too large.
    #[error("{key} cannot be stored: {reason}")]
    Malformed {
        /// The object.
        key: Key,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// The store is shutting down.
    #[error("the store is shutting down")]
    Closed,
    /// The batch could not be made durable. It is not published; a retry is safe where the operation carries a
    /// precondition.
    #[error("the store could not commit")]
    Storage {
        /// What the backend said.
        #[source]
        source: Arc<BackendError>,
    },
}

fn changed(key: Option<&Key>) -> String {
    key.map_or_else(|| "much has changed".to_owned(), |key| format!("{key} has changed"))
}

/// Why [`Store::update`](super::Store::update) gave up.
#[derive(Debug, thiserror::Error)]
pub enum UpdateError<E> {
    /// The closure refused the change.
    #[error(transparent)]
    Refused(E),
    /// The store did.
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// Why a store could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The database was written by a newer version of this program.
    #[error(
        "{} has schema version {found}, and this version of muster reads up to {supported}",
        path.display()
    )]
    Newer {
        /// The database file.
        path: PathBuf,
        /// Its schema version.
        found: i64,
        /// The newest that this binary knows.
        supported: i64,
    },
    /// The keys of its Secrets cannot be used.
    #[error(transparent)]
    Keys(super::seal::SealError),
    /// It could not be opened, migrated or read.
    #[error("cannot open the store at {}", path.display())]
    Backend {
        /// The database file.
        path: PathBuf,
        /// What the backend said.
        #[source]
        source: BackendError,
    },
}
