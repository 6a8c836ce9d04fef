//! The seam between a task's spec and the runtimes: what to start, and how it is held.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use muster_api::id::TaskUid;
use muster_api::kind::task::StopSignal;
use serde::{Deserialize, Serialize};

use crate::given::Given;

/// One attempt of one task.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub(crate) struct AttemptId {
    pub(crate) uid: TaskUid,
    /// 1 is the first.
    pub(crate) attempt: u32,
}

impl fmt::Display for AttemptId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.uid, self.attempt)
    }
}

/// How an attempt is held. Absent: not limited.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Limits {
    pub(crate) cpu_millis: Option<u64>,
    pub(crate) memory_bytes: Option<u64>,
    /// Processes and threads.
    pub(crate) pids: Option<u64>,
    /// Bytes per second from the disk under the work directory.
    pub(crate) read_bps: Option<u64>,
    /// Bytes per second to the disk under the work directory.
    pub(crate) write_bps: Option<u64>,
}

/// What is started.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) enum Program {
    /// A program of the host.
    Process {
        /// Name or path, then arguments. Passed as it is.
        argv: Vec<String>,
        /// Absent: the task's work directory.
        working_dir: Option<PathBuf>,
        /// `name`, `name:group` or numbers. Absent: the agent's user.
        user: Option<String>,
        /// Host or None.
        #[serde(default)]
        network: Network,
    },
    /// A container.
    Container(Container),
    /// What an executor on this node does.
    Work(Work),
}

/// What an executor is told.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Work {
    pub(crate) namespace: String,
    pub(crate) name: String,
    /// Name of the executor's task, in the same namespace.
    pub(crate) executor: String,
    /// Id of the framework whose work and executor it is; none: declared.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) framework: Option<String>,
    pub(crate) data: serde_json::Map<String, serde_json::Value>,
    pub(crate) lease: Option<Lease>,
}

/// The right to the actuators of a group.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Lease {
    pub(crate) node: String,
    pub(crate) group: String,
    pub(crate) epoch: u64,
}

impl Lease {
    /// From `<node>.<group>:<epoch>[,sequence…]`.
    pub(crate) fn from_text(text: &str) -> Option<Lease> {
        let (whose, number) = text.rsplit_once(':')?;
        let (node, group) = whose.rsplit_once('.')?;
        let epoch = number.split(',').next()?.parse().ok()?;
        Some(Lease { node: node.to_owned(), group: group.to_owned(), epoch })
    }
}

/// A container of an engine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Container {
    pub(crate) image: String,
    /// Empty: the image's entrypoint.
    pub(crate) command: Vec<String>,
    pub(crate) args: Vec<String>,
    pub(crate) working_dir: Option<String>,
    pub(crate) mounts: Vec<Mount>,
    pub(crate) network: Network,
    pub(crate) pull: Pull,
    /// `UID` or `UID:GID`; none: the image's user.
    #[serde(default)]
    pub(crate) run_as: Option<String>,
    /// Whom it runs as, when that is said by number and something is to be its own.
    #[serde(default)]
    pub(crate) user: Option<(u32, u32)>,
}

/// A directory of the host in a container.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Mount {
    pub(crate) host: String,
    pub(crate) container: String,
    pub(crate) read_only: bool,
}

/// A program's network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Network {
    #[default]
    Host,
    None,
    Bridge,
}

/// When an image is fetched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Pull {
    Always,
    IfNotPresent,
    Never,
}

/// Everything that a runtime needs to start an attempt.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Launch {
    pub(crate) id: AttemptId,
    pub(crate) program: Program,
    /// On top of the agent's own environment for a process, of the image's for a container.
    pub(crate) env: BTreeMap<String, String>,
    /// Values of ConfigMaps and Secrets; its variables go before `env`. Never in a file.
    #[serde(skip)]
    pub(crate) given: Given,
    pub(crate) limits: Limits,
    /// Whether a limit is a promise to the user: without enforcement the launch is refused. The
    /// caps that the agent adds on its own are dropped instead.
    pub(crate) promised: bool,
    /// What asks it to end.
    #[serde(default)]
    pub(crate) stop_signal: StopSignal,
    /// How long between that and SIGKILL when it is ended without an order, milliseconds.
    pub(crate) grace_ms: u64,
    /// `onDisconnect: Stop`: ended after this long without contact, milliseconds.
    pub(crate) stop_after_ms: Option<u64>,
}

/// What the kernel counted for an attempt.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Used {
    /// Since the attempt began.
    pub(crate) cpu_usec: u64,
    pub(crate) memory_bytes: u64,
}
