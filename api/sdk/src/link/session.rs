//! One stream at a time to the controller, made again whenever it breaks.
//!
//! ```text
//!   handle ── Command ──▶ session ──▶ out queue ──▶ gRPC stream ──▶ controller
//!   stream ◀── Event ──── session ◀── heard ◀────── gRPC stream ◀──
//! ```
//!
//! One task a framework. It keeps what outlives a connection: the framework's id and wishes (they go into the next
//! Subscribe), calls without an answer, and which updates were handed out.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use muster_api::wire::framework::v1 as proto;
use proto::call::Call as Say;
use proto::event::Event as Hear;
use rustls::ClientConfig;
use tokio::sync::mpsc;
use tokio::time::Instant;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;

use super::direct::{Lanes, Outgoing, Relayed};
use super::kubeconfig::{Address, Authorization, authorized};
use super::pending::{Answered, Pending};
use super::seen::{Seen, Verdict};
use super::state::StateFile;
use super::tls;
use crate::backoff::Backoff;
use crate::event::Outlet;
use crate::{Event, FrameworkError};

/// The framework's side of the service.
mod service {
    #![allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        missing_debug_implementations,
        missing_docs,
        unreachable_pub,
        reason = "generated"
    )]
    include!(concat!(env!("OUT_DIR"), "/muster.framework.v1.rs"));
}
use service::framework_service_client::FrameworkServiceClient;

/// Calls under way to the controller.
const QUEUE: usize = 32;
/// Largest message on the wire: 4 MiB between a framework and an executor, and what is around it.
const MAX_WIRE: usize = (4 << 20) + (64 << 10);
/// A controller that is there answers a Subscribe with one write to its store.
const SUBSCRIBED_WITHIN: Duration = Duration::from_secs(15);
/// The reason of an error: the id is no framework's any more.
const UNKNOWN: &str = "UnknownFramework";
/// So many heartbeats in a row do not get lost on a connection that works.
const MISSED_HEARTBEATS: u32 = 5;

/// What the handle wants.
#[derive(Debug)]
pub(crate) enum Command {
    Call { say: Box<Say>, answer: Answered },
    Acknowledge { task: String, version: u64 },
}

/// What the session is told to say, and the lanes that it tells what it hears of messages. The lanes end with it.
#[derive(Debug)]
pub(crate) struct Inbox {
    pub(crate) commands: mpsc::Receiver<Command>,
    pub(crate) relayed: mpsc::UnboundedReceiver<Relayed>,
    pub(crate) lanes: Lanes,
}

/// What is to be said.
#[derive(Debug)]
enum Wanted {
    Command(Command),
    Relayed(Relayed),
}

impl Inbox {
    /// The next, as soon as it can be said at once: events are heard meanwhile, or two sides that have much to say would wait for
    /// each other. Half of the queue is kept for what follows from events. Cancel-safe.
    async fn next(&mut self, out: &mpsc::Sender<proto::Call>) -> Option<Wanted> {
        // Closed: the stream says why.
        drop(out.reserve_many(QUEUE / 2 + 1).await.ok()?);
        tokio::select! {
            Some(command) = self.commands.recv() => Some(Wanted::Command(command)),
            Some(relayed) = self.relayed.recv() => Some(Wanted::Relayed(relayed)),
            else => None,
        }
    }
}

impl Drop for Inbox {
    fn drop(&mut self) {
        self.lanes.close();
    }
}

/// Where the controller is and how it is talked to.
#[derive(Debug)]
pub(crate) struct Link {
    pub(crate) address: Address,
    pub(crate) tls: Arc<ClientConfig>,
    pub(crate) authorization: Option<Authorization>,
}

/// Who the framework is.
#[derive(Debug)]
pub(crate) struct Identity {
    /// What the next session begins with; kept up to date.
    pub(crate) subscribe: proto::Subscribe,
    pub(crate) state: StateFile,
}

/// Why a connection ended that will be made again.
#[derive(Debug, thiserror::Error)]
enum Broken {
    #[error("failed to connect")]
    Connect(#[source] tonic::transport::Error),
    #[error("the controller ended the session")]
    Status(#[source] Box<tonic::Status>),
    #[error("the controller ended the session: {0}")]
    Told(FrameworkError),
    #[error("the controller closed the session")]
    Closed,
    #[error("the controller's first event was not Subscribed")]
    NotSubscribed,
    #[error("nothing was heard for {} s", .0.as_secs_f64())]
    Deaf(Duration),
}

/// How a connection ended.
#[derive(Debug)]
enum End {
    /// Make it again.
    Broken(Broken),
    /// Nothing comes after it.
    Final(Final),
}

/// How a framework ends other than by being stopped.
#[derive(Debug)]
enum Final {
    /// As it asked for itself.
    TornDown,
    /// The controller will not have it.
    Refused(FrameworkError),
}

/// The session of one framework, across connections.
#[derive(Debug)]
pub(crate) struct Session {
    link: Link,
    identity: Identity,
    /// No offers are wanted; the controller forgets this with the connection.
    suppressed: bool,
    /// This connection got as far as Subscribed.
    subscribed: bool,
    pending: Pending,
    seen: Seen,
    inbox: Inbox,
    events: Outlet,
    stop: CancellationToken,
}

/// One connection's outgoing side, and how long it may be silent.
struct Line {
    out: mpsc::Sender<proto::Call>,
    last_heard: Instant,
    deaf_after: Duration,
}

impl Session {
    pub(crate) fn new(
        link: Link,
        identity: Identity,
        inbox: Inbox,
        events: Outlet,
        stop: CancellationToken,
    ) -> Self {
        Session {
            link,
            identity,
            suppressed: false,
            subscribed: false,
            pending: Pending::default(),
            seen: Seen::default(),
            inbox,
            events,
            stop,
        }
    }

    /// Runs until the framework is stopped, refused or dropped.
    pub(crate) async fn run(mut self) {
        let (stop, events) = (self.stop.clone(), self.events.clone());
        let end = tokio::select! {
            // First: a stop follows the answer to a teardown, and does not undo it.
            biased;
            end = self.keep_connected() => end,
            // What is cut off here is repeated by the controller to whoever comes back.
            () = stop.cancelled() => return,
            () = events.closed() => return,
        };
        match end {
            Final::TornDown => self.identity.state.remove().await,
            Final::Refused(error) => self.events.send(Event::Error(error)),
        }
    }

    async fn keep_connected(&mut self) -> Final {
        let mut backoff = Backoff::new();
        loop {
            let Err(end) = self.connection().await;
            match end {
                End::Final(end) => return end,
                End::Broken(broken) => {
                    tracing::warn!(error = chain(&broken), address = %self.link.address, "not connected to the controller");
                }
            }
            self.pending.disconnected();
            if std::mem::take(&mut self.subscribed) {
                backoff.reset();
                self.events.send(Event::Disconnected);
            }
            tokio::time::sleep(backoff.pause()).await;
        }
    }

    /// One connection, from dialling to its end.
    async fn connection(&mut self) -> Result<Infallible, End> {
        let (mut line, mut heard) = self.subscribe().await?;
        if self.suppressed {
            let call = Some(Say::Suppress(proto::Suppress {}));
            line.say(proto::Call { id: String::new(), call }).await?;
        }
        for call in self.pending.again() {
            line.say(call).await?;
        }
        loop {
            let deaf_at = line.last_heard + line.deaf_after;
            // Every arm is cancel-safe: a stream's next message stays in the stream, a command is taken whole or
            // not at all. What an arm sends, it sends before the next wait.
            tokio::select! {
                event = heard.message() => {
                    line.last_heard = Instant::now();
                    match event.map_err(ended_by)? {
                        Some(proto::Event { event: Some(event) }) => self.hear(event, &line).await?,
                        Some(_) => tracing::warn!("the controller says something newer than this SDK"),
                        None => return Err(End::Broken(Broken::Closed)),
                    }
                }
                // Closed: every handle is gone, and what happens is still of interest.
                Some(wanted) = self.inbox.next(&line.out) => match wanted {
                    Wanted::Command(command) => self.command(command, &line).await?,
                    Wanted::Relayed(relayed) => self.relay(relayed, &line).await?,
                },
                () = tokio::time::sleep_until(deaf_at) => {
                    return Err(End::Broken(Broken::Deaf(line.deaf_after)));
                }
            }
        }
    }

    async fn subscribe(&mut self) -> Result<(Line, tonic::Streaming<proto::Event>), End> {
        let channel = tls::dial(&self.link.address, &self.link.tls).await;
        let channel = channel.map_err(|error| End::Broken(Broken::Connect(error)))?;
        let mut client = FrameworkServiceClient::new(channel)
            .max_decoding_message_size(MAX_WIRE)
            .max_encoding_message_size(MAX_WIRE);
        let (out, queue) = mpsc::channel(QUEUE);
        let subscribe = Some(Say::Subscribe(self.identity.subscribe.clone()));
        // The queue is empty: this does not wait.
        drop(out.send(proto::Call { id: String::new(), call: subscribe }).await);
        let first = async {
            let calls = authorized(ReceiverStream::new(queue), self.link.authorization.as_ref());
            let mut heard = client.session(calls).await?.into_inner();
            let first = heard.message().await?;
            Ok((heard, first))
        };
        let first = tokio::time::timeout(SUBSCRIBED_WITHIN, first).await;
        let first = first.map_err(|_| End::Broken(Broken::Deaf(SUBSCRIBED_WITHIN)))?;
        let (heard, first) = first.map_err(ended_by)?;
        let subscribed = match first.and_then(|event| event.event) {
            Some(Hear::Subscribed(subscribed)) => subscribed,
            Some(Hear::Error(error)) => return Err(self.refused(error)),
            Some(_) => return Err(End::Broken(Broken::NotSubscribed)),
            None => return Err(End::Broken(Broken::Closed)),
        };
        let interval =
            Duration::from_millis(subscribed.heartbeat_interval_ms.clamp(50, 60_000).into());
        self.registered(subscribed).await;
        let deaf_after = interval * MISSED_HEARTBEATS;
        Ok((Line { out, last_heard: Instant::now(), deaf_after }, heard))
    }

    async fn registered(&mut self, subscribed: proto::Subscribed) {
        let proto::Subscribed { framework_id, reregistered, .. } = subscribed;
        tracing::info!(address = %self.link.address, framework_id, reregistered, "registered");
        self.subscribed = true;
        if self.identity.subscribe.framework_id != framework_id {
            self.identity.state.write(&framework_id).await;
            self.identity.subscribe.framework_id.clone_from(&framework_id);
        }
        self.events.send(if reregistered {
            Event::Reregistered
        } else {
            // Executors of an earlier one are not this one's.
            self.inbox.lanes.forget();
            Event::Registered { framework_id }
        });
    }

    /// The controller does not begin the session and says why.
    fn refused(&mut self, error: proto::Error) -> End {
        let is_known = !self.identity.subscribe.framework_id.is_empty();
        match self.told(error) {
            // Away for longer than its failover timeout: its tasks are gone, and the work is still wanted.
            End::Final(Final::Refused(error)) if error.reason == UNKNOWN && is_known => {
                self.identity.subscribe.framework_id.clear();
                End::Broken(Broken::Told(error))
            }
            end => end,
        }
    }

    /// The controller ends the session and says why.
    fn told(&mut self, error: proto::Error) -> End {
        let proto::Error { reason, message } = error;
        let error = FrameworkError { reason, message };
        match error.reason.as_str() {
            UNKNOWN if self.pending.torn_down() => End::Final(Final::TornDown),
            // Coming back after Cut would throw the one out that took this one's place, and so on for ever.
            UNKNOWN | "AlreadyExists" | "Forbidden" | "Invalid" | "Cut" => {
                End::Final(Final::Refused(error))
            }
            _ => End::Broken(Broken::Told(error)),
        }
    }

    async fn hear(&mut self, event: Hear, line: &Line) -> Result<(), End> {
        let event = match event {
            Hear::Offers(offers) => Event::Offers(offers.offers),
            Hear::Rescind(rescind) => {
                let reason = rescind.reason();
                Event::Rescinded { offers: rescind.offers, reason }
            }
            Hear::Update(update) => match self.seen.judge(&update) {
                Verdict::Fresh => Event::Update(update),
                Verdict::Ignore => return Ok(()),
                Verdict::Acknowledge => {
                    return line.acknowledge(update.task, update.version).await;
                }
            },
            Hear::Message(message) => {
                self.inbox.lanes.relayed(message);
                return Ok(());
            }
            Hear::Direct(direct) => {
                self.inbox.lanes.told(direct);
                return Ok(());
            }
            Hear::Moved(moved) => {
                self.identity.subscribe.position.clone_from(&moved.position);
                Event::Moved(moved)
            }
            Hear::NodeLost(lost) => Event::NodeLost(lost),
            Hear::ExecutorLost(lost) => {
                self.inbox.lanes.lost(&lost.executor);
                Event::ExecutorLost(lost)
            }
            Hear::Answer(answer) => return self.answer(answer),
            Hear::Error(error) => return Err(self.told(error)),
            Hear::Heartbeat(_) => return Ok(()),
            Hear::Subscribed(_) => {
                tracing::warn!("the controller says twice that the framework is subscribed");
                return Ok(());
            }
        };
        self.events.send(event);
        Ok(())
    }

    fn answer(&mut self, answer: proto::Answer) -> Result<(), End> {
        let Some(done) = self.pending.answer(answer) else { return Ok(()) };
        match done.call {
            _ if done.refused => {}
            Some(Say::SetPosition(new)) => self.identity.subscribe.position = new.position,
            Some(Say::SetFilter(new)) => self.identity.subscribe.filter = new.filter,
            Some(Say::Suppress(_)) => self.suppressed = true,
            Some(Say::Revive(_)) => self.suppressed = false,
            Some(Say::Teardown(_)) => return Err(End::Final(Final::TornDown)),
            _ => {}
        }
        Ok(())
    }

    async fn relay(&mut self, relayed: Relayed, line: &Line) -> Result<(), End> {
        match relayed {
            Relayed::Message { executor, outgoing } => {
                let Outgoing { data, answered, room } = outgoing;
                let message = proto::Message { executor, data, ..proto::Message::default() };
                line.say(self.pending.add(Say::Message(message), answered)).await?;
                drop(room);
                Ok(())
            }
            Relayed::Mark { executor, line: mark } => {
                let mark = mark.number();
                let message = proto::Message { executor, mark, ..proto::Message::default() };
                line.say(proto::Call { id: String::new(), call: Some(Say::Message(message)) }).await
            }
        }
    }

    async fn command(&mut self, command: Command, line: &Line) -> Result<(), End> {
        match command {
            Command::Call { say, answer } => {
                if let Say::Reconcile(reconcile) = &*say {
                    self.seen.ask(&reconcile.tasks);
                }
                line.say(self.pending.add(*say, answer)).await
            }
            // What is said of a task that there is not needs no acknowledgement.
            Command::Acknowledge { version: 0, .. } => Ok(()),
            Command::Acknowledge { task, version } => {
                self.seen.acknowledged(&task, version);
                line.acknowledge(task, version).await
            }
        }
    }
}

impl Line {
    async fn acknowledge(&self, task: String, version: u64) -> Result<(), End> {
        let call = Some(Say::Acknowledge(proto::Acknowledge { task, version }));
        self.say(proto::Call { id: String::new(), call }).await
    }

    async fn say(&self, call: proto::Call) -> Result<(), End> {
        // A queue that does not move is a connection that is gone.
        match tokio::time::timeout(self.deaf_after, self.out.send(call)).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err(End::Broken(Broken::Closed)),
            Err(_) => Err(End::Broken(Broken::Deaf(self.deaf_after))),
        }
    }
}

/// Whether a status will be the same next time.
fn ended_by(status: tonic::Status) -> End {
    use tonic::Code;
    match status.code() {
        Code::Unauthenticated | Code::PermissionDenied | Code::Unimplemented => {
            let (reason, message) = (format!("{:?}", status.code()), status.message().to_owned());
            End::Final(Final::Refused(FrameworkError { reason, message }))
        }
        _ => End::Broken(Broken::Status(Box::new(status))),
    }
}

/// An error and what is behind it, on one line.
pub(crate) fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(error) = next {
        text = format!("{text}: {error}");
        next = error.source();
    }
    text
}
