//! The gRPC service that agents dial: one stream a session, one task a stream.
//!
//! Order at the beginning: Hello → the Node is written → the agent's reports are applied → Welcome,
//! then the whole page of assignments. So an assignment never tells an agent to start what it has
//! just reported as ended. Afterwards the session's task has four sources, all in one select: the
//! agent's messages, changes of its page, a later session of the same node, the end of the controller.
//!
//! What the agent runs and should not is looked after in `strays`.

use std::pin::{Pin, pin};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use futures::{Stream, StreamExt as _, future};
use muster_api::id::{Incarnation, TaskUid};
use muster_api::kind::lease::{DEFAULT_GROUP, Lease};
use muster_api::name::NodeName;
use muster_api::pose::Pose;
use muster_api::wire::agent::v1 as wire;
use muster_api::wire::agent_session::{NodeReport, node_order};
use muster_controller_core::node_health::{DETECT_AFTER, HEARTBEAT_EVERY};
use muster_controller_core::stray::Strays;
use tokio::sync::{Notify, mpsc, watch};
use tokio_stream::wrappers::{ReceiverStream, WatchStream};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tonic::{Request, Response, Status, Streaming};
use wire::agent_message::Body as FromAgent;
use wire::controller_message::Body as ToAgent;

use super::nodes::{self, Speaker};
use super::poses::LivePoses;
use super::proto::agent_service_server::AgentService;
use super::strays::lives;
use super::{Connection, NodeUsage, Sessions, agent_of, relay, reports};
use crate::context::Context;
use crate::objects;
use crate::reconcile::images;

/// An agent that connects says Hello at once.
const HELLO_WITHIN: Duration = Duration::from_secs(10);
/// Messages that wait to be sent to one agent. Assignments are not among them (they are state, taken
/// when there is room); acknowledgements and log requests are a few at a time.
const OUTBOUND: usize = 64;

/// The service.
#[derive(Debug)]
pub struct Agents {
    context: Arc<Context>,
    sessions: Arc<Sessions>,
    poses: Arc<LivePoses>,
    tasks: TaskTracker,
    next_id: AtomicU64,
}

impl Agents {
    /// A service whose sessions run on `tasks` and end with `context.stop`.
    #[must_use]
    pub fn new(
        context: Arc<Context>,
        sessions: Arc<Sessions>,
        poses: Arc<LivePoses>,
        tasks: TaskTracker,
    ) -> Self {
        Agents { context, sessions, poses, tasks, next_id: AtomicU64::new(1) }
    }

    /// A session with the agent that showed the certificate of `node` with this `key`; gives what is said to it. Whatever
    /// carries the messages keeps their order.
    pub fn begin(&self, node: NodeName, key: String, inbound: Inbound) -> Told {
        let (to_agent, told) = mpsc::channel(OUTBOUND);
        let session = Session {
            context: Arc::clone(&self.context),
            sessions: Arc::clone(&self.sessions),
            poses: Arc::clone(&self.poses),
            id: self.next_id.fetch_add(1, Ordering::Relaxed),
            node,
            key,
            node_uid: "".into(),
            strays: Strays::default(),
            inbound,
            to_agent,
            ended: CancellationToken::new(),
        };
        self.tasks.spawn(session.run());
        ReceiverStream::new(told)
    }

    /// What people decide about `node`, whole: how it is, and each change. `key`: of its agent's certificate.
    ///
    /// # Errors
    ///
    /// Whoever shows another certificate than its agent's hears nothing.
    pub fn orders_for(
        &self,
        node: &NodeName,
        key: &str,
    ) -> Result<impl Stream<Item = wire::NodeOrder> + Send + use<>, Status> {
        // Followed before it is read: what changes in between is told.
        let told = self.sessions.orders().follow(node);
        let (stored, object) =
            nodes::admit(&self.context, node, key).map_err(|error| status(&error))?;
        let lease = self.context.store.get(&objects::lease_key(node.as_str(), DEFAULT_GROUP));
        if let Some((lease, stored)) = lease.and_then(|s| Some((objects::read::<Lease>(&s)?, s))) {
            self.sessions.orders().tell_lease(&lease, stored.revision);
        }
        self.sessions.orders().say(node, stored.revision, node_order(&object.spec));
        let told = WatchStream::new(told).filter(|told| future::ready(told.revision > 0));
        let stop = self.context.stop.clone().cancelled_owned();
        Ok(told.map(|told| told.order).take_until(stop))
    }
}

/// What an agent says, in order. Dropping a wait for the next message loses none.
pub type Inbound = Pin<Box<dyn Stream<Item = Result<wire::AgentMessage, Status>> + Send + Sync>>;

/// What an agent is told.
pub type Told = ReceiverStream<Result<wire::ControllerMessage, Status>>;

type Outbound = mpsc::Sender<Result<wire::ControllerMessage, Status>>;

#[tonic::async_trait]
impl AgentService for Agents {
    type SessionStream =
        Pin<Box<dyn Stream<Item = Result<wire::ControllerMessage, Status>> + Send>>;
    type MessagesStream = Pin<Box<dyn Stream<Item = Result<wire::Message, Status>> + Send>>;
    type OrdersStream = Pin<Box<dyn Stream<Item = Result<wire::NodeOrder, Status>> + Send>>;

    async fn session(
        &self,
        request: Request<Streaming<wire::AgentMessage>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (node, key) = agent_of(&request)?;
        let outbound = self.begin(node, key, Box::pin(request.into_inner()));
        Ok(Response::new(Box::pin(outbound)))
    }

    async fn orders(
        &self,
        request: Request<wire::OrdersRequest>,
    ) -> Result<Response<Self::OrdersStream>, Status> {
        let (node, key) = agent_of(&request)?;
        Ok(Response::new(Box::pin(self.orders_for(&node, &key)?.map(Ok))))
    }

    async fn messages(
        &self,
        request: Request<Streaming<wire::Message>>,
    ) -> Result<Response<Self::MessagesStream>, Status> {
        let (node, key) = agent_of(&request)?;
        nodes::admit(&self.context, &node, &key).map_err(|error| status(&error))?;
        let connection = self.sessions.connection(&node);
        let connection = connection.ok_or_else(|| {
            Status::failed_precondition("messages are carried beside a session; say Hello first")
        })?;
        let told = connection.relay.attach();
        let heard = hear_messages(Arc::clone(&self.context), node, request.into_inner());
        let until = (self.context.stop.clone(), connection.ended, told.over());
        self.tasks.spawn(async move {
            tokio::select! {
                () = until.0.cancelled() => {}
                () = until.1.cancelled() => {}
                () = until.2.cancelled() => {}
                () = heard => {}
            }
            until.2.cancel();
        });
        Ok(Response::new(Box::pin(told.map(Ok))))
    }
}

/// Passes on what executors of a node say, to the end of the stream.
async fn hear_messages(
    context: Arc<Context>,
    node: NodeName,
    mut messages: Streaming<wire::Message>,
) {
    while let Some(Ok(message)) = messages.next().await {
        if let Some(live) = context.live() {
            live.frameworks.take_from_executor(&node, message);
        }
    }
}

/// What others say to the agent through its session.
struct Beside {
    messages: mpsc::Receiver<wire::ControllerMessage>,
    tickets: watch::Receiver<wire::Tickets>,
}

pub(super) struct Session {
    pub(super) context: Arc<Context>,
    pub(super) sessions: Arc<Sessions>,
    poses: Arc<LivePoses>,
    pub(super) id: u64,
    pub(super) node: NodeName,
    /// Of the agent's certificate.
    key: String,
    /// Of the Node for which this session speaks.
    node_uid: Box<str>,
    pub(super) strays: Strays,
    inbound: Inbound,
    to_agent: Outbound,
    /// It has ended.
    ended: CancellationToken,
}

/// Why a session ends other than by the agent's wish.
pub(super) enum End {
    /// The agent closed it, or cannot be written to.
    Closed,
    /// The agent is told why.
    Because(Status),
}

impl From<Status> for End {
    fn from(status: Status) -> Self {
        End::Because(status)
    }
}

/// The node was given up meanwhile and its tasks are Unknown: a new session tells everything anew.
fn given_up() -> End {
    Status::aborted("the node was silent for too long; say Hello again").into()
}

/// Does what waits for the disk. Nobody reads meanwhile what the agent says: that is no silence of the agent's.
async fn heard_while<T>(
    (sessions, node): (&Sessions, &NodeName),
    work: impl Future<Output = Result<T, End>>,
) -> Result<T, End> {
    let mut work = pin!(work);
    loop {
        match tokio::time::timeout(HEARTBEAT_EVERY, &mut work).await {
            Ok(done) => return done,
            Err(_) if sessions.heard(node) => return Err(given_up()),
            Err(_) => {}
        }
    }
}

impl Session {
    async fn run(mut self) {
        let stop = self.context.stop.clone();
        let ended = tokio::select! {
            () = stop.cancelled() => End::Because(Status::unavailable("the controller ends")),
            Err(end) = self.serve() => end,
        };
        self.sessions.disconnect(&self.node, self.id);
        self.ended.cancel();
        if let End::Because(status) = ended {
            tracing::debug!(node = %self.node, code = ?status.code(), message = status.message(), "session ended");
            // An agent that does not read any more need not be told.
            drop(self.to_agent.try_send(Err(status)));
        }
    }

    async fn serve(&mut self) -> Result<std::convert::Infallible, End> {
        let hello = tokio::time::timeout(HELLO_WITHIN, self.next()).await;
        let Ok(FromAgent::Hello(hello)) =
            hello.map_err(|_| Status::deadline_exceeded("no Hello came"))?
        else {
            return Err(Status::invalid_argument("the first message of a session is Hello").into());
        };
        let speaker = self.speaker(&hello)?;
        self.sessions.board().ready().await;
        let (outbound, messages) = mpsc::channel(OUTBOUND);
        let (to_agent, tickets) = watch::channel(wire::Tickets::default());
        let mut beside = Beside { messages, tickets };
        let replaced = CancellationToken::new();
        let logs = Arc::default();
        let connection = Connection {
            id: self.id,
            key: speaker.key.as_str().into(),
            outbound,
            relay: relay::Relay::default(),
            tickets: to_agent,
            logs: Arc::clone(&logs),
            replaced: replaced.clone(),
            ended: self.ended.clone(),
            written: Arc::default(),
        };
        let hello_written = Arc::clone(&connection.written);
        let sessions = Arc::clone(&self.sessions);
        let beginning = sessions.begin().await;
        // First of all: one that is not admitted must not end the session of one that is.
        nodes::admit(&self.context, &speaker.node, &speaker.key)
            .map_err(|error| refused(&error))?;
        self.sessions.connect(&self.node, connection);
        // Heard before it is written that it is ready: whoever is about to write that it is silent looks
        // at this again, and must not overwrite the newer word with the older one.
        self.sessions.heard(&self.node);
        let (sessions, node) = (Arc::clone(&self.sessions), self.node.clone());
        heard_while((&sessions, &node), self.write_hello(&speaker, &hello)).await?;
        hello_written.store(true, Ordering::Release);
        drop(beginning);
        self.send(ToAgent::Welcome(welcome())).await?;
        // What changes from now on comes from `reconcile::images`, behind this.
        self.send(ToAgent::Images(images::wanted_on(&self.context.store, &self.node))).await?;
        let wake = self.send_page(&hello.tasks).await?;
        for report in &hello.tasks {
            self.acknowledge(report).await?;
        }
        tracing::info!(node = %self.node, incarnation = %speaker.incarnation, tasks = hello.tasks.len(), "agent connected");
        self.context.events.node(
            self.node.as_str(),
            "AgentConnected",
            format!("agent {} is connected", speaker.version),
        );
        self.listen(&speaker, &wake, &mut beside, &logs, &replaced).await
    }

    /// What Hello says, written down. Strays are known before the node is called ready.
    async fn write_hello(&mut self, speaker: &Speaker, hello: &wire::Hello) -> Result<(), End> {
        for report in &hello.tasks {
            let uid = TaskUid::new(report.uid.clone());
            // All of them are written with the node below.
            let _ = self.strays.told(&uid, lives(report), self.is_assigned(&uid));
        }
        self.take_node(speaker, hello.state.as_ref()).await?;
        if !self.strays.is_empty() {
            self.tell_strays();
        }
        for report in &hello.tasks {
            self.apply_report(report).await?;
        }
        reports::unsaid(&self.context, &self.sessions, &self.node).await.map_err(internal)
    }

    async fn listen(
        &mut self,
        speaker: &Speaker,
        wake: &Notify,
        beside: &mut Beside,
        logs: &super::logs::Readers,
        replaced: &CancellationToken,
    ) -> Result<std::convert::Infallible, End> {
        loop {
            tokio::select! {
                // Cancel safe: tonic keeps a half-read message in the stream.
                message = self.inbound.next() => {
                    let body = message.ok_or(End::Closed)?.map_err(|_| End::Closed)?.body;
                    self.take(body, speaker, logs).await?;
                }
                // Cancel safe: a permit that was not received stays.
                () = wake.notified() => self.send_changed().await?,
                Some(message) = beside.messages.recv() => self.send_message(message).await?,
                // Cancel safe: what was not marked as seen is a change again.
                Ok(()) = beside.tickets.changed() => {
                    let tickets = beside.tickets.borrow_and_update().clone();
                    self.send(ToAgent::Tickets(tickets)).await?;
                }
                () = replaced.cancelled() => {
                    self.is_admitted()?;
                    return Err(Status::aborted("another session of this node has begun, or is asked for").into());
                }
            }
        }
    }

    fn speaker(&self, hello: &wire::Hello) -> Result<Speaker, Status> {
        if hello.node != self.node.as_str() {
            let text =
                format!("the certificate is {}'s, and Hello says {:?}", self.node, hello.node);
            return Err(Status::permission_denied(text));
        }
        if hello.incarnation.is_empty() {
            return Err(Status::invalid_argument("hello.incarnation is missing"));
        }
        Ok(Speaker {
            node: self.node.clone(),
            key: self.key.clone(),
            incarnation: Incarnation::new(hello.incarnation.clone()),
            version: hello.version.clone(),
        })
    }

    async fn next(&mut self) -> Result<FromAgent, End> {
        let message = self.inbound.next().await.ok_or(End::Closed)?.map_err(|_| End::Closed)?;
        message.body.ok_or_else(|| Status::invalid_argument("a message without a body").into())
    }

    pub(super) async fn send(&self, body: ToAgent) -> Result<(), End> {
        self.send_message(wire::ControllerMessage { body: Some(body) }).await
    }

    async fn send_message(&self, message: wire::ControllerMessage) -> Result<(), End> {
        self.to_agent.send(Ok(message)).await.map_err(|_| End::Closed)
    }

    async fn take(
        &mut self,
        body: Option<FromAgent>,
        speaker: &Speaker,
        logs: &super::logs::Readers,
    ) -> Result<(), End> {
        match body {
            Some(FromAgent::Heartbeat(heartbeat)) => self.take_heartbeat(heartbeat).await,
            Some(FromAgent::Pose(pose)) => self.take_pose(&pose),
            Some(FromAgent::Task(report)) => {
                let (sessions, node) = (Arc::clone(&self.sessions), self.node.clone());
                heard_while((&sessions, &node), self.take_report(&report)).await
            }
            Some(FromAgent::Node(state)) => {
                self.is_newest()?;
                let (sessions, node) = (Arc::clone(&self.sessions), self.node.clone());
                heard_while((&sessions, &node), self.take_node(speaker, Some(&state))).await
            }
            Some(FromAgent::Log(chunk)) => {
                let id = chunk.id;
                if !logs.take(chunk) {
                    self.send(ToAgent::LogCancel(wire::LogCancel { id })).await?;
                }
                Ok(())
            }
            Some(FromAgent::Executors(executors)) => self.take_executors(&executors).await,
            Some(FromAgent::Hello(_)) => Err(Status::invalid_argument("a second Hello").into()),
            None => Err(Status::invalid_argument("a message without a body").into()),
        }
    }

    /// No later session of this node has begun; what an earlier one still reads is old.
    pub(super) fn is_newest(&self) -> Result<(), End> {
        match self.sessions.is_present(&self.node, self.id) {
            true => Ok(()),
            false => Err(replaced(&self.node)),
        }
    }

    /// The Node for which this session speaks is still there.
    fn is_admitted(&self) -> Result<(), End> {
        let stored = self.context.store.get(&objects::node_key(self.node.as_str()));
        match stored.is_some_and(|stored| stored.uid == self.node_uid) {
            true => Ok(()),
            false => Err(refused(&nodes::NodeError::Deleted { node: self.node.clone() })),
        }
    }

    async fn take_heartbeat(&mut self, heartbeat: wire::Heartbeat) -> Result<(), End> {
        self.is_admitted()?;
        if self.sessions.heard(&self.node) {
            return Err(given_up());
        }
        if let Some(pose) = &heartbeat.pose {
            self.take_pose(pose)?;
        }
        let usage = NodeUsage {
            node: heartbeat.node.unwrap_or_default(),
            tasks: heartbeat.usage,
            link: heartbeat.link.map(Into::into),
        };
        self.sessions.set_usage(&self.node, usage);
        self.send(ToAgent::Heartbeat(wire::HeartbeatAck { sequence: heartbeat.sequence })).await
    }

    async fn take_executors(&mut self, said: &wire::Executors) -> Result<(), End> {
        self.is_newest()?;
        let Some(live) = self.context.live() else { return Ok(()) };
        let executors = live.frameworks.executors_on(&self.node, &said.tasks);
        live.frameworks.executors_at(&self.node, &said.address, &executors);
        // The scheduler ends only with the controller.
        live.scheduler.executors(self.node.clone(), executors).await.map_err(|_| End::Closed)
    }

    /// Not of an earlier session that still reads: it says where the robot was.
    fn take_pose(&self, pose: &wire::Pose) -> Result<(), End> {
        self.is_newest()?;
        let pose = Pose::try_from(pose).map_err(|e| Status::invalid_argument(e.to_string()))?;
        self.say_pose(&pose);
        Ok(())
    }

    /// False: the building knows better.
    fn say_pose(&self, pose: &Pose) -> bool {
        let taken = self.poses.say_own(&self.node, pose);
        if let Err(why) = &taken {
            tracing::trace!(node = %self.node, %why, "the agent's pose is passed over");
        }
        taken.is_ok()
    }

    pub(super) async fn acknowledge(&self, report: &wire::TaskReport) -> Result<(), End> {
        let ack = wire::TaskReportAck { uid: report.uid.clone(), sequence: report.sequence };
        self.send(ToAgent::Task(ack)).await
    }

    pub(super) async fn apply_report(&self, report: &wire::TaskReport) -> Result<(), End> {
        reports::apply(&self.context, &self.sessions, &self.node, report).await.map_err(|error| {
            match error {
                reports::ReportError::Wire(wire) => {
                    End::Because(Status::invalid_argument(wire.to_string()))
                }
                reports::ReportError::Store(store) => internal(store),
            }
        })
    }

    async fn take_node(
        &mut self,
        speaker: &Speaker,
        state: Option<&wire::NodeState>,
    ) -> Result<(), End> {
        let state = state.ok_or_else(|| Status::invalid_argument("hello.state is missing"))?;
        self.sessions.set_person_epoch(&self.node, state.person_epoch);
        let mut report =
            NodeReport::try_from(state).map_err(|e| Status::invalid_argument(e.to_string()))?;
        // The Node is written for the rest of the report anyway, so what counts is written with it.
        report.pose = report.pose.filter(|pose| self.say_pose(pose));
        let strays = self.stray_names();
        let is_newest = || self.sessions.is_present(&self.node, self.id);
        let written = nodes::write(&self.context, speaker, &report, &strays, is_newest).await;
        self.node_uid = written.map_err(|error| match error {
            nodes::NodeError::Store(store) => internal(store),
            nodes::NodeError::Replaced { node } => replaced(&node),
            error => refused(&error),
        })?;
        Ok(())
    }
}

/// Trying again does not help: a person has to do something first.
fn refused(error: &nodes::NodeError) -> End {
    End::Because(status(error))
}

fn status(error: &nodes::NodeError) -> Status {
    match error {
        nodes::NodeError::Deleted { .. } | nodes::NodeError::OtherAgent { .. } => {
            Status::permission_denied(error.to_string())
        }
        _ => Status::failed_precondition(error.to_string()),
    }
}

fn replaced(node: &NodeName) -> End {
    Status::aborted(format!("a later session of {node} has begun")).into()
}

/// The agent tries again; what it said is not lost, it repeats it.
pub(super) fn internal(error: crate::store::StoreError) -> End {
    End::Because(Status::unavailable(crate::app::chain(&error)))
}

fn welcome() -> wire::Welcome {
    let millis = |d: Duration| u32::try_from(d.as_millis()).unwrap_or(u32::MAX);
    wire::Welcome {
        controller: env!("CARGO_PKG_VERSION").to_owned(),
        heartbeat_interval_ms: millis(HEARTBEAT_EVERY),
        detect_after_ms: millis(DETECT_AFTER),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn an_agent_is_not_silent_while_nobody_listens() {
        let (sessions, node) = (Sessions::default(), NodeName::new("robot").unwrap());
        sessions.heard(&node);
        let slow = async {
            tokio::time::sleep(DETECT_AFTER * 5).await;
            Ok(sessions.silent_nodes())
        };
        let silent = heard_while((&sessions, &node), slow).await;
        assert!(silent.is_ok_and(|silent| silent.is_empty()));
        tokio::time::sleep(DETECT_AFTER * 2).await;
        assert_eq!(sessions.silent_nodes().len(), 1, "now it is its own silence");
        // Given up before: a session that goes on would leave its tasks Unknown.
        let slow = async {
            tokio::time::sleep(DETECT_AFTER).await;
            Ok(())
        };
        assert!(heard_while((&sessions, &node), slow).await.is_err());
    }
}
