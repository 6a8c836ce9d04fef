//! When a running attempt is checked, and what follows from the answers (Kubernetes' semantics).
//!
//! ```text
//! begin ──▶ start-up (if there is one) ── first success ──▶ readiness and liveness, side by side
//!              └─ failureThreshold ──▶ Failed                 └─ liveness: failureThreshold ──▶ Failed
//! ```
//!
//! A [`Prober`] belongs to one attempt and ends with it: an answer of an earlier one cannot reach it. Whoever drives it
//! asks what is [`due`](Prober::due), makes those checks, and hands each [`Answer`] back once; a check that is under way
//! is never due, so that none pile up. What must outlive the agent is in [`Verdicts`], which the task's
//! [`Workload`](crate::workload::Workload) keeps: another life of the agent goes on from them, and nothing changes
//! before the first new verdict.

#[cfg(test)]
mod tests;
pub mod topic;

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::time::Boot;

/// What a probe is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Role {
    /// Holds the others back until it has succeeded.
    Startup,
    /// Says whether the task serves.
    Readiness,
    /// Says whether the task is alive.
    Liveness,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Role::Startup => "start-up probe",
            Role::Readiness => "readiness probe",
            Role::Liveness => "liveness probe",
        })
    }
}

/// When one probe is made, and how many answers make a verdict.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Timing {
    /// From the start of the attempt to the first check, milliseconds.
    pub initial_delay_ms: u64,
    /// From one check to the next, milliseconds.
    pub period_ms: u64,
    /// Successes in a row.
    pub success_threshold: u32,
    /// Failures in a row.
    pub failure_threshold: u32,
}

/// The probes of a task.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Probes {
    /// See [`Role::Startup`].
    pub startup: Option<Timing>,
    /// See [`Role::Readiness`].
    pub readiness: Option<Timing>,
    /// See [`Role::Liveness`].
    pub liveness: Option<Timing>,
}

impl Probes {
    /// The probe of a role.
    #[must_use]
    pub fn of(&self, role: Role) -> Option<Timing> {
        match role {
            Role::Startup => self.startup,
            Role::Readiness => self.readiness,
            Role::Liveness => self.liveness,
        }
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        *self == Probes::default()
    }

    /// Whether they say if the task is ready; without, it is when it runs.
    #[must_use]
    pub fn tell_ready(&self) -> bool {
        self.startup.is_some() || self.readiness.is_some()
    }
}

/// What has been found of an attempt: not started up, not ready, alive. Durable.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Verdicts {
    /// Its start-up probe has succeeded.
    pub started: bool,
    /// Its readiness probe succeeds.
    pub ready: bool,
    /// What the check said that is to blame when it is not ready; empty: none has failed yet.
    pub why: String,
}

impl Verdicts {
    /// The probe that keeps the task from being ready; `None`: it is.
    #[must_use]
    pub fn missing(&self, probes: &Probes) -> Option<Role> {
        if probes.startup.is_some() && !self.started {
            Some(Role::Startup)
        } else if probes.readiness.is_some() && !self.ready {
            Some(Role::Readiness)
        } else {
            None
        }
    }

    /// Takes a verdict that does not end the attempt.
    pub fn take(&mut self, verdict: &Verdict) {
        match verdict {
            Verdict::Started => {
                self.started = true;
                self.why.clear();
            }
            Verdict::Ready => {
                self.ready = true;
                self.why.clear();
            }
            Verdict::NotReady { why } => {
                self.ready = false;
                self.why.clone_from(why);
            }
            Verdict::Failed { .. } => {}
        }
    }
}

/// What came of one check.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// All is well.
    Success,
    /// It is not, and what the check said.
    Failure(String),
    /// The check could not be made, which says nothing about the task; why.
    Unknown(String),
}

/// What the answers up to now mean.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// The start-up probe has succeeded.
    Started,
    /// The readiness probe has succeeded.
    Ready,
    /// The readiness probe has failed, or what is waited for has failed for the first time; what the check said.
    NotReady {
        /// The probe's and the check's words.
        why: String,
    },
    /// The attempt is to be ended.
    Failed {
        /// Start-up or liveness.
        role: Role,
        /// The probe's and the check's words.
        why: String,
    },
}

/// One probe of an attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Probe {
    role: Role,
    timing: Timing,
    /// Its next check.
    due: Boot,
    under_way: bool,
    /// The last answer that counts, and how often it came in a row.
    success: bool,
    in_a_row: u32,
}

/// The checks of one attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Prober {
    probes: Vec<Probe>,
    startup: bool,
    ready: bool,
    /// Why it is not ready was told.
    told: bool,
    /// The attempt is to be ended: nothing more is asked.
    over: bool,
}

impl Prober {
    /// The checks of an attempt that began at `begun`, of which `verdicts` are known.
    #[must_use]
    pub fn new(probes: &Probes, verdicts: &Verdicts, begun: Boot) -> Prober {
        let probe = |role| {
            let timing = probes.of(role)?;
            let due = begun.plus(timing.initial_delay_ms);
            Some(Probe { role, timing, due, under_way: false, success: false, in_a_row: 0 })
        };
        Prober {
            probes: [Role::Startup, Role::Readiness, Role::Liveness]
                .into_iter()
                .filter_map(probe)
                .collect(),
            startup: probes.startup.is_some() && !verdicts.started,
            ready: verdicts.ready,
            told: !verdicts.why.is_empty(),
            over: false,
        }
    }

    fn asks(&self, probe: &Probe) -> bool {
        !self.over && (probe.role == Role::Startup) == self.startup
    }

    /// The checks to begin now. Each must be answered once.
    #[must_use = "a check that is not made is never asked for again"]
    pub fn due(&mut self, now: Boot) -> Vec<Role> {
        let (over, startup) = (self.over, self.startup);
        let asked = |p: &&mut Probe| !over && (p.role == Role::Startup) == startup;
        let mut due = Vec::new();
        for probe in self.probes.iter_mut().filter(asked) {
            if !probe.under_way && probe.due <= now {
                probe.under_way = true;
                // One that takes longer than the period is followed by the next at once.
                probe.due = now.plus(probe.timing.period_ms);
                due.push(probe.role);
            }
        }
        due
    }

    /// When to ask for what is due; `None`: not before an answer.
    #[must_use]
    pub fn next(&self) -> Option<Boot> {
        let idle = |p: &&Probe| self.asks(p) && !p.under_way;
        self.probes.iter().filter(idle).map(|p| p.due).min()
    }

    /// Takes the answer of a check that was due.
    pub fn answer(&mut self, role: Role, answer: Answer) -> Option<Verdict> {
        let probe = self.probes.iter_mut().find(|p| p.role == role)?;
        probe.under_way = false;
        if self.over || (role == Role::Startup) != self.startup {
            return None;
        }
        let (success, said) = match answer {
            Answer::Success => (true, String::new()),
            Answer::Failure(said) => (false, said),
            Answer::Unknown(said) => return self.first_word(role, format!("{role}: {said}")),
        };
        if probe.success != success {
            probe.in_a_row = 0;
        }
        probe.success = success;
        probe.in_a_row = probe.in_a_row.saturating_add(1);
        let threshold =
            if success { probe.timing.success_threshold } else { probe.timing.failure_threshold };
        let (times, counts) = (probe.in_a_row, probe.in_a_row >= threshold);
        match role {
            Role::Startup if success => {
                self.startup = false;
                self.told = false;
                Some(Verdict::Started)
            }
            Role::Startup | Role::Liveness if !success && counts => {
                self.over = true;
                let times =
                    if times == 1 { String::new() } else { format!(" {times} times in a row") };
                Some(Verdict::Failed { role, why: format!("{role} failed{times}: {said}") })
            }
            Role::Readiness if success && counts && !self.ready => {
                self.ready = true;
                Some(Verdict::Ready)
            }
            Role::Readiness if !success && counts && self.ready => {
                (self.ready, self.told) = (false, true);
                Some(Verdict::NotReady { why: format!("{role} failed: {said}") })
            }
            Role::Startup | Role::Readiness if !success => {
                self.first_word(role, format!("{role} failed: {said}"))
            }
            Role::Startup | Role::Readiness | Role::Liveness => None,
        }
    }

    /// Why it is not ready, told once: a check that fails for hours must not be a report each time.
    fn first_word(&mut self, role: Role, why: String) -> Option<Verdict> {
        let waited_for = match role {
            Role::Startup => true,
            Role::Readiness => !self.ready,
            Role::Liveness => false,
        };
        let news = waited_for && !std::mem::replace(&mut self.told, true);
        news.then_some(Verdict::NotReady { why })
    }
}

/// How much of a check's words is told.
pub const MAX_SAID: usize = 256;

/// What a check said in one line that is not longer than [`MAX_SAID`] bytes and `…`.
#[must_use]
pub fn shorten(said: &str) -> String {
    let mut text = String::new();
    for word in said.split(|c: char| c.is_whitespace() || c.is_control()).filter(|w| !w.is_empty())
    {
        if !text.is_empty() {
            text.push(' ');
        }
        text.push_str(word);
        if text.len() > MAX_SAID {
            let end = text.floor_char_boundary(MAX_SAID);
            text.truncate(end);
            text.push('…');
            break;
        }
    }
    text
}
