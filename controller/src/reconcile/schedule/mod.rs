//! Feeds the pure scheduler from the store and carries its plans out.
//!
//! ```text
//!   store.watch_all ──▶ take_in ──▶ Cluster + waiting tasks ──core::schedule──▶ Plan ──▶ transactions
//!   questions (plan, why) ─────────────▲ answered from a copy, nothing is changed
//!   live poses (see `moves`) ──────────▲ whoever moved, as it is now; looked at again are tasks that ask for a place, and offers
//! ```
//!
//! One task owns the cluster, so decisions are made one after the other. They are made when the cluster, a quota or the
//! waiting tasks have changed, or a time has come: what frameworks and people ask changes mostly nothing of that. A bind is one transaction:
//! the task's status and the lease it needs, each with the revision it was decided on, while the node is there. When it fails,
//! the reservation is released and the store's next event brings the task back. What this task wrote
//! itself is known already, and is passed over when the store tells it.

mod holds;
mod write;

use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use muster_api::id::TaskUid;
use muster_api::kind::lease::Lease;
use muster_api::kind::node::Node;
use muster_api::kind::quota::Quota;
use muster_api::kind::site::Site;
use muster_api::kind::task::{NodeRefusal, Task, TaskSpec, TaskStatus};
use muster_api::name::NodeName;
use muster_api::phase::TaskPhase;
use muster_controller_core::cluster::{Cluster, Executor};
use muster_controller_core::ledger::Reservation;
use muster_controller_core::offer::COURTESY;
use muster_controller_core::recent::Recent;
use muster_controller_core::reschedule;
use muster_controller_core::schedule::{self, Demand};
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;

use super::bind::Unsure;
use super::books::{Books, Page};
use super::desk::{self, Desk};
use super::moves::Moves;
use super::quotas::{Counter, Counts};
use super::{RETRY, next_events, watch_from_now};
use crate::configs;
use crate::context::Context;
use crate::objects::{self, LEASES, NODES, QUOTAS, SITES, TASKS};
use crate::session::frameworks::owner_of;
use crate::session::poses::LivePoses;
use crate::store::{Change, Event, Key, Stored, Watcher};
use holds::resting_until;

/// How often changed numbers in a waiting task's reasons are written. New reasons are written at
/// once; a reason whose numbers move with every bind would write without end.
const WHY_EVERY: Duration = Duration::from_secs(1);
/// Between two decisions of which the first gave something that tasks may have wanted whose turn was before.
const AGAIN: Duration = Duration::from_millis(100);
/// Questions that wait; they are answered between passes.
const QUESTIONS: usize = 1024;

/// A question to the scheduler.
#[derive(Debug)]
enum Question {
    /// Where would these tasks go now, and as of which revision of the store?
    Plan { tasks: Vec<Demand>, answer: oneshot::Sender<(schedule::Plan, u64)> },
    /// Why does this task wait? All nodes, not only those in its status.
    Why { demand: Demand, answer: oneshot::Sender<Vec<NodeRefusal>> },
    /// Which executors live on a node.
    Executors { node: NodeName, executors: Vec<Executor> },
    /// Something for the frameworks' desk.
    Desk(desk::Request),
}

/// Asks the scheduler.
#[derive(Debug, Clone)]
pub struct Handle {
    questions: mpsc::Sender<Question>,
}

/// The scheduler has ended, because the controller ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the scheduler has ended")]
pub struct Ended;

impl Handle {
    /// What the real scheduler would decide for these tasks now, on a copy, and the revision of the store up to which it
    /// knows everything.
    ///
    /// # Errors
    ///
    /// When the controller ends.
    pub async fn plan(&self, tasks: Vec<Demand>) -> Result<(schedule::Plan, u64), Ended> {
        let (answer, answered) = oneshot::channel();
        self.questions.send(Question::Plan { tasks, answer }).await.map_err(|_| Ended)?;
        answered.await.map_err(|_| Ended)
    }

    /// Why no node takes a task, every node named.
    ///
    /// # Errors
    ///
    /// When the controller ends.
    pub async fn why(&self, demand: Demand) -> Result<Vec<NodeRefusal>, Ended> {
        let (answer, answered) = oneshot::channel();
        self.questions.send(Question::Why { demand, answer }).await.map_err(|_| Ended)?;
        answered.await.map_err(|_| Ended)
    }

    /// Asks the frameworks' desk.
    ///
    /// # Errors
    ///
    /// When the controller ends.
    pub async fn desk(&self, request: desk::Request) -> Result<(), Ended> {
        self.questions.send(Question::Desk(request)).await.map_err(|_| Ended)
    }

    /// Says which executors live on a node: all of them.
    ///
    /// # Errors
    ///
    /// When the controller ends.
    pub async fn executors(&self, node: NodeName, executors: Vec<Executor>) -> Result<(), Ended> {
        let question = Question::Executors { node, executors };
        self.questions.send(question).await.map_err(|_| Ended)
    }
}

/// A task without a place.
#[derive(Debug)]
struct Waiting {
    demand: Demand,
    stored: Arc<Stored>,
    /// Why it is not considered at all; none: it is.
    holds: Arc<[NodeRefusal]>,
    /// What its status says.
    written: Arc<[NodeRefusal]>,
    written_at: Instant,
    /// What its status says of nodes that were tried before; none: nothing.
    past: Option<Box<TaskStatus>>,
}

/// The one task that places tasks.
#[derive(Debug)]
pub struct Scheduler {
    context: Arc<Context>,
    books: Arc<Books>,
    counter: Counter,
    questions: mpsc::Receiver<Question>,
    cluster: Cluster,
    desk: Desk,
    moves: Moves,
    waiting: HashMap<TaskUid, Waiting>,
    /// Who waited for a task when it was looked at last, by that task's key.
    dependents: HashMap<Key, BTreeSet<TaskUid>>,
    /// Tasks that are held back until a time.
    resting: BTreeSet<(Timestamp, TaskUid)>,
    /// When waiting tasks are looked at again even if nothing changes.
    look_again: Option<Instant>,
    /// The cluster's edition that was decided on; none: waiting tasks have changed since.
    decided: Option<u64>,
    /// The store failed: robots that move are no reason to try again before.
    binds_after: Option<Instant>,
    specs: Recent<TaskSpec>,
    /// Revisions that this task wrote and the watcher has not brought yet.
    own: HashSet<u64>,
    /// Nodes whose books changed since the last pass.
    dirty: BTreeSet<NodeName>,
    /// Every change of the store up to this revision is known.
    seen: u64,
    /// Binds that keep what they took until the store says whether they are written.
    unsure: Vec<Unsure>,
}

impl Scheduler {
    /// A scheduler that knows nothing yet, and the handle to ask it.
    #[must_use]
    pub fn new(
        context: Arc<Context>,
        (books, counts): (Arc<Books>, Arc<Counts>),
        poses: Arc<LivePoses>,
    ) -> (Self, Handle) {
        let (sender, questions) = mpsc::channel(QUESTIONS);
        let scheduler = Scheduler {
            desk: Desk::new(Arc::clone(&context)),
            context,
            books,
            counter: Counter::new(counts),
            questions,
            cluster: Cluster::new(),
            moves: Moves::new(poses),
            waiting: HashMap::new(),
            dependents: HashMap::new(),
            resting: BTreeSet::new(),
            look_again: None,
            decided: None,
            binds_after: None,
            specs: Recent::default(),
            own: HashSet::new(),
            dirty: BTreeSet::new(),
            seen: 0,
            unsure: Vec::new(),
        };
        (scheduler, Handle { questions: sender })
    }

    /// Works until dropped.
    pub async fn run(mut self) {
        let mut watcher = self.rebuild().await;
        self.decide_if_due().await;
        let mut looking = None;
        loop {
            let desk = self.close_pass().await;
            if let Some(began) = looking.take() {
                self.moves.looked(began);
            }
            let look_again = soonest([self.look_again, desk]);
            tokio::select! {
                // Cancel safe: events that were not returned are returned by the next call.
                events = next_events(&mut watcher) => match events {
                    Some(events) => self.take_in_all(&mut watcher, events),
                    None => watcher = self.rebuild().await,
                },
                // Cancel safe: a question that was not received stays in the channel.
                Some(question) = self.questions.recv() => {
                    self.answer(question);
                    // One pass serves everything that is there already, as with events.
                    for _ in 0..QUESTIONS {
                        let Ok(question) = self.questions.try_recv() else { break };
                        self.answer(question);
                    }
                }
                // Cancel safe, as it says.
                () = self.moves.due() => {
                    looking = Some(Instant::now());
                    self.look_at_moves().await;
                    continue;
                }
                () = sleep_until(look_again) => {}
            }
            self.decide_if_due().await;
        }
    }

    /// Looks at everything.
    async fn rebuild(&mut self) -> Watcher {
        // What is listed is to say what became of them.
        while self.resolve_unsure().await.is_some() {
            tokio::time::sleep(RETRY).await;
        }
        let watcher = watch_from_now(&self.context.store).await;
        let old = std::mem::take(&mut self.cluster);
        self.decided = None;
        self.waiting.clear();
        self.dependents.clear();
        self.resting.clear();
        self.own.clear();
        for resource in [QUOTAS, SITES, NODES, LEASES] {
            for stored in self.context.store.list(resource, None).items {
                self.take_in(resource, Change::Put, &stored);
            }
        }
        let mut tasks = self.context.store.list(TASKS, None).items;
        // The ledger knows who came last by the order in which it hears of them.
        tasks.sort_by_cached_key(|stored| {
            let task = stored.mentions("boundAt").then(|| objects::read::<Task>(stored)).flatten();
            task.and_then(|t| t.status).and_then(|s| s.bound_at).map(|at| at.0)
        });
        for stored in tasks {
            self.take_in(TASKS, Change::Put, &stored);
        }
        // Agents say it once a session, and not to the store.
        for member in old.all().filter(|member| !member.executors.is_empty()) {
            self.cluster.set_executors(&member.name, member.executors.clone());
        }
        self.moves.begin_anew(&mut self.cluster);
        self.desk.begin_anew(&old, &self.cluster);
        // What was listed is at least as new.
        self.seen = watcher.revision();
        tracing::info!(
            nodes = self.cluster.members().count(),
            waiting = self.waiting.len(),
            "scheduler is up to date"
        );
        watcher
    }

    fn take_in_all(&mut self, watcher: &mut Watcher, mut events: Vec<Event>) {
        loop {
            for event in &events {
                if !self.own.remove(&event.revision()) {
                    self.take_in(event.object.key.resource, event.change, &event.object);
                }
            }
            // One pass serves everything that is there already.
            match watcher.take() {
                Ok(more) if !more.is_empty() => events = more,
                // Fallen behind: the next call of `next` says so.
                Ok(_) | Err(_) => break,
            }
        }
        self.seen = watcher.revision();
    }

    fn take_in(&mut self, resource: crate::store::Resource, change: Change, stored: &Arc<Stored>) {
        if resource == TASKS {
            self.take_in_task(change, stored);
            self.look_at_dependents(&stored.key);
        } else if resource == NODES {
            self.take_in_node(change, stored);
        } else if resource == QUOTAS {
            self.take_in_quota(change, stored);
        } else if resource == SITES {
            self.take_in_site(change, stored);
        } else if configs::is_source(resource) {
            self.look_at_holds(&stored.key);
        } else if resource == LEASES && change == Change::Put {
            let Some(lease) = objects::read::<Lease>(stored) else { return };
            let Ok(node) = NodeName::new(lease.spec.node.clone()) else { return };
            let status = lease.status.unwrap_or_default();
            self.counter.changed();
            // A group that is new is not in its Node's books.
            self.dirty.insert(node.clone());
            self.cluster.set_lease(
                &node,
                &lease.spec.group,
                status.epoch,
                status.holder.map(|h| h.uid),
            );
        }
    }

    fn take_in_quota(&mut self, change: Change, stored: &Arc<Stored>) {
        let namespace = stored.key.namespace().unwrap_or_default();
        let quota = (change == Change::Put).then(|| objects::read::<Quota>(stored)).flatten();
        // Somebody may have written another status.
        self.counter.changed();
        let spec = quota.map(|q| q.spec);
        // Most changes are the writing of what the namespace has.
        if self.cluster.quota(namespace) != spec.as_ref() {
            self.cluster.set_quota(namespace, spec);
            self.desk.look_at_all();
        }
    }

    /// Ways are other ones: everything that waits is decided anew after this, and offers are looked at.
    fn take_in_site(&mut self, change: Change, stored: &Arc<Stored>) {
        let site = (change == Change::Put).then(|| objects::read::<Site>(stored)).flatten();
        self.cluster.set_site(&stored.key.name, site.as_ref().map(|site| &site.spec));
        self.desk.look_at_all();
    }

    fn quota_reason(&self, demand: &Demand) -> Option<NodeRefusal> {
        let over = schedule::over_quota(&self.cluster, self.cluster.accounts(), demand)?;
        Some(schedule::quota_refusal(&over))
    }

    fn take_in_node(&mut self, change: Change, stored: &Arc<Stored>) {
        let Ok(name) = NodeName::new(&*stored.key.name) else { return };
        if change == Change::Delete {
            self.cluster.remove_node(&name);
            return;
        }
        let Some(node) = objects::read::<Node>(stored) else { return };
        let is_new = self.cluster.member(&name).is_none_or(|m| m.facts.is_none());
        self.cluster.upsert_node(&name, &node);
        if let Some(pose) = is_new.then(|| self.moves.of_new(&name)).flatten() {
            self.cluster.set_pose(&name, &pose);
        }
        let page = self.cluster.member(&name).map(|m| Page::from(&m.ledger));
        if page.is_some_and(|p| !p.is_written(node.status.as_ref())) {
            self.dirty.insert(name);
        }
    }

    fn take_in_task(&mut self, change: Change, stored: &Arc<Stored>) {
        let uid = TaskUid::new(&*stored.uid);
        let task = (change == Change::Put).then(|| objects::read::<Task>(stored)).flatten();
        let Some(task) = task else {
            self.forget(&uid);
            return;
        };
        let status = task.status.unwrap_or_default();
        match (status.phase, status.node.as_deref()) {
            // An old event, from before it was bound: nothing goes back to Pending.
            (TaskPhase::Pending, _) if self.cluster.node_of(&uid).is_some() => {}
            (TaskPhase::Pending, _) if task.metadata.deletion_timestamp.is_none() => {
                let created =
                    task.metadata.creation_timestamp.as_ref().map_or(0, |t| t.0.as_second());
                let fresh = || schedule::since(created, stored.revision);
                let since = self.waiting.get(&uid).map_or_else(fresh, |w| w.demand.since);
                let title =
                    format!("{}/{}", stored.key.namespace().unwrap_or_default(), stored.key.name);
                let avoid = reschedule::avoided(&status).filter_map(|n| NodeName::new(n).ok());
                let demand = Demand {
                    uid: uid.clone(),
                    title: title.into(),
                    spec: self.specs.share(task.spec),
                    since,
                    avoid: avoid.collect(),
                    framework: owner_of(&task.metadata),
                };
                self.take_in_dependencies(&uid, &stored.key, &demand.spec);
                let past = (!status.earlier.is_empty()).then(|| Box::new(status.carried()));
                let holds = self.holds(&stored.key, &demand.spec, past.as_deref());
                self.resting.extend(resting_until(past.as_deref()).map(|at| (at, uid.clone())));
                if holds.is_empty() {
                    self.take_in_nomination(&demand, status.nominated_node);
                } else {
                    self.cluster.unnominate(&uid);
                }
                // What the namespace asks for changes.
                self.counter.changed();
                self.decided = None;
                let written_at = Instant::now();
                self.waiting.insert(
                    uid,
                    Waiting {
                        demand,
                        stored: Arc::clone(stored),
                        holds,
                        written: status.why.into(),
                        written_at,
                        past,
                    },
                );
            }
            (phase, Some(node)) if phase.holds_node() => {
                self.waiting.remove(&uid);
                let Ok(node) = NodeName::new(node) else { return };
                let title =
                    format!("{}/{}", stored.key.namespace().unwrap_or_default(), stored.key.name);
                let compute = task.spec.resources.reserved();
                let stopping = phase == TaskPhase::Stopping
                    || status.stop.is_some()
                    || task.metadata.deletion_timestamp.is_some();
                let standing = schedule::standing(&title, &task.spec, stopping);
                let apart = task.spec.placement.apart.map(Into::into);
                // Which groups it holds is said by the Lease objects.
                self.cluster.book(
                    &uid,
                    &node,
                    Reservation {
                        title: title.into(),
                        compute,
                        groups: Vec::new(),
                        standing,
                        apart,
                        framework: owner_of(&task.metadata),
                    },
                );
                self.dirty.insert(node);
            }
            _ => self.forget(&uid),
        }
    }

    /// Room that was being made before the cluster was made anew is kept on.
    fn take_in_nomination(&mut self, demand: &Demand, node: Option<String>) {
        let Some(node) = node.and_then(|n| NodeName::new(n).ok()) else { return };
        if self.cluster.nomination(&demand.uid).is_some() {
            return;
        }
        let facts = self.cluster.member(&node).and_then(|m| m.facts.as_ref());
        if let Some(reservation) = facts.map(|facts| demand.reservation(facts)) {
            self.cluster.nominate(&demand.uid, &node, &reservation);
        }
    }

    fn forget(&mut self, uid: &TaskUid) {
        self.counter.changed();
        self.cluster.unnominate(uid);
        self.waiting.remove(uid);
        self.dirty.extend(self.cluster.release(uid));
    }

    fn answer(&mut self, question: Question) {
        // Nobody waits for an answer any more when its receiver is gone; that is no fault.
        match question {
            Question::Plan { mut tasks, answer } => {
                let plan = schedule::schedule(&mut self.cluster.clone(), &mut tasks);
                drop(answer.send((plan, self.seen)));
            }
            Question::Why { demand, answer } => {
                let held = self.waiting.get(&demand.uid).map(|w| Arc::clone(&w.holds));
                let held = held.unwrap_or_default();
                let quota = self.quota_reason(&demand);
                let why = schedule::explain(&self.cluster, &demand);
                let nodes = why.iter().map(|(node, refusal)| refusal.of_node(node.as_str()));
                let holds = held.iter().cloned();
                drop(answer.send(holds.chain(quota).chain(nodes).collect()));
            }
            Question::Executors { node, executors } => {
                self.cluster.set_executors(&node, executors);
            }
            Question::Desk(request) => self.desk.take(&mut self.cluster, request),
        }
    }

    /// Decides when something has changed since the last time, or a time has come.
    async fn decide_if_due(&mut self) {
        let unsure = self.resolve_unsure().await;
        self.desk.begin_pass(&mut self.cluster, !self.waiting.is_empty());
        let now = Instant::now();
        let same = self.decided == Some(self.cluster.edition());
        if same && self.look_again.is_none_or(|at| at > now) {
            self.look_again = soonest([self.look_again, unsure]);
            return;
        }
        self.look_again = unsure;
        let rested = self.wake_rested();
        if self.waiting.is_empty() {
            self.decided = Some(self.cluster.edition());
        } else {
            let later = self.decide().await;
            self.look_again = soonest([unsure, later, rested]);
        }
    }

    /// Decides for everything that waits, and carries it out. Says when to look again even if nothing changes.
    async fn decide(&mut self) -> Option<Instant> {
        metrics::counter!("muster_decisions_total").increment(1);
        let mut demands: Vec<Demand> = self.placeable().map(|w| w.demand.clone()).collect();
        let mut plan = schedule::schedule(&mut self.cluster, &mut demands);
        // What fails to be written from here on changes it again.
        self.decided = (!plan.again).then(|| self.cluster.edition());
        let again = plan.again.then(|| Instant::now() + AGAIN);
        self.desk.claim(&plan.claims);
        plan.waits.extend(self.held());
        let binds = self.bind_all(plan.binds).await;
        let preempted = self.preempt_all(plan.preemptions).await;
        let waits = self.write_reasons(plan.waits).await;
        soonest([again, binds, preempted, waits])
    }

    /// Robots moved: offers follow them at the end of the pass, and tasks that ask for a place may have one now. Why the
    /// others wait is written when everything is decided anew, a moment later.
    async fn look_at_moves(&mut self) {
        self.moves.take(&mut self.cluster);
        let now = Instant::now();
        let mut demands: Vec<Demand> = self
            .placeable()
            .filter(|w| w.demand.spec.placement.at.is_some())
            .map(|w| w.demand.clone())
            .collect();
        if demands.is_empty() || self.binds_after.is_some_and(|at| at > now) {
            return;
        }
        let plan = schedule::schedule_moved(&mut self.cluster, &mut demands);
        // What is left to somebody is left for so long.
        let soon = if plan.claims.is_empty() { WHY_EVERY } else { COURTESY };
        let retry = self.bind_all(plan.binds).await;
        self.look_again = soonest([self.look_again, retry, Some(now + soon)]);
    }

    /// Offers and books after what was decided. Says when the desk has something to do even if nothing changes.
    async fn close_pass(&mut self) -> Option<Instant> {
        let before = self.cluster.edition();
        let desk = self.desk.work(&mut self.cluster).await;
        // What an Accept gave back, which was not written after all, may be somebody else's.
        let back = (self.cluster.edition() != before).then(Instant::now);
        if !self.dirty.is_empty() {
            self.counter.changed();
        }
        let count = self.counter.work(&self.cluster);
        for node in std::mem::take(&mut self.dirty) {
            if let Some(member) = self.cluster.member(&node) {
                self.books.put(&node, Page::from(&member.ledger));
            }
        }
        soonest([desk, back, count])
    }
}

fn soonest<const N: usize>(instants: [Option<Instant>; N]) -> Option<Instant> {
    instants.into_iter().flatten().min()
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline).await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests;
