//! When an ended task starts again. Deterministic: the same history gives the same delay.

use crate::desired::RestartPolicy;
use crate::observed::{End, Exit, Loss};

/// First delay. Short, since most first failures are a race at start-up.
pub const BASE_MS: u64 = 1_000;

/// Longest delay: a robot that is repaired should not wait longer for its task.
pub const CAP_MS: u64 = 5 * 60 * 1_000;

/// An attempt that ran this long was healthy; the count of failures starts anew.
pub const HEALTHY_MS: u64 = 10 * 60 * 1_000;

/// Whether `exit` is followed by another attempt.
#[must_use]
pub fn restarts(policy: RestartPolicy, exit: &Exit) -> bool {
    if exit.disconnected {
        // The controller may have given its actuators to another by now: it alone may start it again.
        return false;
    }
    match policy {
        RestartPolicy::Never => false,
        RestartPolicy::OnFailure => !exit.succeeded(),
        RestartPolicy::Always => true,
    }
}

/// Failures in a row, `exit` included.
#[must_use]
pub fn failures_after(failures: u32, exit: &Exit) -> u32 {
    if exit.end == End::Lost(Loss::Reboot) {
        return failures;
    }
    let before = if exit.ran_ms() >= HEALTHY_MS { 0 } else { failures };
    before.saturating_add(1)
}

/// `1 s · 2^(failures − 1)`, at most [`CAP_MS`]; none without a failure.
#[must_use]
pub fn delay_ms(failures: u32) -> u64 {
    match failures {
        0 => 0,
        // 2^9 s is above the cap already.
        1..=9 => (BASE_MS << (failures - 1)).min(CAP_MS),
        _ => CAP_MS,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::Wall;

    fn exit(code: i32, ran_ms: i64) -> Exit {
        Exit {
            end: End::Exited(code),
            oom_killed: false,
            disconnected: false,
            started_at: Some(Wall(0)),
            finished_at: Wall(ran_ms),
        }
    }

    #[test]
    fn delays_double_up_to_the_cap() {
        let delays: Vec<u64> = (0..12).map(delay_ms).collect();
        assert_eq!(delays[..5], [0, 1_000, 2_000, 4_000, 8_000]);
        assert_eq!(delays[9], 256_000);
        assert_eq!(delays[10..], [CAP_MS, CAP_MS]);
        assert_eq!(delay_ms(u32::MAX), CAP_MS);
    }

    #[test]
    fn a_long_run_forgives() {
        assert_eq!(failures_after(7, &exit(1, 1_000)), 8);
        assert_eq!(failures_after(7, &exit(1, HEALTHY_MS as i64)), 1);
    }

    #[test]
    fn policies() {
        for (policy, success, failure) in [
            (RestartPolicy::Never, false, false),
            (RestartPolicy::OnFailure, false, true),
            (RestartPolicy::Always, true, true),
        ] {
            assert_eq!(restarts(policy, &exit(0, 1)), success, "{policy:?}");
            assert_eq!(restarts(policy, &exit(3, 1)), failure, "{policy:?}");
            let disconnected = Exit { disconnected: true, ..exit(3, 1) };
            assert!(!restarts(policy, &disconnected), "{policy:?}");
        }
    }
}
