//! What a task runs: a container, a process, or work of an executor.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::config::{EnvFrom, EnvSource, Files};

/// The program: exactly one of the three.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Run {
    /// A container of the node's Docker Engine.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub container: Option<ContainerRun>,
    /// A process of the node itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub process: Option<ProcessRun>,
    /// Work that an executor does which runs on the node already.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub executor: Option<ExecutorRun>,
}

/// Work for an executor: a task of the same namespace that stays alive on the node and runs many tasks itself
/// (Avalon, IV-B). The agent hands the work over by the executor's Unix socket, and the executor's limits grow by
/// what this task reserves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ExecutorRun {
    /// Name of the executor's Task.
    pub task: String,
    /// What the executor is told; the controller does not look into it.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    pub data: serde_json::Map<String, serde_json::Value>,
}

/// A container.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ContainerRun {
    /// The image.
    pub image: String,
    /// Replaces the image's entry point.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub command: Vec<String>,
    /// Replaces the image's arguments.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub args: Vec<String>,
    /// Environment.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["name"]))]
    pub env: Vec<EnvVar>,
    /// Whole ConfigMaps and Secrets as environment.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub env_from: Vec<EnvFrom>,
    /// ConfigMaps and Secrets as files.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["mountPath"]))]
    pub files: Vec<Files>,
    /// Working directory in the container.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub working_dir: Option<String>,
    /// Directories of the node that the container sees.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["mountPath"]))]
    pub mounts: Vec<Mount>,
    /// The container's network.
    #[serde(default)]
    pub network: Network,
    /// When the image is pulled.
    #[serde(default)]
    pub pull_policy: PullPolicy,
    /// The user that it runs as, `UID` or `UID:GID`: names mean something inside of an image only. None: the image's, which
    /// is root where the image says nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
}

/// A process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ProcessRun {
    /// The program (looked up in PATH when it has no `/`) and its first arguments; passed as it
    /// is, without a shell.
    pub command: Vec<String>,
    /// More arguments.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub args: Vec<String>,
    /// Environment, beside the agent's PATH and the MUSTER_ variables.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["name"]))]
    pub env: Vec<EnvVar>,
    /// Whole ConfigMaps and Secrets as environment.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub env_from: Vec<EnvFrom>,
    /// ConfigMaps and Secrets as files.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["mountPath"]))]
    pub files: Vec<Files>,
    /// Working directory; none: a directory of the task's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub working_dir: Option<String>,
    /// The user it runs as, a name or a number; none: the agent's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// Its network: the node's, or none but a loopback of its own, so that it reaches nobody and is reached by nobody. A
    /// program that is to be held in needs a `user`, too: root can leave.
    #[serde(default, skip_serializing_if = "ProcessNetwork::is_default")]
    pub network: ProcessNetwork,
}

/// A signal that a program may end at, by POSIX's name.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "UPPERCASE")]
pub enum StopSignal {
    /// Terminate.
    #[default]
    SigTerm,
    /// Interrupt, as of a terminal.
    SigInt,
    /// Quit.
    SigQuit,
    /// Hang up.
    SigHup,
    /// The program's own.
    SigUsr1,
    /// The program's own.
    SigUsr2,
}

impl StopSignal {
    pub(super) fn is_default(&self) -> bool {
        *self == StopSignal::default()
    }

    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            StopSignal::SigTerm => "SIGTERM",
            StopSignal::SigInt => "SIGINT",
            StopSignal::SigQuit => "SIGQUIT",
            StopSignal::SigHup => "SIGHUP",
            StopSignal::SigUsr1 => "SIGUSR1",
            StopSignal::SigUsr2 => "SIGUSR2",
        }
    }
}

/// A program's network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum ProcessNetwork {
    /// The node's own network.
    #[default]
    Host,
    /// Loopback only; shared memory and message queues of System V are its own as well.
    None,
}

impl ProcessNetwork {
    fn is_default(&self) -> bool {
        *self == ProcessNetwork::default()
    }
}

/// A variable of a task's environment.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct EnvVar {
    /// Name.
    pub name: String,
    /// Value.
    #[serde(default)]
    pub value: String,
    /// Where the value comes from instead.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value_from: Option<EnvSource>,
}

/// A directory or file of the node that a container sees.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Mount {
    /// Absolute path on the node.
    pub host_path: String,
    /// Absolute path in the container.
    pub mount_path: String,
    /// The container cannot write to it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub read_only: bool,
}

/// A container's network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Network {
    /// The node's own network.
    #[default]
    Host,
    /// Loopback only.
    None,
    /// The engine's default bridge.
    Bridge,
}

/// When an image is pulled.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum PullPolicy {
    /// When the node does not have it.
    #[default]
    IfNotPresent,
    /// Before every start.
    Always,
    /// Not at all; the node must have it.
    Never,
}
