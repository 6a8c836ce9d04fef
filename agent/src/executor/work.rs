//! Works as tasks: the runtime of tasks that an executor does. "Launched" means that the executor
//! says it runs; an end is the executor's word, or that no process of the executor is left.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::future::{BoxFuture, FutureExt};
use futures::stream::{self, BoxStream, StreamExt};
use muster_agent_core::desired::StopTimes;
use muster_agent_core::executor::{Event, Life, Stage, Work};
use muster_agent_core::observed::{End, Exit, Loss, Observed, Started};
use muster_agent_core::time::Boot;
use muster_agent_core::workload::Failure;
use muster_api::id::TaskUid;
use tokio::sync::watch;

use super::desk::{Choice, Desks};
use crate::clock;
use crate::contact::Contact;
use crate::driver::chain;
use crate::runtime::launch::{AttemptId, Launch, Limits, Program, Used};
use crate::runtime::{Launched, LogQuery, Runtime, RuntimeError, RuntimeStatus};

/// The runtime.
#[derive(Debug)]
pub(crate) struct WorkRuntime {
    pub(crate) desks: Arc<Desks>,
    pub(crate) contact: Arc<Contact>,
}

impl WorkRuntime {
    async fn prepare(&self, launch: &Launch) -> Result<(), Failure> {
        let Program::Work(work) = &launch.program else { return Ok(()) };
        let mut changes = self.desks.changes();
        loop {
            match self.desks.choose(work) {
                Choice::Ready(_) => return Ok(()),
                Choice::Never => {
                    let message = format!("its executor {:?} has ended", work.executor);
                    let reason = "ExecutorLost".to_owned();
                    return Err(Failure { reason, message, retry: false });
                }
                // The sender lives as long as `self`.
                Choice::Wait => drop(changes.changed().await),
            }
        }
    }

    async fn launch(&self, launch: &Launch) -> Launched {
        let uid = &launch.id.uid;
        let refused = |reason: &str, message: String| {
            Launched::Refused(Failure { reason: reason.to_owned(), message, retry: true })
        };
        let mut changes = self.desks.changes();
        // Before the first await: a stop or a watch that the driver asks for after this finds the work.
        let Some(executor) = self.desks.claim(launch) else {
            return refused("ExecutorAway", "its executor went away".to_owned());
        };
        if let Err(error) = self.desks.fit(&executor).await {
            self.desks.forget(uid);
            self.refit(&executor).await;
            return refused("QuotaNotEnforced", chain(&error));
        }
        self.desks.write_down(&executor, uid).await;
        self.desks.handle(&executor, Event::Recorded(uid.clone())).await;
        let mut told = false;
        loop {
            let Some((_, work, _)) = self.desks.look(&launch.id) else {
                return Launched::Ended(lost());
            };
            match work.stage {
                Stage::Running => return Launched::Running(started(&work)),
                Stage::Ended(exit) => {
                    self.refit(&executor).await;
                    return Launched::Ended(exit);
                }
                Stage::Claimed | Stage::Recorded | Stage::Sent => {
                    self.attend(launch, (&executor, &work), &mut told, &mut changes).await;
                }
            }
        }
    }

    async fn find(&self, launch: &Launch) -> Result<Observed, RuntimeError> {
        let mut changes = self.desks.changes();
        while let Some((executor, work, life)) = self.desks.look(&launch.id) {
            match (&work.stage, life) {
                (Stage::Ended(exit), _) => {
                    self.refit(&executor).await;
                    return Ok(Observed::Ended(exit.clone()));
                }
                // Whether its executor lives is being found out.
                (_, Life::Unsure(_)) => drop(changes.changed().await),
                _ => return Ok(Observed::Running(started(&work))),
            }
        }
        let file = self.desks.file(&launch.id);
        let file = file.map_err(|error| RuntimeError::new("read a work's record", error))?;
        // Its executor is not here any more, and tasks leave only when nothing of them is left.
        Ok(file.map_or(Observed::NeverStarted, |file| {
            Observed::Ended(file.record.exit.unwrap_or_else(lost))
        }))
    }

    async fn wait(&self, launch: &Launch) -> Exit {
        let id = &launch.id;
        let mut changes = self.desks.changes();
        let mut told = false;
        loop {
            let Some((executor, work, _)) = self.desks.look(id) else { return lost() };
            if let Stage::Ended(exit) = work.stage {
                self.refit(&executor).await;
                return exit;
            }
            self.attend(launch, (&executor, &work), &mut told, &mut changes).await;
        }
    }

    /// Waits for a change, or does what is due: contact that was lost for too long ends a work, once
    /// (`told`), and what does not end in time ends with its executor. Also of a work that was only
    /// handed over: it may run.
    async fn attend(
        &self,
        launch: &Launch,
        (executor, work): (&TaskUid, &Work),
        told: &mut bool,
        changes: &mut watch::Receiver<()>,
    ) {
        let contact = launch
            .stop_after_ms
            .filter(|_| !*told)
            .map(|limit| self.contact.last().unwrap_or_default().plus(limit));
        let (uid, now) = (launch.id.uid.clone(), clock::boot());
        if contact.is_some_and(|limit| now >= limit) {
            *told = true;
            let grace_ms = launch.grace_ms;
            let stop = Event::Stop { work: uid, grace_ms, disconnected: true };
            self.desks.handle(executor, stop).await;
        } else if work.until.is_some_and(|until| now >= until) {
            self.desks.handle(executor, Event::Tick(uid)).await;
        } else {
            let next = [contact, work.until].into_iter().flatten().min();
            // Cancel-safe: a receiver and a sleep whose deadline is kept.
            tokio::select! {
                changed = changes.changed() => drop(changed),
                () = sleep_until(next, now) => {}
            }
        }
    }

    /// Limits that stay too wide are no reason to keep a work's end back.
    async fn refit(&self, executor: &TaskUid) {
        if let Err(error) = self.desks.fit(executor).await {
            tracing::warn!(%executor, error = chain(&error), "an executor's limits stay as they were");
        }
    }
}

async fn sleep_until(at: Option<Boot>, now: Boot) {
    match at {
        Some(at) => tokio::time::sleep(Duration::from_millis(at.0.saturating_sub(now.0))).await,
        None => std::future::pending().await,
    }
}

/// One that is only handed over counts from then on, when another life of the agent did it.
fn started(work: &Work) -> Started {
    Started { at: work.began.unwrap_or(work.claimed) }
}

fn lost() -> Exit {
    Exit {
        end: End::Lost(Loss::Executor),
        oom_killed: false,
        disconnected: false,
        started_at: None,
        finished_at: clock::wall(),
    }
}

impl Runtime for WorkRuntime {
    fn status(&self) -> RuntimeStatus {
        let (version, message) = (env!("CARGO_PKG_VERSION").to_owned(), String::new());
        RuntimeStatus { available: true, version, message }
    }

    fn prepare<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<(), Failure>> {
        self.prepare(launch).boxed()
    }

    fn launch<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Launched> {
        self.launch(launch).boxed()
    }

    fn find<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<Observed, RuntimeError>> {
        self.find(launch).boxed()
    }

    fn wait<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Exit> {
        self.wait(launch).boxed()
    }

    fn stop<'a>(
        &'a self,
        id: &'a AttemptId,
        times: StopTimes,
    ) -> BoxFuture<'a, Result<(), RuntimeError>> {
        async move {
            let grace_ms = times.kill_ms;
            if let Some((executor, ..)) = self.desks.look(id) {
                let stop = Event::Stop { work: id.uid.clone(), grace_ms, disconnected: false };
                self.desks.handle(&executor, stop).await;
            }
            Ok(())
        }
        .boxed()
    }

    fn resize<'a>(
        &'a self,
        _: &'a AttemptId,
        _: &'a Limits,
    ) -> BoxFuture<'a, Result<(), RuntimeError>> {
        // A work has no processes of its own, and so no works either.
        async { Ok(()) }.boxed()
    }

    fn remove<'a>(&'a self, uid: &'a TaskUid) -> BoxFuture<'a, Result<(), RuntimeError>> {
        self.desks.forget(uid);
        async { Ok(()) }.boxed()
    }

    fn used(&self, _: &AttemptId) -> Option<Used> {
        None
    }

    fn logs(&self, _: &AttemptId, _: LogQuery) -> BoxStream<'static, io::Result<Bytes>> {
        let error = io::Error::other("an executor does this task: its output is the executor's");
        stream::iter([Err(error)]).boxed()
    }
}
