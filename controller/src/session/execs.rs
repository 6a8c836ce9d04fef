//! Programs that clients run in tasks: ordered in the agent's session, carried by a stream that the agent dials for each.
//!
//! ```text
//!   rest::exec ── open ──▶ Execs ── Exec ──▶ agent's session
//!                            ▲ Begin
//!   agent ── ExecService ────┘──▶ one task a stream: output → From, and To → input
//! ```
//!
//! In each direction no more is under way than the other end has room for: a client that reads slowly holds up its program
//! and nothing else, and one that does not read at all costs a window.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use futures::Stream;
use muster_api::kind::task::Task;
use muster_api::name::NodeName;
use muster_api::phase::TaskPhase;
use muster_api::wire::agent::v1 as wire;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::task::TaskTracker;
use tonic::{Request, Response, Status, Streaming};
use wire::exec_input::Body as ToAgent;
use wire::exec_output::Body as FromAgent;

use super::proto::exec_service_server::ExecService;
use super::{Sessions, agent_of};

/// Streams at once, of all nodes: each may hold a window in both directions, half a mebibyte.
const MOST: usize = 256;
/// An agent that is there dials at once.
const DIALS_WITHIN: Duration = Duration::from_secs(10);
/// Bytes under way in one direction; exec.proto says so to both ends.
const WINDOW: usize = 256 << 10;
/// Longest piece of input.
const CHUNK: usize = 64 << 10;
/// Messages to one agent's stream that wait to be written; what they hold is bounded by [`WINDOW`].
const QUEUE: usize = 8;

/// What a client wants of a task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Asked {
    /// Empty: to follow what the task writes.
    pub(crate) command: Vec<String>,
    pub(crate) stdin: bool,
    pub(crate) stdout: bool,
    pub(crate) stderr: bool,
    pub(crate) tty: bool,
}

/// Why there is no stream to a task.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ExecError {
    /// It has no processes now.
    #[error("{0}")]
    NotRunning(String),
    /// Not in such a task.
    #[error("{0}")]
    Unsupported(String),
    /// Later.
    #[error("{0}")]
    TooMany(String),
    /// Nobody there hears it.
    #[error("node {0:?} cannot be reached")]
    Unreachable(String),
    /// It heard it, and does not come.
    #[error("node {node:?} did not answer within {} s", DIALS_WITHIN.as_secs())]
    Silent {
        /// Which.
        node: String,
    },
}

/// A task that a program may be run in: it runs, on a node that is connected.
#[derive(Debug, Clone)]
pub(crate) struct Ready {
    pub(crate) uid: String,
    pub(crate) node: NodeName,
}

/// The other end of a program's streams.
#[derive(Debug)]
pub(crate) struct Opened {
    pub(crate) from: From,
    pub(crate) to: To,
    /// One of [`MOST`].
    _place: OwnedSemaphorePermit,
}

/// What the program says.
#[derive(Debug)]
pub(crate) enum Said {
    /// Count it as taken with [`To::taken`] when the client has it.
    Stdout(Bytes),
    /// The same.
    Stderr(Bytes),
    /// Its exit code, or why it has none. Nothing follows.
    End(Result<i32, String>),
}

/// The program's output, in order.
#[derive(Debug)]
pub(crate) struct From(mpsc::UnboundedReceiver<Said>);

impl From {
    /// The next piece; none: the connection to the node broke. Cancel-safe.
    pub(crate) async fn next(&mut self) -> Option<Said> {
        self.0.recv().await
    }
}

/// The program is gone, or its node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Gone;

/// The program's input.
#[derive(Debug, Clone)]
pub(crate) struct To {
    agent: mpsc::Sender<Result<wire::ExecInput, Status>>,
    /// Bytes of input that the program has room for.
    window: Arc<Semaphore>,
    /// Bytes of output that there is room for on the way to the client.
    room: Arc<Semaphore>,
}

impl To {
    async fn send(&self, body: ToAgent) -> Result<(), Gone> {
        self.agent.send(Ok(wire::ExecInput { body: Some(body) })).await.map_err(|_| Gone)
    }

    /// Waits until the program has room for it.
    pub(crate) async fn stdin(&self, mut data: Bytes) -> Result<(), Gone> {
        while !data.is_empty() {
            let piece = data.split_to(data.len().min(CHUNK));
            let size = u32::try_from(piece.len()).unwrap_or(u32::MAX);
            self.window.acquire_many(size).await.map_err(|_| Gone)?.forget();
            self.send(ToAgent::Stdin(piece)).await?;
        }
        Ok(())
    }

    /// No input follows.
    pub(crate) async fn end(&self) -> Result<(), Gone> {
        self.send(ToAgent::StdinEnd(true)).await
    }

    /// The client's terminal has another size, characters.
    pub(crate) async fn size(&self, columns: u16, rows: u16) -> Result<(), Gone> {
        let size = wire::TerminalSize { columns: columns.into(), rows: rows.into() };
        self.send(ToAgent::Size(size)).await
    }

    /// The client has taken so many bytes of output.
    pub(crate) async fn taken(&self, bytes: usize) -> Result<(), Gone> {
        self.room.add_permits(bytes);
        self.send(ToAgent::Taken(u32::try_from(bytes).unwrap_or(u32::MAX))).await
    }
}

#[derive(Debug)]
struct Waiting {
    node: NodeName,
    begun: oneshot::Sender<Result<(From, To), ExecError>>,
}

/// Every stream.
#[derive(Debug)]
pub(crate) struct Execs {
    sessions: Arc<Sessions>,
    waiting: Mutex<HashMap<String, Waiting>>,
    places: Arc<Semaphore>,
    /// What serves the clients and reads the streams; ended with the controller.
    pub(crate) tasks: TaskTracker,
}

impl Execs {
    pub(crate) fn new(sessions: Arc<Sessions>, tasks: TaskTracker) -> Self {
        let (waiting, places) = (Mutex::default(), Arc::new(Semaphore::new(MOST)));
        Execs { sessions, waiting, places, tasks }
    }

    fn waiting(&self) -> MutexGuard<'_, HashMap<String, Waiting>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether a program may be run in the task now.
    pub(crate) fn check(&self, task: &Task) -> Result<Ready, ExecError> {
        let status = task.status.clone().unwrap_or_default();
        if let Some(executor) = &task.spec.run.executor {
            let why = format!(
                "it is the work of an executor and has no processes of its own; try task {:?}",
                executor.task
            );
            return Err(ExecError::Unsupported(why));
        }
        if status.phase != TaskPhase::Running {
            let why = format!("it is {}, and only a Running task has processes", status.phase);
            return Err(ExecError::NotRunning(why));
        }
        let name = status.node.unwrap_or_default();
        let node = NodeName::new(name.clone());
        let node = node.map_err(|_| ExecError::Unreachable(name.clone()))?;
        match self.sessions.connection(&node) {
            Some(_) => Ok(Ready { uid: task.metadata.uid.clone().unwrap_or_default(), node }),
            None => Err(ExecError::Unreachable(name)),
        }
    }

    /// Orders it, and waits for the agent's stream. Dropped meanwhile: nobody waits any more, and nothing is run.
    pub(crate) async fn open(&self, ready: &Ready, asked: Asked) -> Result<Opened, ExecError> {
        let place = Arc::clone(&self.places).try_acquire_owned();
        let place = place.map_err(|_| {
            ExecError::TooMany(format!("clients run {MOST} programs in tasks already"))
        })?;
        let unreachable = || ExecError::Unreachable(ready.node.to_string());
        let connection = self.sessions.connection(&ready.node).ok_or_else(unreachable)?;
        // As unguessable as a ticket: whoever names it is the agent that was told it.
        let id = uuid::Uuid::new_v4().to_string();
        let (begun, begins) = oneshot::channel();
        self.waiting().insert(id.clone(), Waiting { node: ready.node.clone(), begun });
        let _forgotten = Forget { execs: self, id: &id };
        let Asked { command, stdin, stdout, stderr, tty } = asked;
        let uid = ready.uid.clone();
        let order = wire::Exec { id: id.clone(), uid, command, stdin, stdout, stderr, tty };
        let body = Some(wire::controller_message::Body::Exec(order));
        let dials = async {
            let sent = connection.outbound.send(wire::ControllerMessage { body }).await;
            sent.map_err(|_| unreachable())?;
            begins.await.map_err(|_| unreachable())?
        };
        let dialled = tokio::time::timeout(DIALS_WITHIN, dials).await;
        let (from, to) =
            dialled.map_err(|_| ExecError::Silent { node: ready.node.to_string() })??;
        Ok(Opened { from, to, _place: place })
    }

    /// Takes an agent's stream in.
    async fn begin(
        self: &Arc<Self>,
        node: &NodeName,
        mut said: Streaming<wire::ExecOutput>,
    ) -> Result<ReceiverStream<Result<wire::ExecInput, Status>>, Status> {
        let first = tokio::time::timeout(DIALS_WITHIN, said.message()).await;
        let first = first.map_err(|_| Status::deadline_exceeded("no Begin came"))??;
        let Some(wire::ExecOutput { body: Some(FromAgent::Begin(begin)) }) = first else {
            return Err(Status::invalid_argument("the first message of a stream is Begin"));
        };
        let waiting = {
            let mut all = self.waiting();
            match all.get(&begin.id) {
                Some(waiting) if waiting.node == *node => all.remove(&begin.id),
                _ => None,
            }
        };
        let waiting =
            waiting.ok_or_else(|| Status::not_found("the client that asked for it is gone"))?;
        let (agent, input) = mpsc::channel(QUEUE);
        let refusal = begin.refusal();
        let answer = if refusal == wire::ExecRefusal::Unspecified {
            let (output, from) = mpsc::unbounded_channel();
            let full = || Arc::new(Semaphore::new(WINDOW));
            let to = To { agent, window: full(), room: full() };
            let (room, window) = (Arc::clone(&to.room), Arc::clone(&to.window));
            self.tasks.spawn(async move { listen(said, &output, (&room, &window)).await });
            Ok((From(from), to))
        } else {
            Err(refused(refusal, begin.message))
        };
        // The client went away: with what it is dropped here the stream ends.
        drop(waiting.begun.send(answer));
        Ok(ReceiverStream::new(input))
    }
}

fn refused(refusal: wire::ExecRefusal, message: String) -> ExecError {
    match refusal {
        wire::ExecRefusal::TooMany => ExecError::TooMany(message),
        wire::ExecRefusal::Unsupported => ExecError::Unsupported(message),
        wire::ExecRefusal::NotRunning | wire::ExecRefusal::Unspecified => {
            ExecError::NotRunning(message)
        }
    }
}

/// Nobody waits for an agent that has not dialled by then.
struct Forget<'a> {
    execs: &'a Execs,
    id: &'a str,
}

impl Drop for Forget<'_> {
    fn drop(&mut self) {
        self.execs.waiting().remove(self.id);
    }
}

/// Reads a stream until its end, or until nobody wants it any more. Never waits for the client: what it has not taken is
/// bounded by the window, and an agent that sends more is cut off.
async fn listen(
    mut said: Streaming<wire::ExecOutput>,
    output: &mpsc::UnboundedSender<Said>,
    (room, window): (&Semaphore, &Semaphore),
) {
    let has_room = |data: &Bytes| {
        let size = u32::try_from(data.len()).unwrap_or(u32::MAX);
        room.try_acquire_many(size).map(tokio::sync::SemaphorePermit::forget).is_ok()
    };
    loop {
        let message = tokio::select! {
            // Cancel safe: tonic keeps a half-read message in the stream.
            message = said.message() => message,
            () = output.closed() => return,
        };
        let Ok(Some(message)) = message else { return };
        let said = match message.body {
            Some(FromAgent::Stdout(data)) if has_room(&data) => Said::Stdout(data),
            Some(FromAgent::Stderr(data)) if has_room(&data) => Said::Stderr(data),
            Some(FromAgent::Taken(bytes)) => {
                let most = WINDOW.saturating_sub(window.available_permits());
                window.add_permits(usize::try_from(bytes).unwrap_or(most).min(most));
                continue;
            }
            Some(FromAgent::End(end)) => {
                let end = if end.error.is_empty() { Ok(end.exit_code) } else { Err(end.error) };
                // Closed: nobody asks for it.
                drop(output.send(Said::End(end)));
                return;
            }
            Some(_) | None => return,
        };
        drop(output.send(said));
    }
}

/// The service that agents dial.
#[derive(Debug)]
pub(crate) struct Service(pub(crate) Arc<Execs>);

#[tonic::async_trait]
impl ExecService for Service {
    type ExecStream = Pin<Box<dyn Stream<Item = Result<wire::ExecInput, Status>> + Send>>;

    async fn exec(
        &self,
        request: Request<Streaming<wire::ExecOutput>>,
    ) -> Result<Response<Self::ExecStream>, Status> {
        let (node, _) = agent_of(&request)?;
        let input = self.0.begin(&node, request.into_inner()).await?;
        Ok(Response::new(Box::pin(input)))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn task(run: serde_json::Value, phase: &str) -> Task {
        let object = json!({
            "apiVersion": muster_api::API_VERSION, "kind": "Task",
            "metadata": {"name": "t", "uid": "u"}, "spec": {"run": run},
            "status": {"phase": phase, "node": "n"},
        });
        serde_json::from_value(object).unwrap()
    }

    #[tokio::test]
    async fn what_cannot_be_entered_says_why() {
        let execs = Execs::new(Arc::default(), TaskTracker::new());
        let process = json!({"process": {"command": ["x"]}});
        let said = |task: &Task| execs.check(task).unwrap_err().to_string();
        let work = task(json!({"executor": {"task": "crew"}}), "Running");
        assert!(said(&work).contains("try task \"crew\""), "{}", said(&work));
        assert!(said(&task(process.clone(), "Stopping")).starts_with("it is Stopping"));
        assert_eq!(said(&task(process, "Running")), "node \"n\" cannot be reached");
    }

    #[tokio::test]
    async fn input_waits_until_the_program_has_room() {
        let (agent, mut input) = mpsc::channel(QUEUE);
        let full = || Arc::new(Semaphore::new(WINDOW));
        let to = To { agent, window: full(), room: full() };
        let sender = to.clone();
        let sends = tokio::spawn(async move { sender.stdin(vec![0; WINDOW + 1].into()).await });
        for _ in 0..WINDOW / CHUNK {
            let message = input.recv().await.unwrap().unwrap();
            assert!(matches!(message.body, Some(ToAgent::Stdin(data)) if data.len() == CHUNK));
        }
        tokio::task::yield_now().await;
        assert!(input.try_recv().is_err(), "no more than a window is under way");
        to.window.add_permits(1);
        assert!(input.recv().await.is_some());
        assert_eq!(sends.await.unwrap(), Ok(()));
    }
}
