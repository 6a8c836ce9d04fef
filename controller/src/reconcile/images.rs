//! Tells agents which images rollouts want on their nodes, and people what became of that. What is wanted stands in the
//! status of the TaskSets: a session begins with it, and this says what changes afterwards.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use muster_api::kind::node::Node;
use muster_api::kind::node::image::{ImagePhase, ImageStatus};
use muster_api::kind::taskset::{ImagePull, TaskSet};
use muster_api::name::NodeName;
use muster_api::wire::agent::v1 as wire;

use super::{next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, TASK_SETS};
use crate::session::Sessions;
use crate::store::{Change, Key, Store, Stored};

/// Works until dropped.
pub async fn run(context: Arc<Context>, sessions: Arc<Sessions>) {
    // What agents were told, also when this begins anew: what nobody wants any more is told them, too.
    let mut known = BTreeMap::new();
    loop {
        follow(&context, &sessions, &mut known).await;
    }
}

/// Says everything once, then what changes; ends when it must begin anew.
async fn follow(context: &Context, sessions: &Sessions, known: &mut BTreeMap<Key, Vec<ImagePull>>) {
    let mut watcher = watch_from_now(&context.store).await;
    let sets = context.store.list(TASK_SETS, None).items;
    let gone = |key: &&Key| sets.iter().all(|stored| stored.key != **key);
    for key in known.keys().filter(gone).cloned().collect::<Vec<_>>() {
        say_again(context, sessions, known.remove(&key).unwrap_or_default().iter());
    }
    for stored in &sets {
        take_in(context, sessions, known, (Change::Put, stored));
    }
    while let Some(events) = next_events(&mut watcher).await {
        for event in events.iter().filter(|event| event.object.key.resource == TASK_SETS) {
            take_in(context, sessions, known, (event.change, &event.object));
        }
    }
}

/// What a set wants; a set that is being deleted changes nothing any more.
fn pulls(stored: &Stored) -> Vec<ImagePull> {
    let set = stored.mentions("imagePulls").then(|| objects::read::<TaskSet>(stored)).flatten();
    let set = set.filter(|set| set.metadata.deletion_timestamp.is_none());
    set.and_then(|set| set.status).map(|status| status.image_pulls).unwrap_or_default()
}

fn take_in(
    context: &Context,
    sessions: &Sessions,
    known: &mut BTreeMap<Key, Vec<ImagePull>>,
    (change, stored): (Change, &Stored),
) {
    let now = if change == Change::Put { pulls(stored) } else { Vec::new() };
    let before = known.remove(&stored.key).unwrap_or_default();
    let other = |pull: &&ImagePull| !(before.contains(pull) && now.contains(pull));
    say_again(context, sessions, before.iter().chain(&now).filter(other));
    if !now.is_empty() {
        known.insert(stored.key.clone(), now);
    }
}

/// The nodes of these are told what is wanted of them now.
fn say_again<'a>(
    context: &Context,
    sessions: &Sessions,
    pulls: impl Iterator<Item = &'a ImagePull>,
) {
    let nodes: BTreeSet<&str> = pulls.map(|pull| pull.node.as_str()).collect();
    nodes.into_iter().for_each(|node| say(context, sessions, node));
}

fn say(context: &Context, sessions: &Sessions, node: &str) {
    let Ok(node) = NodeName::new(node) else { return };
    let Some(connection) = sessions.connection(&node) else { return };
    let body = wire::controller_message::Body::Images(wanted_on(&context.store, &node));
    // An agent that does not read must not keep the others waiting. Its next session begins with it.
    if connection.outbound.try_send(wire::ControllerMessage { body: Some(body) }).is_err() {
        sessions.kick(&node);
    }
}

/// What all sets want of a node.
pub(crate) fn wanted_on(store: &Store, node: &NodeName) -> wire::Images {
    let sets = store.list(TASK_SETS, None).items;
    let pulls = sets.iter().flat_map(|stored| pulls(stored));
    let here = pulls.filter(|pull| pull.node == node.as_str());
    wire::Images { wanted: here.map(|pull| (&pull.wish).into()).collect() }
}

/// Puts into Events what a node says of its images that it did not say before.
pub(crate) fn tell(context: &Context, before: &Node, after: &Node) {
    let images = |node: &Node| node.status.as_ref().map(|s| s.images.clone()).unwrap_or_default();
    let (Some(name), before) = (after.metadata.name.as_deref(), images(before)) else { return };
    for image in images(after) {
        let known = before.iter().find(|known| known.wish == image.wish);
        let is_news = |same: fn(&ImageStatus, &ImageStatus) -> bool| {
            known.is_none_or(|known| !same(known, &image))
        };
        match image.phase {
            ImagePhase::Pulled if is_news(|a, b| a.phase == b.phase) => {
                let message = format!("{} is there before a task needs it", image.wish.image);
                context.events.node(name, "Pulled", message);
            }
            ImagePhase::BackOff if is_news(|a, b| a.message == b.message) => {
                context.events.warn_node(name, "ImagePullFailed", image.message.clone());
            }
            _ => {}
        }
    }
}
