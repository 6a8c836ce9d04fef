//! The invariants of DESIGN §4 by their names, and what a run says that breaks one.

use std::fmt;

/// What must never be otherwise.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Invariant {
    /// 1: a robot has one driver at any instant, and its lease's epoch only grows.
    OneDriver,
    /// 2: Σ reserved ≤ allocatable, by the books and by the processes.
    NoOversubscription,
    /// 3: what was answered 2xx is there.
    NothingAcknowledgedIsLost,
    /// 4: a uid has at most one live attempt, and no attempt begins twice.
    NothingRunsTwice,
    /// 5: nobody's death but its own restarts a task, and no end is lost.
    WorkOutlivesItsManagers,
    /// 6: what waits says why; without faults everything settles.
    EverythingEndsOrExplainsItself,
    /// Not one of the seven: the program itself fell over.
    Panicked,
}

impl Invariant {
    /// It is broken.
    pub(crate) fn broken(self, how: String) -> Violation {
        Violation { invariant: self, how }
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            Invariant::OneDriver => "one_driver",
            Invariant::NoOversubscription => "no_oversubscription",
            Invariant::NothingAcknowledgedIsLost => "nothing_acknowledged_is_lost",
            Invariant::NothingRunsTwice => "nothing_runs_twice",
            Invariant::WorkOutlivesItsManagers => "work_outlives_its_managers",
            Invariant::EverythingEndsOrExplainsItself => "everything_ends_or_explains_itself",
            Invariant::Panicked => "panicked",
        }
    }
}

/// A broken invariant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Violation {
    pub(crate) invariant: Invariant,
    pub(crate) how: String,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.invariant.name(), self.how)
    }
}
