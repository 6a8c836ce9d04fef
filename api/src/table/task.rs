//! Tasks: how far each is, where, and why not further.

use crate::kind::task::{Cost, NodeRefusal, Task, TaskSpec, TaskStatus};
use crate::phase::TaskPhase;

use super::Cell;
use super::Mood;
use super::human;
use super::{Column, age};

pub(super) const COLUMNS: &[Column<Task>] = &[
    Column::new("PHASE", |task, _| phase(task)),
    Column::new("NODE", |task, _| status(task, |s| s.node.clone().unwrap_or_default())),
    Column::new("SCORE", |task, _| {
        status(task, |s| s.score.map(|v| score(v, task.spec.placement.cost)).unwrap_or_default())
    }),
    Column::new("CLASS", |task, _| task.spec.resources.class().into()),
    Column::new("ATTEMPT", |task, _| status(task, |s| attempts(&task.spec, s))),
    Column::new("AGE", |task, now| age(task.metadata.creation_timestamp.as_ref(), now)),
    Column::new("REASON", |task, _| status(task, reason)),
    Column::wide("READY", |task, _| status(task, |s| ready(s).unwrap_or_default().to_owned())),
    Column::wide("EPOCH", |task, _| {
        status(task, |s| s.lease.as_ref().map(|l| l.epoch.to_string()).unwrap_or_default())
    }),
    Column::wide("CPU", |task, _| status(task, |s| cpu(&task.spec, s))),
    Column::wide("MEMORY", |task, _| status(task, |s| memory(&task.spec, s))),
    Column::wide("EXIT", |task, _| status(task, exit)),
    Column::wide("MESSAGE", |task, _| status(task, |s| s.message.clone())),
];

fn status(task: &Task, text: impl Fn(&TaskStatus) -> String) -> Cell {
    task.status.as_ref().map(text).unwrap_or_default().into()
}

/// What a phase means to the reader.
pub fn mood(phase: TaskPhase) -> Mood {
    match phase {
        TaskPhase::Running => Mood::Good,
        TaskPhase::Succeeded => Mood::Dim,
        TaskPhase::Failed | TaskPhase::Unknown => Mood::Bad,
        TaskPhase::Pending | TaskPhase::Bound | TaskPhase::Starting | TaskPhase::Stopping => {
            Mood::Warn
        }
    }
}

/// Whether a running task serves; of others nothing is said.
pub fn ready(status: &TaskStatus) -> Option<&'static str> {
    let runs = status.phase == TaskPhase::Running;
    runs.then(|| if status.is_ready() { "True" } else { "False" })
}

fn phase(task: &Task) -> Cell {
    let phase = task.status.as_ref().map(|s| s.phase).unwrap_or_default();
    Cell::new(phase.as_str(), mood(phase))
}

/// Which attempt it is; of a task that is tried on other nodes counted over all of them, and how many there may be.
#[must_use]
pub fn attempts(spec: &TaskSpec, status: &TaskStatus) -> String {
    let attempt = status.attempts_used.saturating_add(status.attempt);
    match (&spec.reschedule, attempt) {
        (_, 0) => String::new(),
        (Some(block), _) => format!("{attempt}/{}", block.max_attempts),
        (None, _) => attempt.to_string(),
    }
}

/// A score with its unit.
pub fn score(value: f64, cost: Cost) -> String {
    match cost {
        Cost::Distance => format!("{value:.2}m"),
        Cost::TravelTime => format!("{value:.1}s"),
    }
}

/// The reason of the phase; of a waiting task, the filters that refuse it and on how many nodes.
pub fn reason(status: &TaskStatus) -> String {
    if status.phase == TaskPhase::Pending && !status.why.is_empty() {
        return refusals(&status.why);
    }
    status.reason.clone()
}

/// `LeaseHeld×2,OutOfRange`: most frequent first.
pub fn refusals(why: &[NodeRefusal]) -> String {
    let mut counts: Vec<(&str, usize)> = Vec::new();
    for refusal in why {
        match counts.iter_mut().find(|(reason, _)| *reason == refusal.reason) {
            Some((_, n)) => *n += 1,
            None => counts.push((&refusal.reason, 1)),
        }
    }
    counts.sort_by_key(|(_, n)| std::cmp::Reverse(*n));
    let texts = counts.into_iter().map(|(reason, n)| match n {
        1 => reason.to_owned(),
        _ => format!("{reason}×{n}"),
    });
    texts.collect::<Vec<_>>().join(",")
}

fn cpu(spec: &TaskSpec, status: &TaskStatus) -> String {
    let used = status.usage.as_ref().map(|u| human::cores(u.cpu));
    let reserved = spec.resources.cpu.map(human::cores);
    of_reserved(used, reserved)
}

fn memory(spec: &TaskSpec, status: &TaskStatus) -> String {
    let used = status.usage.as_ref().map(|u| human::bytes(u.memory));
    let reserved = spec.resources.memory.map(human::bytes);
    of_reserved(used, reserved)
}

fn of_reserved(used: Option<String>, reserved: Option<String>) -> String {
    match (used, reserved) {
        (None, None) => String::new(),
        (used, reserved) => {
            let dash = || "-".to_owned();
            format!("{}/{}", used.unwrap_or_else(dash), reserved.unwrap_or_else(dash))
        }
    }
}

/// How the last attempt that ended ended.
pub fn exit(status: &TaskStatus) -> String {
    match (status.signal, status.exit_code) {
        (Some(signal), _) => format!("signal {signal}"),
        (None, Some(code)) => code.to_string(),
        (None, None) => String::new(),
    }
}
