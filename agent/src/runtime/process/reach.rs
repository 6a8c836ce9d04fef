//! All processes of one attempt, however they are found, and the ladder that ends them.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use muster_agent_core::desired::StopTimes;
use muster_api::kind::task::StopSignal;

use super::scan;
use crate::runtime::cgroup::group::Group;
use crate::runtime::launch::{AttemptId, Used};

/// The environment variable that marks the processes of an attempt, whole.
pub(crate) fn mark(id: &AttemptId) -> String {
    format!("MUSTER_ATTEMPT_ID={id}")
}

/// How the processes of an attempt are found.
#[derive(Debug, Clone)]
pub(crate) enum Reach {
    /// By the kernel: nothing escapes.
    Group(Group),
    /// By looking, for want of a group.
    Tree { shim: i32, session: Option<i32>, mark: String },
}

impl Reach {
    pub(crate) fn pids(&self) -> BTreeSet<i32> {
        match self {
            Reach::Group(group) => group.pids(),
            Reach::Tree { shim, session, mark } => scan::tree(*shim, *session, mark),
        }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.pids().is_empty()
    }

    pub(crate) fn terminate(&self, signal: StopSignal) {
        let signal = match signal {
            StopSignal::SigTerm => libc::SIGTERM,
            StopSignal::SigInt => libc::SIGINT,
            StopSignal::SigQuit => libc::SIGQUIT,
            StopSignal::SigHup => libc::SIGHUP,
            StopSignal::SigUsr1 => libc::SIGUSR1,
            StopSignal::SigUsr2 => libc::SIGUSR2,
        };
        for pid in self.pids() {
            // SAFETY: kill takes no pointers. A pid that ended meanwhile is no error here.
            unsafe { libc::kill(pid, signal) };
        }
    }

    pub(crate) fn kill(&self) {
        match self {
            Reach::Group(group) => group.kill(),
            Reach::Tree { .. } => {
                for pid in self.pids() {
                    // SAFETY: as above.
                    unsafe { libc::kill(pid, libc::SIGKILL) };
                }
            }
        }
    }

    pub(crate) fn oom_kills(&self) -> u64 {
        match self {
            Reach::Group(group) => group.oom_kills(),
            Reach::Tree { .. } => 0,
        }
    }

    pub(crate) fn used(&self) -> Option<Used> {
        match self {
            Reach::Group(group) => group.used(),
            Reach::Tree { .. } => {
                let (cpu_usec, memory_bytes) = scan::usage(&self.pids());
                Some(Used { cpu_usec, memory_bytes })
            }
        }
    }
}

/// Where the ladder stands. It only goes up.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Ladder {
    /// Nobody asked for an end.
    Idle,
    /// It may end by itself until the signal is due that asks it to.
    Asked { signal: Instant, until: Instant },
    /// That was sent; SIGKILL follows at the deadline.
    Terminating { until: Instant },
    /// SIGKILL until nothing is left.
    Killing { pause: Duration },
}

/// First and longest pause between two rounds of SIGKILL. A process in an uninterruptible wait
/// dies only when the kernel lets it; asking it more often helps nobody.
const KILL_PAUSE: (Duration, Duration) = (Duration::from_millis(1), Duration::from_millis(200));

impl Ladder {
    /// A later call can only bring the deadlines nearer. [`Ladder::step`] does what is due.
    pub(crate) fn stop(&mut self, times: StopTimes) {
        let after = |ms| Instant::now() + Duration::from_millis(ms);
        let (term, kill) = (after(times.signal_ms), after(times.kill_ms));
        match self {
            Ladder::Idle => *self = Ladder::Asked { signal: term, until: kill },
            Ladder::Asked { signal, until } => {
                (*signal, *until) = ((*signal).min(term), (*until).min(kill));
            }
            Ladder::Terminating { until } => *until = (*until).min(kill),
            Ladder::Killing { .. } => {}
        }
    }

    /// Nobody is left who could end by itself: the signal is due.
    pub(crate) fn signal_now(&mut self) {
        if let Ladder::Asked { signal, .. } = self {
            *signal = Instant::now();
        }
    }

    /// SIGKILL from now on.
    pub(crate) fn kill(&mut self) {
        if !matches!(self, Ladder::Killing { .. }) {
            *self = Ladder::Killing { pause: KILL_PAUSE.0 };
        }
    }

    /// Does what is due; `stop` asks for an end. Returns how long nothing more will be.
    pub(crate) fn step(&mut self, reach: &Reach, stop: StopSignal) -> Option<Duration> {
        if let Ladder::Asked { signal, until } = *self {
            let left = signal.saturating_duration_since(Instant::now());
            if !left.is_zero() {
                return Some(left);
            }
            reach.terminate(stop);
            *self = Ladder::Terminating { until };
        }
        if let Ladder::Terminating { until } = *self {
            let left = until.saturating_duration_since(Instant::now());
            if !left.is_zero() {
                return Some(left);
            }
            self.kill();
        }
        let Ladder::Killing { pause } = self else { return None };
        reach.kill();
        let now = *pause;
        *pause = (*pause * 2).min(KILL_PAUSE.1);
        Some(now)
    }

    pub(crate) fn is_idle(self) -> bool {
        matches!(self, Ladder::Idle)
    }
}
