//! Tells agents what people decide about their nodes: emergency stops and their releases, and
//! whether a person holds the actuators. A stream of orders begins with them;
//! this says what changes afterwards, at once.

use std::collections::HashMap;
use std::sync::Arc;

use muster_api::kind::lease::Lease;
use muster_api::kind::node::Node;
use muster_api::name::NodeName;
use muster_api::wire::agent::v1 as wire;
use muster_api::wire::agent_session::node_order;

use super::{next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, LEASES, NODES};
use crate::session::Sessions;
use crate::store::{Change, Stored};

/// What no node orders: what its agent was told is not known.
const UNKNOWN: wire::NodeOrder =
    wire::NodeOrder { estop_tier: u32::MAX, estop_release: 0, lease_fence: 0, lease_held: false };

/// Works until dropped.
pub async fn run(context: Arc<Context>, sessions: Arc<Sessions>) {
    loop {
        follow(&context, &sessions).await;
    }
}

/// Says everything once, then what changes; ends when it must begin anew.
async fn follow(context: &Context, sessions: &Sessions) {
    let mut watcher = watch_from_now(&context.store).await;
    // Only orders that order something are kept: most nodes have none.
    let mut told: HashMap<Arc<str>, wire::NodeOrder> = HashMap::new();
    for stored in &context.store.list(NODES, None).items {
        // What was ordered before may be over.
        if node_name(stored).is_some_and(|name| sessions.orders().is_heard(&name)) {
            told.insert(stored.key.name.clone(), UNKNOWN);
        }
        tell(sessions, &mut told, stored);
    }
    for stored in &context.store.list(LEASES, None).items {
        tell_lease(sessions, stored);
    }
    while let Some(events) = next_events(&mut watcher).await {
        for event in events.iter().filter(|event| event.object.key.resource == LEASES) {
            if event.change == Change::Put {
                tell_lease(sessions, &event.object);
            }
        }
        for event in events.iter().filter(|event| event.object.key.resource == NODES) {
            match event.change {
                Change::Put => tell(sessions, &mut told, &event.object),
                Change::Delete => {
                    told.remove(&event.object.key.name);
                    if let Some(name) = node_name(&event.object) {
                        sessions.orders().end(&name);
                    }
                }
            }
        }
    }
}

fn tell(sessions: &Sessions, told: &mut HashMap<Arc<str>, wire::NodeOrder>, stored: &Stored) {
    // Nodes change all the time, and hardly one in a day is stopped: most are not read.
    let orders = stored.mentions("estop") || stored.mentions("estopRelease");
    if !orders && !told.contains_key(&stored.key.name) {
        return;
    }
    let Some(node) = objects::read::<Node>(stored) else { return };
    let order = node_order(&node.spec);
    let before = told.get(&stored.key.name).copied().unwrap_or_default();
    if before == order {
        return;
    }
    if order == wire::NodeOrder::default() {
        told.remove(&stored.key.name);
    } else {
        told.insert(stored.key.name.clone(), order);
    }
    if let Some(name) = node_name(stored) {
        sessions.orders().say(&name, stored.revision, order);
    }
}

/// Most leases were never a person's, and are not read.
fn tell_lease(sessions: &Sessions, stored: &Stored) {
    if stored.mentions("fence")
        && let Some(lease) = objects::read::<Lease>(stored)
    {
        sessions.orders().tell_lease(&lease, stored.revision);
    }
}

fn node_name(stored: &Stored) -> Option<NodeName> {
    NodeName::new(stored.key.name.to_string()).ok()
}
