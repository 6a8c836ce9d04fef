//! A runtime with answers given beforehand, and a list of what it was asked.

use std::collections::VecDeque;
use std::sync::Mutex;

use bytes::Bytes;
use futures::future::{BoxFuture, FutureExt};
use futures::stream::{BoxStream, StreamExt};
use muster_agent_core::desired::StopTimes;
use muster_agent_core::observed::{Exit, Observed};
use muster_agent_core::workload::Failure;
use muster_api::id::TaskUid;
use tokio::sync::Notify;

use super::{
    AttemptId, Launch, Launched, Limits, LogQuery, Pull, Runtime, RuntimeError, RuntimeStatus, Used,
};

/// The fake. An answer that was not given never comes.
#[derive(Debug, Default)]
pub(crate) struct Fake {
    pub(crate) launches: Mutex<VecDeque<Launched>>,
    pub(crate) finds: Mutex<VecDeque<Observed>>,
    fetches: Mutex<VecDeque<Result<(), Failure>>>,
    fetch: Notify,
    exits: Mutex<VecDeque<Exit>>,
    exited: Notify,
    asked: Mutex<Vec<String>>,
}

impl Fake {
    /// What it was asked, in order.
    pub(crate) fn asked(&self) -> Vec<String> {
        self.asked.lock().unwrap().clone()
    }

    fn ask(&self, what: &str, id: &AttemptId) {
        self.asked.lock().unwrap().push(format!("{what} {}", id.attempt));
    }

    /// What came of the fetch that is under way.
    pub(crate) fn fetched(&self, result: Result<(), Failure>) {
        self.fetches.lock().unwrap().push_back(result);
        self.fetch.notify_one();
    }

    /// The running attempt ends.
    pub(crate) fn exit(&self, exit: Exit) {
        self.exits.lock().unwrap().push_back(exit);
        self.exited.notify_one();
    }
}

/// Queued, or never.
async fn next<T>(queue: &Mutex<VecDeque<T>>) -> T {
    let answer = queue.lock().unwrap().pop_front();
    match answer {
        Some(answer) => answer,
        None => std::future::pending().await,
    }
}

impl Runtime for Fake {
    fn status(&self) -> RuntimeStatus {
        RuntimeStatus { available: true, version: String::new(), message: String::new() }
    }

    fn prepare<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<(), Failure>> {
        self.ask("prepare", &launch.id);
        async { Ok(()) }.boxed()
    }

    fn fetch<'a>(&'a self, image: &'a str, _: Pull) -> BoxFuture<'a, Result<(), Failure>> {
        self.asked.lock().unwrap().push(format!("fetch {image}"));
        async {
            loop {
                let result = self.fetches.lock().unwrap().pop_front();
                match result {
                    Some(result) => return result,
                    None => self.fetch.notified().await,
                }
            }
        }
        .boxed()
    }

    fn launch<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Launched> {
        self.ask("launch", &launch.id);
        next(&self.launches).boxed()
    }

    fn find<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<Observed, RuntimeError>> {
        self.ask("find", &launch.id);
        async { Ok(next(&self.finds).await) }.boxed()
    }

    fn wait<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Exit> {
        self.ask("wait", &launch.id);
        async {
            loop {
                let exit = self.exits.lock().unwrap().pop_front();
                match exit {
                    Some(exit) => return exit,
                    None => self.exited.notified().await,
                }
            }
        }
        .boxed()
    }

    fn stop<'a>(
        &'a self,
        id: &'a AttemptId,
        _: StopTimes,
    ) -> BoxFuture<'a, Result<(), RuntimeError>> {
        self.ask("stop", id);
        async { Ok(()) }.boxed()
    }

    fn resize<'a>(
        &'a self,
        id: &'a AttemptId,
        _: &'a Limits,
    ) -> BoxFuture<'a, Result<(), RuntimeError>> {
        self.ask("resize", id);
        async { Ok(()) }.boxed()
    }

    fn remove<'a>(&'a self, _: &'a TaskUid) -> BoxFuture<'a, Result<(), RuntimeError>> {
        self.asked.lock().unwrap().push("remove".to_owned());
        async { Ok(()) }.boxed()
    }

    fn used(&self, _: &AttemptId) -> Option<Used> {
        None
    }

    fn logs(&self, _: &AttemptId, _: LogQuery) -> BoxStream<'static, std::io::Result<Bytes>> {
        futures::stream::empty().boxed()
    }
}
