//! Typed reading and writing of the kinds that the controller itself works on.
//!
//! Sessions and reconcilers change only `status` (and metadata that is theirs), each through a
//! read-modify-write that repeats when somebody else wrote in between.
//!
//! What is read is on the disk, and may be older than what the disk has: a write that is queued or under way is not read yet,
//! and one that seemed to fail not before the disk was asked, within a second or when it answers again.
//! Who finds that nothing is to be written, and lets somebody rely on that, therefore commits that the object is as it was
//! read: [`change`] does. [`change_watched`] is for those who are told of every later change.

use std::sync::Arc;

use muster_api::kind::lease::{Lease, LeaseSpec};
use muster_api::kind::namespace::DEFAULT;
use muster_api::kind::node::{MissionLock, Node};
use muster_api::kind::task::Task;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::store::{Key, Op, Precondition, Resource, Store, StoreError, Stored};

/// Nodes.
pub const NODES: Resource = Resource::new("nodes");
/// Tasks.
pub const TASKS: Resource = Resource::new("tasks");
/// TaskSets.
pub const TASK_SETS: Resource = Resource::new("tasksets");
/// Templates that TaskSets have or had.
pub const REVISIONS: Resource = Resource::new("tasksetrevisions");
/// Applications.
pub const APPLICATIONS: Resource = Resource::new("applications");
/// Frameworks.
pub const FRAMEWORKS: Resource = Resource::new("frameworks");
/// Quotas.
pub const QUOTAS: Resource = Resource::new("quotas");
/// Who may do what.
pub const ACCESSES: Resource = Resource::new("accesses");
/// Sites.
pub const SITES: Resource = Resource::new("sites");
/// Leases.
pub const LEASES: Resource = Resource::new("leases");
/// Events.
pub const EVENTS: Resource = Resource::new("events");

/// The key of a Node.
#[must_use]
pub fn node_key(name: &str) -> Key {
    Key::cluster(NODES, name)
}

/// The key of the Lease of a robot's conflict group.
#[must_use]
pub fn lease_key(node: &str, group: &str) -> Key {
    Key::cluster(LEASES, LeaseSpec::object_name(node, group))
}

/// A stored object that does not read as its kind. It got past admission, so a newer version of
/// muster wrote it, or the disk lies; it is left alone and said so.
pub fn read<T: DeserializeOwned>(stored: &Stored) -> Option<T> {
    match stored.parse() {
        Ok(object) => Some(object),
        Err(error) => {
            tracing::error!(key = %stored.key, %error, "a stored object does not read as its kind; it is ignored");
            None
        }
    }
}

/// A typed object as JSON.
#[must_use]
pub fn to_value<T: Serialize>(object: &T) -> Value {
    serde_json::to_value(object).expect("resource types serialise to JSON objects")
}

/// A replacement that fails when somebody else wrote in between.
#[must_use]
pub fn replace<T: Serialize>(stored: &Stored, object: &T) -> Op {
    Op::replace(stored.key.clone(), to_value(object), stored.revision)
}

/// That an object is as it was read.
#[must_use]
pub fn unchanged(stored: &Stored) -> Op {
    Op::Check { key: stored.key.clone(), precondition: Precondition::revision(stored.revision) }
}

/// That there is no object of this key.
#[must_use]
pub fn absent(key: &Key) -> Op {
    Op::Check { key: key.clone(), precondition: Precondition::Absent }
}

/// Reads an object, lets `change` make operations of it, and applies them as one transaction; again
/// when anything they depend on changed in between. `None` from `change` or no such object: nothing
/// is written, and `None` is returned when it is certain that this is what the disk has.
///
/// # Errors
///
/// When the store fails; never for a conflict.
pub async fn change<T: DeserializeOwned>(
    store: &Store,
    key: &Key,
    mut change: impl FnMut(&Arc<Stored>, T) -> Option<Vec<Op>>,
) -> Result<Option<Arc<Stored>>, StoreError> {
    loop {
        let stored = store.get(key);
        let as_read = || vec![stored.as_deref().map_or_else(|| absent(key), unchanged)];
        let ops = operations(stored.as_ref(), &mut change).unwrap_or_else(as_read);
        if let Some(written) = commit(store, ops).await? {
            return Ok(written.into_iter().next());
        }
    }
}

/// The same for a loop that follows the store's events, or looks again soon: what is not read yet comes to it later, and
/// finding nothing to write costs it no turn of the writer.
///
/// # Errors
///
/// As [`change`].
pub async fn change_watched<T: DeserializeOwned>(
    store: &Store,
    key: &Key,
    mut change: impl FnMut(&Arc<Stored>, T) -> Option<Vec<Op>>,
) -> Result<Option<Arc<Stored>>, StoreError> {
    while let Some(ops) = operations(store.get(key).as_ref(), &mut change) {
        if let Some(written) = commit(store, ops).await? {
            return Ok(written.into_iter().next());
        }
    }
    Ok(None)
}

/// None: there is no such object, or nothing of it is to be changed.
fn operations<T: DeserializeOwned>(
    stored: Option<&Arc<Stored>>,
    change: &mut impl FnMut(&Arc<Stored>, T) -> Option<Vec<Op>>,
) -> Option<Vec<Op>> {
    let stored = stored?;
    change(stored, read(stored)?)
}

/// None: somebody else was first.
async fn commit(store: &Store, ops: Vec<Op>) -> Result<Option<Vec<Arc<Stored>>>, StoreError> {
    match store.apply(ops).await {
        Ok(written) => Ok(Some(written)),
        Err(error) if is_race(&error) => {
            tokio::task::yield_now().await;
            Ok(None)
        }
        Err(error) => Err(error),
    }
}

/// Somebody else was first; reading again shows what is now.
#[must_use]
pub fn is_race(error: &StoreError) -> bool {
    match error {
        StoreError::AlreadyExists { .. }
        | StoreError::NotFound { .. }
        | StoreError::Conflict { .. }
        | StoreError::Moved { .. }
        | StoreError::UidMismatch { .. } => true,
        StoreError::Malformed { .. } | StoreError::Closed | StoreError::Storage { .. } => false,
    }
}

/// The operation that frees a lease, if `uid` still holds it.
#[must_use]
pub fn release_lease(store: &Store, name: &str, uid: &str) -> Option<Op> {
    let stored = store.get(&Key::cluster(LEASES, name))?;
    let mut lease: Lease = read(&stored)?;
    let status = lease.status.as_mut()?;
    status.holder.as_ref().filter(|h| h.uid.as_str() == uid)?;
    status.holder = None;
    status.acquired = None;
    Some(replace(&stored, &lease))
}

/// Why nobody may end what runs on a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Locked {
    /// A mission lock says so.
    By(MissionLock),
    /// There is no such Node.
    Gone,
}

/// A condition of the orders that end tasks on a node: that it has no mission lock at the moment of the commit.
///
/// # Errors
///
/// What stands against it now.
pub fn unlocked(store: &Store, node: &str) -> Result<Op, Locked> {
    let key = node_key(node);
    let stored = store.get(&key).ok_or(Locked::Gone)?;
    let object: Node = read(&stored).ok_or(Locked::Gone)?;
    match object.mission_lock() {
        Some(lock) => Err(Locked::By(lock)),
        None => Ok(unchanged(&stored)),
    }
}

/// The tasks that hold resources of a node, in the order of their names.
#[must_use]
pub fn tasks_holding(store: &Store, node: &str) -> Vec<(Arc<Stored>, Task)> {
    let placed = store.list(TASKS, None).items.into_iter().filter(|s| s.mentions(node));
    let read = placed.filter_map(|stored| read::<Task>(&stored).map(|task| (stored, task)));
    read.filter(|(_, task)| {
        let status = task.status.as_ref();
        status.is_some_and(|s| s.phase.holds_node() && s.node.as_deref() == Some(node))
    })
    .collect()
}

/// Fields that the server owns, for objects that the controller itself creates.
pub fn stamp_new(
    metadata: &mut k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta,
    now: jiff::Timestamp,
) {
    metadata.uid = Some(uuid::Uuid::new_v4().to_string());
    let whole = jiff::Timestamp::from_second(now.as_second()).unwrap_or(now);
    metadata.creation_timestamp = Some(k8s_openapi::apimachinery::pkg::apis::meta::v1::Time(whole));
    metadata.generation = Some(1);
}

/// The object of this kind and name among manifests.
#[must_use]
pub fn among<'a>(
    manifests: &'a [Value],
    kind: &str,
    (namespace, name): (&str, &str),
) -> Option<&'a Value> {
    manifests.iter().find(|object| {
        let there = object["metadata"]["namespace"].as_str().unwrap_or(DEFAULT);
        object["kind"] == kind && object["metadata"]["name"] == name && there == namespace
    })
}

/// A creation, or a replacement of what is there.
#[must_use]
pub fn create<T: Serialize>(key: Key, object: &T) -> Op {
    Op::Put { key, value: to_value(object), precondition: Precondition::Absent }
}

/// The uid of a typed object; empty for one that was never stored.
#[must_use]
pub fn uid_of(metadata: &k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta) -> &str {
    metadata.uid.as_deref().unwrap_or_default()
}

/// The key of a stored Task.
#[must_use]
pub fn task_key(task: &Task) -> Key {
    let namespace =
        task.metadata.namespace.as_deref().unwrap_or(muster_api::kind::namespace::DEFAULT);
    Key::namespaced(TASKS, namespace, task.metadata.name.as_deref().unwrap_or_default())
}

/// The name of a stored Node.
#[must_use]
pub fn node_name(node: &Node) -> &str {
    node.metadata.name.as_deref().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use futures::FutureExt as _;
    use serde_json::json;

    use super::*;
    use crate::store::memory;

    fn key() -> Key {
        node_key("r1")
    }

    async fn create(store: &Store) -> Result<Arc<Stored>, StoreError> {
        let value = json!({"metadata": {"name": "r1", "uid": "u"}, "word": "first"});
        store.create(key(), value).await
    }

    /// Writes a word where another one stands.
    async fn say(store: &Store, word: &str) -> Result<Option<Arc<Stored>>, StoreError> {
        change(store, &key(), |stored, mut object: Value| {
            if object["word"] == word {
                return None;
            }
            object["word"] = word.into();
            Some(vec![replace(stored, &object)])
        })
        .await
    }

    async fn kept(store: &Store) -> Value {
        store.settled().await.expect("the disk answers");
        store.get(&key()).expect("it is there").value()["word"].take()
    }

    #[tokio::test]
    async fn nothing_is_to_be_written_where_the_disk_says_the_same() {
        let (store, failures) = memory::start_failing().await;
        create(&store).await.expect("it is new");
        failures.mislead_next(1);
        say(&store, "second").await.expect_err("it seems to fail");
        let written = say(&store, "first").await.expect("the disk is well");
        assert!(written.is_some(), "the disk had the other word");
        assert_eq!(kept(&store).await, "first");
        failures.fail_next(1);
        say(&store, "second").await.expect_err("it fails");
        assert_eq!(say(&store, "first").await.expect("the disk is well"), None);
        assert_eq!(kept(&store).await, "first");
    }

    #[tokio::test]
    async fn a_write_that_nobody_waits_for_any_more_is_not_what_stands_at_the_end() {
        let store = memory::start().await;
        create(&store).await.expect("it is new");
        assert!(say(&store, "second").now_or_never().is_none(), "it is queued");
        say(&store, "first").await.expect("the disk is well");
        assert_eq!(kept(&store).await, "first");
    }

    #[tokio::test]
    async fn an_object_is_not_there_where_the_disk_has_none() {
        let (store, failures) = memory::start_failing().await;
        assert_eq!(say(&store, "second").await.expect("the disk is well"), None);
        failures.mislead_next(1);
        create(&store).await.expect_err("it seems to fail");
        assert!(say(&store, "second").await.expect("the disk is well").is_some());
        assert_eq!(kept(&store).await, "second");
    }

    #[tokio::test]
    async fn who_is_told_of_changes_does_not_wait_for_the_disk() {
        let (store, writer, _) = memory::open().await;
        let nothing = |_: &Arc<Stored>, _: Value| None;
        let found = change_watched(&store, &key(), nothing).now_or_never();
        assert!(matches!(found, Some(Ok(None))), "nobody writes, and nobody is asked");
        drop(writer);
    }
}
