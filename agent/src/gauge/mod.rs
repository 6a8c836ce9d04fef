//! What is read off the machine now and then: a robot's battery, the disk that the agent writes to, what it is made of.

pub(crate) mod battery;
pub(crate) mod disk;
pub(crate) mod machine;

use std::time::Duration;

use tokio::sync::watch;
use tokio::time::MissedTickBehavior;
use tokio_util::task::AbortOnDropHandle;

/// The newest reading of something that is read again every so often, on another thread: a file system that hangs later
/// must not stop the agent.
#[derive(Debug)]
pub(crate) struct Gauge<T> {
    newest: watch::Receiver<T>,
    _reader: AbortOnDropHandle<()>,
}

impl<T: Clone + PartialEq + Send + Sync + 'static> Gauge<T> {
    /// `read` is given the last reading. The first one is made here, before this returns: what the controller is told first
    /// must not be less than what it knew.
    fn open(every: Duration, first: T, read: impl Fn(T) -> T + Clone + Send + 'static) -> Self {
        let first = read(first);
        let (say, newest) = watch::channel(first);
        let reader = tokio::spawn(async move {
            let mut ticks = tokio::time::interval(every);
            ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
            ticks.tick().await;
            loop {
                ticks.tick().await;
                let (read, last) = (read.clone(), say.borrow().clone());
                let Ok(new) = tokio::task::spawn_blocking(move || read(last)).await else { return };
                say.send_if_modified(|known| {
                    let changes = *known != new;
                    *known = new;
                    changes
                });
            }
        });
        Gauge { newest, _reader: AbortOnDropHandle::new(reader) }
    }

    fn newest(&self) -> T {
        self.newest.borrow().clone()
    }
}
