//! What the controller wants of one task, reduced to what decisions depend on.

use serde::{Deserialize, Serialize};

use crate::depend::Dependency;
use crate::probe::Probes;

/// When a task whose main process ended starts again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum RestartPolicy {
    /// Never: its first end is its end.
    Never,
    /// After a failure.
    OnFailure,
    /// After every end.
    Always,
}

/// The controller's order to end a task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopOrder {
    /// Time between SIGTERM and SIGKILL, milliseconds.
    pub grace_ms: u64,
    /// Why, for people (`Deleted`, `Preempted` …).
    pub reason: String,
}

/// When the processes of a task that must end are signalled, counted from the order on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StopTimes {
    /// SIGTERM, milliseconds. 0 but for executors, which are asked first.
    pub signal_ms: u64,
    /// SIGKILL, milliseconds; what the task has in all.
    pub kill_ms: u64,
}

/// What the controller wants of one task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Desired {
    /// When to start it again.
    pub restart: RestartPolicy,
    /// Its own grace period, used when it is ended without an order (milliseconds).
    pub grace_ms: u64,
    /// Present: it may run only while the controller was in contact within this time
    /// (`onDisconnect: Stop`), milliseconds.
    pub stop_after_ms: Option<u64>,
    /// Present: it stands by. Its first attempt begins when this is taken away, or when there was no contact with the
    /// controller for so long, milliseconds.
    #[serde(default)]
    pub standby_ms: Option<u64>,
    /// What is looked at while it runs.
    #[serde(default)]
    pub probes: Probes,
    /// Tasks that must have come so far before an attempt begins.
    #[serde(default)]
    pub depends: Vec<Dependency>,
    /// Present: so many attempts may fail here, and the last of them is its end, whatever `restart` says.
    #[serde(default)]
    pub attempts: Option<u32>,
    /// Present: it must end.
    pub stop: Option<StopOrder>,
}

impl Desired {
    /// A task that is not started again, may run without contact, is not looked at, and waits for nobody.
    #[must_use]
    pub fn once(grace_ms: u64) -> Desired {
        let (restart, probes) = (RestartPolicy::Never, Probes::default());
        Desired {
            restart,
            grace_ms,
            stop_after_ms: None,
            standby_ms: None,
            probes,
            depends: Vec::new(),
            attempts: None,
            stop: None,
        }
    }
}
