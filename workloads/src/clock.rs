//! Cpu time of this process, and the wish that it ends.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};

/// Cpu time of this process, all threads, user and system. Wall time would count what others got.
pub(super) fn cpu_time() -> Duration {
    let t = clock_gettime(ClockId::ProcessCPUTime);
    // The kernel gives neither a negative time nor a nanosecond too many.
    Duration::new(t.tv_sec.unsigned_abs(), u32::try_from(t.tv_nsec).unwrap_or(0))
}

/// Set by SIGTERM and SIGINT; a sleeper wakes at once.
#[derive(Debug, Clone, Default)]
pub(super) struct Stop(Arc<(Mutex<bool>, Condvar)>);

impl Stop {
    /// Begins to listen for signals, in a thread of its own that costs nothing until one comes.
    pub(super) fn on_signals() -> Self {
        let stop = Stop::default();
        let seen = stop.clone();
        let listening = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            listen(&listening.0, |_| {
                seen.set();
                true
            });
        });
        // Whatever happens after this return happens with the handler in place.
        let _ = listening.1.recv();
        stop
    }

    pub(super) fn set(&self) {
        *self.0.0.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.0.1.notify_all();
    }

    pub(super) fn is_set(&self) -> bool {
        *self.0.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sleeps until `then`, at most until the wish comes. True: it has come.
    pub(super) fn sleep_until(&self, then: Instant) -> bool {
        let mut stopped = self.0.0.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            let left = then.saturating_duration_since(Instant::now());
            if *stopped || left.is_zero() {
                return *stopped;
            }
            let woken = self.0.1.wait_timeout(stopped, left);
            stopped = woken.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Sleeps until the wish comes.
    pub(super) fn wait(&self) {
        let mut stopped = self.0.0.lock().unwrap_or_else(PoisonError::into_inner);
        while !*stopped {
            stopped = self.0.1.wait(stopped).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// Calls `each` for every SIGTERM and SIGINT until it returns true. Says when it listens.
pub(super) fn listen(
    listening: &std::sync::mpsc::Sender<()>,
    mut each: impl FnMut(&'static str) -> bool,
) {
    use tokio::signal::unix::{SignalKind, signal};
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let Ok(runtime) = runtime else { return };
    runtime.block_on(async {
        let (Ok(mut terminate), Ok(mut interrupt)) =
            (signal(SignalKind::terminate()), signal(SignalKind::interrupt()))
        else {
            // Then a signal ends the process as it would have anyway.
            return;
        };
        let _ = listening.send(());
        loop {
            let name = tokio::select! {
                _ = terminate.recv() => "SIGTERM",
                _ = interrupt.recv() => "SIGINT",
            };
            if each(name) {
                return;
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cpu_time_counts_work_and_not_sleep() {
        let begin = cpu_time();
        std::thread::sleep(Duration::from_millis(30));
        let slept = cpu_time() - begin;
        let until = Instant::now() + Duration::from_millis(30);
        while Instant::now() < until {
            std::hint::spin_loop();
        }
        // Other tests of this process may work meanwhile, so only the direction is sure.
        assert!(cpu_time() > begin + slept);
    }

    #[test]
    fn a_sleeper_wakes_for_the_end() {
        let stop = Stop::default();
        assert!(!stop.sleep_until(Instant::now() + Duration::from_millis(1)));
        let other = stop.clone();
        let thread = std::thread::spawn(move || other.set());
        assert!(stop.sleep_until(Instant::now() + Duration::from_secs(60)));
        thread.join().unwrap();
    }
}
