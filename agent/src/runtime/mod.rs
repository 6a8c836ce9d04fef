//! What runs tasks. A [`Runtime`] starts, watches, ends and removes attempts; which one a task gets
//! follows from its spec.
//!
//! | module | holds |
//! |---|---|
//! | [`process`] | programs of the host, each under a [`shim`](crate::shim) that outlives the agent |
//! | [`docker`] | containers of a Docker Engine |
//! | [`cgroup`] | the kernel's groups and limits |
//! | [`logs`] | task output on disk: written by shims, read here |
//! | [`fake`] | a runtime with answers given beforehand, for tests |

pub(crate) mod cgroup;
pub(crate) mod contact;
pub(crate) mod docker;
#[cfg(test)]
pub(crate) mod fake;
pub(crate) mod launch;
pub(crate) mod logs;
pub(crate) mod process;

use std::os::fd::OwnedFd;

use bytes::Bytes;
use futures::future::{BoxFuture, FutureExt};
use futures::stream::{BoxStream, StreamExt as _};
use muster_agent_core::desired::StopTimes;
use muster_agent_core::observed::{Exit, Observed, Started};
use muster_agent_core::workload::Failure;
use muster_api::id::TaskUid;

use crate::exec::ends::{Ends, Invocation, Outlet, Ran, Stream};
pub(crate) use launch::{AttemptId, Launch, Limits, Pull, Used};

/// Why an image is not on the node, one word.
pub(crate) const IMAGE_PULL_FAILED: &str = "ImagePullFailed";

/// What came of a program that was run beside an attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Executed {
    /// It ended with this code, as a shell shows it, and said this.
    Ended { code: i32, said: String },
    /// It could not be started, by its own fault: why.
    NotStarted(String),
    /// It was killed before it ended, and had said this.
    Cut { said: String },
}

/// How much of what a check says is kept, bytes.
pub(crate) const KEPT_WORDS: usize = 4 << 10;

/// Where a running attempt can be reached over the network.
#[derive(Debug)]
pub(crate) enum Reached {
    /// In the node's own network.
    Here,
    /// In the network namespace of this descriptor.
    Inside(OwnedFd),
}

/// What came of a launch.
#[derive(Debug)]
pub(crate) enum Launched {
    /// The program runs.
    Running(Started),
    /// It was over, or could not begin, before anybody could say that it ran.
    Ended(Exit),
    /// Nothing was started, and nothing will be.
    Refused(Failure),
    /// Nothing was started: what it needs has to be fetched first, with [`Runtime::prepare`].
    Unprepared(Failure),
    /// It may or may not have been started: ask with [`Runtime::find`].
    Unclear(RuntimeError),
}

/// Why a runtime could not do what it was asked; asking again may help.
#[derive(Debug, thiserror::Error)]
#[error("failed to {what}")]
pub(crate) struct RuntimeError {
    pub(crate) what: &'static str,
    #[source]
    pub(crate) source: Box<dyn std::error::Error + Send + Sync>,
}

impl RuntimeError {
    pub(crate) fn new(
        what: &'static str,
        source: impl Into<Box<dyn std::error::Error + Send + Sync>>,
    ) -> Self {
        RuntimeError { what, source: source.into() }
    }
}

/// Which part of a task's output is wanted.
#[derive(Debug, Clone, Default)]
pub(crate) struct LogQuery {
    pub(crate) follow: bool,
    pub(crate) tail: Option<u64>,
    pub(crate) timestamps: bool,
    pub(crate) since: Option<jiff::Timestamp>,
}

impl LogQuery {
    /// Only what is written after this.
    pub(crate) fn from_now_on() -> LogQuery {
        LogQuery { follow: true, tail: Some(0), ..LogQuery::default() }
    }
}

/// Starts, watches, ends and removes attempts. Every answer of [`Runtime::wait`] and of
/// `Ended` means that the kernel shows no process of the attempt any more.
pub(crate) trait Runtime: Send + Sync + std::fmt::Debug {
    /// Whether tasks can be run now; else why not.
    fn status(&self) -> RuntimeStatus;
    /// Fetches what the launch needs. May be dropped at any await: what was fetched stays.
    fn prepare<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<(), Failure>>;
    /// Has an image on the node, when this runtime runs images. May be dropped at any await: what was fetched stays.
    fn fetch<'a>(&'a self, image: &'a str, _: Pull) -> BoxFuture<'a, Result<(), Failure>> {
        let message = format!("image {image:?}: this runtime runs no images");
        let reason = IMAGE_PULL_FAILED.to_owned();
        futures::future::ready(Err(Failure { reason, message, retry: false })).boxed()
    }
    /// Starts the attempt.
    fn launch<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Launched>;
    /// What became of an attempt of an earlier life of the agent.
    fn find<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<Observed, RuntimeError>>;
    /// Resolves when no process of the attempt is left.
    fn wait<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Exit>;
    /// Orders the kill ladder; whoever orders does not wait for its end. A later order hastens it, and never delays it.
    fn stop<'a>(
        &'a self,
        id: &'a AttemptId,
        times: StopTimes,
    ) -> BoxFuture<'a, Result<(), RuntimeError>>;
    /// Holds a running attempt to other limits from now on; each one is read back.
    fn resize<'a>(
        &'a self,
        id: &'a AttemptId,
        limits: &'a Limits,
    ) -> BoxFuture<'a, Result<(), RuntimeError>>;
    /// Runs a program beside a running attempt: in its group, as its user, in its directory and with its environment.
    /// It is killed whole when `until` resolves first. A runtime without processes of its own runs none.
    fn exec<'a>(
        &'a self,
        _: &'a Launch,
        _: &'a [String],
        _: BoxFuture<'a, ()>,
    ) -> BoxFuture<'a, Result<Executed, RuntimeError>> {
        let error = RuntimeError::new("run a program beside a task", "it has no processes");
        futures::future::ready(Err(error)).boxed()
    }
    /// Whether attempts have processes of their own, which programs may be run beside.
    fn has_processes(&self) -> bool {
        false
    }
    /// Whether a process is one of a running attempt; none: this runtime does not know of the attempt, or not yet.
    fn has(&self, _: &AttemptId, _: i32) -> Option<bool> {
        None
    }
    /// Runs a program beside a running attempt, as [`Runtime::exec`] does, for a client: with its input and output, or
    /// with a terminal. It is killed with all of its session when `until` resolves first, or this is dropped.
    fn interact<'a>(
        &'a self,
        _: &'a AttemptId,
        _: &'a Invocation,
        _: Ends,
        _: BoxFuture<'a, ()>,
    ) -> BoxFuture<'a, Result<Ran, RuntimeError>> {
        let error = RuntimeError::new("run a program in a task", "it has no processes");
        futures::future::ready(Err(error)).boxed()
    }
    /// Gives a client what a running attempt writes from now on, until it ends.
    fn attach<'a>(
        &'a self,
        id: &'a AttemptId,
        output: &'a Outlet,
    ) -> BoxFuture<'a, Result<(), RuntimeError>> {
        let mut parts = self.logs(id, LogQuery::from_now_on());
        async move {
            while let Some(part) = parts.next().await {
                let part = part.map_err(|error| RuntimeError::new("follow a task", error))?;
                if output.send(Stream::Stdout, part).await.is_err() {
                    break;
                }
            }
            Ok(())
        }
        .boxed()
    }
    /// The network of a running attempt.
    fn network<'a>(&'a self, _: &'a Launch) -> BoxFuture<'a, Result<Reached, RuntimeError>> {
        futures::future::ready(Ok(Reached::Here)).boxed()
    }
    /// Removes every trace of a task of which nothing runs.
    fn remove<'a>(&'a self, uid: &'a TaskUid) -> BoxFuture<'a, Result<(), RuntimeError>>;
    /// What the kernel counted for a running attempt.
    fn used(&self, id: &AttemptId) -> Option<Used>;
    /// The attempt's output. Ends at the end of what there is, or with `follow` when the attempt ends.
    fn logs(&self, id: &AttemptId, query: LogQuery) -> BoxStream<'static, std::io::Result<Bytes>>;
}

/// What the node says about a runtime.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RuntimeStatus {
    pub(crate) available: bool,
    pub(crate) version: String,
    pub(crate) message: String,
}
