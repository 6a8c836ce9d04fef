//! One task's driver: carries out what the core decides, in order, and brings back what came of it.
//!
//! | source of events | cancel-safe because |
//! |---|---|
//! | inbox (from the supervisor) | an mpsc receiver |
//! | runtime operations under way | futures owned by the driver, polled in place |
//! | the next wake-up | a sleep; the deadline itself is kept |
//! | probes of a running attempt | see [`Probing::verdict`] |
//!
//! A driver ends when its task is dropped, or when the inbox closes: the agent is going down, and
//! the task's processes stay.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use futures::future::{AbortHandle, Abortable, BoxFuture, FutureExt};
use futures::stream::{FuturesUnordered, StreamExt};
use muster_agent_core::desired::{Desired, StopTimes};
use muster_agent_core::time::Boot;
use muster_agent_core::workload::{
    Context, Effect, Event, Failure, Outcome, Response, State, Workload,
};
use muster_api::id::TaskUid;
use tokio::sync::mpsc;

use crate::board::Board;
use crate::checkpoint::{Assignment, Checkpoint, Record};
use crate::clock;
use crate::contact::Contact;
use crate::depends::Others;
use crate::durable::FileError;
use crate::exec::Execs;
use crate::executor;
use crate::executor::desk::Desks;
use crate::executor::seat::Seat;
use crate::gate::keeper::Keeper;
use crate::given;
use crate::given::files::Place;
use crate::images::Images;
use crate::probe::Probing;
use crate::probe::topic::Topics;
use crate::runtime::launch::Lease;
use crate::runtime::{AttemptId, Launch, Launched, Runtime};
use crate::sensor;
use crate::sensor::Sensors;
use crate::sensor::talk::Owner;
use crate::spec::{self, Kind, Surroundings};
use crate::view::{Plan, View};

/// Between two tries to make a record durable. Nothing else of the task happens meanwhile: a disk
/// that is full must not lead to a second run.
const WRITE_AGAIN: Duration = Duration::from_secs(1);

/// A task that may drive begins when the gate knows it; one that does not know it by then is asked again with the next try.
const GATE_WITHIN: Duration = Duration::from_secs(5);

/// What every driver uses.
#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) node: String,
    pub(crate) boot_id: String,
    pub(crate) checkpoint: Checkpoint,
    pub(crate) files: Place,
    pub(crate) board: Board,
    pub(crate) contact: Arc<Contact>,
    pub(crate) desks: Arc<Desks>,
    pub(crate) execs: Arc<Execs>,
    pub(crate) process: Arc<dyn Runtime>,
    pub(crate) docker: Arc<dyn Runtime>,
    pub(crate) works: Arc<dyn Runtime>,
    /// Absent: nothing stands before the drivers.
    pub(crate) gate: Option<Arc<Keeper>>,
    /// Those that have a source.
    pub(crate) sensors: Arc<Sensors>,
    /// Those that the node is to have before a task needs them.
    pub(crate) images: Images,
    /// Those that probes look at.
    pub(crate) topics: Arc<Topics>,
    /// Memory that tasks may reserve, bytes.
    pub(crate) allocatable_memory: u64,
}

impl Shared {
    /// Which runtime runs a task.
    fn runtime(&self, record: &Record) -> &Arc<dyn Runtime> {
        match Kind::of(&record.assignment.spec) {
            Kind::Process => &self.process,
            Kind::Docker => &self.docker,
            Kind::Work => &self.works,
        }
    }

    fn launch(&self, record: &Record) -> Launch {
        let workload = &record.workload;
        let reserved = record.assignment.spec.resources.memory.map_or(0, |memory| memory.0);
        let task_dir = self.checkpoint.task_dir(&workload.uid);
        let others = self.board.reserved().saturating_sub(reserved);
        let gate = self.gate.as_ref().map(|gate| gate.tasks_dir());
        let around = Surroundings {
            node: &self.node,
            task_dir: &task_dir,
            token: &record.token,
            gate: gate.as_deref(),
            sensors: self.sensors.serves(&record.assignment.spec.resources.sensors),
            ros: self.topics.ros(),
            unreserved: self.allocatable_memory.saturating_sub(others),
        };
        let id = AttemptId { uid: workload.uid.clone(), attempt: workload.attempt };
        spec::launch(id, &record.assignment, &around)
    }

    fn enrol(&self, record: &Record) {
        if Kind::of(&record.assignment.spec) != Kind::Work {
            let room = (Arc::clone(self.runtime(record)), self.launch(record).limits);
            self.desks.enrol(&record.assignment, &record.workload, room);
        }
    }

    /// Who may connect to the gate: every task of which processes may live, and with its lease to drive.
    fn admit(&self, record: &Record) {
        let Some(gate) = &self.gate else { return };
        let uid = &record.workload.uid;
        if record.workload.state.may_be_live() {
            let lease = record.assignment.lease.as_deref().and_then(Lease::from_text);
            gate.seat(uid, &record.token, lease.map(|lease| lease.epoch));
        } else {
            gate.unseat(uid);
        }
    }

    /// Tasks of an earlier life of the agent: all executors, and then their works. Before any driver
    /// begins: an executor may speak of its works as soon as it can connect.
    pub(crate) fn restore(&self, records: &[Record]) -> Result<(), FileError> {
        for record in records {
            self.enrol(record);
            self.admit(record);
        }
        let works = records.iter().filter(|record| {
            Kind::of(&record.assignment.spec) == Kind::Work && record.workload.state.may_be_live()
        });
        for record in works {
            self.desks.adopt(&self.launch(record))?;
        }
        Ok(())
    }
}

/// What the supervisor tells a driver.
#[derive(Debug)]
pub(crate) enum Message {
    /// The controller's present wish.
    Assigned(Box<Assignment>, Desired),
    /// Anything else.
    Event(Event),
}

type Operation = BoxFuture<'static, Option<Event>>;

/// One task.
pub(crate) struct Driver {
    shared: Arc<Shared>,
    runtime: Arc<dyn Runtime>,
    record: Record,
    inbox: mpsc::UnboundedReceiver<Message>,
    operations: FuturesUnordered<Operation>,
    wakes: BTreeSet<Boot>,
    prepare: Option<AbortHandle>,
    /// What the task is given is not yet durable.
    unkept: bool,
    /// Files of an attempt may be there.
    files: bool,
    /// While processes of the task may exist: it may be an executor.
    seat: Option<Seat>,
    /// While processes of an attempt may exist that asked for sensors.
    sensing: Option<sensor::seat::Seat>,
    /// While processes of an attempt may exist that has a ROS master of its own.
    view: Option<View>,
    /// While an attempt runs that has probes.
    probing: Option<Probing>,
    /// The tasks that it waits for.
    others: Others,
    dropped: bool,
}

/// How a driver begins.
#[derive(Debug)]
pub(crate) enum Begin {
    /// A task that was just assigned.
    New(TaskUid, Box<Assignment>, Desired),
    /// A task whose assignment cannot be read, and why.
    Unreadable(TaskUid, Box<Assignment>, String),
    /// A task of an earlier life of the agent, and the first things to do about it.
    Restored(Box<Record>, Response),
}

impl Begin {
    /// Takes up a task of an earlier life of the agent, and shows its report: the first Hello must
    /// name everything of which a process may live, however slow the disk is.
    pub(crate) fn restore(shared: &Shared, mut record: Record) -> Begin {
        let same_boot = record.boot_id == shared.boot_id;
        record.boot_id.clone_from(&shared.boot_id);
        let response = record.workload.restored(same_boot, context(shared));
        if response.effects.contains(&Effect::Publish) {
            publish(shared, &record);
        }
        Begin::Restored(Box::new(record), response)
    }
}

pub(crate) async fn drive(
    shared: Arc<Shared>,
    begin: Begin,
    inbox: mpsc::UnboundedReceiver<Message>,
) {
    let context = context(&shared);
    let unkept = match &begin {
        Begin::New(_, assignment, _) | Begin::Unreadable(_, assignment, _) => {
            assignment.given.is_some()
        }
        Begin::Restored(..) => false,
    };
    let (record, response) = match begin {
        Begin::New(uid, assignment, desired) => {
            let fetch = spec::fetch(&assignment.spec);
            let (workload, response) = Workload::assigned(uid, desired, fetch, context);
            (Record::new(&shared.boot_id, *assignment, workload), response)
        }
        Begin::Unreadable(uid, assignment, why) => {
            let (workload, response) = Workload::unreadable(uid, why, context);
            (Record::new(&shared.boot_id, *assignment, workload), response)
        }
        Begin::Restored(record, response) => (*record, response),
    };
    shared.enrol(&record);
    let runtime = Arc::clone(shared.runtime(&record));
    let others = Others::new(&shared.board);
    let files = !record.assignment.spec.run.wanted().files.is_empty();
    let mut driver = Driver {
        shared,
        runtime,
        record,
        inbox,
        operations: FuturesUnordered::new(),
        wakes: BTreeSet::new(),
        prepare: None,
        unkept,
        files,
        seat: None,
        sensing: None,
        view: None,
        probing: None,
        others,
        dropped: false,
    };
    driver.carry_out(response).await;
    driver.run().await;
}

fn publish(shared: &Shared, record: &Record) {
    let (workload, runtime) = (&record.workload, shared.runtime(record));
    let reserved = record.assignment.spec.resources.memory.map_or(0, |memory| memory.0);
    let board = &shared.board;
    let title = format!("{}/{}", record.assignment.namespace, record.assignment.name);
    board.publish((workload, &title), runtime, reserved);
}

fn context(shared: &Shared) -> Context {
    Context { now: clock::now(), contact: shared.contact.last() }
}

impl Driver {
    async fn run(&mut self) {
        while !self.dropped {
            let wake = self.wakes.first().copied();
            let event = tokio::select! {
                message = self.inbox.recv() => match message {
                    None => return,
                    Some(Message::Event(event)) => Some(event),
                    Some(Message::Assigned(assignment, desired)) => {
                        self.reassign(*assignment).await;
                        Some(Event::Assigned(desired))
                    }
                },
                Some(event) = self.operations.next() => event,
                event = verdict(&mut self.probing) => Some(event),
                standing = self.others.news(&self.shared.board, &self.record.workload.desired.depends) => {
                    Some(Event::Dependencies(standing))
                }
                () = sleep_until(wake) => {
                    let now = clock::boot();
                    self.wakes.retain(|wake| *wake > now);
                    Some(Event::Tick)
                }
            };
            let Some(event) = event else { continue };
            let id = self.id();
            tracing::debug!(%id, ?event, state = ?self.record.workload.state, "event");
            let context = context(&self.shared);
            let response = self.record.workload.handle(event, context);
            self.carry_out(response).await;
        }
    }

    /// Takes the controller's newest word. What it gives is durable before anything else happens: the next start of
    /// the task may be that of another life of the agent, with nobody to ask.
    async fn reassign(&mut self, mut assignment: Assignment) {
        let before = std::mem::take(&mut self.record.assignment.given);
        assignment.given = given::renew(&before, assignment.given);
        self.unkept |= assignment.given != before;
        self.record.assignment = assignment;
        if self.unkept {
            tracing::debug!(id = %self.id(), "other values for the next attempt");
            self.keep_given().await;
        }
    }

    async fn keep_given(&mut self) {
        loop {
            let (shared, uid) = (Arc::clone(&self.shared), self.record.workload.uid.clone());
            let given = self.record.assignment.given.clone();
            let write = move || shared.checkpoint.write_given(&uid, &given);
            let Some(error) = blocking(write).await else { break };
            tracing::error!(id = %self.id(), error = chain(&error), "the task waits for its disk");
            tokio::time::sleep(WRITE_AGAIN).await;
        }
        self.unkept = false;
    }

    /// Removes the files of attempts that are over.
    async fn clear_files(&mut self) {
        let (files, uid) = (self.shared.files.clone(), self.record.workload.uid.clone());
        match blocking(move || files.clear(&uid)).await {
            None => self.files = false,
            Some(error) => {
                tracing::warn!(id = %self.id(), error = chain(&error), "a task's files stay behind");
            }
        }
    }

    fn id(&self) -> AttemptId {
        let workload = &self.record.workload;
        AttemptId { uid: workload.uid.clone(), attempt: workload.attempt }
    }

    /// Keeps what is known of the task as an executor: before anything is started, and after the
    /// kernel has shown an end.
    async fn attend(&mut self) {
        self.shared.admit(&self.record);
        if !self.record.workload.state.may_be_live() {
            (self.seat, self.sensing, self.view) = (None, None, None);
            if self.files {
                self.clear_files().await;
            }
        }
        let workload = &self.record.workload;
        if Kind::of(&self.record.assignment.spec) != Kind::Work {
            self.shared.desks.live(workload).await;
        }
    }

    /// Listens for the task as an executor, while it may live. After its record is durable: that
    /// makes the directory, and makes the directory durable.
    fn listen(&mut self) {
        let workload = &self.record.workload;
        let work = Kind::of(&self.record.assignment.spec) == Kind::Work;
        if workload.state.may_be_live() && self.seat.is_none() && !work {
            let dir = self.shared.checkpoint.task_dir(&workload.uid).join(executor::DIR);
            let (desks, token) = (Arc::clone(&self.shared.desks), self.record.token.clone());
            match Seat::open(desks, workload.uid.clone(), &dir, token) {
                Ok(seat) => self.seat = Some(seat),
                Err(error) => {
                    tracing::warn!(uid = %workload.uid, %error, "no executor socket for this task");
                }
            }
        }
    }

    /// Lets the task read the sensors that it asked for, before it is started. After its record is durable, as above.
    fn sense(&mut self) {
        let (workload, spec) = (&self.record.workload, &self.record.assignment.spec);
        self.sensing.take_if(|seat| seat.attempt != workload.attempt);
        let (sensors, functions) = (&self.shared.sensors, &spec.resources.sensors);
        // A work reads by its executor, which is a task of its own.
        let asks = Kind::of(spec) != Kind::Work && sensors.serves(functions);
        if workload.state.may_be_live() && self.sensing.is_none() && asks {
            let dir = self.shared.checkpoint.task_dir(&workload.uid).join(sensor::DIR);
            let owner = Owner {
                runtime: Arc::clone(&self.runtime),
                id: self.id(),
                token: self.record.token.clone(),
            };
            match sensor::seat::Seat::open(sensors, &dir, functions, owner) {
                Ok(seat) => self.sensing = Some(seat),
                Err(error) => {
                    tracing::warn!(id = %self.id(), %error, "no sensors for this task");
                }
            }
        }
    }

    /// Serves the ROS master of an attempt that runs, until nothing of it may live.
    fn show(&mut self) {
        let (workload, spec) = (&self.record.workload, &self.record.assignment.spec);
        self.view.take_if(|view| view.attempt != workload.attempt);
        let runs = matches!(workload.state, State::Running { .. });
        if runs && self.view.is_none() && spec::has_view(spec) {
            let plan = Plan::of(&self.shared, &self.record);
            self.view = Some(View::open(Arc::clone(&self.runtime), self.launch(), plan));
        }
    }

    /// Probes what runs, and nothing else. Before anything is told or ended: no check outlives its attempt.
    async fn probe(&mut self) {
        let workload = &self.record.workload;
        let runs = matches!(workload.state, State::Running { .. });
        let other = |probing: &Probing| !runs || probing.attempt != workload.attempt;
        if let Some(probing) = self.probing.take_if(|probing| other(probing)) {
            probing.end().await;
        }
        if self.probing.is_none() {
            let (workload, spec) = (&self.record.workload, &self.record.assignment.spec);
            let with = (&self.runtime, &self.shared.topics);
            self.probing = Probing::begin(workload, spec, with, || self.launch());
        }
    }

    async fn carry_out(&mut self, response: Response) {
        self.attend().await;
        self.show();
        self.probe().await;
        // As checks: no client's program outlives the attempt that it was run in.
        self.shared.execs.settle(&self.record.workload).await;
        for effect in response.effects {
            match effect {
                Effect::Persist => {
                    self.persist().await;
                    self.listen();
                    self.sense();
                }
                Effect::Publish => publish(&self.shared, &self.record),
                Effect::WakeAt(at) => {
                    self.wakes.insert(at);
                }
                Effect::CancelPrepare => {
                    if let Some(prepare) = self.prepare.take() {
                        prepare.abort();
                    }
                }
                Effect::Drop => self.drop_task().await,
                Effect::Prepare(attempt) => {
                    let (handle, registration) = AbortHandle::new_pair();
                    self.prepare = Some(handle);
                    let operation = self.operation(effect);
                    let operation = Abortable::new(operation, registration);
                    let event = async move { operation.await.ok().flatten() };
                    tracing::debug!(attempt, "prepare");
                    self.operations.push(event.boxed());
                }
                Effect::Stop { grace_ms, .. } => {
                    let uid = &self.record.workload.uid;
                    let times = self.shared.desks.shut_down(uid, grace_ms).await;
                    let operation = self.stop(times);
                    self.operations.push(operation);
                }
                Effect::Launch(_) | Effect::Watch(_) | Effect::Find(_) | Effect::Remove => {
                    self.files |= matches!(effect, Effect::Launch(_))
                        && !self.record.assignment.spec.run.wanted().files.is_empty();
                    let operation = self.operation(effect);
                    self.operations.push(operation);
                }
            }
        }
    }

    /// The future of an effect that asks a runtime; its output is the answer.
    fn operation(&self, effect: Effect) -> Operation {
        let runtime = Arc::clone(&self.runtime);
        let launch = self.launch();
        let attempt = launch.id.attempt;
        let ready = given::check(&self.record.assignment.spec, &launch.given);
        let gate = self.shared.gate.clone().filter(|_| self.record.assignment.lease.is_some());
        let answer = move |outcome| Some(Event::Attempt(attempt, outcome));
        match effect {
            Effect::Prepare(_) => async move {
                answer(match runtime.prepare(&launch).await {
                    Ok(()) => Outcome::Prepared,
                    Err(failure) => Outcome::PrepareFailed(failure),
                })
            }
            .boxed(),
            Effect::Launch(_) => async move {
                if let Err(failure) = ready {
                    return answer(Outcome::LaunchFailed(failure));
                }
                // It must be able to drive as soon as it runs.
                if let Some(gate) = gate
                    && tokio::time::timeout(GATE_WITHIN, gate.settled()).await.is_err()
                {
                    let message = "the gate before the robot's drivers does not answer".to_owned();
                    let reason = "GateDown".to_owned();
                    return answer(Outcome::LaunchFailed(Failure { reason, message, retry: true }));
                }
                answer(match runtime.launch(&launch).await {
                    Launched::Running(started) => Outcome::Launched(started),
                    Launched::Ended(exit) => Outcome::Exited(exit),
                    Launched::Refused(failure) => Outcome::LaunchFailed(failure),
                    Launched::Unprepared(failure) => Outcome::Unprepared(failure),
                    Launched::Unclear(error) => {
                        tracing::warn!(id = %launch.id, error = chain(&error), "launch unclear");
                        Outcome::LaunchUnclear
                    }
                })
            }
            .boxed(),
            Effect::Watch(_) => {
                async move { answer(Outcome::Exited(runtime.wait(&launch).await)) }.boxed()
            }
            Effect::Find(_) => async move {
                answer(match runtime.find(&launch).await {
                    Ok(observed) => Outcome::Found(observed),
                    Err(error) => {
                        tracing::warn!(id = %launch.id, error = chain(&error), "not found out");
                        Outcome::FindFailed
                    }
                })
            }
            .boxed(),
            Effect::Remove => {
                self.shared.board.withdraw(&launch.id.uid);
                async move {
                    let error = match runtime.remove(&launch.id.uid).await {
                        Ok(()) => return Some(Event::Removed),
                        Err(error) => error,
                    };
                    tracing::warn!(id = %launch.id, error = chain(&error), "not removed");
                    Some(Event::RemoveFailed)
                }
                .boxed()
            }
            Effect::Persist
            | Effect::Publish
            | Effect::CancelPrepare
            | Effect::Stop { .. }
            | Effect::WakeAt(_)
            | Effect::Drop => futures::future::ready(None).boxed(),
        }
    }

    fn stop(&self, times: StopTimes) -> Operation {
        let (runtime, id) = (Arc::clone(&self.runtime), self.id());
        async move {
            let error = runtime.stop(&id, times).await.err()?;
            tracing::warn!(%id, error = chain(&error), "not stopped");
            Some(Event::Attempt(id.attempt, Outcome::StopFailed))
        }
        .boxed()
    }

    fn launch(&self) -> Launch {
        self.shared.launch(&self.record)
    }

    async fn persist(&mut self) {
        if self.unkept {
            self.keep_given().await;
        }
        loop {
            let (shared, record) = (Arc::clone(&self.shared), self.record.clone());
            let write = move || shared.checkpoint.write(&record);
            let Some(error) = blocking(write).await else { return };
            tracing::error!(id = %self.id(), error = chain(&error), "the task waits for its disk");
            tokio::time::sleep(WRITE_AGAIN).await;
        }
    }

    async fn drop_task(&mut self) {
        let (shared, uid) = (Arc::clone(&self.shared), self.record.workload.uid.clone());
        if let Some(error) = blocking(move || shared.checkpoint.drop_task(&uid)).await {
            // Without its record it is swept at the next start; with it, it is removed then.
            tracing::warn!(id = %self.id(), error = chain(&error), "the task's files stay behind");
        }
        self.shared.desks.dismiss(&self.record.workload.uid);
        self.dropped = true;
    }
}

async fn blocking<F>(work: F) -> Option<FileError>
where
    F: FnOnce() -> Result<(), FileError> + Send + 'static,
{
    match tokio::task::spawn_blocking(work).await {
        Ok(done) => done.err(),
        Err(error) => Some(FileError {
            action: "finish the work on",
            path: std::path::PathBuf::new(),
            source: std::io::Error::other(error),
        }),
    }
}

/// The next verdict on the attempt that runs.
async fn verdict(probing: &mut Option<Probing>) -> Event {
    match probing {
        Some(probing) => Event::Probed(probing.attempt, probing.verdict().await),
        None => std::future::pending().await,
    }
}

pub(crate) async fn sleep_until(wake: Option<Boot>) {
    match wake {
        Some(wake) => {
            let left = wake.0.saturating_sub(clock::boot().0);
            tokio::time::sleep(Duration::from_millis(left)).await;
        }
        None => std::future::pending().await,
    }
}

/// An error and its causes, for one line of a log or one message to a person.
pub(crate) fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(source) = cause {
        text.push_str(": ");
        text.push_str(&source.to_string());
        cause = source.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use muster_agent_core::observed::{End, Exit, Observed, Started};
    use muster_agent_core::report::{Phase, Reason, Report};
    use muster_agent_core::time::Wall;
    use muster_api::wire::agent_session::spec_from_wire;
    use tokio::task::JoinHandle;

    use super::*;
    use crate::runtime::fake::Fake;

    struct Bench {
        dir: tempfile::TempDir,
        fake: Arc<Fake>,
        shared: Arc<Shared>,
        inbox: mpsc::UnboundedSender<Message>,
        driver: JoinHandle<()>,
    }

    fn shared(dir: &tempfile::TempDir, fake: &Arc<Fake>) -> Arc<Shared> {
        let checkpoint = Checkpoint::open(dir.path()).unwrap();
        let desks = Arc::new(Desks::new(checkpoint.clone(), "n".to_owned()));
        Arc::new(Shared {
            node: "n".to_owned(),
            boot_id: "b".to_owned(),
            files: Place::find("test", checkpoint.tasks()),
            checkpoint,
            board: Board::default(),
            contact: Arc::new(Contact::open(&dir.path().join("contact"), "b").unwrap()),
            desks,
            execs: Arc::default(),
            works: Arc::clone(fake) as Arc<dyn Runtime>,
            gate: None,
            sensors: Arc::default(),
            images: Images::default(),
            topics: Arc::default(),
            process: Arc::clone(fake) as Arc<dyn Runtime>,
            docker: Arc::clone(fake) as Arc<dyn Runtime>,
            allocatable_memory: 1 << 30,
        })
    }

    fn begin() -> Begin {
        let json = br#"{"run":{"process":{"command":["x"]}},"restartPolicy":"OnFailure"}"#;
        let task_spec = spec_from_wire(json).unwrap();
        let desired = spec::desired(&task_spec, None);
        let assignment = Assignment {
            namespace: "default".to_owned(),
            name: "t".to_owned(),
            spec: task_spec,
            lease: None,
            framework: None,
            given: None,
        };
        Begin::New(TaskUid::new("t"), Box::new(assignment), desired)
    }

    fn bench(dir: tempfile::TempDir, fake: Arc<Fake>, begin: Begin) -> Bench {
        let shared = shared(&dir, &fake);
        run(dir, fake, shared, begin)
    }

    fn run(dir: tempfile::TempDir, fake: Arc<Fake>, shared: Arc<Shared>, begin: Begin) -> Bench {
        let (inbox, messages) = mpsc::unbounded_channel();
        let driver = tokio::spawn(drive(Arc::clone(&shared), begin, messages));
        Bench { dir, fake, shared, inbox, driver }
    }

    impl Bench {
        async fn report(&self, wanted: impl Fn(&Report) -> bool) -> Report {
            loop {
                let reports = self.shared.board.reports();
                if let Some((_, report, _)) = reports.into_iter().find(|(_, r, _)| wanted(r)) {
                    return report;
                }
                self.shared.board.changed().await;
            }
        }
    }

    fn exit(code: i32) -> Exit {
        Exit {
            end: End::Exited(code),
            oom_killed: false,
            disconnected: false,
            started_at: Some(Wall(1)),
            finished_at: Wall(2),
        }
    }

    #[tokio::test]
    async fn a_failure_waits_and_another_life_goes_on_with_the_same_attempt() {
        let dir = tempfile::tempdir().unwrap();
        let fake = Arc::new(Fake::default());
        let refused =
            Failure { reason: "NodeError".to_owned(), message: "no".to_owned(), retry: true };
        fake.launches
            .lock()
            .unwrap()
            .extend([Launched::Refused(refused), Launched::Running(Started { at: Wall(1) })]);
        let bench = bench(dir, fake, begin());
        let waits = bench.report(|r| r.content.reason != Reason::None).await;
        assert_eq!(waits.content.reason, Reason::Runtime("NodeError".to_owned()));
        bench.report(|r| r.content.phase == Phase::Running).await;
        // It is told before it is watched.
        while bench.fake.asked().len() < 3 {
            tokio::task::yield_now().await;
        }
        assert_eq!(bench.fake.asked(), ["launch 1", "launch 1", "wait 1"]);

        // The agent dies, and the program ends meanwhile.
        bench.driver.abort();
        let Bench { dir, .. } = bench;
        let fake = Arc::new(Fake::default());
        fake.finds.lock().unwrap().push_back(Observed::Ended(exit(0)));
        let record = Checkpoint::open(dir.path()).unwrap().read_all().unwrap().remove(0);
        let shared = shared(&dir, &fake);
        let begin = Begin::restore(&shared, record);
        let told: Vec<Phase> =
            shared.board.reports().iter().map(|(_, r, _)| r.content.phase).collect();
        assert_eq!(told, [Phase::Running], "the first Hello names what may live");
        let bench = run(dir, fake, shared, begin);
        let end = bench.report(|r| r.content.phase.is_terminal()).await;
        assert_eq!((end.content.phase, end.content.attempt), (Phase::Succeeded, 1));
        assert_eq!(bench.fake.asked(), ["find 1"]);
    }

    #[tokio::test]
    async fn a_forgotten_task_is_stopped_removed_and_dropped() {
        let fake = Arc::new(Fake::default());
        let running = Launched::Running(Started { at: Wall(1) });
        fake.launches.lock().unwrap().push_back(running);
        let bench = bench(tempfile::tempdir().unwrap(), fake, begin());
        bench.report(|r| r.content.phase == Phase::Running).await;
        bench.inbox.send(Message::Event(Event::Forgotten)).unwrap();
        bench.report(|r| r.content.phase == Phase::Stopping).await;
        bench.fake.exit(exit(0));
        bench.driver.await.unwrap();
        assert_eq!(bench.fake.asked(), ["launch 1", "wait 1", "stop 1", "remove"]);
        assert!(!bench.dir.path().join("tasks/t").exists());
        assert!(bench.shared.board.reports().is_empty());
    }
}
