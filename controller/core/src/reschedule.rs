//! Tasks that have failed on their node and are tried again on another one: when, with what of the past, and which nodes
//! come last then.
//!
//! Whether a task is tried again at all is said by its own object ([`Task::outlook`]), so that everybody agrees who asks.
//! Another node means another uid: what a uid was and did stays true, and at most one attempt of it lives (invariant 4).
//! A task is Failed only when nothing of it runs any more, or a person said so (invariant 1), so the next one may be
//! placed at once.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use muster_api::kind::task::reschedule::{ATTEMPTS_EXHAUSTED, EARLIER_LIMIT};
use muster_api::kind::task::{
    EarlierTry, NodeRefusal, Outlook, Over, Reschedule, Task, TaskSpec, TaskStatus,
};

use crate::hold::Hold;

/// Reason of a node that a waiting task has failed on: others come first.
pub const TRIED_BEFORE: &str = "TriedBefore";

/// What is to be done about a task.
#[derive(Debug, Clone, PartialEq)]
pub enum Step {
    /// Nothing.
    Nothing,
    /// It stays Failed, and its object is to say what was tried where.
    Conclude {
        /// The reason of its end from now on.
        reason: &'static str,
        /// The same in a sentence.
        message: String,
    },
    /// A new object in its place, under the same name: this is its status.
    Again(Box<TaskStatus>),
}

/// What becomes of a task as of `now`.
#[must_use]
pub fn step(task: &Task, now: Timestamp) -> Step {
    let Some(status) = &task.status else { return Step::Nothing };
    match task.outlook() {
        Outlook::Again { attempts } => Step::Again(Box::new(next(task, status, attempts, now))),
        Outlook::Over(Over::Exhausted(used)) if status.reason != ATTEMPTS_EXHAUSTED => {
            Step::Conclude { reason: ATTEMPTS_EXHAUSTED, message: exhausted(status, used) }
        }
        Outlook::Over(_) | Outlook::Alive => Step::Nothing,
    }
}

/// What the next object of a task knows, of which `attempts` more have failed.
fn next(task: &Task, status: &TaskStatus, attempts: u32, now: Timestamp) -> TaskStatus {
    let mut earlier = status.earlier.clone();
    earlier.push(EarlierTry {
        uid: task.metadata.uid.clone().unwrap_or_default(),
        ..tried(status, attempts)
    });
    let nodes = earlier.iter().filter(|one| one.attempts > 0).count();
    while earlier.len() > EARLIER_LIMIT {
        // What counts stays longest, and what came last always.
        let before = &earlier[..earlier.len() - 1];
        earlier.remove(before.iter().position(|one| one.attempts == 0).unwrap_or(0));
    }
    let reschedule = task.spec.reschedule.as_ref().filter(|_| attempts > 0);
    let mut next = TaskStatus {
        earlier,
        attempts_used: status.attempts_used.saturating_add(attempts),
        first_bound_at: status.first_bound_at.clone().or_else(|| status.bound_at.clone()),
        ..TaskStatus::default()
    };
    if let Some(block) = reschedule {
        next.hold_until(after(now, backoff(block, nodes)));
    }
    next
}

fn tried(status: &TaskStatus, attempts: u32) -> EarlierTry {
    EarlierTry {
        uid: String::new(),
        node: status.node.clone().unwrap_or_default(),
        reason: status.reason.clone(),
        message: status.message.clone(),
        attempts,
        exit_code: status.exit_code,
        signal: status.signal,
        bound_at: status.bound_at.clone(),
        started_at: status.started_at.clone(),
        finished_at: status.finished_at.clone(),
    }
}

fn after(now: Timestamp, wait: Duration) -> Timestamp {
    SignedDuration::try_from(wait).ok().and_then(|wait| now.checked_add(wait).ok()).unwrap_or(now)
}

/// How long a task waits that has failed on so many nodes: `backoff · 2^(nodes − 1)`, at most `maxBackoff`.
#[must_use]
pub fn backoff(block: &Reschedule, nodes: usize) -> Duration {
    let doublings = u32::try_from(nodes.saturating_sub(1)).unwrap_or(u32::MAX);
    let factor = 2_u32.checked_pow(doublings).unwrap_or(u32::MAX);
    block.backoff.as_duration().saturating_mul(factor).min(block.max_backoff.as_duration())
}

fn exhausted(status: &TaskStatus, used: u32) -> String {
    let here = tried(status, status.failed_attempts.max(1));
    let tries = status.earlier.iter().filter(|one| one.attempts > 0).chain([&here]);
    let tries: Vec<String> =
        tries.map(|one| format!("{} on {} ({})", one.attempts, one.node, one.end())).collect();
    format!("{}, as many as may fail: {}", failed(used), tries.join(", "))
}

fn failed(attempts: u32) -> String {
    match attempts {
        1 => "1 attempt has failed".to_owned(),
        n => format!("{n} attempts have failed"),
    }
}

/// What holds a task back as of `now` that has failed on other nodes: it waits a while before the next one is tried.
#[must_use]
pub fn hold(spec: &TaskSpec, status: &TaskStatus, now: Timestamp) -> Option<Hold> {
    let until = status.not_before.as_ref().map(|at| at.0).filter(|until| *until > now)?;
    let last = status.earlier.iter().rfind(|one| one.attempts > 0)?;
    Some(Hold::BackOff {
        until,
        node: last.node.clone(),
        end: last.end(),
        used: status.attempts_used,
        most: spec.reschedule.as_ref()?.max_attempts,
    })
}

/// The nodes that a task has failed on, as reasons of a task that is held back.
#[must_use]
pub fn refusals(status: &TaskStatus) -> Vec<NodeRefusal> {
    let mut refusals: Vec<NodeRefusal> = Vec::new();
    // Of a node that was tried twice, what came last.
    for one in status.earlier.iter().rev().filter(|one| one.attempts > 0) {
        if refusals.iter().all(|known| known.node != one.node) {
            refusals.push(NodeRefusal {
                node: one.node.clone(),
                reason: TRIED_BEFORE.to_owned(),
                message: format!(
                    "{} there ({}); nodes that were not tried come first",
                    failed(one.attempts),
                    one.end()
                ),
            });
        }
    }
    refusals.reverse();
    refusals
}

/// The nodes that come last for a task.
pub fn avoided(status: &TaskStatus) -> impl Iterator<Item = &str> {
    status.earlier.iter().filter(|one| one.attempts > 0).map(|one| one.node.as_str())
}

#[cfg(test)]
mod tests;
