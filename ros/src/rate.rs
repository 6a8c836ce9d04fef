//! How often a topic is published. Pure: the time is an argument.

use std::collections::VecDeque;
use std::time::Duration;

/// Slots of a window: a rate is wrong by the arrivals of one of them at most.
const KEPT: usize = 256;

/// Counts arrivals over a sliding window that is cut into slots, so that its memory does not grow with the rate.
#[derive(Debug, Clone)]
pub struct RateMeter {
    window: Duration,
    /// A slot's number since time zero and the arrivals in it, oldest first.
    slots: VecDeque<(u64, u64)>,
    slot: Duration,
    /// When counting began, and when the last arrival was.
    began: Option<Duration>,
    last: Option<Duration>,
}

impl RateMeter {
    /// Over the last `window`, at least a millisecond.
    #[must_use]
    pub fn new(window: Duration) -> Self {
        let window = window.max(Duration::from_millis(1));
        let slot = window / u32::try_from(KEPT).expect("it is small");
        RateMeter { window, slots: VecDeque::new(), slot, began: None, last: None }
    }

    fn number(&self, at: Duration) -> u64 {
        u64::try_from(at.as_nanos() / self.slot.as_nanos().max(1)).unwrap_or(u64::MAX)
    }

    /// Counting begins at `now`, on any monotonic clock: before that, silence means nothing.
    pub fn begin(&mut self, now: Duration) {
        self.began.get_or_insert(now);
    }

    /// A message has come.
    pub fn arrived(&mut self, now: Duration) {
        self.begin(now);
        self.last = Some(now);
        let number = self.number(now);
        match self.slots.back_mut() {
            Some((newest, count)) if *newest >= number => *count += 1,
            _ => self.slots.push_back((number, 1)),
        }
        self.forget(now);
    }

    fn forget(&mut self, now: Duration) {
        let oldest = self.number(now.saturating_sub(self.window));
        while self.slots.front().is_some_and(|(number, _)| *number <= oldest) {
            self.slots.pop_front();
        }
    }

    /// Messages a second over the window that ends at `now`; `None`: a whole window has not passed yet.
    #[must_use]
    pub fn hertz(&self, now: Duration) -> Option<f64> {
        let began = self.began?;
        (now.saturating_sub(began) >= self.window)
            .then(|| self.in_window(now) as f64 / self.window.as_secs_f64())
    }

    /// Messages in the window that ends at `now`.
    #[must_use]
    pub fn in_window(&self, now: Duration) -> u64 {
        let oldest = self.number(now.saturating_sub(self.window));
        let began_inside = self.began.is_some_and(|began| now.saturating_sub(began) < self.window);
        let counts = self.slots.iter().filter(|(number, _)| began_inside || *number > oldest);
        counts.map(|(_, count)| count).sum()
    }

    /// When the last message came.
    #[must_use]
    pub fn last(&self) -> Option<Duration> {
        self.last
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn nothing_is_known_before_a_window_has_passed() {
        let mut meter = RateMeter::new(SECOND);
        assert_eq!(meter.hertz(SECOND), None);
        meter.begin(SECOND);
        assert_eq!(meter.hertz(SECOND * 3 / 2), None);
        assert_eq!(meter.hertz(SECOND * 2), Some(0.0), "silence for a whole window is a rate");
    }

    #[test]
    fn a_topic_that_falls_silent_falls_to_zero() {
        let mut meter = RateMeter::new(SECOND);
        (0..300).for_each(|n| meter.arrived(Duration::from_millis(10) * n));
        let full = meter.hertz(Duration::from_millis(2990)).unwrap();
        assert!((full - 100.0).abs() <= 2.0, "{full}");
        assert_eq!(meter.hertz(Duration::from_millis(4100)), Some(0.0));
    }

    proptest! {
        /// Against every arrival kept: wrong by one slot of the window at most.
        #[test]
        fn the_count_is_right_but_for_a_slot(gaps in prop::collection::vec(0u64..40_000, 1..2_000)) {
            let mut meter = RateMeter::new(SECOND);
            let mut now = SECOND;
            meter.begin(now);
            let mut all = Vec::new();
            for gap in gaps {
                now += Duration::from_micros(gap);
                meter.arrived(now);
                all.push(now);
            }
            prop_assert!(meter.slots.len() <= KEPT + 1);
            let inside = |window: Duration| all.iter().filter(|at| now - **at < window).count() as u64;
            let slot = SECOND / KEPT as u32;
            let (least, most) = (inside(SECOND - slot), inside(SECOND + slot));
            prop_assert!((least..=most).contains(&meter.in_window(now)), "{least} {} {most}", meter.in_window(now));
        }
    }
}
