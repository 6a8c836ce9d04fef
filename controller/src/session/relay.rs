//! Messages of frameworks on their way to the executors of one agent: a stream of its own beside the agent's session, on a
//! connection of its own.
//!
//! A robot's link may be slow, and messages are up to 4 MiB: nothing of the session waits behind them. What waits is bounded
//! in bytes and in number; more is refused, and the framework is told that the node does not keep up.

use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};

use futures::Stream;
use muster_api::wire::agent::v1 as wire;
use tokio::sync::mpsc;
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

use super::lock;

/// Most bytes of messages that wait for one agent: some of the largest.
const MAX_WAITING: usize = 16 << 20;
/// Most messages that wait for one agent.
const MAX_MESSAGES: usize = 1024;

/// Where messages to a node's executors go in, for one session of its agent.
#[derive(Debug, Clone, Default)]
pub(crate) struct Relay(Arc<Mutex<Option<Line>>>);

/// The way to one stream.
#[derive(Debug, Clone)]
struct Line {
    messages: mpsc::Sender<wire::Message>,
    waiting: Arc<AtomicUsize>,
    over: CancellationToken,
}

/// What an agent's executors are told.
#[derive(Debug)]
pub(super) struct Relayed {
    messages: mpsc::Receiver<wire::Message>,
    waiting: Arc<AtomicUsize>,
    over: CancellationToken,
    end: Pin<Box<WaitForCancellationFutureOwned>>,
}

/// Why a message is lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Lost {
    /// The agent has no stream for them: it has no executors, or has just lost it.
    NoWay,
    /// Too much waits for the agent.
    TooMuch,
}

impl Relay {
    /// A stream of the agent's; an earlier one ends.
    pub(super) fn attach(&self) -> Relayed {
        let (to_agent, messages) = mpsc::channel(MAX_MESSAGES);
        let (waiting, over) = (Arc::<AtomicUsize>::default(), CancellationToken::new());
        let line = Line { messages: to_agent, waiting: Arc::clone(&waiting), over: over.clone() };
        if let Some(earlier) = lock(&self.0).replace(line) {
            earlier.over.cancel();
        }
        let end = Box::pin(over.clone().cancelled_owned());
        Relayed { messages, waiting, over, end }
    }

    /// Passes a message on. Never waits.
    pub(crate) fn send(&self, message: wire::Message) -> Result<(), Lost> {
        let line = lock(&self.0).clone().filter(|line| !line.over.is_cancelled());
        let Line { messages, waiting, .. } = line.ok_or(Lost::NoWay)?;
        let bytes = message.data.len();
        let fits = waiting.fetch_add(bytes, Ordering::Relaxed) + bytes <= MAX_WAITING;
        let sent = fits && messages.try_send(message).is_ok();
        if !sent {
            waiting.fetch_sub(bytes, Ordering::Relaxed);
        }
        sent.then_some(()).ok_or(Lost::TooMuch)
    }
}

impl Relayed {
    /// Cancelled when the stream is over; cancelling it ends the stream.
    pub(super) fn over(&self) -> CancellationToken {
        self.over.clone()
    }
}

impl Drop for Relayed {
    fn drop(&mut self) {
        self.over.cancel();
    }
}

impl Stream for Relayed {
    type Item = wire::Message;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<wire::Message>> {
        let this = self.get_mut();
        if this.end.as_mut().poll(context).is_ready() {
            return Poll::Ready(None);
        }
        let next = std::task::ready!(this.messages.poll_recv(context));
        if let Some(message) = &next {
            this.waiting.fetch_sub(message.data.len(), Ordering::Relaxed);
        }
        Poll::Ready(next)
    }
}

#[cfg(test)]
mod tests {
    use futures::{FutureExt as _, StreamExt as _};

    use super::*;

    fn message(bytes: usize) -> wire::Message {
        wire::Message { data: vec![0; bytes].into(), ..wire::Message::default() }
    }

    #[test]
    fn messages_that_wait_are_bounded_in_bytes_and_number() {
        let relay = Relay::default();
        assert_eq!(relay.send(message(1)), Err(Lost::NoWay));
        let mut told = relay.attach();
        let largest = 4 << 20;
        let sent = (0..8).filter(|_| relay.send(message(largest)).is_ok()).count();
        assert_eq!(sent, MAX_WAITING / largest);
        assert!(told.next().now_or_never().flatten().is_some());
        assert_eq!(relay.send(message(largest)), Ok(()), "there is room again");
        assert_eq!(relay.send(message(1)), Err(Lost::TooMuch));
        let mut told = relay.attach();
        assert_eq!(
            (0..2 * MAX_MESSAGES).filter(|_| relay.send(message(0)).is_ok()).count(),
            MAX_MESSAGES
        );
        assert!(told.next().now_or_never().flatten().is_some());
    }

    #[test]
    fn a_later_stream_ends_an_earlier_one() {
        let relay = Relay::default();
        let mut first = relay.attach();
        assert_eq!(relay.send(message(1)), Ok(()));
        let mut second = relay.attach();
        assert_eq!(first.next().now_or_never(), Some(None), "what was under way is lost");
        assert_eq!(relay.send(message(2)), Ok(()));
        assert!(second.next().now_or_never().flatten().is_some_and(|m| m.data.len() == 2));
        second.over().cancel();
        assert_eq!(second.next().now_or_never(), Some(None));
        assert_eq!(relay.send(message(3)), Err(Lost::NoWay));
        drop(relay.attach());
        assert_eq!(relay.send(message(3)), Err(Lost::NoWay), "nobody reads");
    }
}
