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
use prost::Message as _;
use tokio::sync::Notify;

use super::{Sessions, lock};
use crate::context::Context;
use crate::objects::{self, TASKS};
use crate::reconcile::{next_events, watch_from_now};
use crate::store::{Change, Key, Store, Stored};
use crate::{configs, depends};

/// Most bytes of assignments in one message; a single one may be larger, and is still less than a message takes.
const PART: usize = 1 << 20;

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
    /// Which placed tasks name a ConfigMap, a Secret or another task, by the object's key.
    users: HashMap<Key, BTreeSet<TaskUid>>,
    /// The store was looked at since the start; before that, "not here" means nothing.
    filled: bool,
}

impl Pages {
    fn forget_user(&mut self, uid: &TaskUid) {
        self.users.retain(|_, users| {
            users.remove(uid);
            !users.is_empty()
        });
    }
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
            wire::Assignments { complete: true, upserts, ..wire::Assignments::default() },
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
        something.then_some(wire::Assignments { upserts, released, ..Default::default() })
    }

    /// A ConfigMap, a Secret or a task changed: what placed tasks get of it is looked up again. Their attempts keep what they
    /// have; the agents keep the new values for the next ones.
    fn source_changed(&self, store: &Store, source: &Key) {
        let users = lock(&self.pages).users.get(source).cloned().unwrap_or_default();
        for uid in users {
            let Some((_, key)) = self.find(uid.as_str()) else { continue };
            if let Some(stored) = store.get(&key).filter(|stored| *stored.uid == *uid.as_str()) {
                self.take_in(store, Change::Put, &stored);
            }
        }
    }

    fn take_in(&self, store: &Store, change: Change, stored: &Stored) {
        let uid = TaskUid::new(&*stored.uid);
        // A task that was never placed is not read: there may be thousands that wait.
        let read = change == Change::Put && stored.mentions("boundAt");
        let task = read.then(|| objects::read::<Task>(stored)).flatten();
        let placed = task.and_then(|task| {
            let node = NodeName::new(task.status.as_ref()?.node.clone()?).ok()?;
            let namespace = stored.key.namespace().unwrap_or_default();
            let sources = task.spec.references().into_iter();
            let sources = sources.map(|(source, name)| configs::key_of(source, namespace, name));
            let sources: Vec<Key> = sources.chain(depends::keys(namespace, &task.spec)).collect();
            // Known as a user before the look: a change after it looks again.
            for source in sources {
                lock(&self.pages).users.entry(source).or_default().insert(uid.clone());
            }
            Some((node, assignment(store, &task)))
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
                pages.forget_user(&uid);
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
            pages.forget_user(&uid);
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
fn assignment(store: &Store, task: &Task) -> wire::Assignment {
    let status = task.status.clone().unwrap_or_default();
    let namespace = task.metadata.namespace.clone().unwrap_or_default();
    let ended = status.phase.is_terminal();
    // What has ended needs nothing any more.
    let dependencies =
        if ended { Vec::new() } else { depends::to_wire(store, &namespace, &task.spec) };
    let config = (!ended).then(|| configs::to_wire(store, &namespace, &task.spec)).flatten();
    let deleted = task.metadata.deletion_timestamp.is_some().then(|| "Deleted".to_owned());
    let ordered = || status.stop.as_ref().map(|stop| format!("{}: {}", stop.reason, stop.message));
    let stop = deleted
        .or_else(ordered)
        .map(|reason| wire::Stop { grace_period_ms: grace_ms(task), reason });
    wire::Assignment {
        uid: objects::uid_of(&task.metadata).to_owned(),
        namespace,
        name: task.metadata.name.clone().unwrap_or_default(),
        spec: spec_to_wire(&task.spec),
        lease: lease_token(&status),
        stop,
        ended,
        config,
        dependencies,
        attempts: task.spec.attempts_here(status.attempts_used).unwrap_or_default(),
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

/// The same as messages that a session takes. All but the last are parts, and the last one names what they brought.
pub(super) fn split(page: wire::Assignments) -> Vec<wire::Assignments> {
    let wire::Assignments { complete, upserts, released, mut kept } = page;
    let (mut parts, mut part, mut bytes) = (Vec::new(), Vec::new(), 0);
    for upsert in upserts {
        let more = upsert.encoded_len();
        if bytes + more > PART && !part.is_empty() {
            let full: Vec<wire::Assignment> = std::mem::take(&mut part);
            if complete {
                kept.extend(full.iter().map(|a| a.uid.clone()));
            }
            parts.push(wire::Assignments { upserts: full, ..Default::default() });
            bytes = 0;
        }
        bytes += more;
        part.push(upsert);
    }
    parts.push(wire::Assignments { complete, upserts: part, released, kept });
    parts
}

/// Keeps the board like the store, until dropped.
pub async fn run(context: Arc<Context>, sessions: Arc<Sessions>) {
    let board = sessions.board();
    loop {
        let mut watcher = watch_from_now(&context.store).await;
        let snapshot = context.store.list(TASKS, None).items;
        for stored in &snapshot {
            board.take_in(&context.store, Change::Put, stored);
        }
        board.keep_only(&snapshot.iter().map(|s| TaskUid::new(&*s.uid)).collect());
        while let Some(events) = next_events(&mut watcher).await {
            for event in &events {
                let key = &event.object.key;
                if key.resource == TASKS {
                    board.take_in(&context.store, event.change, &event.object);
                    // Others may wait for it.
                    board.source_changed(&context.store, key);
                } else if configs::is_source(key.resource) {
                    board.source_changed(&context.store, key);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_that_is_too_long_for_one_message_is_still_whole() {
        let assignment = |uid: &str| wire::Assignment {
            uid: uid.to_owned(),
            spec: vec![0; PART / 2 + 1],
            ..wire::Assignment::default()
        };
        let upserts = ["a", "b", "c"].map(assignment).to_vec();
        let page = wire::Assignments { complete: true, upserts, ..Default::default() };
        let parts = split(page.clone());
        let told: Vec<(bool, usize)> =
            parts.iter().map(|p| (p.complete, p.upserts.len())).collect();
        assert_eq!(told, [(false, 1), (false, 1), (true, 1)]);
        assert_eq!(parts[2].kept, ["a", "b"]);
        let small = wire::Assignments { upserts: Vec::new(), ..page };
        assert_eq!(split(small.clone()), [small]);
    }
}
