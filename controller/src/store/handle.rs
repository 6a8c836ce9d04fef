//! The front of the store that everybody holds.

use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};

use serde_json::Value;
use tokio::sync::{mpsc, oneshot, watch};

use super::document::Template;
use super::pending::Prepared;
use super::state::{Expired, Snapshot, State};
use super::watch::{WatchError, Watcher};
use super::writer::Request;
use super::{Key, Op, Precondition, Resource, StoreError, Stored, UpdateError};

/// A handle to the store. Cheap to clone; the [`Writer`](super::Writer) ends when the last one is dropped.
#[derive(Debug, Clone)]
pub struct Store {
    state: Arc<RwLock<State>>,
    requests: mpsc::Sender<Request>,
    published: watch::Receiver<u64>,
}

impl Store {
    pub(super) fn new(
        state: Arc<RwLock<State>>,
        requests: mpsc::Sender<Request>,
        published: watch::Receiver<u64>,
    ) -> Self {
        Self { state, requests, published }
    }

    fn read(&self) -> RwLockReadGuard<'_, State> {
        // Nothing panics while it holds the lock half way through a change.
        self.state.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// The revision of the last committed change.
    #[must_use]
    pub fn revision(&self) -> u64 {
        self.read().revision()
    }

    /// The present state of one object.
    #[must_use]
    pub fn get(&self, key: &Key) -> Option<Arc<Stored>> {
        self.read().get(key).map(Arc::clone)
    }

    /// The present objects of `resource`: of one namespace, or of all when `namespace` is `None`.
    #[must_use]
    pub fn list(&self, resource: Resource, namespace: Option<&str>) -> Snapshot {
        self.read().snapshot(resource, namespace, None)
    }

    /// Every present object of every resource, in the order of keys.
    #[must_use]
    pub fn list_all(&self) -> Vec<Arc<Stored>> {
        self.read().all().map(Arc::clone).collect()
    }

    /// The objects after the key `after` as they were at `revision`, which makes a list in pages exact.
    ///
    /// # Errors
    /// When history no longer reaches back that far.
    pub fn list_at(
        &self,
        resource: Resource,
        namespace: Option<&str>,
        after: Option<&Key>,
        revision: u64,
    ) -> Result<Snapshot, Expired> {
        self.read().snapshot_at(resource, namespace, after, revision)
    }

    /// Changes of `resource` after the revision `from`, in all namespaces.
    ///
    /// # Errors
    /// [`WatchError::Expired`] when history no longer reaches back to `from`, [`WatchError::Ahead`] when `from` was
    /// never committed here.
    pub fn watch(&self, resource: Resource, from: u64) -> Result<Watcher, WatchError> {
        Watcher::open(Arc::clone(&self.state), self.published.clone(), Some(resource), from)
    }

    /// Changes of every resource after the revision `from`.
    ///
    /// # Errors
    /// As [`Store::watch`].
    pub fn watch_all(&self, from: u64) -> Result<Watcher, WatchError> {
        Watcher::open(Arc::clone(&self.state), self.published.clone(), None, from)
    }

    /// Whether writes can still be answered.
    #[must_use]
    pub fn is_open(&self) -> bool {
        !self.requests.is_closed()
    }

    /// Applies a transaction. Returns the new states in order, none for an [`Op::Check`] or [`Op::Still`]; for a removal the last
    /// state with the removal's revision.
    ///
    /// # Errors
    /// The first operation that cannot be admitted refuses all of them.
    pub async fn apply(&self, ops: Vec<Op>) -> Result<Vec<Arc<Stored>>, StoreError> {
        if ops.is_empty() {
            return Ok(Vec::new());
        }
        let ops = ops.into_iter().map(prepare).collect::<Result<Vec<_>, _>>()?;
        let (answer, answered) = oneshot::channel();
        let sent = self.requests.send(Request::Apply { ops, answer }).await;
        sent.map_err(|_| StoreError::Closed)?;
        answered.await.map_err(|_| StoreError::Closed)?
    }

    /// Applies a transaction of one change.
    ///
    /// # Errors
    /// As [`Store::apply`].
    ///
    /// # Panics
    /// When `op` is an [`Op::Check`] or [`Op::Still`], which change nothing.
    pub async fn apply_one(&self, op: Op) -> Result<Arc<Stored>, StoreError> {
        let mut stored = self.apply(vec![op]).await?;
        Ok(stored.pop().expect("one change has one result"))
    }

    /// Creates an object.
    ///
    /// # Errors
    /// [`StoreError::AlreadyExists`], and as [`Store::apply`].
    pub async fn create(&self, key: Key, value: Value) -> Result<Arc<Stored>, StoreError> {
        self.apply_one(Op::create(key, value)).await
    }

    /// Creates or replaces an object.
    ///
    /// # Errors
    /// As [`Store::apply`].
    pub async fn put(
        &self,
        key: Key,
        value: Value,
        precondition: Precondition,
    ) -> Result<Arc<Stored>, StoreError> {
        self.apply_one(Op::Put { key, value, precondition }).await
    }

    /// Removes an object.
    ///
    /// # Errors
    /// As [`Store::apply`].
    pub async fn delete(
        &self,
        key: Key,
        precondition: Precondition,
    ) -> Result<Arc<Stored>, StoreError> {
        self.apply_one(Op::Delete { key, precondition }).await
    }

    /// Reads, changes and writes an object, again when somebody else wrote in between. `change` gets the object and
    /// its tree and returns the new tree, or `None` to leave it as it is, which is certain then.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] when there is no such object (any more), or what `change` said.
    pub async fn update<E>(
        &self,
        key: &Key,
        mut change: impl FnMut(&Stored, Value) -> Result<Option<Value>, E>,
    ) -> Result<Arc<Stored>, UpdateError<E>> {
        loop {
            let Some(present) = self.get(key) else {
                return Err(StoreError::NotFound { key: key.clone() }.into());
            };
            let changed = change(&present, present.value()).map_err(UpdateError::Refused)?;
            let (key, precondition) = (key.clone(), Precondition::revision(present.revision));
            let op = match changed {
                Some(value) => Op::Put { key, value, precondition },
                // What was read may be older than the disk.
                None => Op::Check { key, precondition },
            };
            match self.apply(vec![op]).await {
                // Whoever came first made progress, so this ends; the next read sees at least that write.
                Err(StoreError::Conflict { .. }) => tokio::task::yield_now().await,
                written => return Ok(written?.pop().unwrap_or(present)),
            }
        }
    }

    /// Ready when it is known of every transaction that was answered before whether the disk has it. What seemed to fail
    /// and is there all the same can be read from then on.
    ///
    /// # Errors
    /// While the disk cannot be asked.
    pub async fn settled(&self) -> Result<(), StoreError> {
        let (answer, answered) = oneshot::channel();
        let sent = self.requests.send(Request::Settle { answer }).await;
        sent.map_err(|_| StoreError::Closed)?;
        answered.await.map_err(|_| StoreError::Closed)?
    }

    /// Forgets history through `revision`. Watches from before it get [`WatchEnd::Expired`](super::WatchEnd).
    ///
    /// # Errors
    /// When the backend failed; the watches have already ended then.
    pub async fn compact(&self, revision: u64) -> Result<(), StoreError> {
        let (answer, answered) = oneshot::channel();
        let sent = self.requests.send(Request::Compact { through: revision, answer }).await;
        sent.map_err(|_| StoreError::Closed)?;
        answered.await.map_err(|_| StoreError::Closed)?
    }
}

fn prepare(op: Op) -> Result<Prepared, StoreError> {
    match op {
        Op::Put { key, value, precondition } => match Template::new(&value) {
            Ok(template) => Ok(Prepared::Put { key, template, precondition }),
            Err(reason) => Err(StoreError::Malformed { key, reason }),
        },
        Op::Status { of, status } => match Template::with_status(&of, &status) {
            Ok(template) => {
                let precondition = Precondition::revision(of.revision);
                Ok(Prepared::Put { key: of.key.clone(), template, precondition })
            }
            Err(reason) => Err(StoreError::Malformed { key: of.key.clone(), reason }),
        },
        Op::Delete { key, precondition } => Ok(Prepared::Delete { key, precondition }),
        Op::Check { key, precondition } => Ok(Prepared::Check { key, precondition }),
        Op::Still { revision, of } => Ok(Prepared::Still { revision, of }),
    }
}
