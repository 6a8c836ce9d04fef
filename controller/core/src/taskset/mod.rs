//! Which tasks of a TaskSet begin, end and follow each other.
//!
//! ```text
//!   set, its tasks, nodes, revisions ──▶ Snapshot ──plan(now)──▶ Plan { actions, status, news, look_again }
//! ```
//!
//! One call looks at everything and decides what one transaction can do; the next call sees what that changed. An
//! unchanged world gives the same plan, and in the end one without actions. Nothing is remembered between calls but what
//! the set's status says, and that is written together with the actions it explains.
//!
//! | module | decides |
//! |---|---|
//! | [`view`] | what of a Task and a Node matters here |
//! | [`health`] | whether a task is ready, available, or has failed its template |
//! | [`revision`] | which template is wanted, which was good, which are forgotten |
//! | [`places`] | how many tasks or which nodes; what is missing, what is too much |
//! | [`images`] | which images nodes are to have before their tasks are changed |
//! | [`rollout`] | canary, how many at once, giving up, being done |
//! | [`status`] | the numbers and conditions that people see |
//!
//! Rules that hold whatever happens, each with a test of its name in `tests`:
//!
//! - A place has one Task object at a time: the next is created when the one before is gone. So there is never one more
//!   than the set asks for, and two drivers never come from here.
//! - A task that is available is ended for a rollout only while at most `maxUnavailable` are down with it.
//! - A task is ended for a template with another image only when its node has that image.
//! - While a node is under a mission lock, no task there is ended: not for a rollout, a smaller `replicas`, or a label.
//! - A task whose node cannot be reached is not ended for a rollout: nobody knows what it is in the middle of.
//! - A rollout that fails goes back to the last revision that was available everywhere, and stays there until the
//!   template is changed again: applying the same manifest once more does not try the same fault once more.

pub mod health;
pub mod images;
pub mod places;
pub mod revision;
pub mod rollout;
pub mod status;
#[cfg(test)]
mod tests;
pub mod view;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use muster_api::kind::taskset::{TaskSetSpec, TaskSetStatus};

use crate::report::Refusal;
use health::Fault;
use view::{Claim, NodeView, RevisionView, TaskView};

/// Tasks that one plan begins or ends at most: a transaction of this size commits in a few milliseconds, and binds and
/// reports wait for it.
pub const AT_ONCE: usize = 64;

/// Everything that one decision looks at.
#[derive(Debug, Clone)]
pub struct Snapshot<'a> {
    /// The set's name.
    pub name: &'a str,
    /// What is wanted.
    pub spec: &'a TaskSetSpec,
    /// The generation of `spec`.
    pub generation: i64,
    /// What was written last.
    pub status: &'a TaskSetStatus,
    /// The set's revisions.
    pub revisions: &'a [RevisionView],
    /// The set's tasks, and those that it could take in; in the order of their names.
    pub tasks: &'a [TaskView],
    /// The nodes by name.
    pub nodes: &'a BTreeMap<String, NodeView>,
    /// When those that are silent were heard last by a clock that dates do not move, where such a one is at hand.
    pub silent: &'a BTreeMap<String, Timestamp>,
    /// Names that begin as the set's tasks' do and that others have.
    pub taken: &'a BTreeSet<String>,
}

/// What is to be done, and what is to be said about it.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// All of it, as one transaction together with the status.
    pub actions: Vec<Action>,
    /// The new status; conditions are set by [`status::Conditions`] when it is written.
    pub status: TaskSetStatus,
    /// The conditions.
    pub conditions: status::Conditions,
    /// What people should see under the set.
    pub news: Vec<News>,
    /// When to look again although nothing changed.
    pub look_again: Option<Timestamp>,
}

/// One change.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Keep the set's template as a revision.
    CreateRevision {
        /// Its name.
        name: String,
        /// Its number.
        number: u64,
    },
    /// The set has gone back to an old template: it is the newest again.
    Renumber {
        /// The revision.
        name: String,
        /// Its new number.
        number: u64,
    },
    /// Take in a revision that an earlier set of this name left.
    AdoptRevision {
        /// The revision.
        name: String,
    },
    /// Forget a template.
    DeleteRevision {
        /// The revision.
        name: String,
    },
    /// Take in a task that nobody controls.
    Adopt {
        /// The task.
        task: String,
    },
    /// Let go of a task whose labels do not match any more.
    Release {
        /// The task.
        task: String,
    },
    /// Begin a task.
    Create(NewTask),
    /// End a task, with its own grace.
    Delete {
        /// The task.
        task: String,
        /// Why.
        why: Ending,
    },
}

/// A task that begins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewTask {
    /// Its name.
    pub name: String,
    /// The revision that it is made of; that of the set's template may be created by the same plan.
    pub revision: String,
    /// Where.
    pub place: Place,
    /// A task of the set ran there before.
    pub follows: bool,
}

/// Where a new task goes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// Wherever is best.
    Anywhere,
    /// There if possible: the task before it ran there.
    Prefer(String),
    /// There or nowhere.
    Only(String),
}

/// Why a task is ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Ending {
    /// The template has changed.
    Outdated {
        /// The revision that follows.
        revision: String,
    },
    /// There are more than `replicas`.
    TooMany,
    /// The node does not match any more.
    Unsuited(Refusal),
    /// The node has no object any more.
    NodeGone,
    /// It has ended by itself, and another takes its place.
    Over,
}

impl fmt::Display for Ending {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Ending::Outdated { revision } => write!(f, "the template has changed to {revision}"),
            Ending::TooMany => f.write_str("there are more tasks than replicas"),
            Ending::Unsuited(refusal) => write!(f, "its node {refusal}"),
            Ending::NodeGone => f.write_str("its node has no object any more"),
            Ending::Over => f.write_str("it has ended, and another takes its place"),
        }
    }
}

/// What people should see under the set.
#[derive(Debug, Clone, PartialEq)]
pub enum News {
    /// A changed task failed, and the set goes back.
    RolledBack {
        /// From which revision.
        from: String,
        /// To which.
        to: String,
        /// Because of which task.
        task: String,
        /// What it did.
        fault: Fault,
    },
    /// Every task that can be is of this revision and available.
    RolledOut {
        /// The revision.
        revision: String,
    },
}

/// Decides what is to be done about a set as of `now`.
#[must_use]
pub fn plan(snapshot: &Snapshot<'_>, now: Timestamp) -> Plan {
    let mut plan = Plan::begin(snapshot);
    claim(snapshot, &mut plan);
    if !plan.actions.is_empty() {
        // Who belongs to the set is settled first; the next look counts them.
        return plan;
    }
    let history = revision::settle(snapshot, &mut plan);
    let crew = places::Crew::of(snapshot, now);
    plan.look_at(crew.look_again);
    let course = rollout::decide(snapshot, &crew, &history, now, &mut plan);
    places::clean_up(&crew, now, &mut plan);
    places::shrink(snapshot, &crew, &course, &mut plan);
    places::fill(snapshot, &crew, &course, &mut plan);
    images::ask(snapshot, &crew, &course, now, &mut plan);
    rollout::change(snapshot, &crew, &course, &mut plan);
    rollout::conclude(snapshot, &crew, &course, now, &mut plan);
    revision::forget(snapshot, &course, &mut plan);
    status::write(snapshot, &crew, &course, &mut plan);
    plan
}

impl Plan {
    fn begin(snapshot: &Snapshot<'_>) -> Self {
        Plan {
            actions: Vec::new(),
            status: snapshot.status.clone(),
            conditions: status::Conditions::default(),
            news: Vec::new(),
            look_again: None,
        }
    }

    fn look_at(&mut self, when: Option<Timestamp>) {
        self.look_again = [self.look_again, when].into_iter().flatten().min();
    }

    fn ends(&self, task: &TaskView) -> bool {
        self.actions.iter().any(|a| matches!(a, Action::Delete { task: t, .. } if *t == task.name))
    }

    fn is_full(&self) -> bool {
        self.actions.len() >= AT_ONCE
    }
}

fn claim(snapshot: &Snapshot<'_>, plan: &mut Plan) {
    for task in snapshot.tasks.iter().filter(|t| !t.ending) {
        match task.claim {
            Claim::Mine => {}
            Claim::NoLongerMine => plan.actions.push(Action::Release { task: task.name.clone() }),
            // What has ended is no help to the set.
            Claim::Nobodys if task.phase.is_terminal() => {}
            Claim::Nobodys => plan.actions.push(Action::Adopt { task: task.name.clone() }),
        }
    }
    for revision in snapshot.revisions.iter().filter(|r| !r.mine) {
        plan.actions.push(Action::AdoptRevision { name: revision.name.clone() });
    }
}

/// `span` after `when`; the end of time when that is later.
pub(crate) fn after(when: Timestamp, span: Duration) -> Timestamp {
    let span = SignedDuration::try_from(span).unwrap_or(SignedDuration::MAX);
    when.checked_add(span).unwrap_or(Timestamp::MAX)
}
