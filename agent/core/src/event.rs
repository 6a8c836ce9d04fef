//! What goes into a [`Workload`](crate::workload::Workload) and what comes out of it.

use crate::depend::Standing;
use crate::desired::Desired;
use crate::observed::{Exit, Observed, Started};
use crate::probe::Verdict;
use crate::time::{Boot, Now};

/// Why a runtime did not do its part. Nothing of the task ran.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// One CamelCase word.
    pub reason: String,
    /// For people.
    pub message: String,
    /// Whether trying again later makes sense.
    pub retry: bool,
}

/// What happened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event {
    /// The controller wants this now (whole).
    Assigned(Desired),
    /// It is not among what this node should have: it ends, and its end is told until the controller
    /// forgets it.
    Unassigned,
    /// The controller wants it ended and forgotten, or has recorded its end.
    Forgotten,
    /// Time passed, or contact came back.
    Tick,
    /// A runtime answered about the attempt of this number.
    Attempt(u32, Outcome),
    /// The probes of the running attempt of this number say something new.
    Probed(u32, Verdict),
    /// The tasks that it waits for stand so.
    Dependencies(Standing),
    /// The gate gives its right to drive back: it drove, and is silent.
    GivenBack,
    /// Everything of it is removed.
    Removed,
    /// Something of it could not be removed.
    RemoveFailed,
}

/// A runtime's answer about one attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// What it needs is here.
    Prepared,
    /// What it needs could not be had.
    PrepareFailed(Failure),
    /// Its program runs.
    Launched(Started),
    /// It was not started, and will not be.
    LaunchFailed(Failure),
    /// It was not started, and will not be before what it needs has been fetched.
    Unprepared(Failure),
    /// Nobody knows whether it was started.
    LaunchUnclear,
    /// What was found of it.
    Found(Observed),
    /// The runtime could not say.
    FindFailed,
    /// It ended; no process of it is left.
    Exited(Exit),
    /// The order to stop was not taken.
    StopFailed,
}

/// What the executor must do, in this order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Effect {
    /// Make the workload durable. Before everything that acts.
    Persist,
    /// Show the report to whoever sends it.
    Publish,
    /// Fetch what the attempt needs; answers `Prepared` or `PrepareFailed`.
    Prepare(u32),
    /// Forget a `Prepare` that may be under way.
    CancelPrepare,
    /// Start the attempt; answers `Launched`, `LaunchFailed`, `LaunchUnclear` or `Exited`.
    Launch(u32),
    /// Watch the attempt to its end; answers `Exited`.
    Watch(u32),
    /// Ask what became of the attempt; answers `Found` or `FindFailed`.
    Find(u32),
    /// End the attempt; answers only if that fails.
    Stop {
        /// Which.
        attempt: u32,
        /// Until SIGKILL.
        grace_ms: u64,
    },
    /// Send a tick then.
    WakeAt(Boot),
    /// Withdraw the report and remove everything of the task; answers `Removed` or `RemoveFailed`.
    Remove,
    /// Nothing of the task is left here: drop its record too.
    Drop,
}

/// What [`Workload::handle`](crate::workload::Workload::handle) wants done.
#[must_use = "effects that are not carried out leave the task stuck"]
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Response {
    /// In this order.
    pub effects: Vec<Effect>,
}

/// What a decision may look at besides the workload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Context {
    /// The time.
    pub now: Now,
    /// When the last message was sent whose answer came back; none since boot: `None`.
    pub contact: Option<Boot>,
}
