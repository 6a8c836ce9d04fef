//! Programs that clients run in tasks, and tasks' output that clients follow.
//!
//! ```text
//!   session ── Exec ──▶ Execs ── a connection of its own ──▶ controller ⇄ client
//!   driver ── settle ──▶  │ └── Runtime::interact ⇄ program
//! ```
//!
//! | module | holds |
//! |---|---|
//! | [`ends`] | what a program and its client say to each other, and how much of it is under way |
//!
//! A visit belongs to one attempt of a task. New ones are let in while it runs, and before its driver says that it has
//! ended it waits for [`Execs::settle`]: nothing of a visit is left then. Visits end with the agent.

pub(crate) mod ends;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use futures::FutureExt as _;
use muster_agent_core::workload::{State, Workload};
use muster_api::id::TaskUid;
use muster_api::wire::agent::v1 as proto;
use proto::exec_input::Body as Hear;
use proto::exec_output::Body as Say;
use tokio::sync::{Semaphore, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tokio_util::task::task_tracker::TaskTrackerToken;

use crate::driver::chain;
use crate::link::dial::service::exec_service_client::ExecServiceClient;
use crate::link::dial::{DialError, Dialer};
use crate::runtime::{AttemptId, Runtime, RuntimeError};
use ends::{Ends, Input, Invocation, Outlet, Ran, Room, WINDOW};

/// Visits of one node at once. Each is somebody at a terminal, or a script; all of them together may hold 16 MiB.
const MOST: usize = 32;

/// Messages under way to the connection; what they hold is bounded by [`WINDOW`].
const QUEUE: usize = 8;

/// The visits of all tasks of this node.
#[derive(Debug)]
pub(crate) struct Execs {
    guarded: Mutex<BTreeMap<TaskUid, Guarded>>,
    places: Arc<Semaphore>,
    tasks: TaskTracker,
    stop: CancellationToken,
}

/// The visits of one attempt.
#[derive(Debug)]
struct Guarded {
    attempt: u32,
    /// It runs: others may come.
    open: bool,
    over: CancellationToken,
    visits: TaskTracker,
}

/// The right to be at an attempt, until `over`.
#[derive(Debug)]
struct Visit {
    attempt: u32,
    over: CancellationToken,
    /// Absent: nothing is run, and the log ends by itself.
    _present: Option<TaskTrackerToken>,
}

/// Why there is no stream to the controller.
#[derive(Debug, thiserror::Error)]
enum StreamError {
    #[error(transparent)]
    Dial(#[from] DialError),
    #[error("the controller does not take the stream")]
    Refused(#[source] Box<tonic::Status>),
}

type Refusal = (proto::ExecRefusal, String);

impl Default for Execs {
    fn default() -> Self {
        Execs {
            guarded: Mutex::default(),
            places: Arc::new(Semaphore::new(MOST)),
            tasks: TaskTracker::new(),
            stop: CancellationToken::new(),
        }
    }
}

impl Execs {
    fn guarded(&self) -> MutexGuard<'_, BTreeMap<TaskUid, Guarded>> {
        self.guarded.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets visits in while the task runs. Returns when none is left of an attempt of which nothing lives any more.
    pub(crate) async fn settle(&self, workload: &Workload) {
        let Workload { uid, attempt, state, .. } = workload;
        let open = matches!(state, State::Running { .. });
        let ended = {
            let mut all = self.guarded();
            let stays = |guarded: &Guarded| state.may_be_live() && guarded.attempt == *attempt;
            let ended = if all.get(uid).is_some_and(stays) { None } else { all.remove(uid) };
            if let Some(present) = all.get_mut(uid) {
                present.open = open;
            }
            ended
        };
        if let Some(ended) = ended {
            ended.over.cancel();
            ended.visits.close();
            ended.visits.wait().await;
        }
        if open {
            self.guarded().entry(uid.clone()).or_insert_with(|| Guarded {
                attempt: *attempt,
                open,
                over: self.stop.child_token(),
                visits: TaskTracker::new(),
            });
        }
    }

    fn enter(&self, uid: &str) -> Option<Visit> {
        let all = self.guarded();
        let guarded = all.get(uid).filter(|guarded| guarded.open)?;
        Some(Visit {
            attempt: guarded.attempt,
            over: guarded.over.clone(),
            _present: Some(guarded.visits.token()),
        })
    }

    /// Carries an order out, in a task of its own. `runtime`: that of the task, when this node has it.
    pub(crate) fn begin(
        self: &Arc<Self>,
        dialer: Dialer,
        runtime: Option<Arc<dyn Runtime>>,
        order: proto::Exec,
    ) {
        // Refusals need a connection, too.
        if self.tasks.len() >= 2 * MOST {
            tracing::warn!(
                uid = order.uid,
                "too many clients come at once; this one is not answered"
            );
            return;
        }
        let execs = Arc::clone(self);
        self.tasks.spawn(async move {
            let uid = order.uid.clone();
            if let Err(error) = execs.serve(&dialer, runtime, order).await {
                tracing::info!(uid, error = chain(&error), "a client's program has no stream");
            }
        });
    }

    /// Ends all visits; returns when they are over.
    pub(crate) async fn end(&self) {
        self.stop.cancel();
        self.tasks.close();
        self.tasks.wait().await;
    }

    fn admit(
        &self,
        order: &proto::Exec,
        runtime: Option<Arc<dyn Runtime>>,
    ) -> Result<(Arc<dyn Runtime>, Visit), Refusal> {
        use proto::ExecRefusal::{NotRunning, Unsupported};
        let not_running = |why: &str| (NotRunning, why.to_owned());
        let runtime = runtime.ok_or_else(|| not_running("its node does not have it"))?;
        if !runtime.has_processes() {
            let why = "it is the work of an executor and has no processes of its own";
            return Err((Unsupported, why.to_owned()));
        }
        if order.command.is_empty() && order.stdin {
            let why =
                "a task has no standard input; attach without it (no -i), or run a program in it";
            return Err((Unsupported, why.to_owned()));
        }
        let visit = self.enter(&order.uid).ok_or_else(|| not_running("no attempt of it runs"))?;
        let visit = match order.command.is_empty() {
            true => Visit { over: self.stop.child_token(), _present: None, ..visit },
            false => visit,
        };
        Ok((runtime, visit))
    }

    async fn serve(
        &self,
        dialer: &Dialer,
        runtime: Option<Arc<dyn Runtime>>,
        order: proto::Exec,
    ) -> Result<(), StreamError> {
        let place = Arc::clone(&self.places).try_acquire_owned();
        let admitted = match &place {
            Ok(_) => self.admit(&order, runtime),
            Err(_) => {
                let why = format!("clients run {MOST} programs on its node already");
                Err((proto::ExecRefusal::TooMany, why))
            }
        };
        let (refusal, message) = match &admitted {
            Ok(_) => (proto::ExecRefusal::Unspecified, String::new()),
            Err((refusal, message)) => (*refusal, message.clone()),
        };
        let (out, queue) = mpsc::channel(QUEUE);
        let begin = proto::ExecBegin { id: order.id.clone(), refusal: refusal.into(), message };
        // The queue is empty: this does not wait.
        let _ = out.send(said(Say::Begin(begin))).await;
        let (channel, _) = dialer.channel().await?;
        let mut client = ExecServiceClient::new(channel);
        let heard = client.exec(ReceiverStream::new(queue)).await;
        let mut heard =
            heard.map_err(|status| StreamError::Refused(Box::new(status)))?.into_inner();
        let Ok((runtime, visit)) = admitted else { return Ok(()) };
        let id = AttemptId { uid: TaskUid::new(order.uid.clone()), attempt: visit.attempt };
        let end = visited(runtime.as_ref(), &id, &order, &visit, (&mut heard, &out)).await;
        // Nothing of it is left. How long its client takes to read the rest is nobody else's matter.
        drop(visit);
        // Closed: the client is gone, and asks for nothing any more.
        let _ = out.send(said(Say::End(end))).await;
        drop(out);
        // The controller closes the stream when it has taken all of it.
        tokio::select! {
            () = async { while let Ok(Some(_)) = heard.message().await {} } => {}
            () = self.stop.cancelled() => {}
        }
        Ok(())
    }
}

pub(crate) fn said(body: Say) -> proto::ExecOutput {
    proto::ExecOutput { body: Some(body) }
}

/// One visit, from its program's start to its end.
async fn visited(
    runtime: &dyn Runtime,
    id: &AttemptId,
    order: &proto::Exec,
    visit: &Visit,
    (heard, out): (&mut tonic::Streaming<proto::ExecInput>, &mpsc::Sender<proto::ExecOutput>),
) -> proto::ExecEnd {
    let outlet = Outlet::new(out.clone(), order);
    let room = Room::new(out.clone());
    let (input, received) = mpsc::unbounded_channel();
    let (window, taken) = (outlet.window(), room.clone());
    let gone = async {
        tokio::select! {
            () = hear(heard, input, &taken, &window) => {}
            // The connection is gone, whether or not anything was to be heard.
            () = out.closed() => {}
            () = visit.over.cancelled() => {}
        }
    };
    let ends = Ends { input: received, room, output: outlet };
    let ran = if order.command.is_empty() {
        follow(runtime, id, ends, gone).await
    } else {
        let argv = order.command.clone();
        let invocation = Invocation { argv, stdin: order.stdin, tty: order.tty };
        runtime.interact(id, &invocation, ends, gone.boxed()).await
    };
    let failed = |error: String| proto::ExecEnd { exit_code: 0, error };
    match ran {
        Ok(Ran::Ended(exit_code)) => proto::ExecEnd { exit_code, error: String::new() },
        Ok(Ran::NotStarted(why)) => failed(why),
        // Its processes ended with the task, as those of a shell that is killed.
        Ok(Ran::Cut) => proto::ExecEnd { exit_code: 128 + libc::SIGKILL, error: String::new() },
        Err(error) => failed(chain(&error)),
    }
}

/// Takes what the client says, until it says nothing more. Never waits for the program: what it has not taken is bounded
/// by what the controller may send, and one that sends more is cut off.
async fn hear(
    heard: &mut tonic::Streaming<proto::ExecInput>,
    input: mpsc::UnboundedSender<Input>,
    room: &Room,
    window: &Semaphore,
) {
    while let Ok(Some(message)) = heard.message().await {
        let said = match message.body {
            Some(Hear::Stdin(data)) => match room.takes(data.len()) {
                true => Input::Data(data),
                false => return,
            },
            Some(Hear::StdinEnd(_)) => Input::End,
            Some(Hear::Size(size)) => Input::Size {
                columns: u16::try_from(size.columns).unwrap_or(u16::MAX),
                rows: u16::try_from(size.rows).unwrap_or(u16::MAX),
            },
            Some(Hear::Taken(bytes)) => {
                let most = WINDOW.saturating_sub(window.available_permits());
                window.add_permits(usize::try_from(bytes).unwrap_or(most).min(most));
                continue;
            }
            None => continue,
        };
        // The program takes no more input: what is said to it is dropped.
        let _ = input.send(said);
    }
}

/// The task's own output from now on, until the attempt ends.
async fn follow(
    runtime: &dyn Runtime,
    id: &AttemptId,
    ends: Ends,
    gone: impl Future<Output = ()>,
) -> Result<Ran, RuntimeError> {
    let attached = runtime.attach(id, &ends.output);
    tokio::select! {
        attached = attached => attached.map(|()| Ran::Ended(0)),
        () = gone => Ok(Ran::Cut),
    }
}
