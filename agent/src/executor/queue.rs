//! What waits for one reader, in order, bounded by size.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use tokio::sync::Notify;

/// Bytes of messages that wait; four of the longest. A reader that is further behind loses some.
pub(super) const MOST_BYTES: usize = 4 * super::frame::MESSAGE_MAX;

/// The queue.
#[derive(Debug)]
pub(crate) struct Queue<T> {
    waiting: Mutex<Waiting<T>>,
    more: Notify,
}

#[derive(Debug)]
struct Waiting<T> {
    items: VecDeque<(T, usize)>,
    bytes: usize,
}

impl<T> Default for Queue<T> {
    fn default() -> Self {
        let waiting = Waiting { items: VecDeque::new(), bytes: 0 };
        Queue { waiting: Mutex::new(waiting), more: Notify::new() }
    }
}

impl<T> Queue<T> {
    /// Takes `item` unless too much waits. An item of size 0 is always taken.
    pub(crate) fn push(&self, item: T, size: usize) -> bool {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if size > 0 && waiting.bytes + size > MOST_BYTES {
            return false;
        }
        waiting.bytes += size;
        waiting.items.push_back((item, size));
        drop(waiting);
        self.more.notify_one();
        true
    }

    /// The next item. For one reader at a time; cancel-safe.
    pub(crate) async fn pop(&self) -> T {
        loop {
            let item = {
                let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
                let next = waiting.items.pop_front();
                next.map(|(item, size)| {
                    waiting.bytes -= size;
                    item
                })
            };
            match item {
                Some(item) => return item,
                None => self.more.notified().await,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn in_order_and_bounded() {
        let queue = Queue::default();
        assert!(queue.push(1, MOST_BYTES) && !queue.push(2, 1) && queue.push(3, 0));
        assert_eq!((queue.pop().await, queue.pop().await), (1, 3));
        assert!(queue.push(4, 1));
        assert_eq!(queue.pop().await, 4);
    }
}
