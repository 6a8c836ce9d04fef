//! Exit codes of a workload: `muster`'s own classes.

/// It ran to its end, or was asked to end.
pub(crate) const OK: u8 = 0;
/// It could not do its work.
pub(crate) const FAILURE: u8 = 1;
