//! `muster demo`: Avalon's evaluation (V-A, Fig. 2 and 5) with real processes of this one binary: a
//! controller, two robots and a cloud server, in a directory that is gone afterwards.
//!
//! ```text
//!   house ── starts and ends the processes        scenario ── the manifests
//!     └─ api ── REST of the controller ──┐            │
//!   play ── alone, two, three, more ─────┴─▶ measure ─▶ figures ─▶ check ─▶ print
//! ```
//!
//! | module | holds |
//! |---|---|
//! | [`house`] | the processes and their directory; ends all of them, however the demo ends |
//! | [`groups`] | the control groups that agents leave behind |
//! | [`api`] | what is asked of the controller |
//! | [`scenario`] | nodes and manifests, and the paper's figures |
//! | [`play`] | the course of events |
//! | [`measure`] | counters of the kernel and lines of the workloads → shares and rates |
//! | [`figures`], [`check`] | pure: rows, totals, what must hold |
//! | [`mod@print`] | what people and programs see |

mod api;
mod check;
mod figures;
mod groups;
mod house;
mod measure;
mod play;
mod print;
mod scenario;

use std::time::Duration;

use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::error::CliError;
use crate::exit;
use crate::output::ui::Ui;
use house::House;
use print::Out;

/// Show one robot shared by three workloads, with processes of this program alone
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// End after the table; exit code 0 only if everything was as it should be
    #[arg(long)]
    once: bool,
    /// How to print the result
    #[arg(short, long, value_enum, default_value_t, value_name = "FORMAT")]
    output: Format,
    /// Seconds of each measurement
    #[arg(long, value_name = "SECONDS", default_value_t = 9, value_parser = clap::value_parser!(u64).range(2..=600))]
    measure: u64,
    /// Keep the directory with logs and data
    #[arg(long)]
    keep: bool,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
enum Format {
    /// A table, for people
    #[default]
    Table,
    /// Everything, for programs; what happens meanwhile goes to standard error
    Json,
}

/// Exit code of a program that SIGINT ended, as shells give it.
const INTERRUPTED: u8 = 130;

/// Why the demo could not go on.
#[derive(Debug, thiserror::Error)]
pub(crate) enum DemoError {
    /// The file system, or the system's processes.
    #[error("cannot {what}")]
    System { what: &'static str, source: std::io::Error },
    /// A daemon is not there any more.
    #[error("the {name} ended by itself")]
    Died { name: String },
    /// Something did not come in time.
    #[error("waited {} s for {what}", after.as_secs())]
    Late { what: String, after: Duration },
    /// A task ended that should run.
    #[error("task {name} ended: {reason}")]
    TaskEnded { name: String, reason: String },
}

impl From<DemoError> for CliError {
    fn from(error: DemoError) -> Self {
        CliError::Daemon { name: "demo", source: Box::new(error) }
    }
}

/// Runs the demo to its end and puts everything away. Makes its own runtime.
pub(crate) fn run(args: &Args, ui: &mut Ui) -> Result<u8, CliError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|source| DemoError::System { what: "start", source })?;
    runtime.block_on(show(args, ui))
}

async fn show(args: &Args, ui: &mut Ui) -> Result<u8, CliError> {
    let mut signals = Signals::listen()?;
    let mut out = Out::new(ui, args.output == Format::Json);
    let mut house = House::open(args.keep)?;
    // Whatever ends the play, dropping it half way included, the house is put in order afterwards.
    let played = tokio::select! {
        played = play::play(args, &mut house, &mut out) => played,
        () = signals.next() => Ok(INTERRUPTED),
    };
    // A daemon that is gone is why nobody answers, and its log says more.
    let played = match (played, house.all_alive()) {
        (Err(CliError::Unreachable { .. }), Err(died)) => Err(died.into()),
        (played, _) => played,
    };
    out.clear();
    if let Some(log) = house.last_words() {
        out.note(&log);
    }
    if matches!(played, Ok(INTERRUPTED)) {
        out.note("ending: tasks first, then agents, then the controller");
    }
    tokio::select! {
        left = house.end() => left.iter().for_each(|line| out.note(line)),
        // Somebody is in a hurry: what is left is killed when the house is dropped.
        () = signals.next() => {}
    }
    drop(house);
    played
}

/// SIGINT, SIGTERM, and SIGHUP for a terminal that was closed.
struct Signals([Signal; 3]);

impl Signals {
    fn listen() -> Result<Self, DemoError> {
        let on = |kind| {
            signal(kind).map_err(|source| DemoError::System { what: "listen for signals", source })
        };
        let (interrupt, terminate) = (SignalKind::interrupt(), SignalKind::terminate());
        Ok(Signals([on(interrupt)?, on(terminate)?, on(SignalKind::hangup())?]))
    }

    /// Cancel-safe: a signal that was not waited for yet is kept.
    async fn next(&mut self) {
        let [interrupt, terminate, hangup] = &mut self.0;
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
            _ = hangup.recv() => {}
        }
    }
}

/// The demo's exit code: whether everything was as it should be.
fn verdict(checks: &[check::Check]) -> u8 {
    if checks.iter().any(|check| check.passed == Some(false)) { exit::FAILURE } else { exit::OK }
}
