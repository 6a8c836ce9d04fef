//! `muster workload`: programs for robots to run. Avalon's four workloads (II and V-A) do the real
//! work of their kind on frames of simulated sensors; the probes do one simple thing for tests.
//!
//! ```text
//!   scene, gmapping::world ──frame──▶ a Work ──▶ progress, one JSON line a second on stdout
//!   clock (cpu time) ──▶ pace (what rate holds the cpu share) ──▶ run (frame clock) ──▲
//! ```
//!
//! | module | holds |
//! |---|---|
//! | `clock` | cpu time of this process; SIGTERM as a flag one can wait for |
//! | `pace` | pure: cost of a frame → rate and units; the slow correction |
//! | `run` | the frame clock and its statistics |
//! | `scene`, `rng` | camera frames; seeded randomness |
//! | `gmapping`, `monitoring`, `recognition` | the three workloads of the paper's Fig. 2 and 5 |
//! | `training` | what recognition's framework keeps in the cloud |
//! | `drive` | another task that wants the base |
//! | `exit` | exit codes, the same as the command's |
//! | `probe` | spin, allocate, ignore-term, exit, io |
//!
//! Everything random comes from `--seed`; only rates and latencies differ between runs.

mod clock;
mod drive;
mod exit;
mod gmapping;
mod monitoring;
mod pace;
mod probe;
mod recognition;
mod rng;
mod run;
mod scene;
mod training;

/// Run a program for robots: Avalon's workloads, and probes for tests
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    workload: Workload,
}

#[derive(Debug, clap::Subcommand)]
enum Workload {
    /// Map rooms by laser with a Rao-Blackwellized particle filter, while driving (AR-CR-SR)
    Gmapping(gmapping::Args),
    /// Compress camera frames and send them (SR)
    Monitoring(monitoring::Args),
    /// Classify camera frames with a residual network (CR-SR)
    Recognition(recognition::Args),
    /// Train a network on labelled frames (CR)
    Training(training::Args),
    /// Drive a robot along a path (AR)
    Drive(drive::Args),
    /// Use as much cpu as there is
    Spin(probe::Spin),
    /// Touch memory, then sleep
    Allocate(probe::Allocate),
    /// Stay on when asked to end, with a child that does the same
    IgnoreTerm(probe::IgnoreTerm),
    /// End by itself with a code
    Exit(probe::Exit),
    /// Write a file past the page cache and read it back
    Io(probe::Io),
}

/// Runs it to its end, and returns the exit code. Blocks; needs no runtime of the caller's.
pub fn run(args: Args) -> u8 {
    match args.workload {
        Workload::Gmapping(args) => gmapping::run(&args),
        Workload::Monitoring(args) => monitoring::run(&args),
        Workload::Recognition(args) => recognition::run(&args),
        Workload::Training(args) => training::run(&args),
        Workload::Drive(args) => drive::run(&args),
        Workload::Spin(args) => probe::spin(&args),
        Workload::Allocate(args) => probe::allocate(&args),
        Workload::IgnoreTerm(args) => probe::ignore_term(&args),
        Workload::Exit(args) => probe::exit(&args),
        Workload::Io(args) => probe::io(&args),
    }
}
