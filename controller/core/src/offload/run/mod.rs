//! What is done about an Application: the tasks of its parts are begun, moved and ended, and its status says so.
//!
//! ```text
//!   spec, status, its tasks, nodes, what is observed ──▶ Snapshot ──plan(now)──▶ Plan { actions, status, news, look_again }
//!     each part: status ──▶ Stage ──what became of its tasks──▶ Stage      (super::migration)
//!     all of them: super::plan ──▶ who moves ──▶ Stage ──▶ status
//! ```
//!
//! One call decides what one transaction can do. What is remembered stands in the status and is written together with the
//! actions that it explains; an unchanged world gives the same plan, and in the end one without actions.
//!
//! | module | decides |
//! |---|---|
//! | [`view`] | what of Tasks and Nodes matters here |
//! | [`scales`] | where parts can be, and what is there for them |
//! | `runner` | one part: which of its tasks serves, what becomes of the others |
//! | `standby` | what a robot that is cut off begins by itself, and that nothing else of it runs then |
//! | `observe` | what is measured, as a decision wants it |
//! | `say` | phase, conditions, the parts' words |
//!
//! Rules that hold whatever happens, each with a test of its name in `tests`:
//!
//! - A part has one task; two only from the start of the next one to the end of the other.
//! - The task before is told to end only when it is written down that the next one serves.
//! - A part whose task is gone is begun again, at home.
//! - While the robot cannot be reached, nothing is decided about its application.
//! - What is away ends before its robot, cut off, begins the part by itself.

mod observe;
mod runner;
mod say;
pub mod scales;
mod standby;
#[cfg(test)]
mod tests;
pub mod view;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::application::{
    ApplicationSpec, ApplicationStatus, PartStatus, Policy, task_name,
};

use super::model::Model;
use super::policy;
use super::problem::HOME;
use super::view::{PartView, Snapshot as Decided};
use crate::taskset::health::Fault;
use observe::Observed;
use runner::Runner;
pub use say::Said;
use scales::Scales;
use view::{NodeSeen, TaskSeen};

/// Everything that one decision looks at.
#[derive(Debug, Clone)]
pub struct Snapshot<'a> {
    /// The application's name.
    pub name: &'a str,
    /// What is wanted.
    pub spec: &'a ApplicationSpec,
    /// The generation of `spec`.
    pub generation: i64,
    /// What was written last.
    pub status: &'a ApplicationStatus,
    /// The application's tasks by name: those that its status names.
    pub tasks: &'a BTreeMap<String, TaskSeen>,
    /// The nodes by name.
    pub nodes: &'a BTreeMap<String, NodeSeen>,
    /// Names of tasks that its own would have next and that are taken.
    pub taken: &'a BTreeSet<String>,
    /// By name, why a new task was refused a moment ago: it is not begun now.
    pub refused: &'a BTreeMap<String, String>,
}

/// What is to be done, and what is to be said about it.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// All of it, as one transaction together with the status.
    pub actions: Vec<Action>,
    /// The new status, conditions as they are said.
    pub status: ApplicationStatus,
    /// The conditions.
    pub conditions: Vec<Said>,
    /// What people should see under the application.
    pub news: Vec<News>,
    /// When to look again although nothing changed.
    pub look_again: Timestamp,
}

/// One change.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Begin a task.
    Create(NewTask),
    /// Let a task begin that stands by.
    Release {
        /// The task.
        task: String,
    },
    /// End a task, with its own grace; one that has ended is taken away.
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
    /// The part that it is.
    pub part: String,
    /// The one node where it may run.
    pub node: String,
    /// It stands by: its node begins it by itself after so long without contact.
    pub standby: Option<Duration>,
    /// Its node ends it after so long without contact: its standby may begin a moment later.
    pub stop_after: Option<Duration>,
}

/// Why a task is ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ending {
    /// Another one serves now.
    Moved {
        /// Where.
        to: String,
    },
    /// The move to it was given up.
    Aborted,
    /// The part's template has changed.
    Outdated,
    /// The application has no such part any more.
    NoSuchPart,
    /// It has ended by itself, and another takes its place.
    Over,
    /// The robot cannot be reached, and is about to begin the part by itself.
    RobotAlone,
    /// It stood by for a part that is at home.
    NotNeeded,
}

impl fmt::Display for Ending {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Ending::Moved { to } => write!(f, "the part is served from {to} now"),
            Ending::Aborted => f.write_str("the move was given up"),
            Ending::Outdated => f.write_str("the part's template has changed"),
            Ending::NoSuchPart => f.write_str("the application has no such part any more"),
            Ending::Over => f.write_str("it has ended, and another takes its place"),
            Ending::RobotAlone => {
                f.write_str("the robot cannot be reached, and is about to begin the part by itself")
            }
            Ending::NotNeeded => f.write_str("nothing stands by for a part that is at home"),
        }
    }
}

/// Why a move is given up while the task before still serves.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Abort {
    /// Nothing can run on its scale any more, or it cannot be reached.
    Scale {
        /// Why.
        why: String,
    },
    /// The next task failed, or was not Ready in time.
    Failed(Fault),
    /// There was no room for the next task.
    NoRoom {
        /// Why it is not placed.
        why: String,
    },
    /// The policy is Home now, or the part is to come home.
    Unwanted,
}

impl fmt::Display for Abort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Abort::Scale { why } => write!(f, "nothing can run there: {why}"),
            Abort::Failed(fault) => write!(f, "its task {fault}"),
            Abort::NoRoom { why } => write!(f, "there was no room for it: {why}"),
            Abort::Unwanted => f.write_str("it is to be at home"),
        }
    }
}

/// What people should see under the application.
#[derive(Debug, Clone, PartialEq)]
pub enum News {
    /// A part has a task where it had none.
    Begun {
        /// The task.
        task: String,
        /// Where.
        node: String,
    },
    /// The next task of a part is starting.
    Moving {
        /// The part.
        part: String,
        /// From where.
        from: String,
        /// To where.
        to: String,
        /// Why.
        message: String,
    },
    /// A part is served from somewhere else now.
    Moved {
        /// The part.
        part: String,
        /// To where.
        to: String,
        /// Why.
        message: String,
    },
    /// A robot that was cut off has begun a part by itself.
    Alone {
        /// The part.
        part: String,
        /// The task.
        task: String,
    },
    /// A move was given up.
    Aborted {
        /// The part.
        part: String,
        /// To where.
        to: String,
        /// Why.
        why: Abort,
    },
}

/// What a look has to say, as it is gathered.
#[derive(Debug, Default)]
struct Gathered {
    actions: Vec<Action>,
    news: Vec<News>,
    look_again: Option<Timestamp>,
}

impl Gathered {
    fn look_at(&mut self, when: Timestamp) {
        self.look_again = Some(self.look_again.map_or(when, |w| w.min(when)));
    }

    fn new_task(&mut self, name: &str) -> Option<&mut NewTask> {
        self.actions.iter_mut().find_map(|action| match action {
            Action::Create(new) if new.name == name => Some(new),
            _ => None,
        })
    }

    fn delete(&mut self, task: &str, why: Ending) {
        let known = |a: &Action| matches!(a, Action::Delete { task: t, .. } if t.as_str() == task);
        if !self.actions.iter().any(known) {
            self.actions.push(Action::Delete { task: task.to_owned(), why });
        }
    }
}

/// What every part of a look needs.
#[derive(Debug)]
struct Look<'a> {
    snapshot: &'a Snapshot<'a>,
    model: Model,
    scales: Scales,
    now: Timestamp,
}

impl Look<'_> {
    fn task(&self, name: &str) -> Option<&TaskSeen> {
        self.snapshot.tasks.get(name)
    }

    fn node(&self, name: &str) -> Option<&NodeSeen> {
        self.snapshot.nodes.get(name)
    }

    fn home_is_there(&self) -> bool {
        self.scales.views[HOME].link.up
    }

    /// The number of the part's next task: one whose name is free.
    fn next_number(&self, part: &PartStatus) -> u64 {
        let free = |n: &u64| {
            let name = task_name(self.snapshot.name, &part.name, *n);
            !self.snapshot.taken.contains(&name) && self.task(&name).is_none()
        };
        (part.attempts + 1..).find(free).expect("there are fewer tasks than numbers")
    }

    /// Why the part's next task was refused a moment ago.
    fn refusal(&self, part: &PartStatus) -> Option<String> {
        let name = task_name(self.snapshot.name, &part.name, self.next_number(part));
        self.snapshot.refused.get(&name).cloned()
    }
}

/// Decides what is to be done about an application as of `now`.
#[must_use]
pub fn plan(snapshot: &Snapshot<'_>, now: Timestamp) -> Plan {
    let model = Model::of(snapshot.spec);
    let look = Look { snapshot, model, scales: Scales::of(snapshot, now), now };
    let mut out = Gathered::default();
    let observed = Observed::of(&look, &mut out);
    let mut runners = runner::all(&look);
    for runner in &mut runners {
        runner.follow(&look, &mut out);
    }
    let decided = look.home_is_there().then(|| decide(&look, &observed, &runners));
    if let Some(decided) = &decided {
        out.look_at(decided.look_again);
        for action in &decided.actions {
            runners[action.part].carry_out(&look, decided, action, &mut out);
        }
    }
    say::whole(&look, observed, runners, decided.as_ref(), out)
}

fn decide(look: &Look<'_>, observed: &Observed, runners: &[Runner]) -> super::Plan {
    let model = &look.model;
    let parts: Vec<PartView> =
        runners[..model.parts.len()].iter().map(|runner| runner.view(look)).collect();
    let snapshot = Decided {
        model,
        scales: &look.scales.views,
        parts: &parts,
        connections: &observed.views,
        signals: &observed.signal_views,
    };
    policy::plan(&snapshot, look.now)
}

/// Whether parts may be away at all.
fn only_home(spec: &ApplicationSpec) -> bool {
    spec.policy == Policy::Home
}
