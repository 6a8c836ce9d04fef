//! Emergency stops on their way to agents: a stream for each agent, on a connection that carries nothing else.
//!
//! `reconcile::orders` says what changes; a stream begins with what is so. Both name the revision of the Node that they read, and
//! an older one is never told after a newer one.

use std::collections::HashMap;
use std::sync::Mutex;

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
                *told = Order { revision, order };
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
    use super::*;

    #[tokio::test]
    async fn what_is_older_is_not_told_after_what_is_newer() {
        let (orders, node) = (Orders::default(), NodeName::new("robot").unwrap());
        let order = |estop_tier| wire::NodeOrder { estop_tier, estop_release: 0 };
        orders.say(&node, 3, order(2));
        let mut told = orders.follow(&node);
        assert_eq!(told.borrow_and_update().revision, 0, "nobody heard it");
        orders.say(&node, 7, order(1));
        orders.say(&node, 5, order(0));
        assert!(told.has_changed().unwrap());
        assert_eq!(told.borrow_and_update().order, order(1));
        orders.say(&node, 7, order(0));
        assert!(!told.has_changed().unwrap());
        orders.end(&node);
        assert!(told.changed().await.is_err(), "its streams end");
    }
}
