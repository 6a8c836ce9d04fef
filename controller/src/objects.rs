//! Typed reading and writing of the kinds that the controller itself works on.
//!
//! Sessions and reconcilers change only `status` (and metadata that is theirs), each through a
//! read-modify-write that repeats when somebody else wrote in between.

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

/// Reads an object, lets `change` make operations of it, and applies them as one transaction; again
/// when anything they depend on changed in between. `None` from `change` or no such object: nothing
/// is done.
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
        let Some(stored) = store.get(key) else { return Ok(None) };
        let Some(object) = read::<T>(&stored) else { return Ok(None) };
        let Some(ops) = change(&stored, object) else { return Ok(None) };
        match store.apply(ops).await {
            Ok(mut written) => return Ok(Some(written.swap_remove(0))),
            Err(error) if is_race(&error) => tokio::task::yield_now().await,
            Err(error) => return Err(error),
        }
    }
}

/// Whether an object is still what was read, also when it is known of every write that seemed to fail whether the disk has
/// it: who finds that nothing is to be written, and is not told of changes, must know that.
///
/// # Errors
///
/// While the disk cannot be asked.
pub async fn is_still(store: &Store, stored: &Stored) -> Result<bool, StoreError> {
    store.settled().await?;
    Ok(store.get(&stored.key).is_some_and(|now| now.revision == stored.revision))
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
        None => Ok(Op::Check { key, precondition: Precondition::revision(stored.revision) }),
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
