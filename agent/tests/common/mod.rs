//! What the agent's tests stand on: a controller that does what the test says ([`controller`]), agents as
//! real processes ([`agent`]), frameworks that come directly ([`framework`]), the kernel's accounts ([`cpu`]), and looking until something is so ([`until`]).
#![allow(dead_code, reason = "each test binary uses its own part")]
#![allow(
    clippy::unwrap_used,
    clippy::allow_attributes,
    missing_debug_implementations,
    unreachable_pub,
    reason = "tests"
)]

pub mod agent;
pub mod controller;
pub mod cpu;
pub mod executor;
pub mod framework;
pub mod gate;

use std::time::{Duration, Instant};

/// Generous: the machine may be compiling something else.
pub const PATIENCE: Duration = Duration::from_secs(40);

/// Looks until there is something.
#[track_caller]
pub fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let begun = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(begun.elapsed() < PATIENCE, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Whether a process lives (a zombie does not).
pub fn lives(pid: i32) -> bool {
    std::fs::read_to_string(format!("/proc/{pid}/stat"))
        .is_ok_and(|stat| !stat[stat.rfind(')').unwrap()..].starts_with(") Z"))
}

/// Start time of a process, clock ticks since boot.
#[track_caller]
pub fn start_time(pid: i32) -> u64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    stat[stat.rfind(')').unwrap() + 1..].split_whitespace().nth(19).unwrap().parse().unwrap()
}
