//! A queue that never makes its writer wait: when it is full, the oldest goes.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

#[derive(Debug)]
pub(crate) struct Queue<T> {
    items: Mutex<Items<T>>,
    some: Notify,
    most: usize,
}

#[derive(Debug)]
struct Items<T> {
    waiting: VecDeque<T>,
    dropped: u64,
}

impl<T> Queue<T> {
    /// At least one item waits in it.
    pub(crate) fn new(most: usize) -> Self {
        let items = Items { waiting: VecDeque::new(), dropped: 0 };
        Queue { items: Mutex::new(items), some: Notify::new(), most: most.max(1) }
    }

    fn items(&self) -> MutexGuard<'_, Items<T>> {
        self.items.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn push(&self, item: T) {
        let mut items = self.items();
        if items.waiting.len() == self.most {
            items.waiting.pop_front();
            items.dropped += 1;
        }
        items.waiting.push_back(item);
        drop(items);
        self.some.notify_one();
    }

    /// The oldest. Cancel safe; one reader.
    pub(crate) async fn pop(&self) -> T {
        loop {
            if let Some(item) = self.items().waiting.pop_front() {
                return item;
            }
            self.some.notified().await;
        }
    }

    /// How many were dropped since the start.
    pub(crate) fn dropped(&self) -> u64 {
        self.items().dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_oldest_goes_when_it_is_full() {
        let queue = Queue::new(2);
        (0..5).for_each(|n| queue.push(n));
        assert_eq!((queue.pop().await, queue.pop().await, queue.dropped()), (3, 4, 3));
        let (popped, ()) = tokio::join!(queue.pop(), async { queue.push(9) });
        assert_eq!(popped, 9);
    }
}
