//! One run, in a process of its own: nothing that is left of one changes another.

use std::collections::BTreeSet;
use std::io::Write as _;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::mutation::Mutation;
use crate::world::World;
use crate::{dice, invariant::Violation};

/// A step that takes longer than this, on whatever machine, never ends.
const HANGS_AFTER: Duration = Duration::from_secs(120);
/// How the C library's allocator is set up for a run.
const TUNABLES: &str = "glibc.malloc.trim_threshold=1073741824:glibc.malloc.mmap_threshold=1073741824:\
     glibc.malloc.top_pad=67108864:glibc.malloc.tcache_count=200";
/// What begins the line with a run's outcome.
const MARK: &str = "outcome ";

/// What is to be run.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    pub(crate) seed: u64,
    pub(crate) steps: u64,
    /// Of these, only those; none: all.
    pub(crate) only: Option<BTreeSet<u64>>,
    pub(crate) mutation: Option<Mutation>,
}

/// What came of it.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Outcome {
    pub(crate) seed: u64,
    /// Of the whole log.
    pub(crate) digest: u64,
    pub(crate) done: u64,
    pub(crate) skipped: u64,
    /// Simulated, milliseconds.
    pub(crate) simulated: u64,
    /// Answered 2xx.
    pub(crate) writes: u64,
    pub(crate) messages: u64,
    /// Name and words of the broken invariant, and at which step.
    pub(crate) broken: Option<(String, String, u64)>,
}

static PANIC: Mutex<Option<String>> = Mutex::new(None);
static PROGRESS: AtomicU64 = AtomicU64::new(0);

/// The first panic of any part of the program, were it in a task of the controller that nobody joins.
pub(crate) fn panicked() -> Option<String> {
    PANIC.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

fn watch_for_panics() {
    std::panic::set_hook(Box::new(|info| {
        let mut first = PANIC.lock().unwrap_or_else(PoisonError::into_inner);
        first.get_or_insert_with(|| info.to_string().replace('\n', " "));
    }));
}

fn watch_for_hangs() {
    std::thread::spawn(|| {
        let mut seen = u64::MAX;
        loop {
            let now = PROGRESS.load(Ordering::Relaxed);
            if now == seen {
                eprintln!("step {now} does not end");
                std::process::exit(3);
            }
            seen = now;
            std::thread::sleep(HANGS_AFTER);
        }
    });
}

/// Runs it here. `aloud`: the whole log goes to stdout.
pub(crate) fn here(plan: &Plan, aloud: bool) -> Outcome {
    dice::seed_the_system(plan.seed);
    watch_for_panics();
    watch_for_hangs();
    let dir = tempfile::tempdir().expect("a directory for the controller's certificates");
    let mut world = World::new(plan.seed, plan.mutation, dir.path(), aloud);
    let wanted = |step: &u64| plan.only.as_ref().is_none_or(|only| only.contains(step));
    for step in (0..plan.steps).filter(wanted) {
        world.step(step);
        PROGRESS.store(step + 1, Ordering::Relaxed);
        if world.broken.is_some() {
            break;
        }
    }
    let last = world.log.step;
    world.settle();
    let broken = world
        .broken
        .as_ref()
        .map(|Violation { invariant, how }| (invariant.name().to_owned(), how.clone(), last));
    Outcome {
        seed: plan.seed,
        digest: world.log.digest(),
        done: world.tally.done,
        skipped: world.tally.skipped,
        simulated: world.now,
        writes: world.users.writes,
        messages: world.net.carried,
        broken,
    }
}

/// Says an outcome to the process that started this one.
pub(crate) fn say(outcome: &Outcome) {
    let json = serde_json::to_string(outcome).expect("an outcome is JSON");
    let mut out = std::io::stdout().lock();
    // Nobody reads it any more when whoever asked is gone.
    let _ = writeln!(out, "{MARK}{json}").and_then(|()| out.flush());
}

/// Runs it in a process of its own; gives the log as well.
pub(crate) fn apart(plan: &Plan, aloud: bool) -> (Outcome, String) {
    let mut command = std::process::Command::new(std::env::current_exe().expect("this program"));
    // Memory is kept: a run asks for and gives back the same few megabytes all the time.
    command.env("GLIBC_TUNABLES", TUNABLES);
    command.args(["--one", "--seed", &plan.seed.to_string(), "--steps", &plan.steps.to_string()]);
    if let Some(only) = &plan.only {
        let list: Vec<String> = only.iter().map(u64::to_string).collect();
        command.args(["--only", &list.join(",")]);
    }
    if let Some(mutation) = plan.mutation {
        command.args(["--mutate", &mutation.to_string()]);
    }
    if aloud {
        command.arg("--log");
    }
    let output = command.output().expect("this program starts");
    let text = String::from_utf8_lossy(&output.stdout);
    let said = text.lines().rev().find_map(|line| line.strip_prefix(MARK));
    let outcome = said.and_then(|json| serde_json::from_str(json).ok()).unwrap_or_else(|| {
        let words = String::from_utf8_lossy(&output.stderr).trim().to_owned();
        let broken =
            Some(("panicked".to_owned(), format!("{}: {words}", output.status), plan.steps));
        Outcome { seed: plan.seed, broken, ..Outcome::default() }
    });
    let log = text.lines().filter(|line| !line.starts_with(MARK));
    (outcome, log.collect::<Vec<_>>().join("\n"))
}
