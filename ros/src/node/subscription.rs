//! Subscriptions: a task a topic follows who publishes it, and has one task for each publisher.

use std::collections::{BTreeMap, BTreeSet};
use std::marker::PhantomData;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::watch;
use tokio::time::Instant;
use tokio_util::task::AbortOnDropHandle;

use super::link::attend;
use super::{Leaving, Shared, lock};
use crate::message::{Message, Type};
use crate::queue::Queue;
use crate::rate::RateMeter;
use crate::tcpros::LARGEST_FRAME;
use crate::wire::DecodeError;
use crate::xmlrpc::http::Uri;

/// How a topic is subscribed.
#[derive(Debug, Clone)]
pub struct SubscribeOptions {
    /// Messages that wait to be taken; when it is full, the oldest goes.
    pub queue: usize,
    /// The largest message that is taken, bytes: a publisher that announces more is left alone.
    pub largest: usize,
}

impl Default for SubscribeOptions {
    fn default() -> Self {
        SubscribeOptions { queue: 10, largest: LARGEST_FRAME }
    }
}

/// Who a message is from, by its connection's header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct From {
    /// The publisher's name.
    pub caller: String,
    /// `nav_msgs/Odometry`.
    pub kind: String,
    /// The type's checksum.
    pub md5: String,
    /// The type's definition; empty when the publisher does not say it.
    pub definition: String,
}

impl From {
    /// The type of its messages.
    #[must_use]
    pub fn of(&self) -> Type {
        let From { kind, md5, definition, .. } = self.clone();
        Type { name: kind, md5, definition }
    }
}

/// A message as it came.
#[derive(Debug, Clone)]
pub struct Incoming {
    /// The serialised message.
    pub body: Bytes,
    /// When it was whole.
    pub received: Instant,
    /// Of whom.
    pub from: Arc<From>,
}

/// How it stands with a subscription.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SubscriptionStatus {
    /// Publishers that the master names: those that died without a word are among them.
    pub publishers: usize,
    /// Those that are connected.
    pub connected: usize,
    /// Why one of the others is not.
    pub trouble: Option<String>,
}

/// Who publishes a topic.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Publishers {
    /// By the master.
    listed: BTreeSet<Uri>,
    /// By an earlier master, for as long as they are connected.
    kept: BTreeSet<Uri>,
}

impl Publishers {
    fn all(&self) -> BTreeSet<Uri> {
        &self.listed | &self.kept
    }
}

/// One topic. Public only as a part of the node's own types.
#[derive(Debug)]
pub struct Subscription {
    topic: String,
    kind: &'static str,
    md5: &'static str,
    options: SubscribeOptions,
    queue: Queue<Incoming>,
    /// Messages are counted only, by each of these.
    meters: Option<Mutex<BTreeMap<u64, RateMeter>>>,
    next_meter: AtomicU64,
    began: Instant,
    publishers: watch::Sender<Publishers>,
    /// By publisher: connected, or why not.
    peers: watch::Sender<BTreeMap<Uri, Result<(), String>>>,
    /// Who publishes it is to be asked of the master.
    doubt: AtomicBool,
    /// The master that is asked next may be a new one, which knows nothing.
    forgotten: AtomicBool,
    follower: Mutex<Option<AbortOnDropHandle<()>>>,
}

impl Subscription {
    pub(super) fn start(
        shared: &Arc<Shared>,
        topic: String,
        (kind, md5): (&'static str, &'static str),
        options: SubscribeOptions,
        counts: bool,
    ) -> Arc<Subscription> {
        let subscription = Arc::new(Subscription {
            topic,
            kind,
            md5,
            queue: Queue::new(options.queue),
            meters: counts.then(Mutex::default),
            next_meter: AtomicU64::new(0),
            options,
            began: Instant::now(),
            publishers: watch::Sender::new(Publishers::default()),
            peers: watch::Sender::new(BTreeMap::new()),
            doubt: AtomicBool::new(true),
            forgotten: AtomicBool::new(false),
            follower: Mutex::new(None),
        });
        let follower = tokio::spawn(follow(Arc::clone(&subscription), Arc::clone(shared)));
        *lock(&subscription.follower) = Some(AbortOnDropHandle::new(follower));
        subscription
    }

    /// Its task has a reference to it, and would go on for ever.
    fn stop(&self) {
        drop(lock(&self.follower).take());
    }

    pub(super) fn topic(&self) -> &str {
        &self.topic
    }

    pub(super) fn md5(&self) -> &'static str {
        self.md5
    }

    pub(super) fn largest(&self) -> usize {
        self.options.largest
    }

    /// Messages are not kept.
    pub(super) fn only_counts(&self) -> bool {
        self.meters.is_some()
    }

    pub(super) fn arrived(&self) {
        let now = self.began.elapsed();
        if let Some(meters) = &self.meters {
            lock(meters).values_mut().for_each(|meter| meter.arrived(now));
        }
    }

    pub(super) fn push(&self, incoming: Incoming) {
        self.queue.push(incoming);
    }

    pub(super) fn kind(&self) -> &'static str {
        self.kind
    }

    pub(super) fn doubt(&self) {
        self.doubt.store(true, Ordering::Release);
    }

    pub(super) fn settle(&self) {
        self.doubt.store(false, Ordering::Release);
    }

    pub(super) fn is_in_doubt(&self) -> bool {
        self.doubt.load(Ordering::Acquire)
    }

    /// As [`Subscription::doubt`], of a master that is gone or does not know this node.
    pub(super) fn forget(&self) {
        self.forgotten.store(true, Ordering::Release);
        self.doubt();
    }

    /// What the master says. A new master knows no publisher that has not registered again, and few do: those that are
    /// connected stay so.
    pub(super) fn set_publishers(&self, uris: &[String]) {
        let listed: BTreeSet<Uri> = uris.iter().filter_map(|uri| uri.parse().ok()).collect();
        let forgotten = self.forgotten.swap(false, Ordering::AcqRel);
        let connected: BTreeSet<Uri> = self
            .peers
            .borrow()
            .iter()
            .filter(|(_, how)| how.is_ok())
            .map(|(uri, _)| uri.clone())
            .collect();
        self.publishers.send_if_modified(|old| {
            let mut kept = if forgotten { connected } else { old.kept.clone() };
            kept.retain(|uri| !listed.contains(uri));
            let new = Publishers { listed, kept };
            let changed = *old != new;
            *old = new;
            changed
        });
    }

    /// A connection broke: a publisher that only it held is none any more.
    pub(super) fn let_go(&self, uri: &Uri) {
        self.publishers.send_if_modified(|publishers| publishers.kept.remove(uri));
    }

    fn status(&self) -> SubscriptionStatus {
        let (peers, publishers) = (self.peers.borrow(), self.publishers.borrow().all());
        // What a task said just before it was ended may still stand there.
        let of_now =
            || peers.iter().filter(|(uri, _)| publishers.contains(*uri)).map(|(_, how)| how);
        SubscriptionStatus {
            publishers: publishers.len(),
            connected: of_now().filter(|how| how.is_ok()).count(),
            trouble: of_now().find_map(|how| how.clone().err()),
        }
    }

    pub(super) fn say(&self, uri: &Uri, how: Result<(), String>) {
        self.peers.send_if_modified(|peers| {
            let changed = peers.get(uri) != Some(&how);
            peers.insert(uri.clone(), how);
            changed
        });
    }
}

/// Has a task for each publisher that the master names, and none for others.
async fn follow(subscription: Arc<Subscription>, shared: Arc<Shared>) {
    let mut publishers = subscription.publishers.subscribe();
    let mut connections: BTreeMap<Uri, AbortOnDropHandle<()>> = BTreeMap::new();
    loop {
        let wanted = publishers.borrow_and_update().all();
        connections.retain(|uri, _| wanted.contains(uri));
        subscription.peers.send_if_modified(|peers| {
            let before = peers.len();
            peers.retain(|uri, _| wanted.contains(uri));
            peers.len() != before
        });
        for uri in wanted {
            let (subscription, shared) = (Arc::clone(&subscription), Arc::clone(&shared));
            connections.entry(uri).or_insert_with_key(|uri| {
                AbortOnDropHandle::new(tokio::spawn(attend(uri.clone(), subscription, shared)))
            });
        }
        if publishers.changed().await.is_err() {
            return;
        }
    }
}

/// Gives the messages of a topic. When it is dropped, the topic is not subscribed any more.
#[derive(Debug)]
pub struct Subscriber<M> {
    subscription: Arc<Subscription>,
    shared: Arc<Shared>,
    message: PhantomData<fn() -> M>,
}

impl<M> Subscriber<M> {
    pub(super) fn new(subscription: Arc<Subscription>, shared: Arc<Shared>) -> Self {
        Subscriber { subscription, shared, message: PhantomData }
    }

    /// The topic's global name.
    #[must_use]
    pub fn topic(&self) -> &str {
        &self.subscription.topic
    }

    /// How it stands.
    #[must_use]
    pub fn status(&self) -> SubscriptionStatus {
        self.subscription.status()
    }

    /// Messages that nobody took in time.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.subscription.queue.dropped()
    }
}

impl Subscriber<Incoming> {
    /// The next message. Cancel safe.
    pub async fn next(&mut self) -> Incoming {
        self.subscription.queue.pop().await
    }
}

impl<M: Message> Subscriber<M> {
    /// The next message, and how it came. Cancel safe.
    ///
    /// # Errors
    ///
    /// What came is no such message, though its publisher says so; others may follow.
    pub async fn next(&mut self) -> Result<(M, Incoming), DecodeError> {
        let incoming = self.subscription.queue.pop().await;
        M::decode(incoming.body.clone()).map(|message| (message, incoming))
    }
}

impl<M> Drop for Subscriber<M> {
    fn drop(&mut self) {
        self.subscription.stop();
        self.shared.leave(Leaving::Subscription(self.subscription.topic.clone()));
    }
}

/// Tells how often a topic is published. Several may share a subscription, each with a window of its own; when the last one
/// is dropped, the topic is not subscribed any more.
#[derive(Debug)]
pub struct Arrivals {
    subscription: Arc<Subscription>,
    shared: Arc<Shared>,
    meter: u64,
}

impl Arrivals {
    /// Counting begins now. The caller holds the node's topics, so that nobody ends the subscription meanwhile.
    pub(super) fn new(
        subscription: Arc<Subscription>,
        shared: Arc<Shared>,
        window: Duration,
    ) -> Self {
        let meter = subscription.next_meter.fetch_add(1, Ordering::Relaxed);
        let arrivals = Arrivals { subscription, shared, meter };
        let mut counts = RateMeter::new(window);
        counts.begin(arrivals.subscription.began.elapsed());
        if let Some(meters) = &arrivals.subscription.meters {
            lock(meters).insert(meter, counts);
        }
        arrivals
    }

    fn of<T: Default>(&self, look: impl FnOnce(&RateMeter, Duration) -> T) -> T {
        let meters = self.subscription.meters.as_ref().map(lock);
        let now = self.subscription.began.elapsed();
        meters.and_then(|meters| Some(look(meters.get(&self.meter)?, now))).unwrap_or_default()
    }

    /// Messages a second over the window; `None`: it was not watched for so long yet.
    #[must_use]
    pub fn hertz(&self) -> Option<f64> {
        self.of(RateMeter::hertz)
    }

    /// Messages in the window, or since counting began when that is shorter.
    #[must_use]
    pub fn in_window(&self) -> u64 {
        self.of(RateMeter::in_window)
    }

    /// How it stands.
    #[must_use]
    pub fn status(&self) -> SubscriptionStatus {
        self.subscription.status()
    }
}

impl Drop for Arrivals {
    fn drop(&mut self) {
        let mut topics = self.shared.topics();
        let Some(meters) = &self.subscription.meters else { return };
        let mut meters = lock(meters);
        meters.remove(&self.meter);
        if meters.is_empty() {
            self.subscription.stop();
            self.shared
                .leave_from(&mut topics, Leaving::Subscription(self.subscription.topic.clone()));
        }
    }
}
