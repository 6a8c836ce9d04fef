//! What a runtime saw of one attempt of a task.

use serde::{Deserialize, Serialize};

use crate::time::Wall;

/// An attempt whose main process was started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Started {
    /// When its program began.
    pub at: Wall,
}

/// Why nobody can know how an attempt ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Loss {
    /// Its shim was killed; the agent ended what was left.
    Shim,
    /// The machine was started anew while it ran.
    Reboot,
    /// Its container was removed by somebody else.
    Container,
    /// The executor that ran it ended before it.
    Executor,
}

/// What an executor says of a work that is over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Said {
    /// It did what it was for.
    Succeeded,
    /// It did not.
    Failed,
    /// It was ended.
    Killed,
}

/// How an attempt ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum End {
    /// The main process returned this code.
    Exited(i32),
    /// A signal ended the main process.
    Signaled(i32),
    /// The program could not be started; nothing of it ever ran.
    NotStarted {
        /// The kernel's or the engine's words.
        message: String,
    },
    /// Its executor's word for it.
    Said {
        /// How it ended.
        said: Said,
        /// What its program returned, if it had one.
        code: Option<i32>,
        /// The executor's own words.
        message: String,
    },
    /// It is gone, and its status with it.
    Lost(Loss),
}

/// An attempt of which no process is left.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Exit {
    /// How.
    pub end: End,
    /// The kernel killed a process of it for memory.
    pub oom_killed: bool,
    /// It was ended because contact with the controller was lost for too long.
    pub disconnected: bool,
    /// When its program began, if it did.
    pub started_at: Option<Wall>,
    /// When the last of its processes was gone.
    pub finished_at: Wall,
}

impl Exit {
    /// The exit code as a shell would show it: a signal is 128 + its number.
    #[must_use]
    pub fn code(&self) -> Option<i32> {
        match self.end {
            End::Exited(code) => Some(code),
            End::Signaled(signal) => Some(128 + signal),
            End::Said { code, .. } => code,
            End::NotStarted { .. } | End::Lost(_) => None,
        }
    }

    /// The signal that ended the main process.
    #[must_use]
    pub fn signal(&self) -> Option<i32> {
        match self.end {
            End::Signaled(signal) => Some(signal),
            End::Exited(_) | End::NotStarted { .. } | End::Said { .. } | End::Lost(_) => None,
        }
    }

    /// Whether the program says that it did what it was for.
    #[must_use]
    pub fn succeeded(&self) -> bool {
        let well = matches!(self.end, End::Exited(0) | End::Said { said: Said::Succeeded, .. });
        well && !self.disconnected
    }

    /// How long it ran, milliseconds; 0 when it never did or the clock went backwards.
    #[must_use]
    pub fn ran_ms(&self) -> u64 {
        let Some(started) = self.started_at else { return 0 };
        u64::try_from(self.finished_at.0 - started.0).unwrap_or(0)
    }
}

/// What a runtime finds of an attempt after the agent was started anew.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Observed {
    /// Nothing of it was ever started, and nothing will be.
    NeverStarted,
    /// It runs.
    Running(Started),
    /// It ended, and nothing of it is left.
    Ended(Exit),
}
