//! Subscriptions: a task a topic follows who publishes it, and has one task for each publisher.

use std::collections::{BTreeMap, BTreeSet};
use std::marker::PhantomData;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use tokio::io::{AsyncWriteExt as _, BufReader};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::Instant;
use tokio_util::task::AbortOnDropHandle;

use super::bus::{Connection, Direction};
use super::registrar::chain;
use super::{Leaving, Shared, lock};
use crate::master::{MasterError, unpack};
use crate::message::Message;
use crate::queue::Queue;
use crate::rate::RateMeter;
use crate::tcpros::{
    Header, HeaderError, LARGEST_FRAME, LARGEST_HEADER, ReadError, read_frame, skip_frame,
};
use crate::wire::DecodeError;
use crate::xmlrpc::Value;
use crate::xmlrpc::http::{CallError, Uri, invoke};

/// First and longest pause before a publisher is tried again. One that was killed stays in the master's list for ever.
const PAUSE: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(5));
/// For connecting, and for each header.
const PATIENCE: Duration = Duration::from_secs(5);

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

/// One topic. Public only as a part of the node's own types.
#[derive(Debug)]
pub struct Subscription {
    topic: String,
    kind: &'static str,
    md5: &'static str,
    options: SubscribeOptions,
    /// Messages are counted only, over this window.
    count: Option<Duration>,
    queue: Queue<Incoming>,
    meter: Mutex<RateMeter>,
    began: Instant,
    publishers: watch::Sender<BTreeSet<Uri>>,
    /// By publisher: connected, or why not.
    peers: watch::Sender<BTreeMap<Uri, Result<(), String>>>,
    /// Who publishes it is to be asked of the master.
    doubt: AtomicBool,
    follower: Mutex<Option<AbortOnDropHandle<()>>>,
}

impl Subscription {
    pub(super) fn start(
        shared: &Arc<Shared>,
        topic: String,
        (kind, md5): (&'static str, &'static str),
        options: SubscribeOptions,
        count: Option<Duration>,
    ) -> Arc<Subscription> {
        let subscription = Arc::new(Subscription {
            topic,
            kind,
            md5,
            queue: Queue::new(options.queue),
            meter: Mutex::new(RateMeter::new(count.unwrap_or(Duration::from_secs(1)))),
            options,
            count,
            began: Instant::now(),
            publishers: watch::Sender::new(BTreeSet::new()),
            peers: watch::Sender::new(BTreeMap::new()),
            doubt: AtomicBool::new(true),
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

    pub(super) fn set_publishers(&self, uris: &[String]) {
        let new: BTreeSet<Uri> = uris.iter().filter_map(|uri| uri.parse().ok()).collect();
        self.publishers.send_if_modified(|old| {
            let changed = *old != new;
            *old = new;
            changed
        });
    }

    fn status(&self) -> SubscriptionStatus {
        let peers = self.peers.borrow();
        SubscriptionStatus {
            publishers: self.publishers.borrow().len(),
            connected: peers.values().filter(|peer| peer.is_ok()).count(),
            trouble: peers.values().find_map(|peer| peer.clone().err()),
        }
    }

    fn say(&self, uri: &Uri, how: Result<(), String>) {
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
        let wanted = publishers.borrow_and_update().clone();
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

/// Why a publisher is not connected.
#[derive(Debug, thiserror::Error)]
enum LinkError {
    #[error("failed to ask {uri} for the topic")]
    Ask { uri: Uri, source: Box<CallError> },
    #[error(transparent)]
    Answer(#[from] MasterError),
    #[error("failed to connect to {host}:{port}")]
    Connect { host: String, port: u16, source: std::io::Error },
    #[error("it did not answer in time")]
    Timeout,
    #[error("its connection header is none")]
    Header(#[from] HeaderError),
    #[error("it refuses: {0}")]
    Refused(String),
    #[error("it publishes {kind} with checksum {md5}, not {wanted}")]
    OtherType { kind: String, md5: String, wanted: &'static str },
    #[error(transparent)]
    Read(#[from] ReadError),
}

/// Keeps one publisher connected.
async fn attend(uri: Uri, subscription: Arc<Subscription>, shared: Arc<Shared>) {
    let mut pause = PAUSE.0;
    let connection = shared.bus.add(Direction::In, &subscription.topic, &uri.to_string());
    loop {
        let begun = Instant::now();
        let ended = link(&uri, &subscription, &shared, &connection).await;
        connection.set_connected(false);
        let Err(error) = ended;
        let why = chain(&error);
        tracing::debug!(topic = subscription.topic, publisher = %uri, why, "not connected to a publisher");
        subscription.say(&uri, Err(why));
        if begun.elapsed() > PAUSE.1 {
            pause = PAUSE.0;
        }
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(PAUSE.1);
    }
}

async fn link(
    uri: &Uri,
    subscription: &Subscription,
    shared: &Shared,
    connection: &Connection,
) -> Result<std::convert::Infallible, LinkError> {
    let opened = tokio::time::timeout(PATIENCE * 2, open(uri, subscription, shared));
    let (mut stream, from) = opened.await.map_err(|_| LinkError::Timeout)??;
    connection.set_connected(true);
    subscription.say(uri, Ok(()));
    loop {
        let size = if subscription.count.is_some() {
            skip_frame(&mut stream, subscription.options.largest).await?
        } else {
            let body = read_frame(&mut stream, subscription.options.largest).await?;
            let (size, received) = (body.len(), Instant::now());
            subscription.queue.push(Incoming { body, received, from: Arc::clone(&from) });
            size
        };
        lock(&subscription.meter).arrived(subscription.began.elapsed());
        connection.passed(size);
    }
}

/// A connection on which messages follow.
async fn open(
    uri: &Uri,
    subscription: &Subscription,
    shared: &Shared,
) -> Result<(BufReader<TcpStream>, Arc<From>), LinkError> {
    let (host, port) = ask(uri, subscription, shared).await?;
    let connected = TcpStream::connect((&*host, port)).await;
    let stream = connected.map_err(|source| LinkError::Connect { host, port, source })?;
    keep_alive(&stream);
    let header = Header::new([
        ("callerid", &*shared.name),
        ("topic", &*subscription.topic),
        ("type", subscription.kind),
        ("md5sum", subscription.md5),
        ("tcp_nodelay", "1"),
    ]);
    let mut stream = BufReader::new(stream);
    stream.write_all(&header.encode()).await.map_err(ReadError::from)?;
    let answer = Header::decode(&read_frame(&mut stream, LARGEST_HEADER).await?)?;
    if let Some(error) = answer.get("error") {
        return Err(LinkError::Refused(error.to_owned()));
    }
    let field = |key| answer.get(key).unwrap_or_default().to_owned();
    let from = From { caller: field("callerid"), kind: field("type"), md5: field("md5sum") };
    let fits = |wanted: &str, found: &str| wanted == "*" || found == "*" || wanted == found;
    if !fits(subscription.md5, &from.md5) {
        return Err(LinkError::OtherType {
            kind: from.kind,
            md5: from.md5,
            wanted: subscription.kind,
        });
    }
    Ok((stream, Arc::new(from)))
}

/// Where the publisher gives the topic.
async fn ask(
    uri: &Uri,
    subscription: &Subscription,
    shared: &Shared,
) -> Result<(String, u16), LinkError> {
    let protocols = Value::Array(vec![Value::Array(vec!["TCPROS".into()])]);
    let params = [(&*shared.name).into(), (&*subscription.topic).into(), protocols];
    let answer = invoke(uri, "requestTopic", &params).await;
    let answer =
        answer.map_err(|source| LinkError::Ask { uri: uri.clone(), source: Box::new(source) })?;
    Ok(unpack("requestTopic", &answer, |value| match value.as_array()? {
        [protocol, host, port, ..] if protocol.as_str() == Some("TCPROS") => {
            Some((host.as_str()?.to_owned(), u16::try_from(port.as_int()?).ok()?))
        }
        _ => None,
    })?)
}

/// A publisher whose machine lost power says nothing, and a topic may be silent for hours: the kernels ask each other.
fn keep_alive(stream: &TcpStream) {
    use rustix::net::sockopt;
    let idle = sockopt::set_socket_keepalive(stream, true)
        .and_then(|()| sockopt::set_tcp_keepidle(stream, Duration::from_secs(10)))
        .and_then(|()| sockopt::set_tcp_keepintvl(stream, Duration::from_secs(5)))
        .and_then(|()| sockopt::set_tcp_keepcnt(stream, 3));
    if let Err(error) = idle.and_then(|()| sockopt::set_tcp_nodelay(stream, true)) {
        tracing::debug!(%error, "options of a connection were not set");
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

/// Tells how often a topic is published. When it is dropped, the topic is not subscribed any more.
#[derive(Debug)]
pub struct Arrivals {
    subscription: Arc<Subscription>,
    shared: Arc<Shared>,
}

impl Arrivals {
    pub(super) fn new(subscription: Arc<Subscription>, shared: Arc<Shared>) -> Self {
        lock(&subscription.meter).begin(subscription.began.elapsed());
        Arrivals { subscription, shared }
    }

    /// Messages a second over the window; `None`: it was not watched for so long yet.
    #[must_use]
    pub fn hertz(&self) -> Option<f64> {
        lock(&self.subscription.meter).hertz(self.subscription.began.elapsed())
    }

    /// How it stands.
    #[must_use]
    pub fn status(&self) -> SubscriptionStatus {
        self.subscription.status()
    }
}

impl Drop for Arrivals {
    fn drop(&mut self) {
        self.subscription.stop();
        self.shared.leave(Leaving::Subscription(self.subscription.topic.clone()));
    }
}
