//! Tells agents what people decide about their nodes: emergency stops and their releases. A session begins with them; this
//! says what changes afterwards, at once.

use std::collections::HashMap;
use std::sync::Arc;

use muster_api::kind::node::Node;
use muster_api::name::NodeName;
use muster_api::wire::agent::v1 as wire;
use muster_api::wire::agent_session::node_order;

use super::{next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, NODES};
use crate::session::Sessions;
use crate::store::{Change, Stored};

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
        tell(sessions, &mut told, stored);
    }
    while let Some(events) = next_events(&mut watcher).await {
        for event in events.iter().filter(|event| event.object.key.resource == NODES) {
            match event.change {
                Change::Put => tell(sessions, &mut told, &event.object),
                Change::Delete => drop(told.remove(&event.object.key.name)),
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
    let Ok(name) = NodeName::new(stored.key.name.to_string()) else { return };
    if let Some(connection) = sessions.connection(&name) {
        let body = Some(wire::controller_message::Body::Order(order));
        // An agent that does not read must not keep a stop from the others. Its next session begins with it.
        if connection.outbound.try_send(wire::ControllerMessage { body }).is_err() {
            sessions.kick(&name);
        }
    }
}
