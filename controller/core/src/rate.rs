//! How often somebody may ask: a token bucket.
//!
//! A bucket holds `burst` tokens at most and gains `per_second` of them; each request takes one. So within any time `t` there
//! are `burst + per_second · t` requests at most, and who asks less often is never kept waiting.

use std::time::Duration;

/// What a bucket holds, and gains.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rate {
    /// Tokens a second; above 0.
    pub per_second: f64,
    /// Tokens at most; 1 or more.
    pub burst: f64,
}

/// Of one user. Times are of a clock that only advances, from any beginning.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bucket {
    left: f64,
    at: Duration,
}

impl Bucket {
    /// That of somebody who has not asked for long.
    #[must_use]
    pub fn full(rate: Rate, now: Duration) -> Self {
        Self { left: rate.burst, at: now }
    }

    /// Takes a token.
    ///
    /// # Errors
    ///
    /// After what time there will be one.
    pub fn take(&mut self, rate: Rate, now: Duration) -> Result<(), Duration> {
        *self = Self { left: self.left_at(rate, now), at: self.at.max(now) };
        if self.left >= 1.0 {
            self.left -= 1.0;
            return Ok(());
        }
        Err(Duration::from_secs_f64((1.0 - self.left) / rate.per_second))
    }

    /// Whether it is as one of somebody who has not asked.
    #[must_use]
    pub fn is_full(&self, rate: Rate, now: Duration) -> bool {
        self.left_at(rate, now) >= rate.burst
    }

    fn left_at(&self, rate: Rate, now: Duration) -> f64 {
        let gained = now.saturating_sub(self.at).as_secs_f64() * rate.per_second;
        (self.left + gained).min(rate.burst)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const RATE: Rate = Rate { per_second: 10.0, burst: 20.0 };

    #[test]
    fn who_floods_gets_the_burst_and_then_the_rate() {
        let mut bucket = Bucket::full(RATE, Duration::ZERO);
        let mut taken = |from: u64, to: u64| {
            let times = (from..to).map(Duration::from_millis);
            times.filter(|now| bucket.take(RATE, *now).is_ok()).count()
        };
        assert_eq!(taken(0, 20), 20);
        assert_eq!(taken(20, 10_020), 100);
    }

    proptest! {
        #[test]
        fn never_more_than_the_burst_and_the_rate(pauses in proptest::collection::vec(0..400_u64, 1..300)) {
            let mut bucket = Bucket::full(RATE, Duration::ZERO);
            let (mut now, mut taken) = (Duration::ZERO, Vec::new());
            for pause in pauses {
                now += Duration::from_millis(pause);
                match bucket.take(RATE, now) {
                    Ok(()) => taken.push(now),
                    Err(after) => {
                        // Who waits as told has one, and nobody has it much sooner.
                        let mut patient = bucket;
                        let told = now + after + Duration::from_micros(1);
                        prop_assert_eq!(patient.take(RATE, told), Ok(()));
                        let mut hasty = bucket;
                        prop_assert!(hasty.take(RATE, now + after.mul_f64(0.99)).is_err());
                    }
                }
            }
            for (i, from) in taken.iter().enumerate() {
                for (j, to) in taken.iter().enumerate().skip(i) {
                    let most = RATE.burst + (*to - *from).as_secs_f64() * RATE.per_second;
                    prop_assert!((j - i + 1) as f64 <= most + 1e-6, "{} in {:?}", j - i + 1, *to - *from);
                }
            }
            prop_assert!(bucket.is_full(RATE, now + Duration::from_secs(2)));
        }

        #[test]
        fn who_asks_seldom_is_never_kept_waiting(pauses in proptest::collection::vec(100..5_000_u64, 1..200)) {
            let mut bucket = Bucket::full(RATE, Duration::ZERO);
            let mut now = Duration::ZERO;
            for pause in pauses {
                now += Duration::from_millis(pause);
                prop_assert_eq!(bucket.take(RATE, now), Ok(()));
            }
        }
    }
}
