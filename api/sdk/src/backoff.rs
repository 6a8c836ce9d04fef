//! How long to wait between two tries to connect. Pure: randomness is an argument of the inner function.

use std::hash::{BuildHasher as _, Hasher as _, RandomState};
use std::time::Duration;

/// The first pause. Short, because what is started anew is back within seconds.
const FIRST: Duration = Duration::from_millis(100);
/// The longest pause: how long a framework or an executor may be alone for nothing.
const LONGEST: Duration = Duration::from_secs(10);

/// Doubling pauses up to ten seconds, each shortened at random by up to half, so that many who lost the same
/// controller do not come back at once.
#[derive(Debug)]
pub(crate) struct Backoff {
    ceiling: Duration,
}

impl Backoff {
    pub(crate) fn new() -> Self {
        Backoff { ceiling: FIRST }
    }

    /// After a success: the next pause is the first one again.
    pub(crate) fn reset(&mut self) {
        self.ceiling = FIRST;
    }

    /// The next pause.
    pub(crate) fn pause(&mut self) -> Duration {
        // The keys of a hasher are the one source of randomness in std, and jitter needs no better one.
        let random = RandomState::new().build_hasher().finish();
        self.pause_with((random >> 11) as f64 / (1_u64 << 53) as f64)
    }

    /// `random`: in [0, 1).
    fn pause_with(&mut self, random: f64) -> Duration {
        let pause = self.ceiling.mul_f64(1.0 - random / 2.0);
        self.ceiling = (self.ceiling * 2).min(LONGEST);
        pause
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_to_a_cap_and_lose_up_to_half() {
        let mut backoff = Backoff::new();
        let pauses: Vec<Duration> = (0..10).map(|_| backoff.pause_with(0.0)).collect();
        assert_eq!(pauses[..3], [FIRST, FIRST * 2, FIRST * 4]);
        assert_eq!(pauses[9], LONGEST);
        assert!(backoff.pause_with(0.999) > LONGEST / 2);
        backoff.reset();
        assert_eq!(backoff.pause_with(0.5), FIRST.mul_f64(0.75));
        let pause = backoff.pause();
        assert!(pause >= FIRST && pause <= FIRST * 2, "{pause:?}");
    }
}
