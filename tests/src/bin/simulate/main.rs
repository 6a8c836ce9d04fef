//! The deterministic simulation: a whole cluster in one thread, with faults, and the invariants of DESIGN §4 after every step.
//!
//! ```text
//!   people ──REST──▶ controller ◀──net── agents ──▶ kernels
//!   frameworks ──net──▶  │                  │          │
//!                      disk               disks      truth ── what really runs ──▶ invariants
//! ```
//!
//! | real, as in production | modelled |
//! |---|---|
//! | the controller but its port: REST handlers, every reconciler, sessions, the store with its one writer | the disk under the store; TLS and gRPC: messages are handed over |
//! | the agent's core: workloads, restarts, plans of assignments, the journal; decoding of assignments, reports | the agent's driver, supervisor and link, which carry out what the core decides; shims, kernels, disks |
//! | the gate's core; what the agent wants of its gate, and tells of its standing | the gate's process, its disk and connections; drivers |
//!
//! One seed and one number of steps are one run, whatever else the machine does: time stands until somebody waits for it, and
//! randomness is the seed's (see [`dice`]). So a run is repeated by its seed, and shortened by leaving steps out.
//!
//! Not in it: executors, probes, containers and images, mission locks, and quotas as the kernel measures them (invariant 7).

mod action;
mod agenda;
mod agent;
mod applications;
mod controller;
mod dice;
mod drive;
mod fleet;
mod framework;
mod invariant;
mod kernel;
mod log;
mod mutation;
mod net;
mod run;
mod sets;
mod settle;
mod shrink;
mod truth;
mod users;
mod view;
mod wiring;
mod world;

use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::Parser;
use mutation::Mutation;
use run::Plan;

/// Runs simulated clusters with faults and holds them to their invariants
#[derive(Debug, Parser)]
struct Args {
    /// The seed of the first run; each further run has the next one
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Steps in all
    #[arg(long, default_value_t = 10_000)]
    steps: u64,
    /// Steps of one run
    #[arg(long, default_value_t = 1_000, value_name = "STEPS")]
    run: u64,
    /// Begin no run after so long, though steps are left
    #[arg(long, value_name = "SECONDS")]
    within: Option<u64>,
    /// Runs beside each other [default: one a core]
    #[arg(long)]
    jobs: Option<usize>,
    /// Do only these steps of a run, as a shortened failure names them
    #[arg(long, value_delimiter = ',', value_name = "STEP,…")]
    only: Option<Vec<u64>>,
    /// Do not shorten a run that breaks an invariant
    #[arg(long)]
    no_shrink: bool,
    /// Print the whole log of a run; with --steps of at most one run
    #[arg(long)]
    log: bool,
    /// Plant a fault in the simulation's wiring, to see that it is found
    #[arg(long, value_enum, value_name = "KIND")]
    mutate: Option<Mutation>,
    /// One run here, its outcome as JSON
    #[arg(long, hide = true)]
    one: bool,
}

fn main() -> ExitCode {
    let args = Args::parse();
    let only = args.only.map(|steps| steps.into_iter().collect());
    let steps = if args.one { args.steps } else { args.steps.min(args.run) };
    let plan = Plan { seed: args.seed, steps, only, mutation: args.mutate };
    if args.one {
        run::say(&run::here(&plan, args.log));
        return ExitCode::SUCCESS;
    }
    if args.log {
        let (outcome, log) = run::apart(&plan, true);
        println!("{log}\ndigest {:016x}", outcome.digest);
        return conclude(&plan, outcome.broken.is_some().then_some(&outcome), false);
    }
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let begun = Instant::now();
    let runs = args.steps.div_ceil(plan.steps.max(1));
    let until = args.within.map(|seconds| begun + Duration::from_secs(seconds));
    let sum = fleet::sweep(&plan, (runs, until), args.jobs.unwrap_or(cores));
    sum.print(begun.elapsed());
    conclude(&plan, sum.broken.as_ref(), !args.no_shrink)
}

/// Says what broke, how to see it again, and with `shorten` the log of a run that is as short as it gets.
fn conclude(plan: &Plan, broken: Option<&run::Outcome>, shorten: bool) -> ExitCode {
    let Some(outcome) = broken else { return ExitCode::SUCCESS };
    if let Some((invariant, how, step)) = &outcome.broken {
        println!("{invariant} is broken by seed {} at step {step}: {how}", outcome.seed);
    }
    if shorten {
        let plan = shrink::shrink(&Plan { seed: outcome.seed, ..plan.clone() }, outcome);
        let (short, log) = run::apart(&plan, true);
        println!("{log}");
        let list = plan.only.iter().flatten().map(u64::to_string).collect::<Vec<_>>().join(",");
        let mutate = plan.mutation.map(|m| format!(" --mutate {m}")).unwrap_or_default();
        println!(
            "again ({} of {} steps): simulate --seed {}{mutate} --steps {} --run {} --only {list} --log",
            plan.only.as_ref().map_or(0, std::collections::BTreeSet::len),
            short.done + short.skipped,
            plan.seed,
            plan.steps,
            plan.steps,
        );
    }
    ExitCode::FAILURE
}
