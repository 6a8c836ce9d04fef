//! How often others may call a server: so often, and more often for a moment; who comes too early waits.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

/// Turns, taken one after the other (a leaky bucket; the generic cell rate algorithm, ITU-T I.371).
#[derive(Debug, Clone)]
pub struct Pace {
    every: Duration,
    ahead: Duration,
    /// When the bucket is empty again.
    empty: Arc<Mutex<Instant>>,
}

impl Pace {
    /// A turn `every` so long, and `burst` at once where there were none for a while.
    #[must_use]
    pub fn new(every: Duration, burst: u32) -> Pace {
        Pace { every, ahead: every * burst, empty: Arc::new(Mutex::new(Instant::now())) }
    }

    /// Waits for its turn. A turn whose waiting is dropped is taken all the same.
    pub async fn turn(&self) {
        tokio::time::sleep_until(self.take()).await;
    }

    /// When the next turn is.
    fn take(&self) -> Instant {
        let mut empty = self.empty.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        *empty = (*empty).max(now) + self.every;
        empty.checked_sub(self.ahead).unwrap_or(now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_burst_is_at_once_and_the_rest_in_its_time() {
        let pace = Pace::new(Duration::from_millis(2), 1_000);
        let begun = Instant::now();
        let wait = async |turns: u32| {
            for _ in 0..turns {
                pace.turn().await;
            }
            begun.elapsed()
        };
        assert_eq!(wait(1_000).await, Duration::ZERO);
        assert_eq!(wait(500).await, Duration::from_secs(1));
        // After a while without any, as many as at first.
        tokio::time::advance(Duration::from_secs(5)).await;
        assert_eq!(wait(1_000).await, Duration::from_secs(6));
        assert_eq!(wait(1).await, Duration::from_millis(6_002));
    }
}
