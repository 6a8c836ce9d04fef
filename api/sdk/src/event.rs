//! What happens to a framework, as a stream.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll};

use futures::Stream;
use muster_api::wire::framework::v1 as proto;
use tokio::sync::mpsc;
use tokio_util::task::AbortOnDropHandle;

use crate::FrameworkError;

/// Something that happened.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Event {
    /// The controller knows the framework now, under this id.
    Registered {
        /// The id that brings it back to its tasks.
        framework_id: String,
    },
    /// The framework is back and its tasks are still its own. Offers from before are gone.
    Reregistered,
    /// The session broke; it is being made again. Every outstanding offer is gone.
    Disconnected,
    /// Nodes with room, the closest first.
    Offers(Vec<proto::Offer>),
    /// Offers that hold no more.
    Rescinded {
        /// Their ids.
        offers: Vec<String>,
        /// Why.
        reason: proto::RescindReason,
    },
    /// The present state of a task. Said once by the SDK, and again by the controller until it is acknowledged.
    Update(proto::Update),
    /// From an executor; at most once, in order.
    Message(proto::Message),
    /// A node does not answer.
    NodeLost(proto::NodeLost),
    /// Somebody else has set where the framework works; offers from there follow.
    Moved(proto::Moved),
    /// An executor ended.
    ExecutorLost(proto::ExecutorLost),
    /// The framework has ended; nothing comes after it.
    Error(FrameworkError),
}

/// Messages of executors that come when so many events wait already are dropped: they come at most once anyway, and
/// may be large. All else waits, however long: it is little, and an answer may be behind it.
const MOST_WAITING: usize = 1024;
/// And those that come when messages of so many bytes wait.
const MOST_BYTES: usize = 64 << 20;

/// Begins a stream.
pub(crate) fn channel() -> (Outlet, Inlet) {
    let (sender, events) = mpsc::unbounded_channel();
    let waiting = Arc::<Waiting>::default();
    let inlet = Inlet { events, waiting: Arc::clone(&waiting), heard: VecDeque::new() };
    (Outlet { sender, waiting }, inlet)
}

/// The session's end of the stream. It never waits for the framework's code, which may itself wait for an answer that
/// only the session can hear.
#[derive(Debug, Clone)]
pub(crate) struct Outlet {
    sender: mpsc::UnboundedSender<Event>,
    waiting: Arc<Waiting>,
}

/// What the framework's code has not taken yet.
#[derive(Debug, Default)]
struct Waiting {
    events: AtomicUsize,
    /// Of messages.
    bytes: AtomicUsize,
}

impl Waiting {
    fn gone(&self, events: usize) {
        self.events.fetch_sub(events, Ordering::Relaxed);
    }
}

impl Outlet {
    pub(crate) fn send(&self, event: Event) {
        let Waiting { events, bytes } = &*self.waiting;
        if let Event::Message(message) = &event {
            let (size, events) = (message.data.len(), events.load(Ordering::Relaxed));
            let waiting = bytes.load(Ordering::Relaxed);
            if events >= MOST_WAITING || waiting + size > MOST_BYTES {
                tracing::warn!(
                    events,
                    bytes = waiting,
                    "a message of an executor is dropped: the framework does not keep up"
                );
                return;
            }
            bytes.fetch_add(size, Ordering::Relaxed);
        }
        events.fetch_add(1, Ordering::Relaxed);
        // A stream that was dropped ends the session; see closed().
        drop(self.sender.send(event));
    }

    /// Resolves when the stream is dropped.
    pub(crate) async fn closed(&self) {
        self.sender.closed().await;
    }
}

/// The other end.
#[derive(Debug)]
pub(crate) struct Inlet {
    events: mpsc::UnboundedReceiver<Event>,
    waiting: Arc<Waiting>,
    /// What has come and is not given yet.
    heard: VecDeque<Event>,
}

impl Inlet {
    /// The next event. What came after it is looked at first: an offer that is over is not given any more, so a
    /// framework that has moved, or was busy, does not launch on what it was offered before.
    fn poll(&mut self, context: &mut Context<'_>) -> Poll<Option<Event>> {
        let closed = loop {
            match self.events.poll_recv(context) {
                Poll::Ready(Some(event)) => self.hear(event),
                Poll::Ready(None) => break true,
                Poll::Pending => break false,
            }
        };
        match self.heard.pop_front() {
            Some(event) => {
                self.waiting.gone(1);
                if let Event::Message(message) = &event {
                    self.waiting.bytes.fetch_sub(message.data.len(), Ordering::Relaxed);
                }
                Poll::Ready(Some(event))
            }
            None if closed => Poll::Ready(None),
            None => Poll::Pending,
        }
    }

    fn hear(&mut self, mut event: Event) {
        match &mut event {
            Event::Rescinded { offers: over, .. } => {
                self.withdraw(|offer| {
                    let index = over.iter().position(|id| *id == offer.id);
                    index.map(|index| over.swap_remove(index)).is_some()
                });
                if over.is_empty() {
                    self.waiting.gone(1);
                    return;
                }
            }
            Event::Disconnected => self.withdraw(|_| true),
            _ => {}
        }
        self.heard.push_back(event);
    }

    /// Takes offers out that were not given yet.
    fn withdraw(&mut self, mut is_over: impl FnMut(&proto::Offer) -> bool) {
        let before = self.heard.len();
        self.heard.retain_mut(|event| match event {
            Event::Offers(offers) => {
                offers.retain(|offer| !is_over(offer));
                !offers.is_empty()
            }
            _ => true,
        });
        self.waiting.gone(before - self.heard.len());
    }
}

/// The events of one framework. Ends after [`Event::Error`] or when the framework is stopped. Dropping it ends the
/// session; the framework's tasks go on until its failover timeout.
#[derive(Debug)]
pub struct EventStream {
    pub(crate) inlet: Inlet,
    /// The session's task ends with the stream.
    pub(crate) _session: AbortOnDropHandle<()>,
}

impl EventStream {
    /// The next event; none: the framework has ended. Cancel-safe.
    pub async fn next(&mut self) -> Option<Event> {
        poll_fn(|context| self.poll(context)).await
    }

    fn poll(&mut self, context: &mut Context<'_>) -> Poll<Option<Event>> {
        self.inlet.poll(context)
    }
}

impl Stream for EventStream {
    type Item = Event;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Event>> {
        self.poll(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn an_offer_that_is_over_is_not_given() {
        let (outlet, inlet) = channel();
        let session = AbortOnDropHandle::new(tokio::spawn(async {}));
        let mut stream = EventStream { inlet, _session: session };
        let offers = |ids: &[&str]| {
            let offer =
                |id: &&str| proto::Offer { id: (*id).to_owned(), ..proto::Offer::default() };
            Event::Offers(ids.iter().map(offer).collect())
        };
        let rescinded = |ids: &[&str]| Event::Rescinded {
            offers: ids.iter().map(|id| (*id).to_owned()).collect(),
            reason: proto::RescindReason::Closer,
        };
        outlet.send(offers(&["1", "2"]));
        outlet.send(offers(&["3"]));
        outlet.send(rescinded(&["3", "2"]));
        assert_eq!(stream.next().await, Some(offers(&["1"])));
        outlet.send(rescinded(&["1"]));
        assert_eq!(stream.next().await, Some(rescinded(&["1"])), "that one was given");
        outlet.send(offers(&["4"]));
        outlet.send(Event::Disconnected);
        assert_eq!(stream.next().await, Some(Event::Disconnected));
        drop(outlet);
        assert_eq!(stream.next().await, None);
    }

    #[tokio::test]
    async fn a_framework_that_does_not_read_loses_messages_and_nothing_else() {
        let (outlet, inlet) = channel();
        let session = AbortOnDropHandle::new(tokio::spawn(async {}));
        let mut stream = EventStream { inlet, _session: session };
        for _ in 0..MOST_WAITING {
            outlet.send(Event::Reregistered);
        }
        outlet.send(Event::Message(proto::Message::default()));
        outlet.send(Event::Disconnected);
        for _ in 0..MOST_WAITING {
            assert_eq!(stream.next().await, Some(Event::Reregistered));
        }
        assert_eq!(stream.next().await, Some(Event::Disconnected));
        outlet.send(Event::Message(proto::Message::default()));
        assert!(matches!(stream.next().await, Some(Event::Message(_))));

        let largest = proto::Message { data: vec![0; 4 << 20].into(), ..Default::default() };
        for _ in 0..20 {
            outlet.send(Event::Message(largest.clone()));
        }
        outlet.send(Event::Disconnected);
        for _ in 0..MOST_BYTES / largest.data.len() {
            assert!(matches!(stream.next().await, Some(Event::Message(_))));
        }
        assert_eq!(stream.next().await, Some(Event::Disconnected), "the rest was dropped");
        outlet.send(Event::Message(largest));
        assert!(matches!(stream.next().await, Some(Event::Message(_))));
    }
}
