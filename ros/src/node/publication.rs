//! Publications: one port for all of a node's topics, a task a subscriber. A subscriber that does not keep up loses its
//! own oldest messages, and holds nobody up.

use std::marker::PhantomData;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use bytes::Bytes;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use super::bus::Direction;
use super::{Leaving, Shared, lock};
use crate::message::Message;
use crate::queue::Queue;
use crate::tcpros::{Header, LARGEST_HEADER, length, read_frame};

/// Subscribers of a node at once.
const MOST: usize = 256;
/// For a subscriber's header.
const PATIENCE: Duration = Duration::from_secs(10);
/// A subscriber that reads nothing for this long is gone, or frozen: it may connect again.
const STALLED: Duration = Duration::from_secs(30);

/// How a topic is published.
#[derive(Debug, Clone)]
pub struct PublishOptions {
    /// Messages that wait for one subscriber; when it is full, the oldest goes.
    pub queue: usize,
    /// Who connects later is given the last message.
    pub latch: bool,
}

impl Default for PublishOptions {
    fn default() -> Self {
        PublishOptions { queue: 10, latch: false }
    }
}

#[derive(Debug)]
pub(crate) struct Publication {
    topic: String,
    kind: &'static str,
    md5: &'static str,
    definition: &'static str,
    options: PublishOptions,
    registered: AtomicBool,
    readers: Mutex<Readers>,
    /// It is not published any more.
    closed: CancellationToken,
}

#[derive(Debug, Default)]
struct Readers {
    queues: Vec<Weak<Queue<Bytes>>>,
    last: Option<Bytes>,
}

impl Publication {
    pub(super) fn new<M: Message>(topic: String, options: PublishOptions) -> Self {
        Publication {
            topic,
            kind: M::TYPE,
            md5: M::MD5,
            definition: M::DEFINITION,
            options,
            registered: AtomicBool::new(false),
            readers: Mutex::default(),
            closed: CancellationToken::new(),
        }
    }

    pub(super) fn topic(&self) -> &str {
        &self.topic
    }

    pub(super) fn kind(&self) -> &'static str {
        self.kind
    }

    pub(super) fn is_registered(&self) -> bool {
        self.registered.load(Ordering::Acquire)
    }

    pub(super) fn set_registered(&self, registered: bool) {
        self.registered.store(registered, Ordering::Release);
    }

    /// A subscriber's queue, with the last message in it when there is one to keep.
    fn join(&self) -> Arc<Queue<Bytes>> {
        let queue = Arc::new(Queue::new(self.options.queue));
        let mut readers = lock(&self.readers);
        if let Some(last) = &readers.last {
            queue.push(last.clone());
        }
        readers.queues.push(Arc::downgrade(&queue));
        queue
    }

    /// Why a subscriber with this header is not taken.
    fn objection(&self, header: &Header) -> Option<String> {
        let fits =
            |key, ours: &str| header.get(key).is_none_or(|theirs| theirs == "*" || theirs == ours);
        if header.get("md5sum").is_none() || header.get("callerid").is_none() {
            return Some("the connection header lacks md5sum or callerid".to_owned());
        }
        if !fits("type", self.kind) || !fits("md5sum", self.md5) {
            let theirs = header.get("type").unwrap_or_default();
            return Some(format!(
                "{} is of type {} [{}], not {theirs}",
                self.topic, self.kind, self.md5
            ));
        }
        None
    }

    fn header(&self, caller: &str) -> Header {
        Header::new([
            ("callerid", caller),
            ("latching", if self.options.latch { "1" } else { "0" }),
            ("md5sum", self.md5),
            ("message_definition", self.definition),
            ("topic", &*self.topic),
            ("type", self.kind),
        ])
    }
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
    let queue = publication.join();
    let (mut from, mut to) = stream.split();
    let write = async {
        loop {
            let frame = queue.pop().await;
            match tokio::time::timeout(STALLED, to.write_all(&frame)).await {
                Ok(Ok(())) => connection.passed(frame.len()),
                _ => return,
            }
        }
    };
    // Subscribers say nothing: what comes is their end.
    let closed = async {
        let mut nothing = [0; 64];
        while from.read(&mut nothing).await.is_ok_and(|read| read > 0) {}
    };
    tokio::select! {
        () = write => {}
        () = closed => {}
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

impl<M: Message> Publisher<M> {
    pub(super) fn new(publication: Arc<Publication>, shared: Arc<Shared>) -> Self {
        Publisher { publication, shared, message: PhantomData }
    }

    /// Gives a message to all who are connected; waits for nobody.
    pub fn publish(&self, message: &M) {
        let mut readers = lock(&self.publication.readers);
        readers.queues.retain(|queue| queue.strong_count() > 0);
        let latch = self.publication.options.latch;
        if readers.queues.is_empty() && !latch {
            return;
        }
        let mut frame = vec![0; 4];
        message.write(&mut frame);
        let size = length(frame.len() - 4);
        frame[..4].copy_from_slice(&size);
        let frame = Bytes::from(frame);
        readers.queues.iter().filter_map(Weak::upgrade).for_each(|queue| queue.push(frame.clone()));
        if latch {
            readers.last = Some(frame);
        }
    }

    /// Who is connected.
    #[must_use]
    pub fn subscribers(&self) -> usize {
        lock(&self.publication.readers)
            .queues
            .iter()
            .filter(|queue| queue.strong_count() > 0)
            .count()
    }

    /// The topic's global name.
    #[must_use]
    pub fn topic(&self) -> &str {
        &self.publication.topic
    }
}

impl<M> Drop for Publisher<M> {
    fn drop(&mut self) {
        self.shared.leave(Leaving::Publication(self.publication.topic.clone()));
        self.publication.closed.cancel();
    }
}
