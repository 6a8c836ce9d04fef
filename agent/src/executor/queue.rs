//! What waits for one reader, in order, bounded by what it takes in memory.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

use super::frame::MESSAGE_MAX;

/// What an item takes beside its payload, about, bytes: many small messages are bounded as well.
const BESIDE: usize = 256;

/// Bytes that wait; four of the longest messages. A reader that is further behind loses some.
pub(super) const MOST_BYTES: usize = 4 * cost(MESSAGE_MAX);

/// Answers that wait until the reader is heard again.
const MOST_ANSWERS: usize = 1024;

/// What a message of so many bytes takes while it waits.
pub(super) const fn cost(bytes: usize) -> usize {
    bytes + BESIDE
}

/// The queue.
#[derive(Debug)]
pub(crate) struct Queue<T> {
    waiting: Mutex<Waiting<T>>,
    more: Notify,
    less: Notify,
}

#[derive(Debug)]
struct Waiting<T> {
    items: VecDeque<Item<T>>,
    cost: usize,
    /// How many of them are [`Queue::push_always`]'s.
    answers: usize,
    shut: bool,
}

#[derive(Debug)]
struct Item<T> {
    item: T,
    bytes: usize,
    answer: bool,
}

impl<T> Default for Queue<T> {
    fn default() -> Self {
        let waiting = Waiting { items: VecDeque::new(), cost: 0, answers: 0, shut: false };
        Queue { waiting: Mutex::new(waiting), more: Notify::new(), less: Notify::new() }
    }
}

/// Why an item was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Refused {
    /// Too much waits.
    Full,
    /// Nobody reads.
    Shut,
}

impl<T> Queue<T> {
    fn waiting(&self) -> MutexGuard<'_, Waiting<T>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes an item with a payload of so many bytes, unless too much waits.
    pub(crate) fn push(&self, item: T, bytes: usize) -> Result<(), Refused> {
        let mut waiting = self.waiting();
        if waiting.shut {
            return Err(Refused::Shut);
        }
        if waiting.cost + cost(bytes) > MOST_BYTES {
            return Err(Refused::Full);
        }
        self.take(&mut waiting, Item { item, bytes, answer: false });
        Ok(())
    }

    /// Takes an answer however much waits: nobody may lose it, and [`Queue::room`] bounds how many there are.
    pub(crate) fn push_always(&self, item: T) {
        self.take(&mut self.waiting(), Item { item, bytes: 0, answer: true });
    }

    fn take(&self, waiting: &mut Waiting<T>, item: Item<T>) {
        waiting.cost += cost(item.bytes);
        waiting.answers += usize::from(item.answer);
        waiting.items.push_back(item);
        self.more.notify_one();
    }

    /// The next item. For one reader at a time; cancel-safe.
    pub(crate) async fn pop(&self) -> T {
        loop {
            let item = {
                let mut waiting = self.waiting();
                let next = waiting.items.pop_front();
                next.map(|Item { item, bytes, answer }| {
                    waiting.cost -= cost(bytes);
                    waiting.answers -= usize::from(answer);
                    item
                })
            };
            match item {
                Some(item) => {
                    self.less.notify_one();
                    return item;
                }
                None => self.more.notified().await,
            }
        }
    }

    /// Ready when few answers wait. Nothing else counts: who is sent more than it can read, and says something for each before it
    /// reads the next, is heard. For one waiter at a time; cancel-safe.
    pub(crate) async fn room(&self) {
        while self.waiting().answers > MOST_ANSWERS {
            self.less.notified().await;
        }
    }

    /// Forgets what waits.
    pub(crate) fn clear(&self) {
        let mut waiting = self.waiting();
        waiting.items.clear();
        (waiting.cost, waiting.answers) = (0, 0);
    }

    /// Forgets what waits and takes no more until [`Queue::open`].
    pub(crate) fn shut(&self) {
        self.waiting().shut = true;
        self.clear();
    }

    /// Takes items again.
    pub(crate) fn open(&self) {
        self.waiting().shut = false;
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt as _;

    use super::*;

    #[tokio::test]
    async fn in_order_and_bounded() {
        let queue = Queue::default();
        assert_eq!(queue.push(1, MOST_BYTES - BESIDE), Ok(()));
        assert_eq!(queue.push(2, 0), Err(Refused::Full));
        queue.push_always(3);
        assert_eq!((queue.pop().await, queue.pop().await), (1, 3));
        assert_eq!(queue.push(4, 1), Ok(()));
        assert_eq!(queue.pop().await, 4);
        assert_eq!(queue.waiting().cost, 0);
    }

    /// A reader that answers each message before it reads the next waits for whoever reads its answers: for that it is heard
    /// however much waits for it.
    #[tokio::test]
    async fn answers_alone_keep_a_reader_from_being_heard() {
        let queue = Queue::default();
        assert_eq!(queue.push(0, MOST_BYTES - BESIDE), Ok(()));
        queue.room().await;
        (0..=MOST_ANSWERS).for_each(|_| queue.push_always(1));
        assert!(queue.room().now_or_never().is_none());
        assert_eq!((queue.pop().await, queue.pop().await), (0, 1));
        queue.room().await;
        queue.clear();
        assert_eq!(queue.waiting().cost, 0);
        assert_eq!(queue.waiting().answers, 0);
    }

    #[test]
    fn small_items_are_bounded_too() {
        let queue = Queue::default();
        let taken = (0..).take_while(|_| queue.push((), 0).is_ok()).count();
        assert_eq!(taken, MOST_BYTES / BESIDE);
    }

    #[tokio::test]
    async fn what_waits_when_it_is_shut_is_lost() {
        let queue = Queue::default();
        assert_eq!(queue.push(1, 1), Ok(()));
        queue.shut();
        assert_eq!(queue.push(2, 1), Err(Refused::Shut));
        queue.open();
        assert_eq!(queue.push(3, 1), Ok(()));
        assert_eq!(queue.pop().await, 3);
    }
}
