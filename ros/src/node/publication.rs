//! Publications: one port for all of a node's topics, a task a subscriber. A subscriber that does not keep up loses its
//! own oldest messages, and holds nobody up.

use std::marker::PhantomData;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use bytes::Bytes;
use tokio::io::AsyncWriteExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use super::bus::Direction;
use super::outbox::Outbox;
use super::{Leaving, Shared, lock};
use crate::message::{Message, Type};
use crate::tcpros::{Header, LARGEST_HEADER, length, read_frame};

/// Subscribers of a node at once.
const MOST: usize = 256;
/// For a subscriber's header.
const PATIENCE: Duration = Duration::from_secs(10);

/// How a topic is published.
#[derive(Debug, Clone)]
pub struct PublishOptions {
    /// Messages that wait for one subscriber; when it is full, the oldest goes.
    pub queue: usize,
    /// Who connects later is given the last message.
    pub latch: bool,
    /// Who connects is given this serialised message first.
    pub greeting: Option<Bytes>,
    /// A subscriber is given a message when it has read those before, as far as that is known ([`Publisher::is_delivered`]): what
    /// waits for a slow one gives way to what is newer, and to what goes first.
    pub paced: bool,
}

impl Default for PublishOptions {
    fn default() -> Self {
        PublishOptions { queue: 10, latch: false, greeting: None, paced: false }
    }
}

#[derive(Debug)]
pub(crate) struct Publication {
    topic: String,
    of: Type,
    options: PublishOptions,
    registered: AtomicBool,
    readers: Mutex<Readers>,
    /// The names of those who are connected.
    callers: watch::Sender<Vec<String>>,
    /// It is not published any more.
    closed: CancellationToken,
}

#[derive(Debug, Default)]
struct Readers {
    all: Vec<Reader>,
    last: Option<Bytes>,
}

#[derive(Debug)]
struct Reader {
    caller: String,
    outbox: Weak<Outbox>,
}

impl Publication {
    pub(super) fn new(topic: String, of: Type, options: PublishOptions) -> Self {
        Publication {
            topic,
            of,
            options,
            registered: AtomicBool::new(false),
            readers: Mutex::default(),
            callers: watch::Sender::default(),
            closed: CancellationToken::new(),
        }
    }

    pub(super) fn topic(&self) -> &str {
        &self.topic
    }

    pub(super) fn kind(&self) -> &str {
        &self.of.name
    }

    pub(super) fn is_registered(&self) -> bool {
        self.registered.load(Ordering::Acquire)
    }

    pub(super) fn set_registered(&self, registered: bool) {
        self.registered.store(registered, Ordering::Release);
    }

    /// What waits for a subscriber, with the messages in it that come first.
    fn join(self: &Arc<Self>, caller: &str, stream: TcpStream) -> Joined {
        let outbox = Arc::new(Outbox::new(stream, self.options.queue, self.options.paced));
        let mut readers = lock(&self.readers);
        if let Some(greeting) = &self.options.greeting {
            outbox.push_urgent(framed(greeting));
        }
        if let Some(last) = &readers.last {
            outbox.push(last.clone());
        }
        let caller = caller.to_owned();
        readers.all.push(Reader { caller: caller.clone(), outbox: Arc::downgrade(&outbox) });
        // While the list is held: who counts the callers misses nobody who is in it.
        self.callers.send_modify(|callers| callers.push(caller.clone()));
        Joined { outbox, caller, publication: Arc::clone(self) }
    }

    /// Gives a frame to all who are connected.
    fn send(&self, frame: &Bytes, urgent: bool) {
        let mut readers = lock(&self.readers);
        readers.all.retain(|reader| match reader.outbox.upgrade() {
            Some(outbox) if urgent => {
                outbox.push_urgent(frame.clone());
                true
            }
            Some(outbox) => {
                outbox.push(frame.clone());
                true
            }
            None => false,
        });
        if self.options.latch {
            readers.last = Some(frame.clone());
        }
    }

    /// Why a subscriber with this header is not taken.
    fn objection(&self, header: &Header) -> Option<String> {
        let fits =
            |key, ours: &str| header.get(key).is_none_or(|theirs| theirs == "*" || theirs == ours);
        if header.get("md5sum").is_none() || header.get("callerid").is_none() {
            return Some("the connection header lacks md5sum or callerid".to_owned());
        }
        if !fits("type", &self.of.name) || !fits("md5sum", &self.of.md5) {
            let theirs = header.get("type").unwrap_or_default();
            let Type { name, md5, .. } = &self.of;
            return Some(format!("{} is of type {name} [{md5}], not {theirs}", self.topic));
        }
        None
    }

    fn header(&self, caller: &str) -> Header {
        Header::new([
            ("callerid", caller),
            ("latching", if self.options.latch { "1" } else { "0" }),
            ("md5sum", &*self.of.md5),
            ("message_definition", &*self.of.definition),
            ("topic", &*self.topic),
            ("type", &*self.of.name),
        ])
    }
}

/// A subscriber while it is connected.
struct Joined {
    outbox: Arc<Outbox>,
    caller: String,
    publication: Arc<Publication>,
}

impl Drop for Joined {
    fn drop(&mut self) {
        self.publication.callers.send_modify(|callers| {
            let mine = callers.iter().position(|caller| *caller == self.caller);
            drop(mine.map(|at| callers.swap_remove(at)));
        });
    }
}

/// A message with its length before it.
fn framed(body: &[u8]) -> Bytes {
    [&length(body.len()), body].concat().into()
}

/// Takes subscribers until dropped.
pub(super) async fn serve(listener: TcpListener, shared: Arc<Shared>) {
    let room = Arc::new(Semaphore::new(MOST));
    let mut connections = JoinSet::new();
    loop {
        while connections.try_join_next().is_some() {}
        let permit = Arc::clone(&room).acquire_owned().await.expect("nobody closes it");
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let shared = Arc::clone(&shared);
        connections.spawn(async move {
            attend(stream, &shared).await;
            drop(permit);
        });
    }
}

/// One subscriber, until it goes or does not read.
async fn attend(mut stream: TcpStream, shared: &Shared) {
    drop(stream.set_nodelay(true));
    let Ok(Ok(frame)) =
        tokio::time::timeout(PATIENCE, read_frame(&mut stream, LARGEST_HEADER)).await
    else {
        return;
    };
    let Ok(header) = Header::decode(&frame) else { return };
    let topic = header.get("topic").unwrap_or_default();
    let publication = shared.topics().publications.get(topic).cloned();
    let objection = match &publication {
        Some(publication) => publication.objection(&header),
        None => Some(format!("{} does not publish {topic:?}", shared.name)),
    };
    let (Some(publication), None) = (publication, &objection) else {
        let error = objection.unwrap_or_default();
        drop(stream.write_all(&Header::new([("error", &*error)]).encode()).await);
        return;
    };
    let caller = header.get("callerid").unwrap_or_default();
    let connection = shared.bus.add(Direction::Out, topic, caller);
    let hello = publication.header(&shared.name).encode();
    if stream.write_all(&hello).await.is_err() {
        return;
    }
    connection.set_connected(true);
    let joined = publication.join(caller, stream);
    tokio::select! {
        () = joined.outbox.send(|length| connection.passed(length)) => {}
        () = joined.outbox.closed() => {}
        () = publication.closed.cancelled() => {}
    }
}

/// Publishes a topic. When it is dropped, the topic is not published any more.
#[derive(Debug)]
pub struct Publisher<M> {
    publication: Arc<Publication>,
    shared: Arc<Shared>,
    message: PhantomData<fn(M)>,
}

impl<M> Publisher<M> {
    pub(super) fn new(publication: Arc<Publication>, shared: Arc<Shared>) -> Self {
        Publisher { publication, shared, message: PhantomData }
    }

    /// How many are connected.
    #[must_use]
    pub fn subscribers(&self) -> usize {
        self.publication.callers.borrow().len()
    }

    /// The names of those who are connected, as they say them.
    #[must_use]
    pub fn callers(&self) -> watch::Receiver<Vec<String>> {
        self.publication.callers.subscribe()
    }

    /// The topic's global name.
    #[must_use]
    pub fn topic(&self) -> &str {
        &self.publication.topic
    }

    /// Registers with the master once more, which tells all subscribers again who publishes the topic.
    pub fn announce(&self) {
        self.publication.set_registered(false);
        self.shared.work.notify_one();
    }
}

impl<M: Message> Publisher<M> {
    /// Gives a message to all who are connected; waits for nobody.
    pub fn publish(&self, message: &M) {
        if self.subscribers() == 0 && !self.publication.options.latch {
            return;
        }
        let mut frame = vec![0; 4];
        message.write(&mut frame);
        let size = length(frame.len() - 4);
        frame[..4].copy_from_slice(&size);
        self.publication.send(&frame.into(), false);
    }
}

impl Publisher<Bytes> {
    /// Gives a serialised message to all who are connected; waits for nobody.
    pub fn publish(&self, body: &[u8]) {
        self.publication.send(&framed(body), false);
    }

    /// The same before all that waits, which is dropped.
    pub fn publish_first(&self, body: &[u8]) {
        self.publication.send(&framed(body), true);
    }

    /// Whether those who are connected, or `only` that one, have everything: on this machine and in its network the program, of
    /// one elsewhere its machine; what a program there has read is not known.
    #[must_use]
    pub fn is_delivered(&self, only: Option<&str>) -> bool {
        let readers = lock(&self.publication.readers);
        let mut asked = readers.all.iter().filter(|r| only.is_none_or(|only| only == r.caller));
        asked.all(|reader| reader.outbox.upgrade().is_none_or(|outbox| outbox.is_delivered()))
    }
}

impl<M> Drop for Publisher<M> {
    fn drop(&mut self) {
        self.shared.leave(Leaving::Publication(self.publication.topic.clone()));
        self.publication.closed.cancel();
    }
}
