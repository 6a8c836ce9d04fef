//! Emergency stops, and whether a person holds the robot, on their way to agents: a stream for each agent, on a connection that
//! carries nothing else.
//!
//! `reconcile::orders` says what changes; a stream begins with what is so. Both name the revision of the Node or of the Lease that
//! they read, and an older one is never told after a newer one.

use std::collections::HashMap;
use std::sync::Mutex;

use muster_api::kind::lease::{DEFAULT_GROUP, HolderKind, Lease};
use muster_api::name::NodeName;
use muster_api::wire::agent::v1 as wire;
use tokio::sync::watch;

use super::lock;

/// What each agent is told.
#[derive(Debug, Default)]
pub struct Orders(Mutex<HashMap<NodeName, watch::Sender<Order>>>);

/// What one agent is told.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Order {
    /// Of the Node that says so; 0: none has.
    pub(super) revision: u64,
    /// Of the Lease.
    lease_revision: u64,
    pub(super) order: wire::NodeOrder,
}

impl Orders {
    /// Whether an agent hears what is said.
    pub(crate) fn is_heard(&self, node: &NodeName) -> bool {
        lock(&self.0).contains_key(node)
    }

    /// What is said from now on; closed when the node is no more.
    pub(super) fn follow(&self, node: &NodeName) -> watch::Receiver<Order> {
        lock(&self.0).entry(node.clone()).or_default().subscribe()
    }

    /// A Node says this. Told at once, unless something newer was.
    pub(crate) fn say(&self, node: &NodeName, revision: u64, order: wire::NodeOrder) {
        let Some(told) = lock(&self.0).get(node).cloned() else { return };
        told.send_if_modified(|told| {
            let newer = revision > told.revision;
            if newer {
                let wire::NodeOrder { lease_fence, lease_held, .. } = told.order;
                told.revision = revision;
                told.order = wire::NodeOrder { lease_fence, lease_held, ..order };
            }
            newer
        });
    }

    /// A Lease says whether a person holds it. Told at once, unless something newer was.
    pub(crate) fn tell_lease(&self, lease: &Lease, revision: u64) {
        let status = lease.status.as_ref();
        let Some(fence) = status.and_then(|status| status.fence) else { return };
        let Ok(node) = NodeName::new(lease.spec.node.clone()) else { return };
        // Robots have one gate, of the group that all have.
        if lease.spec.group != DEFAULT_GROUP {
            return;
        }
        let holder = status.and_then(|status| status.holder.as_ref());
        let held = holder.is_some_and(|holder| holder.kind == HolderKind::User);
        let Some(told) = lock(&self.0).get(&node).cloned() else { return };
        told.send_if_modified(|told| {
            let newer = revision > told.lease_revision;
            if newer {
                told.lease_revision = revision;
                told.order.lease_fence = fence.0;
                told.order.lease_held = held;
            }
            newer
        });
    }

    /// The node is no more.
    pub(crate) fn end(&self, node: &NodeName) {
        lock(&self.0).remove(node);
    }
}

#[cfg(test)]
mod tests {
    use muster_api::id::Epoch;
    use muster_api::kind::lease::{LeaseHolder, LeaseSpec, LeaseStatus};

    use super::*;

    #[tokio::test]
    async fn what_is_older_is_not_told_after_what_is_newer() {
        let (orders, node) = (Orders::default(), NodeName::new("robot").unwrap());
        let order = |estop_tier| wire::NodeOrder { estop_tier, ..wire::NodeOrder::default() };
        orders.say(&node, 3, order(2));
        let mut told = orders.follow(&node);
        assert_eq!(told.borrow_and_update().revision, 0, "nobody heard it");
        orders.say(&node, 7, order(1));
        orders.say(&node, 5, order(0));
        assert!(told.has_changed().unwrap());
        assert_eq!(told.borrow_and_update().order, order(1));
        orders.say(&node, 7, order(0));
        assert!(!told.has_changed().unwrap());
        let lease = |holder: Option<LeaseHolder>| {
            let spec = LeaseSpec {
                node: "robot".to_owned(),
                group: DEFAULT_GROUP.to_owned(),
                actuators: Vec::new(),
            };
            let mut lease = Lease::new("robot.body", spec);
            let fence = Some(Epoch(5));
            lease.status = Some(LeaseStatus { holder, fence, ..LeaseStatus::default() });
            lease
        };
        orders.tell_lease(&lease(None), 9);
        orders.tell_lease(&lease(Some(LeaseHolder::person("ada", Epoch(5)))), 8);
        orders.say(&node, 10, order(2));
        let last = told.borrow_and_update().order;
        let both = wire::NodeOrder { lease_fence: 5, lease_held: false, ..order(2) };
        assert_eq!(last, both, "neither takes the other's word away");
        orders.end(&node);
        assert!(told.changed().await.is_err(), "its streams end");
    }
}
