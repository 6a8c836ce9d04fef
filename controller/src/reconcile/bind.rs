//! What a bind writes: the task's status and the leases that it was granted. The same for declared tasks and for those
//! that a framework launches.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use muster_api::kind::lease::{Lease, LeaseHolder, LeaseSpec, LeaseStatus};
use muster_api::kind::task::{TaskLease, TaskStatus};
use muster_api::phase::TaskPhase;
use muster_controller_core::schedule::Bind;

use crate::context::Context;
use crate::objects::{self, NODES};
use crate::store::{Key, Op, Precondition};

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

/// The operations that grant a task its leases, if its node is still there.
pub(super) fn grants(context: &Context, bind: &Bind, task: &Key, now: Timestamp) -> Vec<Op> {
    let grant = |(group, epoch): &(String, muster_api::id::Epoch)| {
        let holder = LeaseHolder {
            namespace: task.namespace().unwrap_or_default().to_owned(),
            name: task.name.to_string(),
            uid: bind.uid.clone(),
        };
        let status = LeaseStatus {
            epoch: *epoch,
            holder: Some(holder),
            acquired: Some(MicroTime(now)),
            renewed: None,
        };
        grant_op(context, bind.node.as_str(), group, status)
    };
    let node = Op::Check {
        key: Key::cluster(NODES, bind.node.as_str()),
        precondition: Precondition::PRESENT,
    };
    std::iter::once(node).chain(bind.leases.iter().map(grant)).collect()
}

fn grant_op(context: &Context, node: &str, group: &str, status: LeaseStatus) -> Op {
    let key: Key = objects::lease_key(node, group);
    let present = context.store.get(&key);
    if let Some((stored, mut lease)) =
        present.and_then(|s| objects::read::<Lease>(&s).map(|l| (s, l)))
    {
        lease.status = Some(status);
        return objects::replace(&stored, &lease);
    }
    let spec = LeaseSpec { node: node.to_owned(), group: group.to_owned(), actuators: Vec::new() };
    let mut lease = Lease::new(&key.name, spec);
    objects::stamp_new(&mut lease.metadata, context.clock.now());
    lease.status = Some(status);
    objects::create(key, &lease)
}
