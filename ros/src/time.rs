//! ROS's two built-in times.

use std::time::{Duration as Span, SystemTime, UNIX_EPOCH};

use crate::wire::{DecodeError, Reader, Wire};

/// A point in time: since the Unix epoch, or of the simulation when `/use_sim_time` is set.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Time {
    /// Whole seconds.
    pub sec: u32,
    /// The rest, below 1 000 000 000 in what is well-formed.
    pub nsec: u32,
}

/// Between two points in time. Both parts carry the sign.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct Duration {
    /// Whole seconds.
    pub sec: i32,
    /// The rest, nanoseconds.
    pub nsec: i32,
}

impl Time {
    /// By this machine's clock.
    #[must_use]
    pub fn now() -> Time {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Time { sec: u32::try_from(since.as_secs()).unwrap_or(u32::MAX), nsec: since.subsec_nanos() }
    }

    /// Nobody said when: many publishers leave stamps at zero.
    #[must_use]
    pub fn is_zero(self) -> bool {
        self == Time::default()
    }

    /// Since the epoch.
    #[must_use]
    pub fn since_epoch(self) -> Span {
        Span::from_secs(self.sec.into()) + Span::from_nanos(self.nsec.into())
    }

    /// Nanoseconds since the epoch.
    #[must_use]
    pub fn nanos(self) -> i64 {
        i64::from(self.sec) * 1_000_000_000 + i64::from(self.nsec)
    }
}

impl Wire for Time {
    const LEAST: usize = 8;

    fn nothing() -> Self {
        Time::default()
    }

    fn read(from: &mut Reader) -> Result<Self, DecodeError> {
        Ok(Time { sec: u32::read(from)?, nsec: u32::read(from)? })
    }

    fn write(&self, to: &mut Vec<u8>) {
        self.sec.write(to);
        self.nsec.write(to);
    }
}

impl Wire for Duration {
    const LEAST: usize = 8;

    fn nothing() -> Self {
        Duration::default()
    }

    fn read(from: &mut Reader) -> Result<Self, DecodeError> {
        Ok(Duration { sec: i32::read(from)?, nsec: i32::read(from)? })
    }

    fn write(&self, to: &mut Vec<u8>) {
        self.sec.write(to);
        self.nsec.write(to);
    }
}
