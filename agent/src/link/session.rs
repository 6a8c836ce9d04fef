//! One stream per life of the agent, made again whenever it breaks.
//!
//! ```text
//! supervisor ◀── Command ── session ──▶ controller
//! board ──── reports, usage ──▶ │
//! node  ──── state, pose ─────▶ │
//! desks ◀─── messages ─────── messages ─▶ controller (a connection of their own)
//! ```
//!
//! Level-triggered: a Hello carries every report and the whole node; what was sent in a session is
//! sent again until it is acknowledged. Losing a session loses nothing but time.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use muster_agent_core::journal::Journal;
use muster_agent_core::link::RoundTrips;
use muster_agent_core::time::Boot;
use muster_api::id::TaskUid;
use muster_api::wire::agent::v1 as proto;
use proto::agent_message::Body as Say;
use proto::controller_message::Body as Hear;
use tokio::sync::{mpsc, watch};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{Instant, MissedTickBehavior};
use tokio_stream::wrappers::ReceiverStream;

use super::dial::service::agent_service_client::AgentServiceClient;
use super::dial::{DEAF_AFTER, DialError, Dialer, Pauses};
use super::messages::Messages;
use super::report;
use super::stream_logs::stream_logs;
use crate::clock;
use crate::driver::{Shared, chain};
use crate::executor::direct::Door;
use crate::executor::frame::FRAME_MAX;
use crate::gate::Standing;
use crate::node::Node;
use crate::told;

/// Messages under way to the controller. Short: whoever has much to say (logs) waits here.
const QUEUE: usize = 32;

/// A robot that has not heard emergency stops for this long is not connected.
const UNORDERED: Duration = Duration::from_secs(3);

/// A log request is a reader at a terminal; more than this is a mistake, or an attack.
const MOST_READERS: usize = 64;

/// What the session tells the supervisor.
#[derive(Debug)]
pub(crate) enum Command {
    Assign(proto::Assignments),
    /// Contact was made after a time without.
    Contact,
}

/// How long the runtimes get to say what has become of the tasks of an earlier life. An engine that does not answer is not to
/// keep the whole node away.
const LOOKED_WITHIN: Duration = Duration::from_secs(2);

/// Why a session ended.
#[derive(Debug, thiserror::Error)]
enum SessionError {
    #[error(transparent)]
    Connect(#[from] DialError),
    #[error("the controller ended the session")]
    Status(#[source] Box<tonic::Status>),
    #[error("the controller closed the session")]
    Closed,
    #[error("the controller's first message was no welcome")]
    NoWelcome,
    #[error("emergency stops are not heard")]
    NotOrdered,
    #[error("nothing was heard for {} s", DEAF_AFTER.as_secs())]
    Deaf,
}

/// What a session needs.
#[derive(Debug)]
pub(crate) struct Link {
    pub(crate) dialer: Dialer,
    /// This life of the agent.
    pub(crate) incarnation: String,
    pub(crate) shared: Arc<Shared>,
    pub(crate) commands: mpsc::Sender<Command>,
    /// Whether emergency stops are heard; absent: nothing stands before the drivers.
    pub(crate) ordered: Option<watch::Receiver<bool>>,
}

pub(crate) fn outgoing(body: Say) -> proto::AgentMessage {
    proto::AgentMessage { body: Some(body) }
}

impl Link {
    /// Keeps a session until it is dropped.
    pub(crate) async fn run(self, mut node: Node, mut door: Door) {
        // What ran when the agent before this one ended may have ended since: that is to be the first word about it.
        let _ = tokio::time::timeout(LOOKED_WITHIN, self.shared.board.known()).await;
        let mut pauses = Pauses::default();
        loop {
            let begun = Instant::now();
            if let Err(error) = self.session(&mut node, &mut door).await {
                // One line a loss, not one a try.
                if begun.elapsed() > DEAF_AFTER || pauses.is_first() {
                    tracing::warn!(error = chain(&error), "not connected to the controller");
                }
            }
            pauses.wait(begun).await;
        }
    }

    /// A robot that would not hear an emergency stop takes no work.
    async fn ordered(&self) -> Result<(), SessionError> {
        let Some(ordered) = &self.ordered else { return Ok(()) };
        let mut ordered = ordered.clone();
        let heard = tokio::time::timeout(DEAF_AFTER, ordered.wait_for(|heard| *heard)).await;
        match heard {
            Ok(Ok(_)) => Ok(()),
            Ok(Err(_)) | Err(_) => Err(SessionError::NotOrdered),
        }
    }

    /// Returns when emergency stops have not been heard for too long: the controller is not to think that this robot is well.
    async fn deaf_to_orders(&self) {
        let Some(ordered) = &self.ordered else { return std::future::pending().await };
        let mut ordered = ordered.clone();
        loop {
            // Closed: the agent goes down.
            if ordered.wait_for(|heard| !heard).await.is_err() {
                return;
            }
            let heard = tokio::time::timeout(UNORDERED, ordered.wait_for(|heard| *heard)).await;
            if !matches!(heard, Ok(Ok(_))) {
                return;
            }
        }
    }

    async fn session(&self, node: &mut Node, door: &mut Door) -> Result<(), SessionError> {
        self.ordered().await?;
        let (channel, own) = self.dialer.channel().await?;
        let mut client = AgentServiceClient::new(channel)
            .max_decoding_message_size(FRAME_MAX)
            .max_encoding_message_size(FRAME_MAX);
        let (out, queue) = mpsc::channel(QUEUE);
        let sent = clock::boot();
        let reports = self.shared.board.reports();
        let hello = proto::Hello {
            node: self.shared.node.clone(),
            incarnation: self.incarnation.clone(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            state: Some(node.state()),
            tasks: reports.iter().map(|(uid, said, _)| report::to_wire(uid, said)).collect(),
        };
        // The queue is empty: this does not wait.
        let _ = out.send(outgoing(Say::Hello(hello))).await;
        let status = |status: tonic::Status| SessionError::Status(Box::new(status));
        let mut heard =
            client.session(ReceiverStream::new(queue)).await.map_err(status)?.into_inner();
        let first = tokio::time::timeout(DEAF_AFTER, heard.message());
        let welcome = match first.await.map_err(|_| SessionError::Deaf)?.map_err(status)? {
            Some(proto::ControllerMessage { body: Some(Hear::Welcome(welcome)) }) => welcome,
            Some(_) => return Err(SessionError::NoWelcome),
            None => return Err(SessionError::Closed),
        };
        tracing::info!(controller = %welcome.controller, address = %self.dialer.address, "connected");
        self.shared.contact.made(sent);
        let _ = self.commands.send(Command::Contact).await;
        let said = reports.into_iter().map(|(uid, said, _)| (uid, said.sequence));
        let mut session = Session {
            link: self,
            node,
            door: (door, own),
            out,
            journal: Journal::begun(said, clock::boot()),
            beats: BTreeMap::new(),
            beat: 0,
            trips: RoundTrips::default(),
            readers: JoinSet::new(),
            requests: BTreeMap::new(),
        };
        let interval =
            Duration::from_millis(welcome.heartbeat_interval_ms.clamp(50, 60_000).into());
        let (told, executors) = watch::channel(None);
        let messages = Messages { dialer: &self.dialer, desks: &self.shared.desks, told };
        // None is polled again after another has ended.
        tokio::select! {
            ended = session.run(&mut heard, interval, executors) => ended,
            never = messages.run() => match never {},
            () = self.deaf_to_orders() => Err(SessionError::NotOrdered),
        }
    }
}

/// Cancel-safe: a change that was seen is one that was returned.
async fn changed(standing: &mut Option<watch::Receiver<Standing>>) {
    let closed = match standing {
        Some(standing) => standing.changed().await.is_err(),
        None => true,
    };
    // The gate's keeper ends with the agent.
    if closed {
        std::future::pending().await
    }
}

struct Session<'a> {
    link: &'a Link,
    node: &'a mut Node,
    /// Where frameworks may come, and the address by which the controller is reached.
    door: (&'a mut Door, Option<IpAddr>),
    out: mpsc::Sender<proto::AgentMessage>,
    journal: Journal,
    /// When heartbeats without an answer were sent.
    beats: BTreeMap<u64, (Boot, Instant)>,
    beat: u64,
    trips: RoundTrips,
    readers: JoinSet<u64>,
    requests: BTreeMap<u64, AbortHandle>,
}

impl Session<'_> {
    async fn run(
        &mut self,
        heard: &mut tonic::Streaming<proto::ControllerMessage>,
        interval: Duration,
        mut executors: watch::Receiver<Option<BTreeSet<TaskUid>>>,
    ) -> Result<(), SessionError> {
        let mut beats = tokio::time::interval(interval);
        beats.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let shared = Arc::clone(&self.link.shared);
        let mut gate = shared.gate.as_ref().map(|gate| gate.standing());
        let mut last_heard = Instant::now();
        loop {
            // Every arm is cancel-safe: a stream's next message stays in the stream, a permit that
            // was stored stays stored, a message stays queued, a tick and a join are taken whole or
            // not at all. What an arm sends, it sends before the next wait.
            tokio::select! {
                message = heard.message() => {
                    last_heard = Instant::now();
                    match message.map_err(|status| SessionError::Status(Box::new(status)))? {
                        Some(proto::ControllerMessage { body: Some(body) }) => self.hear(body).await,
                        Some(_) => tracing::warn!("the controller says something newer than this agent"),
                        None => return Err(SessionError::Closed),
                    }
                }
                () = shared.board.changed() => self.say_reports().await?,
                // Closed: the messages' side has ended, and the session with it.
                Ok(()) = executors.changed() => self.say_executors(&mut executors).await?,
                () = changed(&mut gate) => {
                    // A stop is told at once; whoever ordered it waits for that.
                    if let Some(state) = self.node.changed() {
                        self.say(Say::Node(state)).await?;
                    }
                }
                pose = self.node.moved() => self.say(Say::Pose(pose)).await?,
                _ = beats.tick() => {
                    if last_heard.elapsed() > DEAF_AFTER.max(interval * 4) {
                        return Err(SessionError::Deaf);
                    }
                    self.say_heartbeat().await?;
                    self.say_reports().await?;
                }
                Some(done) = self.readers.join_next() => {
                    if let Ok(id) = done {
                        self.requests.remove(&id);
                    }
                }
            }
        }
    }

    async fn hear(&mut self, body: Hear) {
        match body {
            Hear::Welcome(_) => tracing::warn!("a second welcome"),
            Hear::Assignments(assignments) => {
                // Closed: the agent is going down, and this session with it.
                let _ = self.link.commands.send(Command::Assign(assignments)).await;
            }
            Hear::Heartbeat(answer) => {
                if let Some((sent, at)) = self.beats.remove(&answer.sequence) {
                    self.link.shared.contact.made(sent);
                    let took = u64::try_from(at.elapsed().as_micros()).unwrap_or(u64::MAX);
                    self.trips.answered(took);
                }
                self.beats.retain(|sequence, _| *sequence > answer.sequence);
            }
            Hear::Task(answer) => {
                self.link.shared.board.acknowledged(&answer.uid, answer.sequence);
            }
            Hear::Log(request) => self.start_reader(request).await,
            Hear::Images(images) => self.link.shared.images.want(&images),
            Hear::Exec(order) => {
                let shared = &self.link.shared;
                let runtime = shared.board.find(&order.uid).map(|(runtime, _)| runtime);
                shared.execs.begin(self.link.dialer.clone(), runtime, order);
            }
            Hear::Tickets(tickets) => self.link.shared.desks.admit(tickets),
            Hear::LogCancel(cancel) => {
                if let Some(reader) = self.requests.remove(&cancel.id) {
                    reader.abort();
                }
            }
        }
    }

    async fn start_reader(&mut self, request: proto::LogRequest) {
        let id = request.id;
        if self.requests.len() >= MOST_READERS {
            let error = "too many logs are being read from this node".to_owned();
            let end = proto::LogChunk { id, data: Vec::new(), end: true, error };
            let _ = self.say(Say::Log(end)).await;
            return;
        }
        let (shared, out) = (Arc::clone(&self.link.shared), self.out.clone());
        let reader = self.readers.spawn(async move {
            stream_logs(&shared.board, request, out).await;
            id
        });
        self.requests.insert(id, reader);
    }

    async fn say_reports(&mut self) -> Result<(), SessionError> {
        let now = clock::boot();
        for (uid, report, acked) in self.link.shared.board.reports() {
            if self.journal.is_due(&uid, report.sequence, acked, now) {
                self.say(Say::Task(report::to_wire(&uid, &report))).await?;
            }
        }
        Ok(())
    }

    async fn say_executors(
        &mut self,
        executors: &mut watch::Receiver<Option<BTreeSet<TaskUid>>>,
    ) -> Result<(), SessionError> {
        let Some(there) = executors.borrow_and_update().clone() else { return Ok(()) };
        let tasks: Vec<String> = there.iter().map(ToString::to_string).collect();
        let (door, own) = &mut self.door;
        // Who has no executors needs no door.
        let address = if tasks.is_empty() { None } else { door.address(*own).await };
        let address = address.unwrap_or_default();
        self.say(Say::Executors(proto::Executors { tasks, address })).await
    }

    async fn say_heartbeat(&mut self) -> Result<(), SessionError> {
        if let Some(state) = self.node.changed() {
            self.say(Say::Node(state)).await?;
        }
        self.trips.sent(self.beats.contains_key(&self.beat));
        self.beat += 1;
        let shared = &self.link.shared;
        let usage = shared.board.sample().into_iter();
        let usage = usage.map(|usage| proto::TaskUsage {
            uid: usage.uid.to_string(),
            usage: Some(proto::Usage {
                cpu_millis: usage.cpu_millis,
                memory_bytes: usage.used.memory_bytes,
                cpu_total_usec: usage.used.cpu_usec,
            }),
            told: told::observed(&shared.checkpoint.task_dir(&usage.uid).join("run")),
        });
        let heartbeat = proto::Heartbeat {
            sequence: self.beat,
            pose: None,
            usage: usage.collect(),
            node: self.node.usage(),
            link: self.trips.usec().map(|round_trip_usec| proto::Link {
                round_trip_usec,
                late_permille: self.trips.late_permille(),
            }),
        };
        self.beats.insert(self.beat, (clock::boot(), Instant::now()));
        self.say(Say::Heartbeat(heartbeat)).await
    }

    async fn say(&self, body: Say) -> Result<(), SessionError> {
        // A queue that does not move is a connection that is gone.
        match tokio::time::timeout(DEAF_AFTER, self.out.send(outgoing(body))).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err(SessionError::Closed),
            Err(_) => Err(SessionError::Deaf),
        }
    }
}
