//! Assignments against known tasks: who gets which event. Pure data; the executor has no choices.

use std::collections::{BTreeMap, BTreeSet};

use muster_api::id::TaskUid;

use crate::desired::Desired;
use crate::workload::Event;

/// What the controller sent, decoded.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Assignments {
    /// Everything this node should have.
    pub complete: bool,
    /// Tasks, whole.
    pub upserts: BTreeMap<TaskUid, Desired>,
    /// Tasks whose ends are recorded.
    pub released: BTreeSet<TaskUid>,
    /// With `complete`: tasks that this node should have as well, and was told of before.
    pub kept: BTreeSet<TaskUid>,
    /// Tasks that were sent but could not be read, and why: not started, and not taken for absent.
    pub unreadable: BTreeMap<TaskUid, String>,
}

/// One thing to do with the set of workloads.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Step {
    /// A task that is new here.
    Create(TaskUid, Desired),
    /// A task that is new here and cannot be read: its end is to be told, with this as the reason.
    Refuse(TaskUid, String),
    /// An event for a known one.
    Tell(TaskUid, Event),
}

/// Why nothing is done about a task that was named.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Skipped {
    /// Released, but not known here: released before.
    UnknownRelease(TaskUid),
    /// Wanted, but it is being removed: a uid never runs again after its release.
    BeingRemoved(TaskUid),
    /// Known here, and what was sent now cannot be read: it goes on as it was last understood.
    Unreadable(TaskUid, String),
}

/// What to do, and what was left undone and why.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Plan {
    /// In this order.
    pub steps: Vec<Step>,
    /// For the log.
    pub skipped: Vec<Skipped>,
}

/// Plans for `assignments`. `known`: each task here, and whether it is to be removed.
#[must_use]
pub fn plan(assignments: Assignments, known: &BTreeMap<TaskUid, bool>) -> Plan {
    let mut plan = Plan::default();
    for uid in &assignments.released {
        if known.contains_key(uid) {
            plan.steps.push(Step::Tell(uid.clone(), Event::Forgotten));
        } else {
            plan.skipped.push(Skipped::UnknownRelease(uid.clone()));
        }
    }
    if assignments.complete {
        let named = |uid: &TaskUid| {
            assignments.upserts.contains_key(uid)
                || assignments.unreadable.contains_key(uid)
                || assignments.released.contains(uid)
                || assignments.kept.contains(uid)
        };
        for uid in known.keys().filter(|uid| !named(uid)) {
            plan.steps.push(Step::Tell(uid.clone(), Event::Unassigned));
        }
    }
    for (uid, why) in assignments.unreadable {
        if known.contains_key(&uid) {
            plan.skipped.push(Skipped::Unreadable(uid, why));
        } else if !assignments.released.contains(&uid) {
            plan.steps.push(Step::Refuse(uid, why));
        }
    }
    for (uid, desired) in assignments.upserts {
        match known.get(&uid) {
            _ if assignments.released.contains(&uid) => {
                plan.skipped.push(Skipped::BeingRemoved(uid));
            }
            None => plan.steps.push(Step::Create(uid, desired)),
            Some(true) => plan.skipped.push(Skipped::BeingRemoved(uid)),
            Some(false) => plan.steps.push(Step::Tell(uid, Event::Assigned(desired))),
        }
    }
    plan
}

#[cfg(test)]
mod tests {
    use super::*;

    fn desired() -> Desired {
        Desired::once(0)
    }

    fn uid(name: &str) -> TaskUid {
        TaskUid::new(name)
    }

    #[test]
    fn a_complete_set_ends_what_it_does_not_name() {
        let known = BTreeMap::from([(uid("a"), false), (uid("b"), false), (uid("c"), true)]);
        let wanted = Assignments {
            complete: true,
            upserts: BTreeMap::from([(uid("b"), desired()), (uid("d"), desired())]),
            kept: BTreeSet::from([uid("e")]),
            ..Assignments::default()
        };
        let known = known.into_iter().chain([(uid("e"), false)]).collect();
        assert_eq!(
            plan(wanted, &known).steps,
            [
                Step::Tell(uid("a"), Event::Unassigned),
                Step::Tell(uid("c"), Event::Unassigned),
                Step::Tell(uid("b"), Event::Assigned(desired())),
                Step::Create(uid("d"), desired()),
            ]
        );
    }

    #[test]
    fn a_part_ends_nothing() {
        let known = BTreeMap::from([(uid("a"), false)]);
        assert_eq!(plan(Assignments::default(), &known), Plan::default());
    }

    #[test]
    fn what_cannot_be_read_is_refused_once_and_ends_nothing() {
        let why = || "run.wasm".to_owned();
        let unreadable = Assignments {
            complete: true,
            unreadable: BTreeMap::from([(uid("a"), why()), (uid("b"), why())]),
            ..Assignments::default()
        };
        let known = BTreeMap::from([(uid("a"), false)]);
        let first = plan(unreadable.clone(), &known);
        assert_eq!(first.steps, [Step::Refuse(uid("b"), why())]);
        assert_eq!(first.skipped, [Skipped::Unreadable(uid("a"), why())]);
        let known = BTreeMap::from([(uid("a"), false), (uid("b"), false)]);
        assert!(plan(unreadable.clone(), &known).steps.is_empty());
        let released = Assignments { released: BTreeSet::from([uid("b")]), ..unreadable };
        let known = BTreeMap::from([(uid("a"), false)]);
        assert!(plan(released, &known).steps.is_empty());
    }

    #[test]
    fn a_released_uid_does_not_come_back() {
        let known = BTreeMap::from([(uid("a"), true)]);
        let late = Assignments {
            upserts: BTreeMap::from([(uid("a"), desired())]),
            released: BTreeSet::from([uid("b")]),
            ..Assignments::default()
        };
        assert_eq!(
            plan(late, &known).skipped,
            [Skipped::UnknownRelease(uid("b")), Skipped::BeingRemoved(uid("a"))]
        );
    }
}
