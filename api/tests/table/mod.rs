//! Tables that hold muster to Kubernetes: what is asked, what Kubernetes says, what muster must say. Shared by the tests
//! of the crates that decide.

#![allow(clippy::allow_attributes, dead_code, reason = "each test takes what it needs")]

use std::fmt::Debug;

pub(crate) use Muster::{Differs, Same};

/// What muster must say where Kubernetes says something.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Muster<T> {
    /// The same.
    Same,
    /// This instead, on purpose, and why.
    Differs(T, &'static str),
}

/// What is asked, what Kubernetes says, what muster must say.
pub(crate) type Row<I, T> = (I, T, Muster<T>);

/// Asks `decide` row by row. A row that says to differ has to.
pub(crate) fn hold<I: Clone + Debug, T: Clone + PartialEq + Debug>(
    rows: &[Row<I, T>],
    decide: impl Fn(I) -> T,
) {
    for (input, kubernetes, muster) in rows {
        let (expected, why) = match muster {
            Same => (kubernetes, "as in Kubernetes"),
            Differs(expected, why) => (expected, *why),
        };
        assert_eq!(&decide(input.clone()), expected, "{input:?} ({why})");
        if let Differs(expected, _) = muster {
            assert_ne!(expected, kubernetes, "{input:?} differs in nothing");
        }
    }
}
