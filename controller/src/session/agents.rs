//! The gRPC service that agents dial: one stream a session, one task a stream.
//!
//! Order at the beginning: Hello → the Node is written → the agent's reports are applied → Welcome,
//! then the whole page of assignments. So an assignment never tells an agent to start what it has
//! just reported as ended. Afterwards the session's task has four sources, all in one select: the
//! agent's messages, changes of its page, a later session of the same node, the end of the controller.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use futures::Stream;
use muster_api::id::Incarnation;
use muster_api::name::NodeName;
use muster_api::pose::Pose;
use muster_api::wire::agent::v1 as wire;
use muster_api::wire::agent_session::NodeReport;
use muster_controller_core::node_health::{DETECT_AFTER, HEARTBEAT_EVERY};
use tokio::sync::{Notify, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tonic::{Request, Response, Status, Streaming};
use wire::agent_message::Body as FromAgent;
use wire::controller_message::Body as ToAgent;

use super::nodes::{self, Speaker};
use super::proto::agent_service_server::AgentService;
use super::{Connection, NodeUsage, Sessions, reports};
use crate::auth::Identity;
use crate::context::Context;
use crate::reconcile::schedule;

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
    scheduler: schedule::Handle,
    tasks: TaskTracker,
    next_id: AtomicU64,
}

impl Agents {
    /// A service whose sessions run on `tasks` and end with `context.stop`.
    #[must_use]
    pub fn new(
        context: Arc<Context>,
        sessions: Arc<Sessions>,
        scheduler: schedule::Handle,
        tasks: TaskTracker,
    ) -> Self {
        Agents { context, sessions, scheduler, tasks, next_id: AtomicU64::new(1) }
    }
}

type Outbound = mpsc::Sender<Result<wire::ControllerMessage, Status>>;

#[tonic::async_trait]
impl AgentService for Agents {
    type SessionStream =
        Pin<Box<dyn Stream<Item = Result<wire::ControllerMessage, Status>> + Send>>;

    async fn session(
        &self,
        request: Request<Streaming<wire::AgentMessage>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let node = match request.extensions().get::<Identity>() {
            Some(Identity::Node { name }) => name.clone(),
            _ => return Err(Status::unauthenticated("a node's client certificate is needed")),
        };
        let node = NodeName::new(node)
            .map_err(|e| Status::unauthenticated(format!("the certificate's name {e}")))?;
        let (to_agent, outbound) = mpsc::channel(OUTBOUND);
        let session = Session {
            context: Arc::clone(&self.context),
            sessions: Arc::clone(&self.sessions),
            scheduler: self.scheduler.clone(),
            id: self.next_id.fetch_add(1, Ordering::Relaxed),
            node,
            inbound: request.into_inner(),
            to_agent,
        };
        self.tasks.spawn(session.run());
        Ok(Response::new(Box::pin(ReceiverStream::new(outbound))))
    }
}

struct Session {
    context: Arc<Context>,
    sessions: Arc<Sessions>,
    scheduler: schedule::Handle,
    id: u64,
    node: NodeName,
    inbound: Streaming<wire::AgentMessage>,
    to_agent: Outbound,
}

/// Why a session ends other than by the agent's wish.
enum End {
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

impl Session {
    async fn run(mut self) {
        let stop = self.context.stop.clone();
        let ended = tokio::select! {
            () = stop.cancelled() => End::Because(Status::unavailable("the controller ends")),
            Err(end) = self.serve() => end,
        };
        self.sessions.disconnect(&self.node, self.id);
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
        let (outbound, mut relayed) = mpsc::channel(OUTBOUND);
        let replaced = CancellationToken::new();
        let logs = Arc::default();
        let connection = Connection {
            id: self.id,
            outbound,
            logs: Arc::clone(&logs),
            replaced: replaced.clone(),
        };
        self.sessions.connect(&self.node, connection);
        // Heard before it is written that it is ready: whoever is about to write that it is silent looks
        // at this again, and must not overwrite the newer word with the older one.
        self.sessions.heard(&self.node);
        self.take_node(&speaker, hello.state.as_ref()).await?;
        for report in &hello.tasks {
            self.apply_report(report).await?;
        }
        reports::unsaid(&self.context, &self.sessions, &self.node).await.map_err(internal)?;
        self.send(ToAgent::Welcome(welcome())).await?;
        let (page, wake) = self.sessions.board().whole_page(&self.node);
        let strays = strays(&hello, &page);
        if !strays.is_empty() {
            tracing::warn!(node = %self.node, ?strays, "the agent runs what it should not; it is told to stop it");
        }
        self.send(ToAgent::Assignments(page)).await?;
        for report in &hello.tasks {
            self.acknowledge(report).await?;
        }
        tracing::info!(node = %self.node, incarnation = %speaker.incarnation, tasks = hello.tasks.len(), "agent connected");
        self.context.events.node(
            self.node.as_str(),
            "AgentConnected",
            format!("agent {} is connected", speaker.version),
        );
        self.listen(&speaker, &wake, &mut relayed, &logs, &replaced).await
    }

    async fn listen(
        &mut self,
        speaker: &Speaker,
        wake: &Notify,
        relayed: &mut mpsc::Receiver<wire::ControllerMessage>,
        logs: &super::logs::Readers,
        replaced: &CancellationToken,
    ) -> Result<std::convert::Infallible, End> {
        loop {
            tokio::select! {
                // Cancel safe: tonic keeps a half-read message in the stream.
                message = self.inbound.message() => {
                    let body = message.map_err(|_| End::Closed)?.ok_or(End::Closed)?.body;
                    self.take(body, speaker, logs).await?;
                }
                // Cancel safe: a permit that was not received stays.
                () = wake.notified() => {
                    if let Some(changed) = self.sessions.board().take_changed(&self.node) {
                        self.send(ToAgent::Assignments(changed)).await?;
                    }
                }
                Some(message) = relayed.recv() => self.send_message(message).await?,
                () = replaced.cancelled() => {
                    return Err(Status::aborted("a later session of this node has begun").into());
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
            incarnation: Incarnation::new(hello.incarnation.clone()),
            version: hello.version.clone(),
        })
    }

    async fn next(&mut self) -> Result<FromAgent, End> {
        let message = self.inbound.message().await.map_err(|_| End::Closed)?.ok_or(End::Closed)?;
        message.body.ok_or_else(|| Status::invalid_argument("a message without a body").into())
    }

    async fn send(&self, body: ToAgent) -> Result<(), End> {
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
            Some(FromAgent::Task(report)) => self.take_report(&report).await,
            Some(FromAgent::Node(state)) => self.take_node(speaker, Some(&state)).await,
            Some(FromAgent::Log(chunk)) => {
                let id = chunk.id;
                if !logs.take(chunk) {
                    self.send(ToAgent::LogCancel(wire::LogCancel { id })).await?;
                }
                Ok(())
            }
            Some(FromAgent::Message(message)) => {
                if let Some(live) = self.context.live() {
                    live.frameworks.take_from_executor(&self.node, message);
                }
                Ok(())
            }
            Some(FromAgent::Hello(_)) => Err(Status::invalid_argument("a second Hello").into()),
            None => Err(Status::invalid_argument("a message without a body").into()),
        }
    }

    async fn take_heartbeat(&mut self, heartbeat: wire::Heartbeat) -> Result<(), End> {
        if self.sessions.heard(&self.node) {
            // It was given up meanwhile and its tasks are Unknown: a new session tells everything anew.
            return Err(Status::aborted("the node was silent for too long; say Hello again").into());
        }
        if let Some(pose) = &heartbeat.pose {
            let pose = Pose::try_from(pose).map_err(|e| Status::invalid_argument(e.to_string()))?;
            nodes::write_pose(&self.context, &self.node, &pose).await.map_err(internal)?;
            self.scheduler.pose(self.node.clone(), pose);
        }
        let usage = NodeUsage { node: heartbeat.node.unwrap_or_default(), tasks: heartbeat.usage };
        self.sessions.set_usage(&self.node, usage);
        self.send(ToAgent::Heartbeat(wire::HeartbeatAck { sequence: heartbeat.sequence })).await
    }

    async fn take_report(&self, report: &wire::TaskReport) -> Result<(), End> {
        self.apply_report(report).await?;
        self.acknowledge(report).await
    }

    async fn acknowledge(&self, report: &wire::TaskReport) -> Result<(), End> {
        let ack = wire::TaskReportAck { uid: report.uid.clone(), sequence: report.sequence };
        self.send(ToAgent::Task(ack)).await
    }

    async fn apply_report(&self, report: &wire::TaskReport) -> Result<(), End> {
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
        &self,
        speaker: &Speaker,
        state: Option<&wire::NodeState>,
    ) -> Result<(), End> {
        let state = state.ok_or_else(|| Status::invalid_argument("hello.state is missing"))?;
        let report =
            NodeReport::try_from(state).map_err(|e| Status::invalid_argument(e.to_string()))?;
        nodes::write(&self.context, speaker, &report).await.map_err(|error| match error {
            nodes::NodeError::KindChanged { .. } => {
                End::Because(Status::failed_precondition(error.to_string()))
            }
            nodes::NodeError::Store(store) => internal(store),
        })
    }
}

/// The agent tries again; what it said is not lost, it repeats it.
fn internal(error: crate::store::StoreError) -> End {
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

/// Live tasks that the agent knows of and the store does not.
fn strays<'a>(hello: &'a wire::Hello, page: &wire::Assignments) -> Vec<&'a str> {
    let ended = [wire::TaskPhase::Succeeded.into(), wire::TaskPhase::Failed.into()];
    let live = hello.tasks.iter().filter(|t| !ended.contains(&t.phase));
    live.map(|t| t.uid.as_str()).filter(|uid| page.upserts.iter().all(|a| a.uid != *uid)).collect()
}
