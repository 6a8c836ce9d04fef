//! Where the parts of an Application run: AnyScale, decided purely.
//!
//! ```text
//!   spec ──Model::of──▶ Model (critical parts pinned, impossible mappings pruned)
//!   Model + what is so now ──▶ Snapshot ──plan(now)──▶ Plan { actions, mapping, reasons, fallback, look_again }
//!   one action ──▶ migration::Stage ──▶ start there, switch the connections, stop here
//! ```
//!
//! | module | decides |
//! |---|---|
//! | [`model`] | what follows from the spec alone |
//! | [`view`] | what of the world matters here |
//! | [`violation`] | what is broken, or will be before its parts could be home |
//! | [`problem`], [`constraint`] | a decision as numbers, and what it must keep |
//! | [`solver`] | the best mapping, or one with a proven gap |
//! | [`greedy`] | the paper's Algorithm 1 |
//! | [`policy`] | what is moved, and when it is not |
//! | [`migration`] | make before break; what a robot does alone |
//! | [`reason`] | why a part is where it is, and what it would take |
//! | [`run`] | the tasks of the parts: begun, moved, ended |
//!
//! Rules that hold whatever happens, each with a test of its name in `tests` or `crate::simulation`:
//!
//! - A part is on its way home before what its connections tolerate is over, the time it takes to start there taken off.
//! - A part that came home does not leave again within the cool-down, and one that left is moved again within it only home,
//!   for a violation.
//! - A mapping that is decided keeps every constraint, counted from nothing.

pub mod constraint;
pub mod greedy;
pub mod migration;
pub mod model;
pub mod policy;
pub mod problem;
pub mod reason;
pub mod run;
pub mod solver;
#[cfg(test)]
mod tests;
pub mod view;
pub mod violation;

use std::time::Duration;

use jiff::Timestamp;

pub use policy::plan;
use reason::{Elsewhere, Stand, Violation};

/// What is to be done with an application, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// In this order.
    pub actions: Vec<Action>,
    /// Where every part is when they are done, an index into the snapshot's scales.
    pub mapping: Vec<usize>,
    /// What of each part is to be said.
    pub parts: Vec<Said>,
    /// What the mapping is worth.
    pub value: f64,
    /// What everything at home is worth.
    pub home_value: f64,
    /// No mapping that the policy may choose is worth more.
    pub bound: f64,
    /// What a robot that is cut off does alone.
    pub fallback: Vec<Fallback>,
    /// When to look again, if nothing changes before.
    pub look_again: Timestamp,
}

/// One move. Each is made before it breaks: [`migration`].
#[derive(Debug, Clone, PartialEq)]
pub struct Action {
    /// The part.
    pub part: usize,
    /// Where it goes.
    pub to: usize,
    /// Why it must come home; none: because it is worth more there.
    pub forced: Option<Violation>,
}

/// What is to be said of a part.
#[derive(Debug, Clone, PartialEq)]
pub struct Said {
    /// Why it is where it is.
    pub stand: Stand,
    /// What the other scales would gain, and what stands in the way.
    pub elsewhere: Vec<Elsewhere>,
}

/// What a robot may do without asking, given to it while the part is away: start the part's standby at home.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fallback {
    /// The part.
    pub part: usize,
    /// After so long without its scale. The part there ends itself by then.
    pub after: Duration,
}
