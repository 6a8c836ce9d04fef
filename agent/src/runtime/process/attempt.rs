//! The directory of one attempt: what agent and shim know of it, one file per fact.
//!
//! | file | written by | says |
//! |---|---|---|
//! | `launch.json` | agent | what to start, in which group; without what it is given of ConfigMaps and Secrets |
//! | `lock` | agent, inherited by the shim | held: the shim lives (or is about to) |
//! | `begun.json` | shim | a process may have been started from here on |
//! | `started.json` | shim | the program runs |
//! | `stop.json` | agent | end it; the shim is told by a signal to look |
//! | `disconnected` | guard of a container | it was ended for want of contact |
//! | `exit.json` | shim, or the agent when the shim is lost | it ended and no process is left |
//! | `log`, `log.1` … | shim | its output |
//!
//! Only `exit.json` is synced to disk. The others matter only while this boot lasts: after another
//! boot nothing of the attempt can live.

use std::fs::{File, OpenOptions};
use std::os::fd::AsFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use muster_agent_core::observed::{End, Exit, Loss};
use muster_failpoint::Failpoint;
use rustix::fs::FlockOperation;
use serde::{Deserialize, Serialize};

use crate::durable::{self, FileError, Keep};
use crate::runtime::cgroup::group::Group;
use crate::runtime::launch::Launch;

/// What the shim is given.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Order {
    pub(crate) launch: Launch,
    /// Absent: the attempt runs without a group (`--unenforced-quotas`).
    pub(crate) group: Option<Group>,
    /// Present: nothing is started; the group, whose first process this is, is only ended when
    /// contact is lost (see `shim::guard`).
    #[serde(default)]
    pub(crate) guarded: Option<Process>,
    pub(crate) work_dir: PathBuf,
    /// When the agent was last in contact; see [`crate::runtime::contact`].
    pub(crate) contact: PathBuf,
    pub(crate) boot_id: String,
    pub(crate) log: LogBounds,
}

/// How much output is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct LogBounds {
    /// Size of one file.
    pub(crate) bytes: u64,
    /// Number of files, the current one included.
    pub(crate) files: u32,
}

impl Default for LogBounds {
    fn default() -> Self {
        // 50 MiB a task: some days of a chatty ROS node, and little for a robot's disk.
        LogBounds { bytes: 10 << 20, files: 5 }
    }
}

/// From here on a process of the attempt may exist.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Begun {
    pub(crate) shim: Process,
    pub(crate) boot_id: String,
}

/// The program runs.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Running {
    pub(crate) process: Process,
    pub(crate) at: muster_agent_core::time::Wall,
}

/// A process that cannot be mistaken for a later one with the same pid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Process {
    pub(crate) pid: i32,
    /// Clock ticks since boot, from `/proc/<pid>/stat`.
    pub(crate) start_time: u64,
}

/// The order to end the attempt.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct StopFile {
    pub(crate) grace_ms: u64,
    /// Until SIGTERM.
    #[serde(default)]
    pub(crate) signal_ms: u64,
}

/// One attempt's directory.
#[derive(Debug, Clone)]
pub(crate) struct AttemptDir(PathBuf);

impl AttemptDir {
    pub(crate) fn new(path: PathBuf) -> Self {
        AttemptDir(path)
    }

    pub(crate) fn path(&self) -> &Path {
        &self.0
    }

    pub(crate) fn log(&self) -> PathBuf {
        self.0.join("log")
    }

    pub(crate) fn write_order(&self, order: &Order) -> Result<(), FileError> {
        let point =
            if order.guarded.is_some() { Failpoint::GuardOrder } else { Failpoint::ShimOrder };
        durable::write_json(point, &self.0.join("launch.json"), order, Keep::Crash)
    }

    pub(crate) fn order(&self) -> Result<Option<Order>, FileError> {
        durable::read_json(&self.0.join("launch.json"))
    }

    pub(crate) fn write_begun(&self, begun: &Begun) -> Result<(), FileError> {
        durable::write_json(Failpoint::ShimBegun, &self.0.join("begun.json"), begun, Keep::Crash)
    }

    pub(crate) fn begun(&self) -> Result<Option<Begun>, FileError> {
        durable::read_json(&self.0.join("begun.json"))
    }

    pub(crate) fn write_running(&self, running: &Running) -> Result<(), FileError> {
        durable::write_json(
            Failpoint::ShimStarted,
            &self.0.join("started.json"),
            running,
            Keep::Crash,
        )
    }

    pub(crate) fn running(&self) -> Result<Option<Running>, FileError> {
        durable::read_json(&self.0.join("started.json"))
    }

    pub(crate) fn write_stop(&self, stop: StopFile) -> Result<(), FileError> {
        durable::write_json(Failpoint::StopOrder, &self.0.join("stop.json"), &stop, Keep::Crash)
    }

    pub(crate) fn stop(&self) -> Result<Option<StopFile>, FileError> {
        durable::read_json(&self.0.join("stop.json"))
    }

    /// Says that the attempt was ended for want of contact.
    pub(crate) fn write_disconnected(&self) -> Result<(), FileError> {
        durable::write(
            Failpoint::Disconnected,
            &self.0.join("disconnected"),
            b"",
            0o600,
            Keep::PowerCut,
        )
    }

    pub(crate) fn was_disconnected(&self) -> bool {
        self.0.join("disconnected").exists()
    }

    pub(crate) fn write_exit(&self, exit: &Exit) -> Result<(), FileError> {
        // Of a shim that is lost the agent writes it.
        let lost = exit.end == End::Lost(Loss::Shim);
        let point = if lost { Failpoint::LostShimExit } else { Failpoint::ShimExit };
        durable::write_json(point, &self.0.join("exit.json"), exit, Keep::PowerCut)
    }

    pub(crate) fn exit(&self) -> Result<Option<Exit>, FileError> {
        durable::read_json(&self.0.join("exit.json"))
    }

    /// Takes the lock; `None`: somebody lives who has it.
    pub(crate) fn lock(&self) -> Result<Option<File>, FileError> {
        let path = self.0.join("lock");
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(&path)
            .map_err(FileError::at("open", &path))?;
        match rustix::fs::flock(file.as_fd(), FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => Ok(Some(file)),
            Err(rustix::io::Errno::WOULDBLOCK) => Ok(None),
            Err(errno) => Err(FileError::at("lock", &path)(errno.into())),
        }
    }
}
