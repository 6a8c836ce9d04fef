//! Feeds the pure scheduler from the store and carries its plans out.
//!
//! ```text
//!   store.watch_all ──▶ take_in ──▶ Cluster + waiting tasks ──core::schedule──▶ Plan ──▶ transactions
//!   questions (plan, why) ─────────────▲ answered from a copy, nothing is changed
//!   live poses (see `moves`) ──────────▲ whoever moved, as it is now; looked at again are tasks that ask for a place, and offers
//! ```
//!
//! One task owns the cluster, so decisions are made one after the other. A bind is one transaction:
//! the task's status and the lease it needs, each with the revision it was decided on, while the node is there. When it fails,
//! the reservation is released and the store's next event brings the task back. What this task wrote
//! itself is known already, and is passed over when the store tells it.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use futures::future::join_all;
use muster_api::id::TaskUid;
use muster_api::kind::lease::Lease;
use muster_api::kind::node::Node;
use muster_api::kind::quota::Quota;
use muster_api::kind::task::{NodeRefusal, PREEMPTING, Task, TaskSpec, TaskStatus};
use muster_api::name::NodeName;
use muster_api::phase::TaskPhase;
use muster_controller_core::cluster::{Cluster, Executor};
use muster_controller_core::fairness::Accounts;
use muster_controller_core::ledger::Reservation;
use muster_controller_core::preempt::Preemption;
use muster_controller_core::recent::Recent;
use muster_controller_core::schedule::{self, Bind, Demand, Wait};
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;
use tokio_util::task::AbortOnDropHandle;

use super::books::{Books, Page};
use super::desk::{self, Desk};
use super::moves::Moves;
use super::quotas::{Counter, Counts};
use super::{RETRY, bind, next_events, preempt, watch_from_now};
use crate::context::Context;
use crate::objects::{self, LEASES, NODES, QUOTAS, TASKS};
use crate::session::poses::LivePoses;
use crate::store::{Change, Event, Op, StoreError, Stored, Watcher};

/// How often changed numbers in a waiting task's reasons are written. New reasons are written at
/// once; a reason whose numbers move with every bind would write without end.
const WHY_EVERY: Duration = Duration::from_secs(1);
/// Reasons written in one pass, so that a thousand waiting tasks do not hold up the next bind.
const WHY_AT_ONCE: usize = 256;

/// Binds that are rendered at once. Rendering one takes some tens of microseconds and a commit some
/// milliseconds: a few hundred keep both the disk and this task busy.
const CHUNK: usize = 256;

/// Questions that wait; they are answered between passes.
const QUESTIONS: usize = 1024;

type Committed = Result<Vec<Arc<Stored>>, StoreError>;

/// A question to the scheduler.
#[derive(Debug)]
enum Question {
    /// Where would these tasks go now?
    Plan { tasks: Vec<Demand>, answer: oneshot::Sender<schedule::Plan> },
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
    /// What the real scheduler would decide for these tasks now, on a copy.
    ///
    /// # Errors
    ///
    /// When the controller ends.
    pub async fn plan(&self, tasks: Vec<Demand>) -> Result<schedule::Plan, Ended> {
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
    /// What its status says.
    written: Arc<[NodeRefusal]>,
    written_at: Instant,
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
    /// When waiting tasks are looked at again even if nothing changes.
    look_again: Option<Instant>,
    /// The store failed: robots that move are no reason to try again before.
    binds_after: Option<Instant>,
    specs: Recent<TaskSpec>,
    /// Revisions that this task wrote and the watcher has not brought yet.
    own: HashSet<u64>,
    /// Nodes whose books changed since the last pass.
    dirty: BTreeSet<NodeName>,
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
            look_again: None,
            binds_after: None,
            specs: Recent::default(),
            own: HashSet::new(),
            dirty: BTreeSet::new(),
        };
        (scheduler, Handle { questions: sender })
    }

    /// Works until dropped.
    pub async fn run(mut self) {
        let mut watcher = self.rebuild().await;
        self.decide().await;
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
            self.decide().await;
        }
    }

    /// Looks at everything.
    async fn rebuild(&mut self) -> Watcher {
        let watcher = watch_from_now(&self.context.store).await;
        let old = std::mem::take(&mut self.cluster);
        self.desk.begin_anew();
        self.waiting.clear();
        self.own.clear();
        for resource in [QUOTAS, NODES, LEASES] {
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
                Ok(_) | Err(_) => return,
            }
        }
    }

    fn take_in(&mut self, resource: crate::store::Resource, change: Change, stored: &Arc<Stored>) {
        if resource == TASKS {
            self.take_in_task(change, stored);
        } else if resource == NODES {
            self.take_in_node(change, stored);
        } else if resource == QUOTAS {
            self.take_in_quota(change, stored);
        } else if resource == LEASES && change == Change::Put {
            let Some(lease) = objects::read::<Lease>(stored) else { return };
            let Ok(node) = NodeName::new(lease.spec.node.clone()) else { return };
            let status = lease.status.unwrap_or_default();
            self.counter.changed();
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
            self.desk.quotas_changed();
        }
    }

    fn quota_reason(&self, demand: &Demand) -> Option<NodeRefusal> {
        let accounts = self.cluster.has_quotas().then(|| Accounts::of(&self.cluster))?;
        let over = schedule::over_quota(&self.cluster, &accounts, demand)?;
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
        match (status.phase, status.node) {
            // An old event, from before it was bound: nothing goes back to Pending.
            (TaskPhase::Pending, _) if self.cluster.node_of(&uid).is_some() => {}
            (TaskPhase::Pending, _) if task.metadata.deletion_timestamp.is_none() => {
                let created =
                    task.metadata.creation_timestamp.as_ref().map_or(0, |t| t.0.as_second());
                let fresh = || schedule::since(created, stored.revision);
                let since = self.waiting.get(&uid).map_or_else(fresh, |w| w.demand.since);
                let title =
                    format!("{}/{}", stored.key.namespace().unwrap_or_default(), stored.key.name);
                let demand = Demand {
                    uid: uid.clone(),
                    title: title.into(),
                    spec: self.specs.share(task.spec),
                    since,
                };
                self.take_in_nomination(&demand, status.nominated_node);
                let written_at = Instant::now();
                self.waiting.insert(
                    uid,
                    Waiting {
                        demand,
                        stored: Arc::clone(stored),
                        written: status.why.into(),
                        written_at,
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
        self.cluster.unnominate(uid);
        self.waiting.remove(uid);
        self.dirty.extend(self.cluster.release(uid));
    }

    fn answer(&mut self, question: Question) {
        // Nobody waits for an answer any more when its receiver is gone; that is no fault.
        match question {
            Question::Plan { mut tasks, answer } => {
                drop(answer.send(schedule::schedule(&mut self.cluster.clone(), &mut tasks)));
            }
            Question::Why { demand, answer } => {
                let quota = self.quota_reason(&demand);
                let why = schedule::explain(&self.cluster, &demand);
                let nodes = why.iter().map(|(node, refusal)| refusal.of_node(node.as_str()));
                drop(answer.send(quota.into_iter().chain(nodes).collect()));
            }
            Question::Executors { node, executors } => {
                self.cluster.set_executors(&node, executors);
            }
            Question::Desk(request) => self.desk.take(&mut self.cluster, request),
        }
    }

    /// Decides for everything that waits, and carries it out.
    async fn decide(&mut self) {
        self.look_again = None;
        if !self.waiting.is_empty() {
            let mut demands: Vec<Demand> =
                self.waiting.values().map(|w| w.demand.clone()).collect();
            let plan = schedule::schedule(&mut self.cluster, &mut demands);
            let binds = self.bind_all(plan.binds).await;
            let preempted = self.preempt_all(plan.preemptions).await;
            let waits = self.write_reasons(plan.waits).await;
            self.look_again = soonest([binds, preempted, waits]);
        }
    }

    /// Robots moved: offers follow them at the end of the pass, and tasks that ask for a place may have one now. Why the
    /// others wait is written when everything is decided anew, a moment later.
    async fn look_at_moves(&mut self) {
        self.moves.take(&mut self.cluster);
        let now = Instant::now();
        let mut demands: Vec<Demand> = self
            .waiting
            .values()
            .filter(|w| w.demand.spec.placement.at.is_some())
            .map(|w| w.demand.clone())
            .collect();
        if demands.is_empty() || self.binds_after.is_some_and(|at| at > now) {
            return;
        }
        let binds = schedule::schedule_moved(&mut self.cluster, &mut demands);
        let retry = self.bind_all(binds).await;
        self.look_again = soonest([self.look_again, retry, Some(now + WHY_EVERY)]);
    }

    /// Offers and books after what was decided. Says when the desk has something to do even if nothing changes.
    async fn close_pass(&mut self) -> Option<Instant> {
        let desk = self.desk.work(&mut self.cluster).await;
        if !self.dirty.is_empty() {
            self.counter.changed();
        }
        let count = self.counter.work(&self.cluster);
        for node in std::mem::take(&mut self.dirty) {
            if let Some(member) = self.cluster.member(&node) {
                self.books.put(&node, Page::from(&member.ledger));
            }
        }
        soonest([desk, count])
    }

    async fn bind_all(&mut self, binds: Vec<Bind>) -> Option<Instant> {
        let context = Arc::clone(&self.context);
        let _nodes_stay = context.placing.read().await;
        let results = self.commit(&binds).await;
        let mut retry = None;
        for (bind, result) in binds.into_iter().zip(results) {
            match result {
                Some(Ok(written)) => {
                    self.own.extend(written.iter().map(|stored| stored.revision));
                    tracing::info!(task = %bind.uid, node = %bind.node, score = bind.score, "bound");
                    metrics::counter!("muster_binds_total").increment(1);
                    self.waiting.remove(&bind.uid);
                }
                Some(Err(error)) => {
                    self.cluster.release(&bind.uid);
                    if objects::is_race(&error) {
                        // What changed arrives as an event and brings the task back, if it still waits.
                        tracing::debug!(task = %bind.uid, %error, "a bind came too late");
                    } else {
                        tracing::warn!(task = %bind.uid, error = crate::app::chain(&error), "a bind is not written");
                        retry = Some(Instant::now() + RETRY);
                    }
                }
                None => {
                    self.cluster.release(&bind.uid);
                    self.waiting.remove(&bind.uid);
                }
            }
            self.dirty.insert(bind.node);
        }
        self.binds_after = retry;
        retry
    }

    /// Orders the ends of those that make room, each order with its reason in one transaction with the nomination.
    async fn preempt_all(&mut self, preemptions: Vec<Preemption>) -> Option<Instant> {
        let mut retry = None;
        for preemption in preemptions {
            let Some(waiting) = self.waiting.get_mut(&preemption.uid) else { continue };
            let title = Arc::clone(&waiting.demand.title);
            match preempt::order(&self.context, &waiting.stored, &title, &preemption).await {
                Ok(Some(stored)) => {
                    self.own.insert(stored.revision);
                    waiting.stored = stored;
                }
                // Nothing new is to be ordered.
                Ok(None) => {}
                Err(error) => {
                    // What was marked as ending is not: the next pass decides anew by what the store says.
                    for victim in &preemption.victims {
                        self.cluster.set_stopping(&victim.uid, false);
                    }
                    self.cluster.unnominate(&preemption.uid);
                    if !objects::is_race(&error) {
                        tracing::warn!(task = %preemption.uid, error = crate::app::chain(&error), "a preemption is not written");
                    }
                    retry = Some(Instant::now() + RETRY);
                }
            }
        }
        retry
    }

    /// Carries binds out, each as a transaction of its own; the results are in the same order. None: the
    /// task does not wait any more. The chunks are rendered beside each other, and while one is on its way to
    /// the disk.
    async fn commit(&self, binds: &[Bind]) -> Vec<Option<Committed>> {
        let mut chunks = Vec::with_capacity(binds.len().div_ceil(CHUNK));
        for chunk in binds.chunks(CHUNK) {
            let transactions: Vec<Option<Vec<Op>>> =
                chunk.iter().map(|bind| self.bind_ops(bind)).collect();
            let store = self.context.store.clone();
            let apply = async move {
                let apply = |ops: Option<Vec<Op>>| async { Some(store.apply(ops?).await) };
                join_all(transactions.into_iter().map(apply)).await
            };
            if binds.len() <= CHUNK {
                return apply.await;
            }
            chunks.push(AbortOnDropHandle::new(tokio::spawn(apply)));
        }
        let mut results = Vec::with_capacity(binds.len());
        for chunk in chunks {
            results.extend(
                chunk
                    .await
                    .expect("a commit does not panic, and nobody aborts it while this waits"),
            );
        }
        results
    }

    /// The bind as one transaction. None: it does not wait any more.
    fn bind_ops(&self, bind: &Bind) -> Option<Vec<Op>> {
        let waiting = self.waiting.get(&bind.uid)?;
        let now = self.context.clock.now();
        let mut ops = vec![Op::status(&waiting.stored, &bind::status(bind, now))];
        ops.extend(bind::grants(&self.context, bind, &waiting.stored.key, now));
        Some(ops)
    }

    /// Writes why tasks wait, where it is not written yet.
    async fn write_reasons(&mut self, waits: Vec<Wait>) -> Option<Instant> {
        let now = Instant::now();
        let mut later = None;
        let mut due = Vec::new();
        for Wait { uid, why } in waits {
            let Some(waiting) = self.waiting.get_mut(&uid) else { continue };
            if waiting.written == why {
                // One list in memory for all that say the same.
                waiting.written = why;
                continue;
            }
            let at = waiting.written_at + WHY_EVERY;
            if (same_reasons(&waiting.written, &why) && at > now) || due.len() == WHY_AT_ONCE {
                let at = at.max(now + WHY_EVERY / 10);
                later = Some(later.map_or(at, |l: Instant| l.min(at)));
                continue;
            }
            due.push((Arc::clone(&waiting.stored), uid, why));
        }
        let store = &self.context.store;
        let written = join_all(due.into_iter().map(|(stored, uid, why)| async move {
            // As in a bind: a task that waits has nothing else in its status.
            let status = waiting_status(&why);
            (store.apply_one(Op::status(&stored, &status)).await, uid, why)
        }))
        .await;
        for (result, uid, why) in written {
            match result {
                Ok(stored) => self.reasons_written(&uid, stored, why),
                // What changed arrives as an event and brings the task back, if it still waits.
                Err(error) if objects::is_race(&error) => {}
                Err(error) => {
                    tracing::warn!(task = %uid, error = crate::app::chain(&error), "a task's reasons are not written");
                }
            }
        }
        later
    }

    fn reasons_written(&mut self, uid: &TaskUid, stored: Arc<Stored>, why: Arc<[NodeRefusal]>) {
        self.own.insert(stored.revision);
        if let Some(waiting) = self.waiting.get_mut(uid) {
            (waiting.stored, waiting.written, waiting.written_at) = (stored, why, Instant::now());
        }
    }
}

/// The status of a task that waits for these reasons.
fn waiting_status(why: &[NodeRefusal]) -> TaskStatus {
    let preempting = why.iter().find(|w| w.reason == PREEMPTING);
    TaskStatus {
        reason: preempting.map_or("Unschedulable", |_| PREEMPTING).to_owned(),
        message: preempting.map_or_else(|| headline(why), |w| format!("{}: {}", w.node, w.message)),
        nominated_node: preempting.map(|w| w.node.clone()),
        why: why.to_vec(),
        ..TaskStatus::default()
    }
}

/// The same nodes for the same reasons; numbers in the sentences may differ.
fn same_reasons(a: &[NodeRefusal], b: &[NodeRefusal]) -> bool {
    let of = |why: &[NodeRefusal]| -> Vec<(String, String)> {
        why.iter().map(|w| (w.node.clone(), w.reason.clone())).collect()
    };
    of(a) == of(b)
}

/// The reasons in one line: how many nodes say what.
fn headline(why: &[NodeRefusal]) -> String {
    let mut counts: Vec<(&str, usize)> = Vec::new();
    for refusal in why.iter().filter(|w| !w.node.is_empty()) {
        match counts.iter_mut().find(|(reason, _)| *reason == refusal.reason) {
            Some((_, n)) => *n += 1,
            None => counts.push((&refusal.reason, 1)),
        }
    }
    if counts.is_empty() {
        return why.first().map(|w| w.message.clone()).unwrap_or_default();
    }
    let parts: Vec<String> = counts.iter().map(|(reason, n)| format!("{n} {reason}")).collect();
    format!("no node takes it: {}", parts.join(", "))
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
