//! The one task that writes.
//!
//! While a commit is in flight, transactions queue in the mpsc; the next round takes them all as one batch. Only this
//! task changes [`State`], so admission reads it without fear of change until the commit has been published.

use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use muster_failpoint::{Failpoint, Step, reach};
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;

use super::backend::{Backend, BackendError, Batch, Compaction};
use super::pending::{Pending, Prepared};
use super::state::{RingLimits, State};
use super::{Event, Store, StoreError, Stored};

/// Transactions that may wait while a commit is in flight; beyond it, callers wait in `send`.
const QUEUE: usize = 4096;
/// Operations in one batch. At this size the sync is already a small part of a commit, and a larger batch would
/// only make its first caller wait longer.
const BATCH_OPS: usize = 1024;
/// Bytes in one batch; bounds the text handed to the database in one statement.
const BATCH_BYTES: usize = 8 << 20;
/// When nobody writes, the disk is asked after so long what it has of a commit that failed: a write of which nobody knows is
/// not to take effect at some later hour.
const ASK_AGAIN: Duration = Duration::from_secs(1);
/// Rows that are forgotten together, as part of some commit.
const COMPACT_ROWS: usize = 1024;

pub(super) type Answer = Result<Vec<Arc<Stored>>, StoreError>;

/// What a [`Store`] handle asks of the writer.
#[derive(Debug)]
pub(super) enum Request {
    Apply { ops: Vec<Prepared>, answer: oneshot::Sender<Answer> },
    Compact { through: u64, answer: oneshot::Sender<Result<(), StoreError>> },
    Settle { answer: oneshot::Sender<Result<(), StoreError>> },
}

/// The task behind a [`Store`]; nothing is written unless somebody runs it.
#[must_use = "a store without its writer running never answers a write"]
pub struct Writer {
    backend: Box<dyn Backend>,
    state: Arc<RwLock<State>>,
    requests: mpsc::Receiver<Request>,
    published: watch::Sender<u64>,
    /// A batch whose commit failed in a way that leaves open whether the disk has it.
    unsettled: Option<Vec<Event>>,
    /// Transactions of the previous batch: as many callers are about to come back.
    expected: usize,
}

impl std::fmt::Debug for Writer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Writer").finish_non_exhaustive()
    }
}

/// A batch with those who wait for it.
#[derive(Default)]
struct Round {
    pending: Pending,
    waiting: Vec<(oneshot::Sender<Answer>, Vec<Arc<Stored>>)>,
    compacting: Vec<oneshot::Sender<Result<(), StoreError>>>,
}

pub(super) async fn open(
    mut backend: Box<dyn Backend>,
    limits: RingLimits,
) -> Result<(Store, Writer), BackendError> {
    let mut state = State::new(limits);
    let compacted = backend.load(&mut |row| state.restore(row)).await?;
    state.restored(compacted);
    let (published, subscribed) = watch::channel(state.revision());
    let (sender, requests) = mpsc::channel(QUEUE);
    let state = Arc::new(RwLock::new(state));
    let store = Store::new(Arc::clone(&state), sender, subscribed);
    Ok((store, Writer { backend, state, requests, published, unsettled: None, expected: 0 }))
}

impl Writer {
    /// Writes until `stop` is cancelled or the last [`Store`] is dropped. What was sent before is still committed.
    /// Watches end when this returns.
    pub async fn run(mut self, stop: CancellationToken) {
        loop {
            let first = tokio::select! {
                biased;
                // Cancel safe: a request that was not received stays in the queue and is drained below.
                () = stop.cancelled() => break,
                first = self.requests.recv() => first,
                // Cancel safe: the batch stays unsettled.
                () = tokio::time::sleep(ASK_AGAIN), if self.unsettled.is_some() => {
                    // Why it cannot be asked is told to whoever writes.
                    drop(self.settle().await);
                    continue;
                }
            };
            let Some(first) = first else { return };
            self.round(first).await;
        }
        self.requests.close();
        while let Some(first) = self.requests.recv().await {
            self.round(first).await;
        }
    }

    async fn round(&mut self, first: Request) {
        let mut round = Round::default();
        if let Err(error) = self.settle().await {
            // Admission needs a state that the disk agrees with.
            refuse(first, error);
            return;
        }
        self.take(&mut round, first);
        self.gather(&mut round).await;
        self.expected = round.waiting.len();
        self.commit(round).await;
    }

    /// Fills the batch with what is queued. Callers answered by the previous batch are on their way back, so a few
    /// turns of the scheduler are given to them: a batch of all costs one sync, two batches of half cost two.
    async fn gather(&mut self, round: &mut Round) {
        let mut turns = 0;
        while round.pending.events.len() < BATCH_OPS && round.pending.bytes < BATCH_BYTES {
            match self.requests.try_recv() {
                Ok(request) => self.take(round, request),
                Err(_) if round.waiting.len() < self.expected && turns < 4 => {
                    turns += 1;
                    tokio::task::yield_now().await;
                }
                Err(_) => return,
            }
        }
    }

    fn take(&mut self, round: &mut Round, request: Request) {
        match request {
            Request::Apply { ops, answer } => {
                let state = self.state.read().unwrap_or_else(PoisonError::into_inner);
                match round.pending.admit(&state, ops) {
                    Ok(stored) => round.waiting.push((answer, stored)),
                    // A caller that stopped waiting needs no answer.
                    Err(error) => drop(answer.send(Err(error))),
                }
            }
            Request::Compact { through, answer } => {
                self.state.write().unwrap_or_else(PoisonError::into_inner).compact(through);
                round.compacting.push(answer);
            }
            // Before this round began, everything before it was.
            Request::Settle { answer } => drop(answer.send(Ok(()))),
        }
    }

    async fn commit(&mut self, round: Round) {
        let Round { pending, waiting, compacting } = round;
        let compaction = self.compaction(!compacting.is_empty());
        let batch = Batch { events: &pending.events, compaction: compaction.as_ref() };
        let nothing = pending.events.is_empty() && compaction.is_none();
        let points = [
            (Failpoint::StoreCommit, !pending.events.is_empty()),
            (Failpoint::StoreCompaction, compaction.is_some()),
        ];
        let reach_all = |step| {
            for (point, _) in points.iter().filter(|(_, happens)| *happens) {
                reach(*point, step);
            }
        };
        reach_all(Step::Before);
        let committed = if nothing { Ok(()) } else { self.backend.commit(batch).await };
        reach_all(Step::After);
        match committed {
            Ok(()) => {
                self.publish(pending.events);
                for (answer, stored) in waiting {
                    drop(answer.send(Ok(stored)));
                }
                for answer in compacting {
                    drop(answer.send(Ok(())));
                }
            }
            Err(error) => {
                tracing::error!(error = &error as &dyn std::error::Error, "commit failed");
                metrics::counter!("muster_store_commit_failures_total").increment(1);
                if let Some(compaction) = compaction {
                    self.state
                        .write()
                        .unwrap_or_else(PoisonError::into_inner)
                        .keep_garbage(compaction);
                }
                self.unsettled = Some(pending.events);
                let source = Arc::new(error);
                for (answer, _) in waiting {
                    drop(answer.send(Err(StoreError::Storage { source: Arc::clone(&source) })));
                }
                for answer in compacting {
                    drop(answer.send(Err(StoreError::Storage { source: Arc::clone(&source) })));
                }
            }
        }
    }

    fn compaction(&self, asked: bool) -> Option<Compaction> {
        let mut state = self.state.write().unwrap_or_else(PoisonError::into_inner);
        (asked || state.garbage() >= COMPACT_ROWS).then(|| state.take_garbage())
    }

    fn publish(&self, events: Vec<Event>) {
        if events.is_empty() {
            return;
        }
        metrics::counter!("muster_store_commits_total").increment(1);
        metrics::counter!("muster_store_writes_total").increment(events.len() as u64);
        let mut state = self.state.write().unwrap_or_else(PoisonError::into_inner);
        for event in events {
            state.apply(event);
        }
        let revision = state.revision();
        // Before the watchers wake, or they would all queue for the lock that is held here.
        drop(state);
        metrics::gauge!("muster_store_revision").set(revision as f64);
        self.published.send_replace(revision);
    }

    /// After a failed commit: asks the disk what it has. Either none of the batch is there and it is forgotten, or
    /// all of it is (the failure came after the commit) and it is published late.
    async fn settle(&mut self) -> Result<(), StoreError> {
        let Some(events) = self.unsettled.take() else { return Ok(()) };
        let durable = match self.backend.last_revision().await {
            Ok(durable) => durable,
            Err(error) => {
                self.unsettled = Some(events);
                return Err(StoreError::Storage { source: Arc::new(error) });
            }
        };
        if events.last().is_some_and(|event| event.revision() == durable) {
            self.publish(events);
        }
        Ok(())
    }
}

fn refuse(request: Request, error: StoreError) {
    match request {
        Request::Apply { answer, .. } => drop(answer.send(Err(error))),
        Request::Compact { answer, .. } | Request::Settle { answer } => {
            drop(answer.send(Err(error)));
        }
    }
}
