//! Says of nodes with batteries and maintenance windows when nothing new begins there, and ends what is to be gone.
//!
//! What is so is [`muster_controller_core::upkeep`]'s to decide; here it is written: conditions into the Node's status, and
//! orders to end into the tasks of a node that is drained. A node that is being drained is looked at again every moment, for
//! tasks that were placed in the last one.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{MicroTime, Time};
use muster_api::condition::{BATTERY, MAINTENANCE, set_condition};
use muster_api::kind::node::Node;
use muster_api::kind::task::{NODE_MAINTENANCE, StopOrder, Task};
use muster_controller_core::upkeep::{self, Upkeep};

use super::{again, next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, NODES};
use crate::store::{Change, Key, Op, StoreError, Stored};

/// Between two looks at a node that is being drained.
const DRAINING: Duration = Duration::from_secs(2);

/// Works until dropped.
pub async fn run(context: Arc<Context>) {
    again(&context, "batteries and maintenance are not looked after", follow).await;
}

/// Looks at every node, then at what changes and what is due; ends when it must begin anew.
async fn follow(context: &Context) -> Result<(), StoreError> {
    let mut watcher = watch_from_now(&context.store).await;
    let mut due: BTreeMap<Key, Timestamp> = BTreeMap::new();
    let mut dirty: BTreeSet<Key> = BTreeSet::new();
    for stored in context.store.list(NODES, None).items {
        take_in(Change::Put, &stored, &mut dirty);
    }
    loop {
        while let Some(key) = dirty.pop_first() {
            due.remove(&key);
            if let Some(when) = look(context, &key).await? {
                due.insert(key, when);
            }
        }
        let now = context.clock.now();
        let next = due.values().min().map(|at| at.duration_since(now));
        let wait = async {
            match next {
                Some(left) => tokio::time::sleep(left.try_into().unwrap_or_default()).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            // Cancel safe: events that were not returned are returned by the next call.
            events = next_events(&mut watcher) => {
                let Some(events) = events else { return Ok(()) };
                for event in &events {
                    take_in(event.change, &event.object, &mut dirty);
                }
            }
            () = wait => {
                let now = context.clock.now();
                let passed = due.iter().filter(|(_, at)| **at <= now);
                dirty.extend(passed.map(|(key, _)| key.clone()));
            }
        }
    }
}

fn take_in(change: Change, stored: &Stored, dirty: &mut BTreeSet<Key>) {
    // Nodes are written with every placement; few have a battery or are worked on.
    let concerns = ["battery", "maintenance", BATTERY, MAINTENANCE];
    if change == Change::Put
        && stored.key.resource == NODES
        && concerns.iter().any(|word| stored.mentions(word))
    {
        dirty.insert(stored.key.clone());
    }
}

/// Writes what is so of a node. Says when to look again.
async fn look(context: &Context, key: &Key) -> Result<Option<Timestamp>, StoreError> {
    let now = context.clock.now();
    let mut seen = None;
    objects::change_watched(&context.store, key, |stored, mut node: Node| {
        let upkeep = upkeep::upkeep(&node, now);
        let changed = set(&mut node, &upkeep, now);
        seen = Some(upkeep);
        changed.then(|| vec![Op::status(stored, &node.status)])
    })
    .await?;
    let Some(Upkeep { drain, look_again, .. }) = seen else { return Ok(None) };
    let Some(why) = drain else { return Ok(look_again) };
    drain_node(context, &key.name, &why).await?;
    let soon = now.checked_add(DRAINING).unwrap_or(now);
    Ok(look_again.into_iter().chain([soon]).min())
}

/// Puts our conditions into a node's status; says whether that changes it.
fn set(node: &mut Node, upkeep: &Upkeep, now: Timestamp) -> bool {
    let conditions = &mut node.status.get_or_insert_default().conditions;
    let before = conditions.len();
    let said = |r#type: &str| upkeep.conditions.iter().any(|c| c.r#type == r#type);
    conditions.retain(|c| ![BATTERY, MAINTENANCE].contains(&c.r#type.as_str()) || said(&c.r#type));
    let mut changed = conditions.len() != before;
    for condition in &upkeep.conditions {
        changed |= set_condition(conditions, condition.clone(), &Time(now));
    }
    changed
}

/// Orders the end of every task there that does not tolerate maintenance. A mission that begins meanwhile keeps what has
/// no order yet.
async fn drain_node(context: &Context, node: &str, why: &str) -> Result<(), StoreError> {
    for (stored, task) in objects::tasks_holding(&context.store, node) {
        if upkeep::stays(&task.spec) {
            continue;
        }
        let mut ordered = None;
        objects::change_watched(&context.store, &stored.key, |present, mut task: Task| {
            ordered = None;
            let status = task.status.as_mut()?;
            let concerns = status.phase.holds_node() && status.node.as_deref() == Some(node);
            if !concerns || status.stop.is_some() || task.metadata.deletion_timestamp.is_some() {
                return None;
            }
            let unlocked = objects::unlocked(&context.store, node).ok()?;
            status.stop = Some(StopOrder {
                reason: NODE_MAINTENANCE.to_owned(),
                message: why.to_owned(),
                at: MicroTime(context.clock.now()),
            });
            let op = objects::replace(present, &task);
            ordered = Some(task);
            Some(vec![op, unlocked])
        })
        .await?;
        if let Some(task) = ordered {
            context.events.ordered_to_end(&task, NODE_MAINTENANCE);
        }
    }
    Ok(())
}
