//! One function of a sensor: its source, its frames, its readers.
//!
//! The run of the source publishes, connections take; both hold the lock for a few pointers at a time. [`Channel::attend`] is
//! the only one that begins and ends runs.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use bytes::{Bytes, BytesMut};
use futures::FutureExt as _;
use futures::future::BoxFuture;
use muster_agent_core::sensor::fan::{Delivery, Fan, GivenUp, NotHeld, Reader};
use muster_agent_core::sensor::source::{Action, Event, Source, Standing};
use muster_api::name::FunctionName;
use muster_api::wire::sensor::v1 as proto;
use muster_ros1::message::Type;
use muster_ros1::node::From;
use tokio::sync::{Notify, watch};
use tokio_util::sync::CancellationToken;

use super::settings;
use super::slot::{INLINE, Pool, Slot};
use super::source::{self, Context};
use crate::clock;
use crate::driver::sleep_until;

/// What is told of why nothing comes, bytes.
const LONGEST_WHY: usize = 300;

/// One frame.
#[derive(Debug, Clone)]
pub(super) struct Frame {
    /// When it was whole: nanoseconds since the Unix epoch, and since boot.
    pub(super) stamp_ns: i64,
    pub(super) boot_ns: u64,
    pub(super) body: Body,
}

/// Cheap to clone.
#[derive(Debug, Clone)]
pub(super) enum Body {
    Inline(Bytes),
    Shared { slot: Arc<Slot>, length: usize },
}

/// Room for a frame, which a run fills.
#[derive(Debug)]
pub(super) enum Blank {
    Inline(BytesMut),
    Shared { slot: Slot, length: usize },
}

impl Blank {
    pub(super) fn bytes(&mut self) -> &mut [u8] {
        match self {
            Blank::Inline(bytes) => bytes,
            Blank::Shared { slot, length } => slot.bytes_mut(*length),
        }
    }
}

/// How it stands with the source, and what its frames are.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Stand {
    pub(super) standing: Standing,
    pub(super) format: String,
}

/// What a connection waits for.
#[derive(Debug, Default)]
struct Wake {
    ready: Notify,
    end: Notify,
    /// Why it is to end.
    closed: OnceLock<proto::Closed>,
}

impl Wake {
    fn close(&self, reason: proto::Reason, message: &str) {
        let closed = proto::Closed { reason: reason.into(), message: message.to_owned() };
        // The first reason counts.
        let _ = self.closed.set(closed);
        self.ready.notify_one();
        self.end.notify_one();
    }
}

#[derive(Debug)]
struct Inner {
    fan: Fan<Frame>,
    source: Source,
    pool: Pool,
    wakes: BTreeMap<Reader, Arc<Wake>>,
    next: u64,
}

/// One function.
#[derive(Debug)]
pub(super) struct Channel {
    settings: settings::Source,
    inner: Mutex<Inner>,
    /// How many tasks want it.
    demand: watch::Sender<usize>,
    stand: watch::Sender<Stand>,
    /// What a topic's messages are.
    kind: Mutex<Option<(Arc<From>, Arc<Type>)>>,
}

impl Channel {
    pub(super) fn new(settings: settings::Source) -> Channel {
        let silence = settings.silence.map(|span| span.as_duration().as_millis());
        let inner = Inner {
            fan: Fan::default(),
            source: Source::new(silence.map(|ms| u64::try_from(ms).unwrap_or(u64::MAX))),
            pool: Pool::new(usize::try_from(settings.memory.0).unwrap_or(usize::MAX)),
            wakes: BTreeMap::new(),
            next: 0,
        };
        Channel {
            settings,
            inner: Mutex::new(inner),
            demand: watch::Sender::default(),
            stand: watch::Sender::default(),
            kind: Mutex::default(),
        }
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn function(&self) -> &FunctionName {
        &self.settings.function
    }

    pub(super) fn settings(&self) -> &settings::Source {
        &self.settings
    }

    pub(super) fn standing(&self) -> Standing {
        self.stand.borrow().standing.clone()
    }

    pub(super) fn stand(&self) -> watch::Receiver<Stand> {
        self.stand.subscribe()
    }

    /// A task wants it, until this is dropped.
    pub(super) fn want(self: &Arc<Channel>) -> Demand {
        self.demand.send_modify(|tasks| *tasks += 1);
        Demand(Arc::clone(self))
    }

    /// Room for a frame of `length` bytes.
    ///
    /// # Errors
    ///
    /// It is longer than the source's frames may be.
    pub(super) fn blank(&self, length: usize) -> Result<Blank, String> {
        let longest = self.settings.longest();
        if length > longest {
            return Err(format!(
                "a frame of {length} bytes; the longest is {longest}, a fourth of its `memory`"
            ));
        }
        if length <= INLINE {
            return Ok(Blank::Inline(BytesMut::zeroed(length)));
        }
        Ok(match self.slot(length) {
            Ok(slot) => Blank::Shared { slot, length },
            Err(error) => {
                // An old kernel: every reader gets a copy.
                tracing::debug!(%error, "no shared memory for a sensor's frame");
                Blank::Inline(BytesMut::zeroed(length))
            }
        })
    }

    fn slot(&self, length: usize) -> std::io::Result<Slot> {
        let mut inner = self.inner();
        let Inner { fan, pool, wakes, .. } = &mut *inner;
        loop {
            if let Some(slot) = pool.take(length) {
                return Ok(slot);
            }
            if pool.has_room(length) {
                return pool.make(length);
            }
            match fan.give_up() {
                Some(GivenUp::Held(reader)) => {
                    tracing::warn!(function = %self.function(), "a reader keeps a frame while memory runs out");
                    if let Some(wake) = wakes.get(&reader) {
                        wake.close(proto::Reason::TooSlow, "a frame was kept while memory ran out");
                    }
                }
                Some(GivenUp::Kept | GivenUp::Waiting(_)) => {}
                // Connections that were just put out still have theirs, and let them go with the next turn of the loop.
                None => return pool.make(length),
            }
        }
    }

    /// A frame is whole.
    pub(super) fn publish(&self, blank: Blank) {
        let mut inner = self.inner();
        let body = match blank {
            Blank::Inline(bytes) => Body::Inline(bytes.freeze()),
            Blank::Shared { slot, length } => {
                let slot = Arc::new(slot);
                inner.pool.put(&slot);
                Body::Shared { slot, length }
            }
        };
        let (stamp_ns, boot_ns) = clock::stamp();
        // A frame asks for nothing.
        let _ = inner.source.handle(Event::Frame, clock::boot());
        for reader in inner.fan.publish(Frame { stamp_ns, boot_ns, body }) {
            if let Some(wake) = inner.wakes.get(&reader) {
                wake.ready.notify_one();
            }
        }
        self.say(&inner.source);
    }

    /// The run says why nothing comes.
    pub(super) fn trouble(&self, why: &str) {
        let mut inner = self.inner();
        let _ = inner.source.handle(Event::Trouble(short(why)), clock::boot());
        self.say(&inner.source);
    }

    /// The run says what its frames are.
    pub(super) fn set_format(&self, format: &str) {
        self.stand.send_if_modified(|stand| {
            let changes = stand.format != format;
            if changes {
                format.clone_into(&mut stand.format);
            }
            changes
        });
    }

    /// The run says what its messages are, by who they are from.
    pub(super) fn set_kind(&self, from: &Arc<From>) {
        let mut kind = self.kind.lock().unwrap_or_else(PoisonError::into_inner);
        if kind.as_ref().is_none_or(|(known, _)| !Arc::ptr_eq(known, from)) {
            *kind = Some((Arc::clone(from), Arc::new(from.of())));
            self.set_format(&format!("ros1:{}", from.kind));
        }
    }

    /// Of a topic of ROS's, when something has come.
    pub(super) fn kind(&self) -> Option<Arc<Type>> {
        let kind = self.kind.lock().unwrap_or_else(PoisonError::into_inner);
        kind.as_ref().map(|(_, of)| Arc::clone(of))
    }

    fn say(&self, source: &Source) {
        let standing = source.standing();
        self.stand.send_if_modified(|stand| {
            let changes = stand.standing != standing;
            stand.standing = standing;
            changes
        });
    }

    fn event(&self, event: Event) -> Option<Action> {
        let mut inner = self.inner();
        let why = match &event {
            Event::Ended(why) => Some(why.clone()),
            _ => None,
        };
        let action = inner.source.handle(event, clock::boot());
        if let Some(why) = why {
            tracing::info!(function = %self.function(), why, "a sensor is not read any more");
            inner.fan.forget();
            inner.pool.clear();
        }
        self.say(&inner.source);
        action
    }

    /// Has the source read while tasks want it, until `end`.
    pub(super) async fn attend(&self, context: &Context, end: &CancellationToken) {
        let mut demand = self.demand.subscribe();
        let mut run: Option<(CancellationToken, BoxFuture<'_, String>)> = None;
        loop {
            let wake = self.inner().source.wakes_at();
            // Cancel-safe: a watch, a run that is polled in place, a sleep and a token.
            let event = tokio::select! {
                changed = demand.changed() => match changed {
                    Ok(()) => Event::Wanted(*demand.borrow_and_update() > 0),
                    Err(_) => return,
                },
                why = ended(&mut run) => {
                    run = None;
                    Event::Ended(short(&why))
                }
                () = sleep_until(wake) => Event::Tick,
                () = end.cancelled() => break,
            };
            match self.event(event) {
                Some(Action::Start) => {
                    tracing::info!(function = %self.function(), "a sensor is read");
                    let over = end.child_token();
                    let running = source::run(self, context, over.clone()).boxed();
                    run = Some((over, running));
                }
                Some(Action::End) => {
                    if let Some((over, _)) = &run {
                        over.cancel();
                    }
                }
                None => {}
            }
        }
        // Its token is a child of the one that has ended.
        if run.is_some() {
            ended(&mut run).await;
        }
    }

    /// A reader comes; its frames wait in a line of `depth`.
    pub(super) fn subscribe(self: &Arc<Channel>, depth: usize) -> Subscription {
        let mut inner = self.inner();
        inner.next += 1;
        let (reader, wake) = (Reader(inner.next), Arc::new(Wake::default()));
        inner.fan.open(reader, depth);
        inner.wakes.insert(reader, Arc::clone(&wake));
        Subscription { channel: Arc::clone(self), reader, wake }
    }
}

async fn ended(run: &mut Option<(CancellationToken, BoxFuture<'_, String>)>) -> String {
    match run {
        Some((_, run)) => run.await,
        None => std::future::pending().await,
    }
}

fn short(why: &str) -> String {
    why.chars().take(LONGEST_WHY).collect()
}

/// That a task wants a function.
#[derive(Debug)]
pub(super) struct Demand(Arc<Channel>);

impl Drop for Demand {
    fn drop(&mut self) {
        self.0.demand.send_modify(|tasks| *tasks = tasks.saturating_sub(1));
    }
}

/// One reader. Dropped: it is gone, with what it had.
#[derive(Debug)]
pub(super) struct Subscription {
    channel: Arc<Channel>,
    reader: Reader,
    wake: Arc<Wake>,
}

impl Subscription {
    /// The next frame, when the reader is done with the one before; or why it gets none any more. Cancel-safe.
    pub(super) async fn next(&self) -> Result<Delivery<Frame>, proto::Closed> {
        loop {
            if let Some(closed) = self.wake.closed.get() {
                return Err(closed.clone());
            }
            let delivery = self.channel.inner().fan.take(self.reader);
            if let Some(delivery) = delivery {
                return Ok(delivery);
            }
            self.wake.ready.notified().await;
        }
    }

    /// The reader is done with a frame.
    pub(super) fn done(&self, sequence: u64) -> Result<(), NotHeld> {
        let done = self.channel.inner().fan.done(self.reader, sequence);
        self.wake.ready.notify_one();
        // One that was put out is told so.
        if self.wake.closed.get().is_some() { Ok(()) } else { done }
    }

    /// It says what makes no sense.
    pub(super) fn refuse(&self, message: &str) {
        self.wake.close(proto::Reason::Protocol, message);
    }

    /// Returns when it is to end.
    pub(super) async fn closed(&self) {
        while !self.is_closed() {
            self.wake.end.notified().await;
        }
    }

    /// Whether it is to end.
    pub(super) fn is_closed(&self) -> bool {
        self.wake.closed.get().is_some()
    }

    /// Those of `slots` that come no more.
    pub(super) fn retired(&self, slots: impl Iterator<Item = u32>) -> Vec<u32> {
        let inner = self.channel.inner();
        slots.filter(|slot| !inner.pool.has(*slot)).collect()
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        let mut inner = self.channel.inner();
        inner.fan.close(self.reader);
        inner.wakes.remove(&self.reader);
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt as _;

    use super::*;

    fn channel(settings: &serde_json::Value) -> Arc<Channel> {
        Arc::new(Channel::new(serde_json::from_value(settings.clone()).unwrap()))
    }

    fn publish(channel: &Channel, byte: u8, length: usize) {
        let mut blank = channel.blank(length).unwrap();
        blank.bytes().fill(byte);
        channel.publish(blank);
    }

    fn next(reader: &Subscription) -> Option<Result<Delivery<Frame>, proto::Closed>> {
        reader.next().now_or_never()
    }

    #[test]
    fn frames_lie_once_in_memory_and_memory_is_used_again() {
        let settings = serde_json::json!({"function": "k:I", "exec": ["x"], "framing": "Lines"});
        let channel = channel(&settings);
        let readers = [channel.subscribe(1), channel.subscribe(4)];
        let mut slots = std::collections::BTreeSet::new();
        for n in 1..=50 {
            publish(&channel, n, 100_000);
            let ids = readers.each_ref().map(|reader| {
                let Some(Ok(delivery)) = next(reader) else { panic!("a frame") };
                let Body::Shared { slot, length } = delivery.frame.body else { panic!("lent") };
                assert_eq!(slot.bytes(length), vec![n; 100_000]);
                reader.done(delivery.sequence).unwrap();
                slot.id()
            });
            assert_eq!(ids[0], ids[1], "the same memory");
            slots.insert(ids[0]);
        }
        assert!(slots.len() <= 3, "one is written, one is the newest: {slots:?}");
    }

    #[test]
    fn whoever_keeps_the_oldest_frame_while_memory_runs_out_is_put_out() {
        let settings = serde_json::json!(
            {"function": "k:I", "exec": ["x"], "framing": "Lines", "memory": "4Mi"}
        );
        let channel = channel(&settings);
        assert!(channel.blank((1 << 20) + 1).is_err_and(|why| why.contains("`memory`")));
        let (keeps, queues, reads) =
            (channel.subscribe(1), channel.subscribe(16), channel.subscribe(1));
        publish(&channel, 1, 1 << 20);
        assert!(matches!(next(&keeps), Some(Ok(_))));
        for n in 2..=20 {
            let Some(Ok(Delivery { sequence, dropped, .. })) = next(&reads) else { panic!() };
            assert_eq!((sequence, dropped), (u64::from(n) - 1, 0), "nothing of its own is lost");
            reads.done(sequence).unwrap();
            publish(&channel, n, 1 << 20);
        }
        let Some(Err(closed)) = next(&keeps) else { panic!("it is put out") };
        assert_eq!(closed.reason(), proto::Reason::TooSlow);
        let Some(Ok(first)) = next(&queues) else { panic!("it had taken none, and may read") };
        assert!(first.dropped > 10, "{first:?}");
    }

    #[test]
    fn small_frames_are_sent_and_what_is_not_held_is_not_given_back() {
        let settings = serde_json::json!({"function": "k:I", "exec": ["x"], "framing": "Lines"});
        let channel = channel(&settings);
        let reader = channel.subscribe(1);
        publish(&channel, 7, INLINE);
        let Some(Ok(delivery)) = next(&reader) else { panic!("a frame") };
        assert!(matches!(&delivery.frame.body, Body::Inline(bytes) if bytes.len() == INLINE));
        assert!(reader.done(2).is_err());
        reader.refuse("it is done with what it does not have");
        let Some(Err(closed)) = next(&reader) else { panic!("closed") };
        assert_eq!(closed.reason(), proto::Reason::Protocol);
    }
}
