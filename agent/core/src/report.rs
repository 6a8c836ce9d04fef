//! What is told to the controller about a task. A report is the whole state, never a difference, so
//! that the newest one alone matters; its sequence says which is the newest.

use std::fmt;

use muster_api::kind::task::{LIVENESS_FAILED, NOT_READY, STARTING_UP, STARTUP_FAILED};
use muster_api::phase::TaskPhase;
use serde::{Deserialize, Serialize};

use crate::observed::{End, Exit, Loss, Said};
use crate::probe::Role;
use crate::time::Wall;

/// Where a task is on this node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Phase {
    /// Accepted; being made ready, or waiting to be started again.
    Starting,
    /// Its main process runs.
    Running,
    /// It is being ended.
    Stopping,
    /// It ended well; nothing of it is left.
    Succeeded,
    /// It ended otherwise; nothing of it is left.
    Failed,
}

impl From<Phase> for TaskPhase {
    fn from(phase: Phase) -> Self {
        match phase {
            Phase::Starting => TaskPhase::Starting,
            Phase::Running => TaskPhase::Running,
            Phase::Stopping => TaskPhase::Stopping,
            Phase::Succeeded => TaskPhase::Succeeded,
            Phase::Failed => TaskPhase::Failed,
        }
    }
}

impl Phase {
    /// Whether the task has ended for good.
    #[must_use]
    pub const fn is_terminal(self) -> bool {
        matches!(self, Phase::Succeeded | Phase::Failed)
    }
}

/// Why a task is where it is: one CamelCase word on the wire.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Reason {
    /// Nothing to explain.
    None,
    /// The program returned 0.
    Completed,
    /// The program failed.
    Error,
    /// The kernel killed it for memory.
    OomKilled,
    /// The program could not be started.
    StartError,
    /// It was ended by order.
    Stopped,
    /// It was ended because contact was lost for too long.
    Disconnected,
    /// Its shim was killed, so that nobody knows its status.
    ShimLost,
    /// The machine was started anew while it ran.
    NodeRebooted,
    /// Its container was removed by somebody else.
    ContainerLost,
    /// Its executor ended before it.
    ExecutorLost,
    /// Its executor ended it.
    Killed,
    /// It runs, and its start-up probe has not succeeded.
    StartingUp,
    /// It runs, and its readiness probe does not succeed.
    NotReady,
    /// It was ended because its liveness probe failed.
    LivenessFailed,
    /// It was ended because its start-up probe failed.
    StartupFailed,
    /// It waits for other tasks.
    AwaitingDependency,
    /// It is or was ended because a task that it depends on was started again.
    DependencyRestarted,
    /// It waits for its executor.
    AwaitingExecutor,
    /// It waits before it is started again.
    BackOff,
    /// It waits for contact with the controller (`onDisconnect: Stop`).
    AwaitingContact,
    /// It stands by.
    Standby,
    /// The agent could not read its assignment: a newer controller sent it.
    AssignmentUnreadable,
    /// A runtime's own word (`ImagePullFailed`, `QuotaNotEnforced` …).
    Runtime(String),
}

impl Reason {
    /// Why an attempt is ended whose probe of this role failed.
    #[must_use]
    pub fn failed(role: Role) -> Reason {
        match role {
            Role::Startup => Reason::StartupFailed,
            Role::Readiness | Role::Liveness => Reason::LivenessFailed,
        }
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Reason::None => "",
            Reason::Completed => "Completed",
            Reason::Error => "Error",
            Reason::OomKilled => "OOMKilled",
            Reason::StartError => "StartError",
            Reason::Stopped => "Stopped",
            Reason::Disconnected => "Disconnected",
            Reason::ShimLost => "ShimLost",
            Reason::NodeRebooted => "NodeRebooted",
            Reason::ContainerLost => "ContainerLost",
            Reason::ExecutorLost => "ExecutorLost",
            Reason::Killed => "Killed",
            Reason::StartingUp => STARTING_UP,
            Reason::NotReady => NOT_READY,
            Reason::LivenessFailed => LIVENESS_FAILED,
            Reason::StartupFailed => STARTUP_FAILED,
            Reason::AwaitingDependency => "AwaitingDependency",
            Reason::DependencyRestarted => "DependencyRestarted",
            Reason::AwaitingExecutor => "AwaitingExecutor",
            Reason::BackOff => "BackOff",
            Reason::AwaitingContact => "AwaitingContact",
            Reason::Standby => "Standby",
            Reason::AssignmentUnreadable => "AssignmentUnreadable",
            Reason::Runtime(word) => word,
        })
    }
}

/// What a report says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Content {
    /// Where the task is.
    pub phase: Phase,
    /// The attempt this is about; 0 before the first.
    pub attempt: u32,
    /// How often it was started again.
    pub restarts: u32,
    /// Why.
    pub reason: Reason,
    /// For people.
    pub message: String,
    /// Of the last ended attempt, as a shell shows it.
    pub exit_code: Option<i32>,
    /// That ended the main process.
    pub signal: Option<i32>,
    /// When the attempt's program began.
    pub started_at: Option<Wall>,
    /// When the attempt's last process was gone.
    pub finished_at: Option<Wall>,
    /// Whether its probes say that it serves, true only while it runs; none of them says that: `None`.
    #[serde(default)]
    pub ready: Option<bool>,
    /// How many attempts have failed here.
    #[serde(default)]
    pub failed_attempts: u32,
}

/// A numbered report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Report {
    /// Grows with every change; 1 is the first.
    pub sequence: u64,
    /// What it says.
    pub content: Content,
}

impl Report {
    /// The report of a task that was just accepted.
    #[must_use]
    pub fn accepted() -> Report {
        Report {
            sequence: 1,
            content: Content {
                phase: Phase::Starting,
                attempt: 0,
                restarts: 0,
                reason: Reason::None,
                message: String::new(),
                exit_code: None,
                signal: None,
                started_at: None,
                finished_at: None,
                ready: None,
                failed_attempts: 0,
            },
        }
    }

    /// Takes `content` if it says something new. Returns whether it did.
    pub fn update(&mut self, content: Content) -> bool {
        if self.content == content {
            return false;
        }
        self.sequence += 1;
        self.content = content;
        true
    }
}

/// The reason and the text that an exit gives by itself.
#[must_use]
pub fn explain(exit: &Exit) -> (Reason, String) {
    if exit.disconnected {
        return (Reason::Disconnected, "ended after too long without the controller".to_owned());
    }
    // A child's death for memory that the program survived is no failure of the program.
    if exit.oom_killed && !exit.succeeded() {
        return (Reason::OomKilled, "the kernel killed it at its memory limit".to_owned());
    }
    match &exit.end {
        End::Exited(0) => (Reason::Completed, String::new()),
        End::Exited(code) => (Reason::Error, format!("exited with code {code}")),
        End::Signaled(signal) => (Reason::Error, format!("ended by signal {signal}")),
        End::NotStarted { message } => (Reason::StartError, message.clone()),
        End::Said { said, message, .. } => {
            let reason = match said {
                Said::Succeeded => Reason::Completed,
                Said::Failed => Reason::Error,
                Said::Killed => Reason::Killed,
            };
            (reason, message.clone())
        }
        End::Lost(Loss::Executor) => {
            (Reason::ExecutorLost, "its executor ended before it".to_owned())
        }
        End::Lost(Loss::Shim) => {
            (Reason::ShimLost, "its shim was killed; what was left of it was ended".to_owned())
        }
        End::Lost(Loss::Reboot) => {
            (Reason::NodeRebooted, "the machine was started anew while it ran".to_owned())
        }
        End::Lost(Loss::Container) => {
            (Reason::ContainerLost, "its container was removed by somebody else".to_owned())
        }
    }
}
