//! Programs of the host, each under a [`shim`](crate::shim) that outlives the agent.
//!
//! ```text
//! agent ── launch ──▶ directory, group + limits (read back), lock ──▶ shim ──▶ program
//!   └── pidfd of the shim: readable when it is gone ──▶ exit.json, or the shim was killed:
//!       the agent runs the ladder itself and writes the record
//! ```
//!
//! | module | holds |
//! |---|---|
//! | [`attempt`] | the attempt's directory: what agent and shim know of it |
//! | [`reach`] | all processes of an attempt, and the ladder that ends them |
//! | [`spawn`] | directory, group, lock, shim |
//! | [`adopt`] | what became of the attempts of an earlier life of the agent |
//! | [`scan`] | facts from `/proc` |
//! | [`exec`] | programs beside a running attempt: its checks |
//! | [`interact`] | the same for clients, with their input and output |
//! | [`pty`] | terminals for them |

mod adopt;
pub(crate) mod attempt;
mod exec;
mod interact;
mod pty;
pub(crate) mod reach;
pub(crate) mod scan;
mod spawn;

pub(crate) use interact::kill_session;
pub(crate) use spawn::spawn_shim;

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use futures::FutureExt;
use futures::future::BoxFuture;
use futures::stream::BoxStream;
use muster_agent_core::desired::StopTimes;
use muster_agent_core::observed::{End, Exit, Loss, Observed, Started};
use muster_agent_core::workload::Failure;
use muster_api::id::TaskUid;
use muster_api::kind::task::StopSignal;
use muster_failpoint::{Failpoint, Step, reach};
use rustix::process::{PidfdFlags, Signal, WaitId, WaitIdOptions};
use tokio::io::AsyncReadExt;
use tokio::io::unix::AsyncFd;

use super::cgroup::{Enforcer, Kernel};
use super::launch::{AttemptId, Launch, Limits, Network, Program, Used};
use super::{Executed, Launched, LogQuery, Reached, Runtime, RuntimeError, RuntimeStatus, logs};
use crate::clock;
use crate::durable;
use crate::exec::ends::{Ends, Invocation, Ran};
use crate::given::files::Place;
use attempt::{AttemptDir, LogBounds, Process, StopFile};
use reach::{Ladder, Reach};

/// Attempts whose directories (and so logs) are kept: the present one and the one before it.
pub(crate) const KEPT_ATTEMPTS: u32 = 2;

/// How the shim is executed: this binary again, with the words that lead to the shim's verb.
#[derive(Debug, Clone)]
pub struct Reexec {
    /// The program.
    pub program: PathBuf,
    /// Arguments before the shim's own.
    pub verb: Vec<OsString>,
}

impl Reexec {
    /// The running binary, whatever became of its file, and `verb`.
    #[must_use]
    pub fn this_binary(verb: &[&str]) -> Reexec {
        Reexec {
            program: PathBuf::from("/proc/self/exe"),
            verb: verb.iter().map(OsString::from).collect(),
        }
    }
}

/// What the process runtime is made of.
#[derive(Debug)]
pub(crate) struct ProcessConfig {
    /// Holds `<uid>/attempts/<n>` and `<uid>/work`.
    pub(crate) tasks: PathBuf,
    pub(crate) files: Place,
    pub(crate) reexec: Reexec,
    pub(crate) contact: PathBuf,
    pub(crate) log: LogBounds,
    /// Run tasks without a group when none can be made.
    pub(crate) unenforced: bool,
}

/// The runtime. Cheap to clone; all clones are one.
#[derive(Debug, Clone)]
pub(crate) struct ProcessRuntime(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    config: ProcessConfig,
    boot_id: String,
    /// Or why nothing is enforced.
    enforcer: Result<Box<dyn Enforcer>, String>,
    live: Mutex<BTreeMap<AttemptId, Live>>,
}

/// A shim that is known to run.
#[derive(Debug, Clone)]
struct Live {
    shim: Arc<OwnedFd>,
    reach: Reach,
}

impl ProcessRuntime {
    pub(crate) fn new(config: ProcessConfig, enforcer: Result<Kernel, String>) -> ProcessRuntime {
        ProcessRuntime(Arc::new(Inner {
            config,
            boot_id: clock::boot_id(),
            enforcer: enforcer.map(|kernel| Box::new(kernel) as Box<dyn Enforcer>),
            live: Mutex::default(),
        }))
    }

    /// Ends what is in groups below this agent's root that no attempt accounts for. Attempts with
    /// a directory are spared: [`Runtime::find`] answers for them.
    pub(crate) fn sweep(&self) {
        let Ok(enforcer) = &self.0.enforcer else { return };
        for (name, group) in enforcer.existing() {
            let known = name.rsplit_once('.').and_then(|(uid, attempt)| {
                Some(AttemptId { uid: TaskUid::new(uid), attempt: attempt.parse().ok()? })
            });
            let dir = known.map(|id| self.0.dir(&id));
            if dir.as_ref().is_some_and(|dir| matches!(dir.exit(), Ok(None)) && dir.path().exists())
            {
                continue;
            }
            tracing::info!(group = %name, "a group of no attempt is swept");
            let reach = Reach::Group(group.clone());
            let mut ladder = Ladder::Idle;
            ladder.kill();
            for _ in 0..20 {
                if reach.is_empty() {
                    break;
                }
                std::thread::sleep(ladder.step(&reach, StopSignal::default()).unwrap_or_default());
            }
            if let Err(error) = group.remove() {
                tracing::warn!(group = %name, %error, "the group could not be removed");
            }
        }
    }

    /// The agent ends: takes away what it made for itself and no task uses.
    pub(crate) fn retire(&self) {
        if let Ok(enforcer) = &self.0.enforcer {
            enforcer.retire();
        }
    }

    fn live(&self, id: &AttemptId) -> Option<Live> {
        self.0.live.lock().unwrap_or_else(PoisonError::into_inner).get(id).cloned()
    }

    fn set_live(&self, id: &AttemptId, live: Option<Live>) {
        let mut all = self.0.live.lock().unwrap_or_else(PoisonError::into_inner);
        match live {
            Some(live) => all.insert(id.clone(), live),
            None => all.remove(id),
        };
    }

    async fn launch(&self, launch: &Launch) -> Launched {
        let (inner, order) = (Arc::clone(&self.0), launch.clone());
        // Files, groups and a fork: milliseconds that the agent's one thread has not.
        let spawned = match tokio::task::spawn_blocking(move || spawn::spawn(&inner, order)).await {
            Ok(Ok(spawned)) => spawned,
            Ok(Err(spawn::SpawnError::Refused(failure))) => return Launched::Refused(failure),
            Ok(Err(spawn::SpawnError::Unclear(error))) => return Launched::Unclear(error),
            Err(error) => return Launched::Unclear(RuntimeError::new("start a shim", error)),
        };
        self.set_live(&launch.id, Some(spawned.live));
        let mut word = [0];
        // The pipe ends without a word when the shim dies.
        let _ = spawned.word.read_exact_into(&mut word).await;
        let dir = self.0.dir(&launch.id);
        match (word[0], dir.running(), dir.exit()) {
            (crate::shim::RUNNING, Ok(Some(running)), _) => {
                Launched::Running(Started { at: running.at })
            }
            (crate::shim::ENDED, _, Ok(Some(exit))) => {
                self.reap(&launch.id).await;
                Launched::Ended(exit)
            }
            (_, Err(error), _) | (_, _, Err(error)) => {
                Launched::Unclear(RuntimeError::new("read what the shim wrote", error))
            }
            _ => Launched::Unclear(RuntimeError::new("start the program", "the shim died early")),
        }
    }

    /// Waits for the shim's end and takes it out of the process table if it is this agent's child.
    async fn reap(&self, id: &AttemptId) {
        let Some(live) = self.live(id) else { return };
        // SAFETY: the descriptor is shared, never closed or changed while an `Arc` of it lives, and
        // the `AsyncFd` holds one.
        let watched = unsafe {
            AsyncFd::register_with_interest(Arc::clone(&live.shim), tokio::io::Interest::READABLE)
        };
        match watched {
            // Ready once and for ever: nothing to clear.
            Ok(fd) => drop(fd.readable().await),
            Err(error) => {
                tracing::error!(%id, %error, "a shim cannot be watched; looking at it instead");
                while !shim_gone(&live.shim) {
                    tokio::time::sleep(Duration::from_millis(200)).await;
                }
            }
        }
        // An adopted shim is another's child; that one reaps it.
        let _ = rustix::process::waitid(
            WaitId::PidFd(rustix::fd::AsFd::as_fd(&*live.shim)),
            WaitIdOptions::EXITED | WaitIdOptions::NOHANG,
        );
        self.set_live(id, None);
    }

    async fn wait(&self, launch: &Launch) -> Exit {
        let id = &launch.id;
        let reach = self.live(id).map(|live| live.reach);
        self.reap(id).await;
        let dir = self.0.dir(id);
        let mut pause = Duration::from_millis(50);
        loop {
            match dir.exit() {
                Ok(Some(exit)) => return exit,
                Ok(None) => {
                    if let Some(exit) = self.end_without_shim(&dir, launch, reach.as_ref()).await {
                        return exit;
                    }
                }
                Err(error) => tracing::error!(%id, %error, "an exit record cannot be read"),
            }
            tokio::time::sleep(pause).await;
            pause = (pause * 2).min(Duration::from_secs(10));
        }
    }

    /// Ends what a killed shim left, and writes the record in its place.
    async fn end_without_shim(
        &self,
        dir: &AttemptDir,
        launch: &Launch,
        reach: Option<&Reach>,
    ) -> Option<Exit> {
        let id = &launch.id;
        tracing::warn!(%id, "the shim was killed; ending what is left of its attempt");
        let order = dir.order().ok().flatten();
        let shim = dir.begun().ok().flatten().map_or(0, |begun| begun.shim.pid);
        let running = dir.running().ok().flatten();
        let session = running.as_ref().map(|running| running.process.pid);
        let reach = match (reach, &order) {
            (Some(Reach::Group(group)), _) => Reach::Group(group.clone()),
            (_, Some(order)) => crate::shim::reach(order, shim, session),
            _ => Reach::Tree { shim, session, mark: reach::mark(id) },
        };
        let mut ladder = Ladder::Idle;
        ladder.stop(StopTimes { signal_ms: 0, kill_ms: launch.grace_ms });
        while !reach.is_empty() {
            let pause = ladder.step(&reach, launch.stop_signal).unwrap_or_default();
            // A program that obeys ends long before its grace does.
            tokio::time::sleep(pause.min(Duration::from_millis(20))).await;
        }
        let exit = Exit {
            end: End::Lost(Loss::Shim),
            oom_killed: reach.oom_kills() > 0,
            disconnected: false,
            started_at: running.map(|running| running.at),
            finished_at: clock::wall(),
        };
        if let Reach::Group(group) = &reach
            && let Err(error) = group.remove()
        {
            tracing::warn!(%id, %error, "the group stays behind until the next sweep");
        }
        match dir.write_exit(&exit) {
            Ok(()) => Some(exit),
            Err(error) => {
                tracing::error!(%id, %error, "the exit record cannot be written");
                None
            }
        }
    }

    fn stop(&self, id: &AttemptId, times: StopTimes) -> Result<(), RuntimeError> {
        let what = "order a shim to end its attempt";
        let dir = self.0.dir(id);
        let StopTimes { signal_ms, kill_ms: grace_ms } = times;
        dir.write_stop(StopFile { grace_ms, signal_ms }).map_err(|e| RuntimeError::new(what, e))?;
        let Some(live) = self.live(id) else { return Ok(()) };
        match rustix::process::pidfd_send_signal(&*live.shim, Signal::USR1) {
            // Gone: whoever waits for it ends what is left.
            Ok(()) | Err(rustix::io::Errno::SRCH) => Ok(()),
            Err(errno) => Err(RuntimeError::new(what, errno)),
        }
    }

    fn remove(&self, uid: &TaskUid) -> Result<(), RuntimeError> {
        let task = self.0.config.tasks.join(uid.as_str());
        reach(Failpoint::AttemptsRemoval, Step::Before);
        for part in ["attempts", "work", "run"] {
            durable::remove_dir_all(&task.join(part))
                .map_err(|error| RuntimeError::new("remove a task's directories", error))?;
        }
        reach(Failpoint::AttemptsRemoval, Step::After);
        Ok(())
    }
}

impl Inner {
    fn dir(&self, id: &AttemptId) -> AttemptDir {
        let attempts = self.config.tasks.join(id.uid.as_str()).join("attempts");
        AttemptDir::new(attempts.join(id.attempt.to_string()))
    }

    fn work_dir(&self, uid: &TaskUid) -> PathBuf {
        self.config.tasks.join(uid.as_str()).join("work")
    }
}

fn shim_gone(pidfd: &OwnedFd) -> bool {
    let mut fds = [rustix::event::PollFd::new(pidfd, rustix::event::PollFlags::IN)];
    let now = rustix::event::Timespec { tv_sec: 0, tv_nsec: 0 };
    rustix::event::poll(&mut fds, Some(&now)).is_ok_and(|ready| ready > 0)
}

/// A descriptor of exactly this process; `None`: it is gone.
fn pidfd(process: Process) -> io::Result<Option<OwnedFd>> {
    let Some(pid) = rustix::process::Pid::from_raw(process.pid) else { return Ok(None) };
    match rustix::process::pidfd_open(pid, PidfdFlags::NONBLOCK) {
        // Opened first, compared second: the pid cannot change hands in between unseen.
        Ok(fd) => Ok(scan::process(process.pid).filter(|now| *now == process).map(|_| fd)),
        Err(rustix::io::Errno::SRCH) => Ok(None),
        Err(errno) => Err(errno.into()),
    }
}

/// The pipe on which a new shim says its one word.
#[derive(Debug)]
struct Word(OwnedFd);

impl Word {
    async fn read_exact_into(self, word: &mut [u8; 1]) -> io::Result<()> {
        let mut pipe = tokio::net::unix::pipe::Receiver::from_owned_fd(self.0)?;
        pipe.read_exact(word).await.map(|_| ())
    }
}

impl Runtime for ProcessRuntime {
    fn status(&self) -> RuntimeStatus {
        let message = match &self.0.enforcer {
            Ok(_) => String::new(),
            Err(why) => format!("quotas are not enforced: {why}"),
        };
        RuntimeStatus { available: true, version: env!("CARGO_PKG_VERSION").to_owned(), message }
    }

    fn prepare<'a>(&'a self, _: &'a Launch) -> BoxFuture<'a, Result<(), Failure>> {
        async { Ok(()) }.boxed()
    }

    fn launch<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Launched> {
        self.launch(launch).boxed()
    }

    fn find<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<Observed, RuntimeError>> {
        adopt::find(self, launch).boxed()
    }

    fn wait<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Exit> {
        self.wait(launch).boxed()
    }

    fn stop<'a>(
        &'a self,
        id: &'a AttemptId,
        times: StopTimes,
    ) -> BoxFuture<'a, Result<(), RuntimeError>> {
        async move { self.stop(id, times) }.boxed()
    }

    fn resize<'a>(
        &'a self,
        id: &'a AttemptId,
        limits: &'a Limits,
    ) -> BoxFuture<'a, Result<(), RuntimeError>> {
        async move {
            let what = "change the limits of a process";
            // Without a group nothing is enforced, and the node says so.
            let Some(Live { reach: Reach::Group(group), .. }) = self.live(id) else {
                return Ok(());
            };
            let limits = *limits;
            let done =
                tokio::task::spawn_blocking(move || super::cgroup::resize(&group, &limits)).await;
            match done {
                Ok(done) => done.map_err(|error| RuntimeError::new(what, error)),
                Err(error) => Err(RuntimeError::new(what, error)),
            }
        }
        .boxed()
    }

    fn exec<'a>(
        &'a self,
        launch: &'a Launch,
        argv: &'a [String],
        until: BoxFuture<'a, ()>,
    ) -> BoxFuture<'a, Result<Executed, RuntimeError>> {
        exec::exec(self.0.dir(&launch.id), argv, until).boxed()
    }

    fn network<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<Reached, RuntimeError>> {
        let reached = match &launch.program {
            Program::Process { network: Network::None, .. } => {
                let error = |error: io::Error| RuntimeError::new("enter a task's network", error);
                let process = exec::beside(&self.0.dir(&launch.id));
                let process = process.ok_or_else(|| error(io::ErrorKind::NotFound.into()));
                process.and_then(|process| {
                    scan::namespace(process, "net").map(Reached::Inside).map_err(error)
                })
            }
            _ => Ok(Reached::Here),
        };
        futures::future::ready(reached).boxed()
    }

    fn has_processes(&self) -> bool {
        true
    }

    fn has(&self, id: &AttemptId, pid: i32) -> Option<bool> {
        Some(self.live(id)?.reach.pids().contains(&pid))
    }

    fn interact<'a>(
        &'a self,
        id: &'a AttemptId,
        invocation: &'a Invocation,
        ends: Ends,
        until: BoxFuture<'a, ()>,
    ) -> BoxFuture<'a, Result<Ran, RuntimeError>> {
        interact::interact(self.0.dir(id), invocation, ends, until).boxed()
    }

    fn remove<'a>(&'a self, uid: &'a TaskUid) -> BoxFuture<'a, Result<(), RuntimeError>> {
        let (runtime, uid) = (self.clone(), uid.clone());
        async move {
            match tokio::task::spawn_blocking(move || runtime.remove(&uid)).await {
                Ok(done) => done,
                Err(error) => Err(RuntimeError::new("remove a task's directories", error)),
            }
        }
        .boxed()
    }

    fn used(&self, id: &AttemptId) -> Option<Used> {
        self.live(id)?.reach.used()
    }

    fn logs(&self, id: &AttemptId, query: LogQuery) -> BoxStream<'static, io::Result<Bytes>> {
        let dir = self.0.dir(id);
        let log = dir.log();
        // Without a directory there is nobody who will write in it.
        let ended = move || !matches!(dir.exit(), Ok(None)) || !dir.path().exists();
        logs::read(log, query, Box::new(ended))
    }
}
