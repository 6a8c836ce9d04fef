//! What waits for one subscriber: bounded, the oldest goes, and something urgent goes before all that is not.

use std::collections::VecDeque;
use std::os::fd::{AsRawFd as _, OwnedFd};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use tokio::sync::Notify;

use super::lock;

/// Urgent messages that wait. More are of no use: each says what the one before said.
const MOST_URGENT: usize = 4;

#[derive(Debug)]
pub(super) struct Outbox {
    waiting: Mutex<Waiting>,
    some: Notify,
    most: usize,
    /// The number of the newest frame that the kernel was given.
    written: AtomicU64,
    /// Of the connection.
    socket: OwnedFd,
}

#[derive(Debug, Default)]
struct Waiting {
    urgent: VecDeque<(u64, Bytes)>,
    others: VecDeque<(u64, Bytes)>,
    /// How many frames there were so far: the number of the newest.
    newest: u64,
}

impl Outbox {
    /// At least one frame waits in it.
    pub(super) fn new(most: usize, socket: OwnedFd) -> Outbox {
        Outbox {
            waiting: Mutex::default(),
            some: Notify::new(),
            most: most.max(1),
            written: AtomicU64::new(0),
            socket,
        }
    }

    pub(super) fn push(&self, frame: Bytes) {
        let mut waiting = lock(&self.waiting);
        waiting.newest += 1;
        if waiting.others.len() == self.most {
            waiting.others.pop_front();
        }
        let newest = waiting.newest;
        waiting.others.push_back((newest, frame));
        drop(waiting);
        self.some.notify_one();
    }

    /// In the place of all that waits and is not urgent.
    pub(super) fn push_urgent(&self, frame: Bytes) {
        let mut waiting = lock(&self.waiting);
        waiting.newest += 1;
        waiting.others.clear();
        if waiting.urgent.len() == MOST_URGENT {
            waiting.urgent.pop_front();
        }
        let newest = waiting.newest;
        waiting.urgent.push_back((newest, frame));
        drop(waiting);
        self.some.notify_one();
    }

    /// The next one, and its number. Cancel safe; one reader.
    pub(super) async fn pop(&self) -> (u64, Bytes) {
        loop {
            {
                let mut waiting = lock(&self.waiting);
                let next = waiting.urgent.pop_front().or_else(|| waiting.others.pop_front());
                if let Some(next) = next {
                    return next;
                }
            }
            self.some.notified().await;
        }
    }

    pub(super) fn wrote(&self, number: u64) {
        self.written.store(number, Ordering::Release);
    }

    /// Whether the subscriber's machine has everything. What its program has read is not known.
    pub(super) fn is_delivered(&self) -> bool {
        let newest = lock(&self.waiting).newest;
        self.written.load(Ordering::Acquire) == newest && unsent(&self.socket) == 0
    }
}

/// Bytes that the other side's kernel has not acknowledged. What ours does not tell counts as none.
fn unsent(socket: &OwnedFd) -> libc::c_int {
    let mut bytes: libc::c_int = 0;
    // SAFETY: the descriptor is open, and the request writes one int.
    match unsafe { libc::ioctl(socket.as_raw_fd(), libc::TIOCOUTQ, &mut bytes) } {
        0 => bytes,
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_is_urgent_takes_the_place_of_the_rest() {
        let (socket, _other) = std::os::unix::net::UnixStream::pair().unwrap();
        let outbox = Outbox::new(2, socket.into());
        assert!(outbox.is_delivered());
        for frame in ["a", "b", "c"] {
            outbox.push(Bytes::from(frame));
        }
        assert_eq!(outbox.pop().await, (2, Bytes::from("b")), "the oldest went");
        outbox.wrote(2);
        assert!(!outbox.is_delivered());
        outbox.push_urgent(Bytes::from("stop"));
        outbox.push(Bytes::from("d"));
        outbox.push_urgent(Bytes::from("cut"));
        outbox.push(Bytes::from("e"));
        for (number, frame) in [(4, "stop"), (6, "cut"), (7, "e")] {
            assert_eq!(outbox.pop().await, (number, Bytes::from(frame)));
            outbox.wrote(number);
        }
        assert!(outbox.is_delivered());
    }
}
