//! The other side of a framework: a program that stays alive on a node and runs many tasks itself.
//!
//! ```text
//!  your Executor ◀─ Event ── queue ◀─┐
//!                                    connection ◀── frames ──▶ agent ($MUSTER_EXECUTOR_SOCKET)
//!  ExecutorHandle ── Command ────────┘
//! ```
//!
//! | module | holds |
//! |---|---|
//! | `connection` | one connection at a time to the agent, made again whenever it breaks |
//! | `book` | tasks that are not over and updates that are not acknowledged |
//! | `frame` | messages behind their lengths |
//!
//! An executor is a task that a framework launched like any other; its tasks are launched with
//! [`Launch::executor`](crate::Launch::executor).

mod book;
mod connection;
pub(crate) mod frame;

use std::ffi::OsString;
use std::future::Future;
use std::path::PathBuf;
use std::time::Duration;

use bytes::Bytes;
use muster_api::wire::executor::v1 as proto;
use muster_api::wire::framework_session::json_of;
pub use proto::{Lease, TaskState};
use serde_json::{Map, Value};
use tokio::sync::mpsc;

use connection::{Command, Connection};

/// The variable that names the agent's socket.
pub const SOCKET: &str = "MUSTER_EXECUTOR_SOCKET";
/// The variable that holds the executor's token.
pub const TOKEN: &str = "MUSTER_EXECUTOR_TOKEN";

/// Updates and messages on their way to the agent.
const COMMANDS: usize = 64;
/// Events that wait for the executor's code; more wait in the socket.
const EVENTS: usize = 64;

/// Whom the executor runs for, and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Registration {
    /// Uid of the executor's own task.
    pub executor: String,
    /// Its namespace.
    pub namespace: String,
    /// The framework's name; empty: the executor is a declared task.
    pub framework: String,
    /// The framework's id; empty as well.
    pub framework_id: String,
    /// The node.
    pub node: String,
}

/// A task to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Task {
    /// Its uid.
    pub uid: String,
    /// Its name.
    pub name: String,
    /// What the framework says of it.
    pub data: Map<String, Value>,
    /// The right to the robot's actuators, when it has one.
    pub lease: Option<Lease>,
}

/// What runs tasks. Callbacks run one after another; long work belongs into a task of its own, with a clone of the
/// handle.
pub trait Executor: Send {
    /// The agent knows the executor.
    fn registered(
        &mut self,
        _handle: &ExecutorHandle,
        _registration: Registration,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// The agent is back, and knows again which tasks there are.
    fn reregistered(&mut self, _handle: &ExecutorHandle) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// The agent is away. Tasks go on; updates wait.
    fn disconnected(&mut self, _handle: &ExecutorHandle) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// Run this, and send updates of it: Running, and how it ended.
    fn launch_task(
        &mut self,
        handle: &ExecutorHandle,
        task: Task,
    ) -> impl Future<Output = ()> + Send;

    /// End this task within `grace`, and send the update.
    fn kill_task(
        &mut self,
        handle: &ExecutorHandle,
        task: &str,
        grace: Duration,
    ) -> impl Future<Output = ()> + Send;

    /// From the framework; at most once.
    fn framework_message(
        &mut self,
        _handle: &ExecutorHandle,
        _data: Bytes,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// End every task within `grace`. The driver returns after this, once the agent has the updates; the program should
    /// exit then: half way through the grace the agent sends SIGTERM, and at its end SIGKILL.
    fn shutdown(
        &mut self,
        _handle: &ExecutorHandle,
        _grace: Duration,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }
}

/// How a task is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Status {
    task: String,
    state: TaskState,
    message: String,
    exit_code: Option<i32>,
}

impl Status {
    /// The task of this uid is in this state.
    pub fn new(task: impl Into<String>, state: TaskState) -> Self {
        Status { task: task.into(), state, message: String::new(), exit_code: None }
    }

    /// A sentence for people.
    #[must_use]
    pub fn message(mut self, message: impl Into<String>) -> Self {
        self.message = message.into();
        self
    }

    /// How it ended, as processes do.
    #[must_use]
    pub fn exit_code(mut self, code: i32) -> Self {
        self.exit_code = Some(code);
        self
    }
}

/// The executor has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the executor has ended")]
pub struct Ended;

/// What an executor can do. Clones act for the same executor.
#[derive(Debug, Clone)]
pub struct ExecutorHandle {
    commands: mpsc::Sender<Command>,
}

/// # Errors
///
/// When the driver has returned.
impl ExecutorHandle {
    /// Says how a task is. Kept and repeated until the agent has it on its disk.
    pub async fn send_status_update(&self, status: Status) -> Result<(), Ended> {
        self.commands.send(Command::Update(status)).await.map_err(|_| Ended)
    }

    /// To the framework: at most once, up to 4 MiB. Lost while the agent is away.
    pub async fn send_framework_message(&self, data: impl Into<Bytes>) -> Result<(), Ended> {
        self.commands.send(Command::Message(data.into())).await.map_err(|_| Ended)
    }
}

/// Why an executor cannot run.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ExecutorError {
    /// The program was not started as an executor.
    #[error("{0} is not set: executors are started by the agent")]
    Environment(&'static str),
}

/// Calls an [`Executor`] back.
#[derive(Debug)]
pub struct ExecutorDriver {
    socket: PathBuf,
    token: String,
}

impl ExecutorDriver {
    /// As the agent started this program: with [`SOCKET`] and [`TOKEN`] in its environment.
    ///
    /// # Errors
    ///
    /// When one of them is missing.
    pub fn from_env() -> Result<Self, ExecutorError> {
        let read = |name: &'static str| -> Result<OsString, ExecutorError> {
            std::env::var_os(name).ok_or(ExecutorError::Environment(name))
        };
        let token = read(TOKEN)?.into_string();
        let token = token.map_err(|_| ExecutorError::Environment(TOKEN))?;
        Ok(ExecutorDriver::new(read(SOCKET)?, token))
    }

    /// With this socket and token.
    pub fn new(socket: impl Into<PathBuf>, token: impl Into<String>) -> Self {
        ExecutorDriver { socket: socket.into(), token: token.into() }
    }

    /// Runs until the agent shuts the executor down. An agent that is away is waited for: the executor outlives it.
    pub async fn run(self, mut executor: impl Executor) {
        let (to_connection, commands) = mpsc::channel(COMMANDS);
        let (to_executor, mut events) = mpsc::channel(EVENTS);
        let handle = ExecutorHandle { commands: to_connection };
        let mut connection = Connection::new(self.socket, self.token, commands, to_executor);
        let callbacks = async {
            while let Some(event) = events.recv().await {
                if let Some(grace) = call_back(&mut executor, &handle, event).await {
                    // The connection took every command of the callbacks before this one.
                    drop(handle.commands.send(Command::Finish(grace)).await);
                }
            }
        };
        // Callbacks end when the connection drops its end of the events, which it does not while it runs.
        tokio::select! {
            () = connection.run() => {}
            () = callbacks => {}
        }
    }
}

/// Some: the executor was shut down, with so much time.
async fn call_back(
    executor: &mut impl Executor,
    handle: &ExecutorHandle,
    event: connection::Event,
) -> Option<Duration> {
    use connection::Event;
    match event {
        Event::Registered(registration) => executor.registered(handle, registration).await,
        Event::Reregistered => executor.reregistered(handle).await,
        Event::Disconnected => executor.disconnected(handle).await,
        Event::Launch(launch) => {
            let data = launch.data.as_ref().map(json_of).unwrap_or_default();
            let proto::Launch { task: uid, name, lease, .. } = launch;
            executor.launch_task(handle, Task { uid, name, data, lease }).await;
        }
        Event::Kill { task, grace } => executor.kill_task(handle, &task, grace).await,
        Event::Message(data) => executor.framework_message(handle, data).await,
        Event::Shutdown(grace) => {
            executor.shutdown(handle, grace).await;
            return Some(grace);
        }
    }
    None
}
