//! How the link to the controller does: round trips of heartbeats, and how many were answered late.

/// Heartbeats that are looked back at.
const WINDOW: u32 = 64;

/// What the answers to heartbeats showed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RoundTrips {
    smoothed_usec: Option<u64>,
    /// A bit for each of the last heartbeats, the newest lowest: it was answered late.
    late: u64,
    sent: u32,
}

impl RoundTrips {
    /// A heartbeat is sent; `unanswered`: the one before has no answer yet.
    pub fn sent(&mut self, unanswered: bool) {
        if self.sent > 0 {
            self.late = (self.late << 1) | u64::from(unanswered);
        }
        self.sent = (self.sent + 1).min(WINDOW + 1);
    }

    /// An answer came after so long, microseconds. Smoothed with RFC 6298's 1/8.
    pub fn answered(&mut self, usec: u64) {
        self.smoothed_usec =
            Some(self.smoothed_usec.map_or(usec, |before| before - before / 8 + usec / 8));
    }

    /// The round trip, microseconds; none: nothing was answered yet.
    #[must_use]
    pub fn usec(&self) -> Option<u64> {
        self.smoothed_usec
    }

    /// Of a thousand heartbeats, how many were not answered before the next one.
    #[must_use]
    pub fn late_permille(&self) -> u32 {
        let judged = self.sent.saturating_sub(1);
        (self.late.count_ones() * 1000).checked_div(judged).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trips_are_smoothed_and_late_ones_counted_over_the_last_heartbeats() {
        let mut trips = RoundTrips::default();
        assert_eq!((trips.usec(), trips.late_permille()), (None, 0));
        trips.sent(false);
        trips.answered(800);
        assert_eq!(trips.usec(), Some(800));
        trips.answered(1600);
        assert_eq!(trips.usec(), Some(900));
        trips.sent(false);
        trips.sent(true);
        assert_eq!(trips.late_permille(), 500);
        for _ in 0..WINDOW {
            trips.sent(false);
        }
        assert_eq!(trips.late_permille(), 0, "what is long ago is forgotten");
    }
}
