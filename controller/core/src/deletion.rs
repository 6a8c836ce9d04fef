//! When an object is to be gone that somebody deletes, and what its program has until then.

use jiff::{SignedDuration, Timestamp};

/// A wish that an object goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Deletion {
    /// When it is to be gone (`deletionTimestamp`).
    pub at: Timestamp,
    /// Between asking its program to end and killing it, seconds (`deletionGracePeriodSeconds`).
    pub grace: i64,
}

/// What a request to delete makes of an object: `asked` is the grace that the request names, `own` that of the object,
/// both seconds; `present` is when it is to be gone since an earlier request. None: nothing changes.
///
/// Asked again, the end can come sooner, not later. Kubernetes compares the graces and counts from the first request; what
/// is told there after a second one can lie in the past, and the end come later than without it.
#[must_use]
pub fn deletion(
    now: Timestamp,
    asked: Option<i64>,
    own: i64,
    present: Option<Timestamp>,
) -> Option<Deletion> {
    let grace = asked.unwrap_or(own);
    let at = now.saturating_add(SignedDuration::from_secs(grace)).unwrap_or(Timestamp::MAX);
    let sooner = match present {
        None => true,
        Some(present) => asked.is_some() && at < present,
    };
    sooner.then_some(Deletion { at, grace })
}
