//! What a bind writes: the task's status and the leases that it was granted. The same for declared tasks and for those
//! that a framework launches.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use muster_api::id::Epoch;
use muster_api::kind::lease::{HolderKind, Lease, LeaseHolder, LeaseSpec, LeaseStatus};
use muster_api::kind::task::{TaskLease, TaskStatus};
use muster_api::phase::TaskPhase;
use muster_controller_core::schedule::Bind;

use crate::objects::{self, NODES};
use crate::store::{Key, Op, Precondition, Store, StoreError};

/// The status of a task that was just bound. A task that waited has nothing in its status but why it did, so it is made
/// anew, with what is known of other nodes that were tried before.
pub(super) fn status(bind: &Bind, past: Option<&TaskStatus>, now: Timestamp) -> TaskStatus {
    TaskStatus {
        phase: TaskPhase::Bound,
        node: Some(bind.node.to_string()),
        score: bind.score,
        bound_at: Some(MicroTime(now)),
        lease: bind.leases.first().map(|(group, epoch)| TaskLease {
            name: LeaseSpec::object_name(bind.node.as_str(), group),
            epoch: *epoch,
        }),
        not_before: None,
        ..past.map(TaskStatus::carried).unwrap_or_default()
    }
}

/// A bind whose write seemed to fail: nobody knows yet whether the disk has it.
#[derive(Debug)]
pub(super) struct Unsure {
    pub(super) task: Key,
    pub(super) bind: Bind,
}

/// The operations that grant a task its leases, if its node is still there.
///
/// # Errors
///
/// A conflict when the store has granted one of them already: a bind that seemed to fail was written after all, and whoever
/// decided has not heard of it yet.
pub(super) fn grants(
    store: &Store,
    bind: &Bind,
    task: &Key,
    now: Timestamp,
) -> Result<Vec<Op>, StoreError> {
    let grant = |(group, epoch): &(String, Epoch)| {
        let holder = LeaseHolder {
            kind: HolderKind::Task,
            namespace: task.namespace().unwrap_or_default().to_owned(),
            name: task.name.to_string(),
            uid: bind.uid.clone(),
        };
        let status = LeaseStatus {
            epoch: *epoch,
            holder: Some(holder),
            acquired: Some(MicroTime(now)),
            renewed: None,
            fence: None,
        };
        grant_op(store, bind.node.as_str(), group, status)
    };
    let node = Op::Check {
        key: Key::cluster(NODES, bind.node.as_str()),
        precondition: Precondition::PRESENT,
    };
    std::iter::once(Ok(node)).chain(bind.leases.iter().map(grant)).collect()
}

fn grant_op(store: &Store, node: &str, group: &str, status: LeaseStatus) -> Result<Op, StoreError> {
    let key: Key = objects::lease_key(node, group);
    let present = store.get(&key);
    let Some((stored, mut lease)) =
        present.and_then(|s| objects::read::<Lease>(&s).map(|l| (s, l)))
    else {
        let spec =
            LeaseSpec { node: node.to_owned(), group: group.to_owned(), actuators: Vec::new() };
        let mut lease = Lease::new(&key.name, spec);
        let now = status.acquired.as_ref().map_or(Timestamp::UNIX_EPOCH, |at| at.0);
        objects::stamp_new(&mut lease.metadata, now);
        lease.status = Some(status);
        return Ok(objects::create(key, &lease));
    };
    let before = lease.status.unwrap_or_default();
    if before.holder.is_some() || before.epoch >= status.epoch {
        let (expected, actual) = (stored.revision.saturating_sub(1), stored.revision);
        return Err(StoreError::Conflict { key, expected, actual });
    }
    // What a person fenced off stays so.
    lease.status = Some(LeaseStatus { fence: before.fence, ..status });
    Ok(objects::replace(&stored, &lease))
}

#[cfg(test)]
mod tests {
    use muster_api::id::TaskUid;
    use muster_api::name::NodeName;

    use super::*;

    #[tokio::test]
    async fn a_lease_that_the_store_has_granted_is_not_granted_over_it() {
        let store = crate::store::memory::start().await;
        let bind = |uid: &str, epoch| Bind {
            uid: TaskUid::new(uid),
            node: NodeName::new("r").unwrap(),
            score: None,
            leases: vec![("body".to_owned(), Epoch(epoch))],
        };
        let task = Key::namespaced(objects::TASKS, "default", "t");
        let grant = |bind: Bind| {
            let ops = grants(&store, &bind, &task, Timestamp::UNIX_EPOCH)?;
            // All but the look at the node, which is not there.
            Ok::<_, StoreError>(ops.into_iter().skip(1).collect::<Vec<_>>())
        };
        store.apply(grant(bind("a", 1)).unwrap()).await.unwrap();
        for epoch in [1, 2, 9] {
            let error = grant(bind("b", epoch)).unwrap_err();
            assert!(objects::is_race(&error), "{error}");
        }
        let free = objects::release_lease(&store, "r.body", "a").unwrap();
        store.apply_one(free).await.unwrap();
        assert!(grant(bind("b", 1)).is_err(), "an epoch only grows");
        store.apply(grant(bind("b", 2)).unwrap()).await.unwrap();
    }
}
