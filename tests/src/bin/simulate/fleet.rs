//! Many runs beside each other, and what came of all of them.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::run::{self, Outcome, Plan};

/// The sum of many runs.
#[derive(Debug, Default)]
pub(crate) struct Sum {
    pub(crate) runs: u64,
    done: u64,
    skipped: u64,
    simulated: u64,
    writes: u64,
    messages: u64,
    /// The one with the lowest seed of those that broke an invariant.
    pub(crate) broken: Option<Outcome>,
}

impl Sum {
    fn add(&mut self, outcome: Outcome) {
        self.runs += 1;
        self.done += outcome.done;
        self.skipped += outcome.skipped;
        self.simulated += outcome.simulated;
        self.writes += outcome.writes;
        self.messages += outcome.messages;
        let lower = |known: &Outcome| known.seed > outcome.seed;
        if outcome.broken.is_some() && self.broken.as_ref().is_none_or(lower) {
            self.broken = Some(outcome);
        }
    }

    /// In two lines.
    pub(crate) fn print(&self, took: Duration) {
        let steps = self.done + self.skipped;
        let seconds = took.as_secs_f64().max(0.001);
        let hours = Duration::from_millis(self.simulated).as_secs_f64() / 3600.0;
        println!(
            "{} runs, {steps} steps ({} skipped: nothing to do them to) in {seconds:.1} s: {:.1} runs/s, {:.0} steps/s",
            self.runs,
            self.skipped,
            self.runs as f64 / seconds,
            steps as f64 / seconds,
        );
        println!(
            "{hours:.1} simulated hours, {} writes acknowledged, {} messages carried, {} violations",
            self.writes,
            self.messages,
            u64::from(self.broken.is_some()),
        );
    }
}

/// Runs the seeds from `first.seed` on, `jobs` at a time; none begins after one has broken an invariant, or after `until`.
pub(crate) fn sweep(first: &Plan, (runs, until): (u64, Option<Instant>), jobs: usize) -> Sum {
    let (next, stop) = (AtomicU64::new(0), AtomicBool::new(false));
    let sum = Mutex::new(Sum::default());
    let said = Mutex::new(Instant::now());
    std::thread::scope(|scope| {
        for _ in 0..jobs.max(1) {
            scope.spawn(|| {
                let late = || until.is_some_and(|until| Instant::now() >= until);
                while !stop.load(Ordering::Relaxed) && !late() {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    if index >= runs {
                        return;
                    }
                    let plan = Plan { seed: first.seed + index, ..first.clone() };
                    let (outcome, _) = run::apart(&plan, false);
                    if outcome.broken.is_some() {
                        stop.store(true, Ordering::Relaxed);
                    }
                    let mut sum = sum.lock().unwrap_or_else(PoisonError::into_inner);
                    sum.add(outcome);
                    let mut said = said.lock().unwrap_or_else(PoisonError::into_inner);
                    if said.elapsed() > Duration::from_secs(10) {
                        *said = Instant::now();
                        eprintln!("{} of {runs} runs", sum.runs);
                    }
                }
            });
        }
    });
    sum.into_inner().unwrap_or_else(PoisonError::into_inner)
}
