//! Chaos for real: a controller and three agents as processes in network namespaces of their own, while everything that can
//! happen to processes, disks, clocks and the network between them does.
//!
//! ```text
//!   writer ──REST──▶ controller ══wire══ robot-1 │ robot-2 │ cloud-1        one namespace each
//!      │               (tmpfs)                     (tmpfs)
//!      ▼                                   programs ──▶ witness: who started, what two held at once
//!   what was acknowledged, against what is there
//! ```
//!
//! | module | is |
//! |---|---|
//! | [`house`] | the cluster: processes, wires, disks, clocks |
//! | [`residents`] | tasks that are there all the time; what a fault must not touch |
//! | [`writer`] | applies, changes and deletes without a pause; everything that was acknowledged to it is looked for |
//! | [`witness`] | what the programs themselves wrote down, and what the kernel says |
//! | [`fault`] | what happens |
//! | [`report`] | what was measured, what was broken |
//!
//! A fault begins, ends, and the next one comes when the cluster has settled. The order is drawn by the seed; what happens
//! inside of a fault is as the machine has it. With `--seconds` it goes on for as long; every fault happens at least once.

mod fault;
mod house;
mod report;
mod residents;
mod witness;
mod writer;

use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::Parser;
use fault::Fault;
use house::House;
use muster_tests::dice::Dice;
use muster_tests::netns::Namespace;
use report::Report;

/// Breaks a real cluster in every way, and looks that it keeps what it promises
#[derive(Debug, Clone, Parser)]
struct Args {
    /// How long; every fault happens once in any case
    #[arg(long, default_value_t = 60)]
    seconds: u64,
    /// Draws the order of faults
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Only this fault
    #[arg(long, value_enum)]
    fault: Vec<Fault>,
    /// How many times longer than promised things may take, on a machine that has other work
    #[arg(long, default_value_t = 1.0)]
    slack: f64,
}

fn main() -> ExitCode {
    let args = Args::parse();
    // The controller's network is this one: whoever is started from here has it.
    let home = Namespace::new("home");
    let report = home.run(move || {
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build();
        runtime.expect("a runtime").block_on(run(&args))
    });
    report.print();
    if report.broken.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

async fn run(args: &Args) -> Report {
    let mut report = Report::new(args.slack);
    let mut house = House::build().await;
    residents::move_in(&mut house).await;
    house.settle(&mut report, None).await;
    let writer = writer::Writer::begin(&house).await;
    let mut dice = Dice::new(args.seed);
    let begun = Instant::now();
    let all = if args.fault.is_empty() { Fault::ALL.to_vec() } else { args.fault.clone() };
    loop {
        let mut deck = all.clone();
        dice.shuffle(&mut deck);
        for fault in deck {
            let last = begun.elapsed() >= Duration::from_secs(args.seconds);
            if last && report.has_seen(&all) {
                break;
            }
            fault::happen(fault, &mut house, &mut dice, &mut report).await;
            residents::check(&house, &mut report).await;
            writer.check(&mut report).await;
        }
        if begun.elapsed() >= Duration::from_secs(args.seconds) {
            break;
        }
    }
    let wrote = writer.end(&mut report).await;
    report.wrote(wrote);
    residents::check(&house, &mut report).await;
    residents::move_out(&house, &mut report).await;
    witness::check(&house, &mut report);
    report.lasted = begun.elapsed();
    if !report.broken.is_empty() {
        house.keep();
    }
    report
}
