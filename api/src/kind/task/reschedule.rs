//! What becomes of a task that has failed on its node: whether it is tried again on another one, and what is kept of
//! those that were tried.
//!
//! The block is Nomad's `reschedule`; `maxAttempts` is to it what `backoffLimit` is to a Kubernetes Job. A task uid has at
//! most one live attempt, and what is said of it stays true: another node gets another uid, under the same name.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{DEADLINE_EXCEEDED, OutOfRange, RestartPolicy, Task, TaskSpec, TaskStatus};
use crate::duration::Span;
use crate::phase::TaskPhase;
use crate::validate::Violations;

/// How a task that has failed on its node is tried on others.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Reschedule {
    /// How many attempts may fail, over all nodes; with the last one it has Failed for good. A start that the node cannot
    /// make (no such image) is an attempt.
    pub max_attempts: u32,
    /// How many of them may fail on one node, one after the other as `restartPolicy: OnFailure` has it, before another
    /// node is tried.
    pub attempts_per_node: u32,
    /// How long it waits before the second node is tried; doubled with each one more.
    pub backoff: Span,
    /// The longest that it waits.
    pub max_backoff: Span,
}

impl Default for Reschedule {
    fn default() -> Self {
        Reschedule {
            max_attempts: 3,
            attempts_per_node: 1,
            backoff: Span::from_secs(10),
            max_backoff: Span::from_secs(300),
        }
    }
}

/// Most attempts that may be asked for: a program that fails a hundred times is not mended by another node.
pub const MAX_ATTEMPTS: u32 = 100;

/// How many of the nodes that were tried a status names; the oldest goes first.
pub const EARLIER_LIMIT: usize = 10;

/// Reason of a task whose `reschedule.maxAttempts` have failed.
pub const ATTEMPTS_EXHAUSTED: &str = "AttemptsExhausted";
/// Reason of a task that is ended because its robot has left its radius (`placement.onOutOfRange`).
pub const OUT_OF_RANGE: &str = "OutOfRange";

/// One node that a task was on before, under another uid, and how that ended.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct EarlierTry {
    /// The uid that the task had there.
    pub uid: String,
    /// The node.
    pub node: String,
    /// Why it ended there, one CamelCase word.
    pub reason: String,
    /// Why, in a sentence.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub message: String,
    /// How many attempts failed there; 0: it was ended for a reason that is none of its own, and may go there again.
    pub attempts: u32,
    /// How the last attempt there ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exit_code: Option<i32>,
    /// The signal that ended it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub signal: Option<i32>,
    /// When it was placed there.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bound_at: Option<MicroTime>,
    /// When its last attempt there started.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub started_at: Option<MicroTime>,
    /// When that ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub finished_at: Option<MicroTime>,
}

impl EarlierTry {
    /// How it ended there, in a clause: `Error: exited with code 1`.
    #[must_use]
    pub fn end(&self) -> String {
        match self.message.is_empty() {
            true => self.reason.clone(),
            false => format!("{}: {}", self.reason, self.message),
        }
    }
}

/// What is still to come of a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outlook {
    /// It has not ended.
    Alive,
    /// It has, and stays as it is.
    Over(Over),
    /// It has failed where it was, and is about to be tried again under another uid.
    Again {
        /// How many attempts this one used up: 0, it was ended for a reason that is none of its own.
        attempts: u32,
    },
}

/// Why an ended task is not tried again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Over {
    /// It did what it was to do.
    Succeeded,
    /// Nobody asked for another try.
    NotAsked,
    /// It belongs to a TaskSet or a framework, which decides.
    Owned,
    /// It is being deleted, or a finalizer keeps its object.
    Kept,
    /// Its time has passed.
    Deadline,
    /// It has never been on a node.
    NeverPlaced,
    /// So many attempts have failed in all, and no more may.
    Exhausted(u32),
}

impl Outlook {
    /// Nothing will run again under this name by itself.
    #[must_use]
    pub fn is_over(self) -> bool {
        matches!(self, Outlook::Over(_))
    }
}

impl Task {
    /// What is still to come of it, by what its object says.
    #[must_use]
    pub fn outlook(&self) -> Outlook {
        let nothing = TaskStatus::default();
        let status = self.status.as_ref().unwrap_or(&nothing);
        match status.phase {
            TaskPhase::Failed => {}
            TaskPhase::Succeeded => return Outlook::Over(Over::Succeeded),
            _ => return Outlook::Alive,
        }
        if self.metadata.owner_references.iter().flatten().any(|o| o.controller == Some(true)) {
            return Outlook::Over(Over::Owned);
        }
        let held = self.metadata.finalizers.as_ref().is_some_and(|all| !all.is_empty());
        if self.metadata.deletion_timestamp.is_some() || held {
            return Outlook::Over(Over::Kept);
        }
        if status.node.is_none() {
            return Outlook::Over(Over::NeverPlaced);
        }
        after_failure(&self.spec, status)
    }
}

fn after_failure(spec: &TaskSpec, status: &TaskStatus) -> Outlook {
    if let Some(stop) = &status.stop {
        let own =
            stop.reason == OUT_OF_RANGE && spec.placement.on_out_of_range == OutOfRange::Reschedule;
        if stop.reason == DEADLINE_EXCEEDED {
            return Outlook::Over(Over::Deadline);
        } else if stop.reason == status.reason {
            // It was ended for somebody else's sake.
            return match own || spec.reschedule.is_some() {
                true => Outlook::Again { attempts: 0 },
                false => Outlook::Over(Over::NotAsked),
            };
        }
    }
    let Some(reschedule) = &spec.reschedule else { return Outlook::Over(Over::NotAsked) };
    let attempts = status.failed_attempts.max(1);
    let used = status.attempts_used.saturating_add(attempts);
    match used >= reschedule.max_attempts {
        true => Outlook::Over(Over::Exhausted(used)),
        false => Outlook::Again { attempts },
    }
}

impl TaskStatus {
    /// A status of a task that is not placed, with nothing in it but what is known of the nodes that were tried before.
    #[must_use]
    pub fn carried(&self) -> TaskStatus {
        TaskStatus {
            earlier: self.earlier.clone(),
            attempts_used: self.attempts_used,
            first_bound_at: self.first_bound_at.clone(),
            not_before: self.not_before.clone(),
            ..TaskStatus::default()
        }
    }
}

impl TaskStatus {
    /// The task is not placed before then.
    pub fn hold_until(&mut self, at: Timestamp) {
        self.not_before = Some(MicroTime(at));
    }
}

impl TaskSpec {
    /// How many attempts may fail on the node that it is placed on now, when `used` have failed before; none: as many as
    /// `restartPolicy` makes.
    #[must_use]
    pub fn attempts_here(&self, used: u32) -> Option<u32> {
        let reschedule = self.reschedule.as_ref()?;
        let left = reschedule.max_attempts.saturating_sub(used);
        Some(reschedule.attempts_per_node.min(left).max(1))
    }
}

/// What the types do not hold of a task's `reschedule`.
pub(super) fn rules(spec: &TaskSpec, violations: &mut Violations) {
    if spec.placement.on_out_of_range != OutOfRange::default()
        && (spec.placement.at.is_none() || spec.placement.within.is_none())
    {
        violations
            .invalid("spec.placement.onOutOfRange", "there is no radius to leave")
            .suggest("give the operation position and the radius: at: {x: 3.0, y: 4.0}, within: 5");
    }
    let Some(reschedule) = &spec.reschedule else { return };
    let Reschedule { max_attempts, attempts_per_node, backoff, max_backoff } = reschedule;
    if spec.run.executor.is_some() {
        violations
            .forbidden("spec.reschedule", "an executor's work runs where its executor is")
            .suggest("leave it out; give the executor's task one");
    }
    if spec.restart_policy == RestartPolicy::Always {
        violations
            .invalid("spec.reschedule", "a task that is always started again does not fail")
            .suggest("set restartPolicy: OnFailure, or write a TaskSet with one replica");
    }
    for (field, given) in [("maxAttempts", max_attempts), ("attemptsPerNode", attempts_per_node)] {
        if *given == 0 || *given > MAX_ATTEMPTS {
            violations
                .invalid(
                    format!("spec.reschedule.{field}"),
                    format!("{given} is not between 1 and {MAX_ATTEMPTS}"),
                )
                .suggest(if *given == 0 { "1 lets it fail once" } else { "leave it out" });
        }
    }
    if *attempts_per_node > 1 && spec.restart_policy == RestartPolicy::Never {
        violations
            .invalid(
                "spec.reschedule.attemptsPerNode",
                "with restartPolicy Never there is one attempt on a node",
            )
            .suggest("leave it out, or set restartPolicy: OnFailure");
    }
    if max_backoff < backoff {
        violations
            .invalid(
                "spec.reschedule.maxBackoff",
                format!("{max_backoff} is less than the first wait, {backoff}"),
            )
            .suggest("leave it out, or make it longer than `backoff`");
    }
}
