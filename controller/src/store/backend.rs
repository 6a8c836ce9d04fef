//! Where a batch becomes durable: the only part of the store that differs between SQLite and memory.

use std::fmt;

use futures::future::BoxFuture;

use super::Event;

/// One row of history as it was committed. What is in it is not shown in logs.
#[derive(Clone)]
pub(super) struct Row {
    pub(super) revision: u64,
    pub(super) resource: String,
    pub(super) namespace: String,
    pub(super) name: String,
    pub(super) uid: String,
    pub(super) deleted: bool,
    pub(super) value: String,
}

impl fmt::Debug for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Row { revision, resource, namespace, name, .. } = self;
        write!(f, "Row({revision}, {resource}/{namespace}/{name})")
    }
}

/// What one commit writes. All of it or nothing.
#[derive(Debug)]
pub(super) struct Batch<'a> {
    /// Consecutive revisions, ascending.
    pub(super) events: &'a [Event],
    /// History to forget, carried along so that it costs no sync of its own.
    pub(super) compaction: Option<&'a Compaction>,
}

/// History that no watch can ask for any more.
#[derive(Debug, Default)]
pub(super) struct Compaction {
    /// Events at or below this revision are gone.
    pub(super) through: u64,
    /// Rows that are neither the present state of an object nor needed as the "before" of a later event.
    pub(super) garbage: Vec<u64>,
}

/// Why a backend failed.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    /// SQLite or the file system under it.
    #[error("database error")]
    Sqlite(#[from] sqlx::Error),
    /// The schema could not be brought up to date.
    #[error("schema migration failed")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    /// The rows contradict each other.
    #[error("the database is damaged: {0}")]
    Damaged(String),
    /// Another program has the database open and reads an older state of it.
    #[error("the database's log cannot be emptied while another program reads it")]
    LogInUse,
    /// A Secret cannot be sealed or opened.
    #[error(transparent)]
    Sealed(#[from] super::seal::SealError),
    /// A test asked for it.
    #[error("injected failure")]
    Injected,
}

/// The durable half of a store. Called by one task, one call at a time.
pub(super) trait Backend: Send + 'static {
    /// Feeds every row, ascending by revision, and returns the revision through which history was compacted.
    fn load<'a>(
        &'a mut self,
        sink: &'a mut (dyn FnMut(Row) + Send),
    ) -> BoxFuture<'a, Result<u64, BackendError>>;

    /// Makes a batch durable.
    fn commit<'a>(&'a mut self, batch: Batch<'a>) -> BoxFuture<'a, Result<(), BackendError>>;

    /// The last revision that is durable, asked after a failed commit: the failure may have come after the disk
    /// had taken the batch.
    fn last_revision(&mut self) -> BoxFuture<'_, Result<u64, BackendError>>;
}
