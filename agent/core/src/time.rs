//! Two clocks that must not be mixed.

use serde::{Deserialize, Serialize};

/// Milliseconds since boot, suspend included. Deadlines are in this clock. It starts again at every
/// boot: a stored value means nothing after one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Boot(pub u64);

impl Boot {
    /// This time and `millis` more.
    #[must_use]
    pub const fn plus(self, millis: u64) -> Boot {
        Boot(self.0.saturating_add(millis))
    }
}

/// Milliseconds since the Unix epoch. For people and records only: it may jump.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Wall(pub i64);

/// Both clocks, read together.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Now {
    /// For deadlines.
    pub boot: Boot,
    /// For records.
    pub wall: Wall,
}
