//! Carries plans out: binds, orders to make room, and reasons, each as transactions of its own.

use std::sync::Arc;

use futures::future::join_all;
use muster_api::id::TaskUid;
use muster_api::kind::task::{NodeRefusal, PREEMPTING, Task, TaskStatus};
use muster_controller_core::preempt::Preemption;
use muster_controller_core::schedule::{Bind, Wait};
use tokio::time::Instant;
use tokio_util::task::AbortOnDropHandle;

use super::{Scheduler, WHY_EVERY};
use crate::objects::{self, TASKS};
use crate::reconcile::bind::Unsure;
use crate::reconcile::{RETRY, bind, preempt};
use crate::store::{Change, Op, StoreError, Stored};

/// Reasons written in one pass, so that a thousand waiting tasks do not hold up the next bind.
const WHY_AT_ONCE: usize = 256;

/// Binds that are rendered at once. Rendering one takes some tens of microseconds and a commit some
/// milliseconds: a few hundred keep both the disk and this task busy.
const CHUNK: usize = 256;

type Committed = Result<Vec<Arc<Stored>>, StoreError>;

impl Scheduler {
    pub(super) async fn bind_all(&mut self, binds: Vec<Bind>) -> Option<Instant> {
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
                Some(Err(error)) if objects::is_race(&error) => {
                    self.cluster.withdraw(&bind.uid);
                    // What changed arrives as an event and brings the task back, if it still waits.
                    tracing::debug!(task = %bind.uid, %error, "a bind came too late");
                }
                Some(Err(error)) => {
                    tracing::warn!(task = %bind.uid, error = crate::app::chain(&error), "a bind is not written");
                    retry = Some(Instant::now() + RETRY);
                    if let Some(waiting) = self.waiting.get(&bind.uid) {
                        self.unsure.push(Unsure { task: waiting.stored.key.clone(), bind });
                        continue;
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

    /// Asks the store what became of binds that seemed to fail: the disk may have them all the same. Until that is known
    /// they keep what they took, so that nobody else is given it. Says when to ask again.
    pub(super) async fn resolve_unsure(&mut self) -> Option<Instant> {
        if self.unsure.is_empty() && !self.desk.is_unsure() {
            return None;
        }
        if let Err(error) = self.context.store.settled().await {
            tracing::debug!(
                error = crate::app::chain(&error),
                "the store does not know yet what it has"
            );
            return Some(Instant::now() + RETRY);
        }
        let freed = self.desk.resolve(&mut self.cluster);
        if !freed.is_empty() {
            self.counter.changed();
            self.dirty.extend(freed);
        }
        for Unsure { task, bind } in std::mem::take(&mut self.unsure) {
            let stored = self.context.store.get(&task).filter(|s| *s.uid == *bind.uid.as_str());
            let placed = stored.as_ref().and_then(|s| objects::read::<Task>(s)?.status?.node);
            if placed.is_some() {
                self.waiting.remove(&bind.uid);
                continue;
            }
            self.dirty.extend(self.cluster.withdraw(&bind.uid));
            // Its changes were passed over while it counted as bound.
            match stored {
                Some(stored) => self.take_in(TASKS, Change::Put, &stored),
                None => self.forget(&bind.uid),
            }
        }
        None
    }

    /// Orders the ends of those that make room, each order with its reason in one transaction with the nomination.
    pub(super) async fn preempt_all(&mut self, preemptions: Vec<Preemption>) -> Option<Instant> {
        let order = |preemption: Preemption| {
            let waiting = self.waiting.get(&preemption.uid)?;
            let (stored, title) = (Arc::clone(&waiting.stored), Arc::clone(&waiting.demand.title));
            let context = Arc::clone(&self.context);
            Some(async move {
                let written = preempt::order(&context, &stored, &title, &preemption).await;
                (preemption, written)
            })
        };
        let orders: Vec<_> = preemptions.into_iter().filter_map(order).collect();
        let mut retry = None;
        for (preemption, written) in join_all(orders).await {
            match written {
                Ok(Some(stored)) => {
                    self.own.insert(stored.revision);
                    if let Some(waiting) = self.waiting.get_mut(&preemption.uid) {
                        waiting.stored = stored;
                    }
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
            let transactions: Vec<Option<Result<Vec<Op>, StoreError>>> =
                chunk.iter().map(|bind| self.bind_ops(bind)).collect();
            let store = self.context.store.clone();
            let apply = async move {
                let apply = |ops: Option<Result<Vec<Op>, StoreError>>| async {
                    match ops? {
                        Ok(ops) => Some(store.apply(ops).await),
                        Err(error) => Some(Err(error)),
                    }
                };
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

    /// The bind as one transaction. None: it does not wait any more. An error: the store knows more than this task.
    fn bind_ops(&self, bind: &Bind) -> Option<Result<Vec<Op>, StoreError>> {
        let waiting = self.waiting.get(&bind.uid)?;
        let now = self.context.clock.now();
        let status = bind::status(bind, waiting.past.as_deref(), now);
        let mut ops = vec![Op::status(&waiting.stored, &status)];
        let grants = bind::grants(&self.context.store, bind, &waiting.stored.key, now);
        Some(grants.map(|grants| {
            ops.extend(grants);
            ops
        }))
    }

    /// Writes why tasks wait, where it is not written yet.
    pub(super) async fn write_reasons(&mut self, waits: Vec<Wait>) -> Option<Instant> {
        let now = Instant::now();
        let mut later = None;
        let mut due = Vec::new();
        for Wait { uid, why, brief } in waits {
            let Some(waiting) = self.waiting.get_mut(&uid) else { continue };
            if brief && !waiting.written.is_empty() {
                // What it says is true again in a moment, or it has a place.
                continue;
            }
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
            // As in a bind: a task that waits has nothing else in its status.
            let status = waiting_status(&why, waiting.past.as_deref());
            due.push((Arc::clone(&waiting.stored), uid, why, status));
        }
        let store = &self.context.store;
        let written = join_all(due.into_iter().map(|(stored, uid, why, status)| async move {
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
                    let at = Instant::now() + RETRY;
                    later = Some(later.map_or(at, |l: Instant| l.min(at)));
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
fn waiting_status(why: &[NodeRefusal], past: Option<&TaskStatus>) -> TaskStatus {
    let preempting = why.iter().find(|w| w.reason == PREEMPTING);
    TaskStatus {
        reason: preempting.map_or("Unschedulable", |_| PREEMPTING).to_owned(),
        message: preempting.map_or_else(|| headline(why), |w| format!("{}: {}", w.node, w.message)),
        nominated_node: preempting.map(|w| w.node.clone()),
        why: why.to_vec(),
        ..past.map(TaskStatus::carried).unwrap_or_default()
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
    // What holds it back comes before what is said of nodes.
    if let Some(hold) = why.first().filter(|w| w.node.is_empty()) {
        return hold.message.clone();
    }
    let mut counts: Vec<(&str, usize)> = Vec::new();
    for refusal in why.iter().filter(|w| !w.node.is_empty()) {
        match counts.iter_mut().find(|(reason, _)| *reason == refusal.reason) {
            Some((_, n)) => *n += 1,
            None => counts.push((&refusal.reason, 1)),
        }
    }
    let parts: Vec<String> = counts.iter().map(|(reason, n)| format!("{n} {reason}")).collect();
    format!("no node takes it: {}", parts.join(", "))
}
