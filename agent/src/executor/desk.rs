//! All executors of the node and their works. Every task is enrolled, because any may turn out to be
//! an executor; the lock is never held across an await.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use muster_agent_core::desired::StopTimes;
use muster_agent_core::executor::{Effect, Event, Executor, Life, Record, Update, Work, WorkState};
use muster_agent_core::observed::{End, Said};
use muster_agent_core::workload::{State, Workload};
use muster_api::id::TaskUid;
use muster_api::wire::executor::v1 as proto;
use muster_failpoint::Failpoint;
use proto::event::Event as Say;
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use super::post::Posts;
use super::queue::Queue;
use super::room::Room;
use crate::checkpoint::{self, Checkpoint, Framework};
use crate::clock;
use crate::driver::chain;
use crate::durable::{self, FileError, Keep};
use crate::gate;
use crate::runtime::launch::{self, AttemptId, Launch, Limits, Program};
use crate::runtime::{Runtime, RuntimeError};

/// Between two tries to write a work's record. Its update is not acknowledged before.
const WRITE_AGAIN: Duration = Duration::from_secs(1);

/// A work's file, `tasks/<uid>/work.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct WorkFile {
    pub(super) attempt: u32,
    pub(super) executor: TaskUid,
    pub(super) record: Record,
}

/// Where a work is to go.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Choice {
    /// To this executor, now.
    Ready(TaskUid),
    /// Its executor has not come, or has not registered.
    Wait,
    /// Its executor has ended for good.
    Never,
}

#[derive(Debug)]
struct Desk {
    namespace: String,
    name: String,
    framework: Option<Framework>,
    /// It will not run again.
    over: bool,
    registered_before: bool,
    machine: Executor,
    out: Option<Arc<Queue<proto::Event>>>,
    handed: BTreeMap<TaskUid, Handed>,
    room: Arc<Room>,
    /// Held while a record is taken and written: an older one never replaces a newer one.
    writing: Arc<tokio::sync::Mutex<()>>,
}

impl Desk {
    fn is_executor_of(&self, work: &launch::Work) -> bool {
        let framework = self.framework.as_ref().map(|framework| &framework.id);
        (&self.namespace, &self.name, framework)
            == (&work.namespace, &work.executor, work.framework.as_ref())
    }

    /// Takes note of where its task is; whether that was known.
    fn learn(&mut self, life: Life, over: bool) -> bool {
        let known = (self.machine.life(), self.over) == (life, over);
        if self.machine.life().attempt() != life.attempt() {
            (self.out, self.registered_before) = (None, false);
        }
        self.over = over;
        known
    }
}

/// What an executor is told of a work, and what the work brings.
#[derive(Debug, Clone)]
struct Handed {
    launch: proto::Launch,
    limits: Limits,
}

/// All of them.
#[derive(Debug)]
pub(crate) struct Desks {
    desks: Mutex<BTreeMap<TaskUid, Desk>>,
    changed: watch::Sender<()>,
    /// Those that are executors, as far as is known.
    pub(super) executors: watch::Sender<BTreeSet<TaskUid>>,
    /// Messages between executors and frameworks.
    pub(super) posts: Posts,
    checkpoint: Checkpoint,
    node: String,
}

impl Desks {
    pub(crate) fn new(checkpoint: Checkpoint, node: String) -> Desks {
        let (desks, changed) = (Mutex::default(), watch::Sender::default());
        let (executors, posts) = (watch::Sender::default(), Posts::default());
        Desks { desks, changed, executors, posts, checkpoint, node }
    }

    fn desks(&self) -> MutexGuard<'_, BTreeMap<TaskUid, Desk>> {
        self.desks.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Told after every change; subscribe before the look.
    pub(super) fn changes(&self) -> watch::Receiver<()> {
        self.changed.subscribe()
    }

    /// A task that may be an executor. Of an earlier life of the agent: before any work is adopted.
    pub(crate) fn enrol(
        &self,
        assignment: &checkpoint::Assignment,
        workload: &Workload,
        room: (Arc<dyn Runtime>, Limits),
    ) {
        let mut desks = self.desks();
        let life =
            if workload.state.may_be_live() { Life::Unsure(workload.attempt) } else { Life::Gone };
        desks.entry(workload.uid.clone()).or_insert_with(|| Desk {
            namespace: assignment.namespace.clone(),
            name: assignment.name.clone(),
            framework: assignment.framework.clone(),
            over: false,
            registered_before: false,
            machine: Executor::new(life),
            out: None,
            handed: BTreeMap::new(),
            room: Arc::new(Room::new(room.0, room.1)),
            writing: Arc::default(),
        });
    }

    /// A work of an earlier life of the agent.
    pub(crate) fn adopt(&self, launch: &Launch) -> Result<(), FileError> {
        let id = &launch.id;
        let Some(file) = self.file(id)? else { return Ok(()) };
        let mut desks = self.desks();
        let Some(desk) = desks.get_mut(&file.executor) else { return Ok(()) };
        desk.handed.extend(handed(launch).map(|handed| (id.uid.clone(), handed)));
        let event = Event::Adopted(id.uid.clone(), id.attempt, file.record);
        // Nothing is to be done about what another life did.
        let _ = desk.machine.handle(event, clock::now());
        Ok(())
    }

    /// What was written down of this attempt of a work.
    pub(super) fn file(&self, id: &AttemptId) -> Result<Option<WorkFile>, FileError> {
        let file: Option<WorkFile> = durable::read_json(&self.path(&id.uid))?;
        Ok(file.filter(|file| file.attempt == id.attempt))
    }

    fn path(&self, work: &TaskUid) -> PathBuf {
        self.checkpoint.task_dir(work).join("work.json")
    }

    /// Where the task of a possible executor is now.
    pub(crate) async fn live(&self, workload: &Workload) {
        let attempt = workload.attempt;
        let life = match workload.state {
            State::Launching | State::Running { .. } => Life::Live(attempt),
            State::Stopping { .. } => Life::Ending(attempt),
            State::Recovering { .. } => Life::Unsure(attempt),
            _ => Life::Gone,
        };
        let over = matches!(workload.state, State::Ended | State::Removing { .. });
        let known = match self.desks().get_mut(&workload.uid) {
            Some(desk) => desk.learn(life, over),
            None => return,
        };
        if !known {
            self.handle(&workload.uid, Event::Life(life)).await;
            self.count_executors();
        }
    }

    /// The task is to end within `grace_ms`. An executor is told so; says when its processes are to be signalled.
    pub(crate) async fn shut_down(&self, uid: &TaskUid, grace_ms: u64) -> StopTimes {
        self.handle(uid, Event::ShutDown { grace_ms }).await;
        match self.desks().get(uid) {
            Some(desk) => desk.machine.stop_times(grace_ms, clock::boot()),
            None => StopTimes { signal_ms: 0, kill_ms: grace_ms },
        }
    }

    /// The task is no more.
    pub(crate) fn dismiss(&self, uid: &TaskUid) {
        self.desks().remove(uid);
        self.changed.send_replace(());
        self.count_executors();
    }

    /// The tasks that have registered as executors and may be alive.
    pub(crate) fn executors(&self) -> watch::Receiver<BTreeSet<TaskUid>> {
        self.executors.subscribe()
    }

    fn count_executors(&self) {
        let mut posts = self.posts.table();
        let desks = self.desks();
        let there = desks.iter().filter(|(_, desk)| desk.machine.is_there());
        let there: BTreeSet<TaskUid> = there.map(|(uid, _)| uid.clone()).collect();
        // Under the locks: an older count never replaces a newer one.
        self.posts.keep_only(&mut posts, &there);
        self.executors.send_if_modified(|executors| {
            let changed = *executors != there;
            *executors = there;
            changed
        });
    }

    /// The executor of the work's name, in its namespace and of its framework: no other's work is done there.
    pub(super) fn choose(&self, work: &launch::Work) -> Choice {
        let desks = self.desks();
        let named = || desks.iter().filter(|(_, desk)| desk.is_executor_of(work));
        if let Some((uid, _)) = named().find(|(_, desk)| desk.machine.accepts()) {
            return Choice::Ready(uid.clone());
        }
        let gone = named().next().is_some() && named().all(|(_, desk)| desk.over);
        if gone { Choice::Never } else { Choice::Wait }
    }

    /// Gives the work to its executor, if that would take it now.
    pub(super) fn claim(&self, launch: &Launch) -> Option<TaskUid> {
        let Program::Work(work) = &launch.program else { return None };
        let Choice::Ready(executor) = self.choose(work) else {
            return None;
        };
        let mut desks = self.desks();
        let desk = desks.get_mut(&executor).filter(|desk| desk.machine.accepts())?;
        desk.handed.extend(handed(launch).map(|handed| (launch.id.uid.clone(), handed)));
        let event = Event::Claim(launch.id.uid.clone(), launch.id.attempt);
        // A claim asks for nothing.
        let _ = desk.machine.handle(event, clock::now());
        Some(executor)
    }

    /// The attempt of a work, whose executor, and whether that is known to live.
    pub(super) fn look(&self, id: &AttemptId) -> Option<(TaskUid, Work, Life)> {
        self.desks().iter().find_map(|(executor, desk)| {
            let work = desk.machine.work(&id.uid)?;
            let found = || (executor.clone(), work.clone(), desk.machine.life());
            (work.attempt == id.attempt).then(found)
        })
    }

    /// Fits an executor's limits to its own resources and those of its live works.
    pub(super) async fn fit(&self, executor: &TaskUid) -> Result<(), RuntimeError> {
        let Some(room) = self.desks().get(executor).map(|desk| Arc::clone(&desk.room)) else {
            return Ok(());
        };
        room.fit(executor, || {
            let desks = self.desks();
            let desk = desks.get(executor)?;
            let works = desk.machine.live().filter_map(|uid| desk.handed.get(uid));
            Some((desk.machine.life().attempt()?, works.map(|work| work.limits).collect()))
        })
        .await
    }

    /// Forgets a work, whoever has it.
    pub(super) fn forget(&self, work: &TaskUid) {
        for desk in self.desks().values_mut() {
            desk.handed.remove(work);
            // Nothing follows from it.
            let _ = desk.machine.handle(Event::Forget(work.clone()), clock::now());
        }
        self.changed.send_replace(());
    }

    /// Decides, and carries it out.
    pub(super) async fn handle(&self, executor: &TaskUid, event: Event) {
        let effects = match self.desks().get_mut(executor) {
            Some(desk) => desk.machine.handle(event, clock::now()),
            None => return,
        };
        self.changed.send_replace(());
        for effect in effects {
            match effect {
                Effect::Record(work) => self.write_down(executor, &work).await,
                Effect::Launch(work) => self.send_launch(executor, &work),
                Effect::Kill { work, grace_ms } => {
                    let grace_period_ms = u32::try_from(grace_ms).unwrap_or(u32::MAX);
                    let kill = proto::Kill { task: work.to_string(), grace_period_ms };
                    self.send(executor, Say::Kill(kill));
                }
                Effect::ShutDown { grace_ms } => {
                    let grace_period_ms = u32::try_from(grace_ms).unwrap_or(u32::MAX);
                    self.send(executor, Say::Shutdown(proto::Shutdown { grace_period_ms }));
                }
                Effect::Acknowledge(sequence) => {
                    self.send(executor, Say::Acknowledged(proto::Acknowledged { sequence }));
                }
                Effect::EndExecutor(attempt) => self.end(executor, attempt).await,
            }
        }
    }

    /// Makes what is known of a work durable; does not give up.
    pub(super) async fn write_down(&self, executor: &TaskUid, work: &TaskUid) {
        loop {
            let writing = self.desks().get(executor).map(|desk| Arc::clone(&desk.writing));
            let Some(writing) = writing else { return };
            let turn = writing.lock_owned().await;
            let file = self.desks().get(executor).and_then(|desk| {
                let (record, attempt) =
                    (desk.machine.record(work)?, desk.machine.work(work)?.attempt);
                Some(WorkFile { attempt, executor: executor.clone(), record })
            });
            let Some(file) = file else { return };
            let path = self.path(work);
            let write = move || {
                // Until it is written, whoever waits for it.
                let _turn = turn;
                durable::write_json(Failpoint::WorkRecord, &path, &file, Keep::PowerCut)
            };
            match tokio::task::spawn_blocking(write).await {
                Ok(Ok(())) => return,
                Ok(Err(error)) => {
                    tracing::error!(%work, error = chain(&error), "the work waits for its disk");
                }
                Err(error) => tracing::error!(%work, %error, "the work waits for its disk"),
            }
            tokio::time::sleep(WRITE_AGAIN).await;
        }
    }

    fn send_launch(&self, executor: &TaskUid, work: &TaskUid) {
        let launch = self.desks().get(executor).and_then(|desk| desk.handed.get(work).cloned());
        if let Some(handed) = launch {
            self.send(executor, Say::Launch(handed.launch));
        }
    }

    /// Without a connection nothing is sent: who registers hears it then.
    fn send(&self, executor: &TaskUid, say: Say) {
        if let Some(out) = self.desks().get(executor).and_then(|desk| desk.out.as_ref()) {
            out.push_always(event(say));
        }
    }

    async fn end(&self, executor: &TaskUid, attempt: u32) {
        let room = self.desks().get(executor).map(|desk| Arc::clone(&desk.room));
        let Some(room) = room else { return };
        tracing::warn!(%executor, "an executor did not end a work in time; it is ended itself");
        if let Err(error) = room.end(&AttemptId { uid: executor.clone(), attempt }).await {
            tracing::error!(%executor, error = chain(&error), "not ended; it is tried again");
        }
    }

    /// A connection that showed the executor's token. What is sent to it, beginning with a greeting.
    pub(super) fn connect(&self, uid: &TaskUid) -> Option<Arc<Queue<proto::Event>>> {
        let mut desks = self.desks();
        let desk = desks.get_mut(uid)?;
        desk.machine.life().attempt()?;
        // A former connection may have been dropped without a word; nothing follows from it.
        let _ = desk.machine.handle(Event::Disconnected, clock::now());
        let framework = desk.framework.clone().unwrap_or_default();
        let greeting = proto::Registered {
            executor: uid.to_string(),
            namespace: desk.namespace.clone(),
            framework: framework.name,
            node: self.node.clone(),
            reregistered: std::mem::replace(&mut desk.registered_before, true),
            framework_id: framework.id,
        };
        let out = Arc::new(Queue::default());
        out.push_always(event(Say::Registered(greeting)));
        desk.out = Some(Arc::clone(&out));
        Some(out)
    }

    pub(super) fn disconnected(&self, uid: &TaskUid, out: &Arc<Queue<proto::Event>>) {
        let mut desks = self.desks();
        let Some(desk) = desks.get_mut(uid) else { return };
        if desk.out.as_ref().is_some_and(|present| Arc::ptr_eq(present, out)) {
            desk.out = None;
            // A broken connection proves nothing, and nothing follows from it.
            let _ = desk.machine.handle(Event::Disconnected, clock::now());
        }
    }

    pub(super) async fn registered(&self, uid: &TaskUid, register: proto::Register) {
        let works = register.tasks.into_iter().map(TaskUid::new).collect();
        let unacknowledged = register.unacknowledged.into_iter().filter_map(update).collect();
        self.handle(uid, Event::Registered { works, unacknowledged }).await;
        self.count_executors();
    }

    pub(super) async fn updated(&self, uid: &TaskUid, wire: proto::StatusUpdate) {
        let sequence = wire.sequence;
        match update(wire) {
            Some(update) => self.handle(uid, Event::Said(update)).await,
            None => tracing::warn!(%uid, sequence, "an executor's update cannot be read"),
        }
    }

    /// A message of a framework for its executor; at most once. False: the executor is not there, or does not keep up.
    pub(super) fn hand_over(&self, executor: &TaskUid, data: Bytes) -> bool {
        let size = data.len();
        let out = self.desks().get(executor).and_then(|desk| desk.out.clone());
        let say = Say::Message(proto::Message { data });
        let taken = out.is_some_and(|out| out.push(event(say), size).is_ok());
        if !taken {
            tracing::warn!(%executor, size, "a framework's message is dropped: nobody reads it");
        }
        taken
    }
}

fn event(say: Say) -> proto::Event {
    proto::Event { event: Some(say) }
}

fn handed(launch: &Launch) -> Option<Handed> {
    let Program::Work(work) = &launch.program else { return None };
    let launch_message = proto::Launch {
        task: launch.id.uid.to_string(),
        name: work.name.clone(),
        data: Some(muster_api::wire::framework_session::struct_of(&work.data)),
        lease: work.lease.as_ref().map(|lease| proto::Lease {
            node: lease.node.clone(),
            group: lease.group.clone(),
            epoch: lease.epoch,
            gate_token: launch.env.get(gate::TOKEN_ENV).cloned().unwrap_or_default(),
        }),
    };
    Some(Handed { launch: launch_message, limits: launch.limits })
}

/// `None`: a state that this agent does not know.
fn update(wire: proto::StatusUpdate) -> Option<Update> {
    let over = |said| {
        WorkState::Over(End::Said { said, code: wire.exit_code, message: wire.message.clone() })
    };
    let state = match wire.state() {
        proto::TaskState::Unspecified => return None,
        proto::TaskState::Starting => WorkState::Starting,
        proto::TaskState::Running => WorkState::Running,
        proto::TaskState::Succeeded => over(Said::Succeeded),
        proto::TaskState::Failed => over(Said::Failed),
        proto::TaskState::Killed => over(Said::Killed),
    };
    Some(Update { work: TaskUid::new(wire.task.as_str()), sequence: wire.sequence, state })
}
