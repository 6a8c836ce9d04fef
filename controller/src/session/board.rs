//! What each node should have, by node: the assignments that agents get.
//!
//! One loop keeps the board like the store; sessions take what changed for their node. A session
//! gets its node's whole page when it begins, and nothing is lost between the page and the first
//! change, because both are taken under one lock.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Arc, Mutex};

use muster_api::id::TaskUid;
use muster_api::kind::lease::DEFAULT_GROUP;
use muster_api::kind::task::{Task, TaskStatus};
use muster_api::name::NodeName;
use muster_api::wire::agent::v1 as wire;
use muster_api::wire::agent_session::spec_to_wire;
use tokio::sync::Notify;

use super::{Sessions, lock};
use crate::context::Context;
use crate::objects::{self, TASKS};
use crate::reconcile::{next_events, watch_from_now};
use crate::store::{Change, Key, Stored};

/// What a node should have.
#[derive(Debug, Default)]
struct Page {
    assignments: BTreeMap<TaskUid, wire::Assignment>,
    /// Changed since the node's session last took what changed.
    changed: BTreeSet<TaskUid>,
    wake: Arc<Notify>,
}

#[derive(Debug, Default)]
struct Pages {
    by_node: HashMap<NodeName, Page>,
    /// Every placed task: where it is and what its object is called.
    tasks: HashMap<TaskUid, (NodeName, Key)>,
    /// The store was looked at since the start; before that, "not here" means nothing.
    filled: bool,
}

/// Assignments by node.
#[derive(Debug, Default)]
pub struct Board {
    pages: Mutex<Pages>,
    filled: Notify,
}

impl Board {
    /// The object of a placed task, and the node it is on.
    #[must_use]
    pub fn find(&self, uid: &str) -> Option<(NodeName, Key)> {
        lock(&self.pages).tasks.get(uid).cloned()
    }

    /// The objects of the tasks on a node.
    #[must_use]
    pub fn tasks_on(&self, node: &NodeName) -> Vec<Key> {
        let pages = lock(&self.pages);
        let uids = pages.by_node.get(node).into_iter().flat_map(|p| p.assignments.keys());
        uids.filter_map(|uid| pages.tasks.get(uid).map(|(_, key)| key.clone())).collect()
    }

    /// Waits until the board is like the store was at the start.
    pub(crate) async fn ready(&self) {
        loop {
            let filled = self.filled.notified();
            if lock(&self.pages).filled {
                return;
            }
            filled.await;
        }
    }

    /// Everything a node should have, and what wakes its session when that changes.
    pub(crate) fn whole_page(&self, node: &NodeName) -> (wire::Assignments, Arc<Notify>) {
        let mut pages = lock(&self.pages);
        let page = pages.by_node.entry(node.clone()).or_default();
        page.changed.clear();
        let upserts = page.assignments.values().cloned().collect();
        (
            wire::Assignments { complete: true, upserts, released: Vec::new() },
            Arc::clone(&page.wake),
        )
    }

    /// What changed for a node since the last call; none: nothing.
    pub(crate) fn take_changed(&self, node: &NodeName) -> Option<wire::Assignments> {
        let mut pages = lock(&self.pages);
        let page = pages.by_node.get_mut(node)?;
        let (mut upserts, mut released) = (Vec::new(), Vec::new());
        for uid in std::mem::take(&mut page.changed) {
            match page.assignments.get(&uid) {
                Some(assignment) => upserts.push(assignment.clone()),
                None => released.push(uid.to_string()),
            }
        }
        let something = !upserts.is_empty() || !released.is_empty();
        something.then_some(wire::Assignments { complete: false, upserts, released })
    }

    fn take_in(&self, change: Change, stored: &Stored) {
        let uid = TaskUid::new(&*stored.uid);
        // A task that was never placed is not read: there may be thousands that wait.
        let read = change == Change::Put && stored.mentions("boundAt");
        let task = read.then(|| objects::read::<Task>(stored)).flatten();
        let placed = task.and_then(|task| {
            let node = NodeName::new(task.status.as_ref()?.node.clone()?).ok()?;
            Some((node, assignment(&task)))
        });
        let mut pages = lock(&self.pages);
        match placed {
            Some((node, assignment)) => {
                pages.tasks.insert(uid.clone(), (node.clone(), stored.key.clone()));
                let page = pages.by_node.entry(node).or_default();
                // A status that only counts on is no news for the agent that reported it.
                if page.assignments.get(&uid) != Some(&assignment) {
                    page.assignments.insert(uid.clone(), assignment);
                    page.changed.insert(uid);
                    page.wake.notify_one();
                }
            }
            None => {
                let Some((node, _)) = pages.tasks.remove(&uid) else { return };
                let page = pages.by_node.entry(node).or_default();
                page.assignments.remove(&uid);
                page.changed.insert(uid);
                page.wake.notify_one();
            }
        }
    }

    /// Takes off what the store does not have any more.
    fn keep_only(&self, uids: &BTreeSet<TaskUid>) {
        let mut pages = lock(&self.pages);
        let gone: Vec<(TaskUid, NodeName)> = pages
            .tasks
            .iter()
            .filter(|(u, _)| !uids.contains(*u))
            .map(|(u, (n, _))| (u.clone(), n.clone()))
            .collect();
        for (uid, node) in gone {
            pages.tasks.remove(&uid);
            let page = pages.by_node.entry(node).or_default();
            page.assignments.remove(&uid);
            page.changed.insert(uid);
            page.wake.notify_one();
        }
        pages.filled = true;
        self.filled.notify_waiters();
    }
}

/// What the agent of its node gets of a placed task.
fn assignment(task: &Task) -> wire::Assignment {
    let status = task.status.clone().unwrap_or_default();
    let deleted = task.metadata.deletion_timestamp.is_some().then(|| "Deleted".to_owned());
    let ordered = || status.stop.as_ref().map(|stop| format!("{}: {}", stop.reason, stop.message));
    let stop = deleted
        .or_else(ordered)
        .map(|reason| wire::Stop { grace_period_ms: grace_ms(task), reason });
    wire::Assignment {
        uid: objects::uid_of(&task.metadata).to_owned(),
        namespace: task.metadata.namespace.clone().unwrap_or_default(),
        name: task.metadata.name.clone().unwrap_or_default(),
        spec: spec_to_wire(&task.spec),
        lease: lease_token(&status),
        stop,
        ended: status.phase.is_terminal(),
        framework: super::frameworks::owning(&task.metadata)
            .map(|o| wire::Framework { id: o.uid.clone(), name: o.name.clone() }),
    }
}

fn grace_ms(task: &Task) -> u32 {
    let seconds = task.metadata.deletion_grace_period_seconds;
    let seconds =
        seconds.and_then(|s| u32::try_from(s).ok()).unwrap_or(task.spec.grace_period_seconds);
    seconds.saturating_mul(1000)
}

fn lease_token(status: &TaskStatus) -> Option<wire::LeaseToken> {
    let lease = status.lease.as_ref()?;
    let group = lease.name.rsplit_once('.').map_or(DEFAULT_GROUP, |(_, group)| group);
    Some(wire::LeaseToken {
        node: status.node.clone()?,
        group: group.to_owned(),
        epoch: lease.epoch.0,
        sequence: Vec::new(),
    })
}

/// Keeps the board like the store, until dropped.
pub async fn run(context: Arc<Context>, sessions: Arc<Sessions>) {
    let board = sessions.board();
    loop {
        let mut watcher = watch_from_now(&context.store).await;
        let snapshot = context.store.list(TASKS, None).items;
        for stored in &snapshot {
            board.take_in(Change::Put, stored);
        }
        board.keep_only(&snapshot.iter().map(|s| TaskUid::new(&*s.uid)).collect());
        while let Some(events) = next_events(&mut watcher).await {
            for event in events.iter().filter(|e| e.object.key.resource == TASKS) {
                board.take_in(event.change, &event.object);
            }
        }
    }
}
