//! The one task that asks the core and carries out what it says. Everything that happens comes in as an [`Input`], in order.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use bytes::Bytes;
use muster_agent_core::gate::{
    Conn, DEEPEST, Effect, Event, Gate, Grant, Response, Source, StopReason, Tier, Token, Verdict,
};
use muster_agent_core::time::Boot;
use muster_api::id::{Epoch, TaskUid};
use muster_api::kind::lease::DEFAULT_GROUP;
use muster_api::wire::gate::v1 as proto;
use proto::call::Call as Said;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior};

use super::door::{self, Back};
use super::driver::Driver;
use super::log::Log;
use super::record::{self, Record};
use super::settings::Setup;
use super::topic::Doubt;
use super::{AGENT_SOCKET, GateError, LOG, SOCKET, TASKS_DIR, hook, keeper};
use crate::clock;
use crate::socket;

/// Inputs that may wait. Whoever says more waits until they were looked at.
const INPUTS: usize = 256;

/// Longest command, bytes.
const LONGEST: usize = 60 << 10;

/// An agent that says nothing for this long (it repeats itself every second) is stuck, and nobody can take the robot back
/// through it.
const STUCK: Duration = Duration::from_secs(3);

/// At the end, until the drivers have read their stop.
const LAST_STOP: Duration = Duration::from_millis(100);

/// What happens.
pub(super) enum Input {
    /// A task shows a token. Admitted by an answer; refused by none.
    Opened {
        conn: Conn,
        token: String,
        back: Back<proto::Event>,
        admit: oneshot::Sender<()>,
    },
    Call(Conn, Said),
    Closed(Conn),
    AgentCame(u64, Back<proto::Status>),
    Wanted(u64, proto::Wanted),
    AgentGone(u64),
    DriverBack(usize),
    /// A driver has read its stop.
    DriverStands,
    DriverGone(usize, String),
    /// Whether others may command a driver.
    DriverShared(usize, Option<Doubt>),
    Hook(String, Tier),
}

/// What a call of a task is about.
struct About {
    conn: Conn,
    id: u64,
    /// What is to be handed to a driver; absent: it is no command.
    command: Option<Command>,
}

struct Command {
    /// Absent: no driver moves that.
    driver: Option<usize>,
    actuator: String,
    format: String,
    data: Bytes,
}

/// The rest of a call's effects, which must not happen before the record is durable.
struct Waits {
    about: About,
    verdict: Verdict,
    forward: bool,
    /// How often the robot had been stopped.
    stops: u64,
}

struct Hall {
    dir: PathBuf,
    /// What the agent knows these settings by.
    digest: String,
    core: Gate,
    drivers: Vec<Driver>,
    /// Why a driver is not there.
    missing: Vec<Option<String>>,
    /// Why others may command one.
    shared: Vec<Option<Doubt>>,
    /// By token.
    seats: BTreeMap<String, TaskUid>,
    conns: BTreeMap<Conn, (TaskUid, Back<proto::Event>)>,
    /// The newest connection; its way back is gone when it does not read.
    agent: Option<(u64, Option<Back<proto::Status>>)>,
    /// The newest that it wants, and the newest that counts.
    asked: u64,
    wanted: u64,
    /// When the agent last said something.
    heard: Instant,
    silent: u64,
    gives_back: Option<Grant>,
    /// Whose grant counts also at a gate that is started again: a person is answered by that.
    durable: Option<Grant>,
    wake: Option<Boot>,
    record: Record<Waits>,
    /// How often the robot was stopped.
    stops: u64,
}

/// Runs until it is told to end.
pub(super) async fn serve(dir: PathBuf, setup: Setup) -> Result<(), GateError> {
    let system = |what| move |source| GateError::System { what, source };
    let kept = record::read(&dir)?;
    let mut end = signal(SignalKind::terminate()).map_err(system("hear signals"))?;
    let tasks = socket::listen(&dir.join(TASKS_DIR).join(SOCKET), 0o666)
        .map_err(system("listen for tasks"))?;
    let agents =
        socket::listen(&dir.join(AGENT_SOCKET), 0o600).map_err(system("listen for agents"))?;
    let (inputs, mut calls) = mpsc::channel(INPUTS);
    let (urgently, mut urgent) = mpsc::channel(INPUTS);
    let settings = &setup.settings;
    let (core, response) = Gate::start(settings.core(), kept);
    let driver = |(at, driver): (usize, &_)| {
        Driver::start(at, Clone::clone(driver), &setup.ros, urgently.clone())
    };
    let drivers: Vec<Driver> = settings.drivers.iter().enumerate().map(driver).collect();
    let mut others = JoinSet::new();
    for hook in settings.estop.clone() {
        others.spawn(hook::follow(hook, urgently.clone()));
    }
    others.spawn(door::tasks(tasks, inputs, urgently.clone()));
    others.spawn(door::agents(agents, urgently));
    let record = Record::new(record::write_to(&dir));
    let mut hall = Hall::new(dir, keeper::digest(&setup), (core, drivers), record);
    tracing::info!(newest = %hall.core.newest(), estop = %hall.core.estop().tier(), "the gate starts");
    hall.run(response, (&mut urgent, &mut calls), &mut end).await;
    // Nobody stands before the drivers any more.
    hall.drivers.iter().for_each(Driver::stop);
    tokio::time::sleep(LAST_STOP).await;
    Ok(())
}

impl Hall {
    fn new(
        dir: PathBuf,
        digest: String,
        (core, drivers): (Gate, Vec<Driver>),
        record: Record<Waits>,
    ) -> Hall {
        Hall {
            dir,
            digest,
            core,
            missing: vec![Some("it has not been reached yet".to_owned()); drivers.len()],
            shared: vec![None; drivers.len()],
            drivers,
            seats: BTreeMap::new(),
            conns: BTreeMap::new(),
            agent: None,
            asked: 0,
            wanted: 0,
            heard: Instant::now(),
            silent: 0,
            gives_back: None,
            durable: None,
            wake: None,
            record,
            stops: 0,
        }
    }

    /// Until it is told to end.
    async fn run(
        &mut self,
        first: Response,
        (urgent, calls): (&mut mpsc::Receiver<Input>, &mut mpsc::Receiver<Input>),
        end: &mut Signal,
    ) {
        self.carry_out(first, None);
        let mut looks = tokio::time::interval(STUCK / 4);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut log = Log::new(self.dir.join(LOG));
        let mut looked = Instant::now();
        loop {
            // Cancel-safe: a signal, receivers, a sleep, the record and a tick. In the order of what they are worth: a task that
            // says much is not before a button. What tasks say waits until the record is durable.
            tokio::select! {
                biased;
                _ = end.recv() => return,
                Some(input) = urgent.recv() => self.take(input),
                () = crate::driver::sleep_until(self.wake) => self.event(&Event::Tick),
                waited = self.record.written() => self.written(waited),
                _ = looks.tick() => {
                    log.look();
                    if looked.elapsed() > STUCK / 2 {
                        // It stood still itself: what was said meanwhile is not read yet.
                        self.heard = Instant::now();
                    }
                    looked = Instant::now();
                    if self.agent.is_some() && self.heard.elapsed() > STUCK {
                        tracing::warn!("the agent says nothing");
                        // Its connection ends with its way back; it comes again when it can.
                        self.agent = None;
                        self.event(&Event::AgentGone);
                    }
                }
                Some(input) = calls.recv(), if self.record.is_idle() => self.take(input),
            }
        }
    }

    fn take(&mut self, input: Input) {
        match input {
            Input::Opened { conn, token, back, admit } => {
                let Some(task) = self.seats.get(&token).cloned() else { return };
                if admit.send(()).is_err() {
                    return;
                }
                let registered =
                    proto::Registered { group: DEFAULT_GROUP.to_owned(), task: task.to_string() };
                let event = proto::event::Event::Registered(registered);
                let _ = back.try_send(proto::Event { event: Some(event) });
                self.conns.insert(conn, (task.clone(), back));
                self.event(&Event::Opened(conn, task));
            }
            Input::Call(conn, call) => self.call(conn, call),
            Input::Closed(conn) => self.put_out(conn),
            Input::AgentCame(life, back) => {
                // What an earlier one wanted is not what this one waits for.
                (self.asked, self.wanted, self.heard) = (0, 0, Instant::now());
                self.agent = Some((life, Some(back)));
            }
            Input::Wanted(life, wanted) => self.wanted(life, &wanted),
            Input::AgentGone(life) => {
                if self.agent.take_if(|(newest, _)| *newest == life).is_some() {
                    tracing::info!("the agent is gone");
                    self.event(&Event::AgentGone);
                }
            }
            Input::DriverBack(at) => {
                self.missing[at] = None;
                self.event(&Event::DriverBack);
                self.tell_agent();
            }
            Input::DriverStands => self.tell_agent(),
            Input::DriverGone(at, why) => {
                if self.missing[at].as_ref() != Some(&why) {
                    tracing::warn!(driver = at, why, "a driver is not there");
                    self.missing[at] = Some(why);
                    self.tell_agent();
                }
            }
            Input::DriverShared(at, doubt) => {
                if self.shared[at] != doubt {
                    tracing::info!(driver = at, ?doubt, "whether others may command a driver");
                    self.shared[at] = doubt;
                    self.tell_agent();
                }
            }
            Input::Hook(name, tier) => self.event(&Event::EStop(Source::Local(name), tier)),
        }
    }

    fn call(&mut self, conn: Conn, call: Said) {
        // It was put out, and what it says was under way.
        if !self.conns.contains_key(&conn) {
            return;
        }
        match call {
            Said::Register(_) => self.put_out(conn),
            Said::Retain(_) => self.event(&Event::Retain(conn)),
            Said::Command(command) => {
                let drives = |driver: &Driver| {
                    driver.settings.actuators.iter().any(|a| a.to_string() == command.actuator)
                };
                let driver = self.drivers.iter().position(drives);
                let token = token(command.lease.as_ref());
                let proto::Command { id, actuator, format, data, .. } = command;
                let command = Some(Command { driver, actuator, format, data });
                let event = token.map(|token| Event::Command(conn, token));
                self.answered(event, About { conn, id, command });
            }
            Said::Delegate(delegate) => {
                let about = About { conn, id: delegate.id, command: None };
                let event = |token| Event::Delegate(conn, token, TaskUid::new(delegate.task));
                self.answered(token(delegate.lease.as_ref()).map(event), about);
            }
        }
    }

    /// Carries out an event that is answered; none: its lease is nobody's.
    fn answered(&mut self, event: Option<Event>, about: About) {
        match event {
            Some(event) => {
                let response = self.core.handle(&event, clock::boot());
                self.carry_out(response, Some(about));
            }
            None => self.answer(about.conn, about.id, proto::Verdict::NotHolder),
        }
    }

    fn event(&mut self, event: &Event) {
        let response = self.core.handle(event, clock::boot());
        self.carry_out(response, None);
    }

    /// Carries out what the core says, in order; `about` is what [`Effect::Forward`] forwards and [`Effect::Answer`] answers.
    fn carry_out(&mut self, response: Response, about: Option<About>) {
        let (mut forward, mut said, mut tell) = (false, None, false);
        for effect in response.effects {
            match effect {
                Effect::Keep(kept) => self.record.keep(kept),
                Effect::Stop(why) => self.stop(why),
                Effect::Hold => self.drivers.iter().for_each(Driver::hold),
                Effect::Cut => self.drivers.iter().for_each(Driver::cut),
                Effect::Forward => forward = true,
                Effect::Answer(verdict) => said = Some(verdict),
                Effect::Silent => (self.silent, tell) = (self.silent + 1, true),
                Effect::GiveBack(grant) => (self.gives_back, tell) = (Some(grant), true),
                Effect::Report => tell = true,
            }
        }
        self.wake = response.wake;
        let cut = self.core.estop().tier() == Tier::Cut;
        self.drivers.iter().for_each(|driver| driver.keep_off(cut));
        if let (Some(about), Some(verdict)) = (about, said) {
            let waits = Waits { about, verdict, forward, stops: self.stops };
            match self.record.is_idle() {
                true => self.finish(waits),
                false => self.record.wait(waits),
            }
        }
        if tell {
            self.tell_agent();
        }
    }

    /// Hands a command to its driver, and answers. One that waited while the robot was stopped comes too late.
    fn finish(&mut self, waits: Waits) {
        let Waits { about, verdict, forward, stops } = waits;
        let late = stops != self.stops;
        let taken = about.command.filter(|_| forward && !late).is_some_and(|command| {
            command.data.len() <= LONGEST
                && command.driver.is_some_and(|at| {
                    self.drivers[at].command(&command.actuator, &command.format, &command.data)
                })
        });
        let verdict = match wire(verdict) {
            proto::Verdict::Ok if forward && !taken => match self.core.estop().tier() {
                Tier::None => proto::Verdict::NoDriver,
                Tier::Settle | Tier::Cut => proto::Verdict::Stopped,
            },
            verdict => verdict,
        };
        self.answer(about.conn, about.id, verdict);
    }

    /// The record is durable, or could not be written.
    fn written(&mut self, waited: Vec<Waits>) {
        for waits in waited {
            self.finish(waits);
        }
        if self.record.is_idle() {
            self.wanted = self.asked;
        }
        self.tell_agent();
    }

    fn stop(&mut self, why: StopReason) {
        tracing::info!(%why, "stop");
        self.stops += 1;
        self.drivers.iter().for_each(Driver::stop);
    }

    /// Takes the agent's word. A stop first; then seats, so that whoever lost his cannot go on in the grant's place.
    fn wanted(&mut self, life: u64, wanted: &proto::Wanted) {
        if self.agent.as_ref().is_none_or(|(newest, _)| *newest != life) {
            return;
        }
        self.heard = Instant::now();
        if let Some(estop) = wanted.estop {
            let tier = Tier::from_number(estop);
            self.event(&Event::EStop(Source::Controller, tier));
        }
        self.event(&Event::Release(wanted.release));
        let seats = wanted.seats.iter();
        self.seats = seats.map(|s| (s.token.clone(), TaskUid::new(s.task.clone()))).collect();
        let seated = |task: &TaskUid| wanted.seats.iter().any(|seat| seat.task == task.as_str());
        let gone: Vec<Conn> = self
            .conns
            .iter()
            .filter(|(_, (task, _))| !seated(task))
            .map(|(conn, _)| *conn)
            .collect();
        for conn in gone {
            self.put_out(conn);
        }
        let grant = wanted.grant.as_ref();
        let grant =
            grant.map(|g| Grant { epoch: Epoch(g.epoch), holder: TaskUid::new(g.task.clone()) });
        if self.gives_back.is_some() && self.gives_back != grant {
            self.gives_back = None;
        }
        self.event(&Event::Granted(grant));
        self.event(&Event::Fenced(Epoch(wanted.fence)));
        if wanted.leaves_for_ms > 0 {
            self.event(&Event::AgentLeaves { back_within_ms: wanted.leaves_for_ms.into() });
        }
        self.asked = wanted.id;
        if self.record.is_idle() {
            self.wanted = wanted.id;
        }
        self.tell_agent();
    }

    fn put_out(&mut self, conn: Conn) {
        // Its way back goes, and with it the connection.
        self.conns.remove(&conn);
        self.event(&Event::Closed(conn));
    }

    fn answer(&mut self, conn: Conn, id: u64, verdict: proto::Verdict) {
        let answer = proto::Answer {
            id,
            verdict: verdict.into(),
            holder: self.core.holder().map(holder),
            newest: Some(lease(self.core.newest())),
        };
        let event = proto::Event { event: Some(proto::event::Event::Answer(answer)) };
        if self.conns.get(&conn).is_some_and(|(_, back)| back.try_send(event).is_err()) {
            self.put_out(conn);
        }
    }

    /// How things stand. An agent that does not read is put out: it comes again, and hears everything.
    fn tell_agent(&mut self) {
        if self.record.is_idle() {
            self.durable = self.core.holder().cloned();
        }
        let Some((_, Some(back))) = &self.agent else { return };
        let estop = self.core.estop();
        let demand = |(source, tier): (&Source, Tier)| proto::Demand {
            source: source.to_string(),
            tier: tier.number(),
        };
        // A robot is known to stand when its drivers have read that it must.
        let unread = |driver: &Driver| {
            let unread = estop.tier() > Tier::None && !driver.stands();
            unread.then(|| "it has not read its stop yet".to_owned())
        };
        let record = self.record.error().map(|error| format!("the gate's record: {error}"));
        let driver = |(at, driver): (usize, &Driver)| {
            let missing = self.missing[at].clone();
            let error = missing.or_else(|| unread(driver)).or_else(|| record.clone());
            proto::Driver {
                actuators: driver.settings.actuators.iter().map(ToString::to_string).collect(),
                error: error.unwrap_or_default(),
                doubt: self.shared[at].as_ref().map(|doubt| proto::Doubt {
                    reason: doubt.reason.to_owned(),
                    why: doubt.why.clone(),
                }),
            }
        };
        let status = proto::Status {
            wanted: self.wanted,
            holder: self.durable.as_ref().filter(|g| Some(*g) == self.core.holder()).map(holder),
            newest: Some(lease(self.core.newest())),
            estop: Some(proto::EStop {
                tier: estop.tier().number(),
                number: estop.number(),
                demands: estop.demands().map(demand).collect(),
            }),
            drivers: self.drivers.iter().enumerate().map(driver).collect(),
            silent: self.silent,
            gives_back: self.gives_back.as_ref().map(holder),
            settings: self.digest.clone(),
        };
        if back.try_send(status).is_err()
            && let Some((_, back)) = &mut self.agent
        {
            *back = None;
        }
    }
}

fn holder(grant: &Grant) -> proto::Holder {
    proto::Holder { task: grant.holder.to_string(), epoch: grant.epoch.0 }
}

fn lease(token: &Token) -> proto::Lease {
    proto::Lease { epoch: token.epoch.0, sequence: token.sequence.clone() }
}

fn token(lease: Option<&proto::Lease>) -> Option<Token> {
    let lease = lease.filter(|lease| lease.sequence.len() <= DEEPEST)?;
    Some(Token { epoch: Epoch(lease.epoch), sequence: lease.sequence.clone() })
}

fn wire(verdict: Verdict) -> proto::Verdict {
    match verdict {
        Verdict::Ok => proto::Verdict::Ok,
        Verdict::Older => proto::Verdict::Older,
        Verdict::Revoked => proto::Verdict::Revoked,
        Verdict::NotHolder => proto::Verdict::NotHolder,
        Verdict::Unknown => proto::Verdict::Unknown,
        Verdict::Stopped => proto::Verdict::Stopped,
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use muster_agent_core::gate::{Action, Kept, Settings, Step};
    use tokio::io::{AsyncBufReadExt as _, BufReader, Lines};
    use tokio::net::{UnixListener, UnixStream};
    use tokio::sync::Mutex;
    use tokio::sync::oneshot::Receiver;

    use super::*;
    use crate::gate::record::Write;
    use crate::gate::settings::Ros;

    const HOLDER: Conn = Conn(1);

    /// A hall whose disk takes its time, with a driver that the test reads.
    struct Scene {
        urgent: mpsc::Sender<Input>,
        calls: mpsc::Sender<Input>,
        driver: Lines<BufReader<UnixStream>>,
        answers: mpsc::Receiver<proto::Event>,
        /// How the gate says that it stands.
        status: mpsc::Receiver<proto::Status>,
        /// Held: nothing is written.
        disk: Arc<Mutex<()>>,
        _dir: tempfile::TempDir,
    }

    fn wanted(epoch: u64) -> Input {
        let seat = proto::Seat { task: "a".to_owned(), token: "key".to_owned() };
        let grant = Some(proto::Holder { task: "a".to_owned(), epoch });
        Input::Wanted(
            1,
            proto::Wanted { id: epoch, seats: vec![seat], grant, ..Default::default() },
        )
    }

    fn command(id: u64, lease: &[u32], data: &'static str) -> Input {
        let lease = Some(proto::Lease { epoch: 6, sequence: lease.to_vec() });
        let data = Bytes::from_static(data.as_bytes());
        let actuator = "base:Drive".to_owned();
        Input::Call(
            HOLDER,
            Said::Command(proto::Command { id, lease, actuator, data, ..Default::default() }),
        )
    }

    impl Scene {
        async fn start(steps: &[Step]) -> Scene {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("driver");
            let listener = UnixListener::bind(&path).unwrap();
            let settings =
                serde_json::json!({"actuators": ["base:Drive"], "unix": path, "stop": "stop"});
            let (urgent, mut urgently) = mpsc::channel(INPUTS);
            let (calls, mut called) = mpsc::channel(INPUTS);
            let settings = serde_json::from_value(settings).unwrap();
            let driver = Driver::start(0, settings, &Ros::default(), urgent.clone());
            let disk = Arc::new(Mutex::new(()));
            let held = Arc::clone(&disk);
            let write: Write = Arc::new(move |_| {
                drop(held.blocking_lock());
                Ok(())
            });
            let core = Settings { ladder: steps.to_vec(), ..Settings::default() };
            let (core, first) = Gate::start(core, Kept::default());
            let dir_of = dir.path().to_owned();
            let mut hall =
                Hall::new(dir_of, String::new(), (core, vec![driver]), Record::new(write));
            let mut end = signal(SignalKind::user_defined1()).unwrap();
            tokio::spawn(async move {
                hall.run(first, (&mut urgently, &mut called), &mut end).await;
            });
            let (stream, _) = listener.accept().await.unwrap();
            let (back, answers) = mpsc::channel(8);
            let driver = BufReader::new(stream).lines();
            let (agent, status) = mpsc::channel(64);
            let mut scene = Scene { urgent, calls, driver, answers, status, disk, _dir: dir };
            // Before all that follows the hall hears that its driver is there: it stops it, and drops what waits for it.
            scene.hears("stop").await;
            let (admit, admitted): (_, Receiver<()>) = oneshot::channel();
            scene.urgent.send(Input::AgentCame(1, agent)).await.unwrap();
            scene.urgent.send(wanted(6)).await.unwrap();
            let opened = Input::Opened { conn: HOLDER, token: "key".to_owned(), back, admit };
            scene.say(opened).await;
            admitted.await.unwrap();
            assert!(scene.answers.recv().await.is_some(), "it is registered");
            scene.say(command(1, &[], "go")).await;
            assert_eq!(scene.answer().await, (1, proto::Verdict::Ok));
            scene.hears("go").await;
            scene
        }

        async fn say(&self, input: Input) {
            self.calls.send(input).await.unwrap();
        }

        async fn answer(&mut self) -> (u64, proto::Verdict) {
            match self.answers.recv().await.and_then(|event| event.event) {
                Some(proto::event::Event::Answer(answer)) => (answer.id, answer.verdict()),
                other => panic!("{other:?}"),
            }
        }

        /// Until the driver hears that, after nothing but stops.
        async fn hears(&mut self, word: &str) {
            loop {
                let heard = self.driver.next_line().await.unwrap().unwrap();
                if heard == word {
                    return;
                }
                assert_eq!(heard, "stop");
            }
        }
    }

    const PATIENT: &[Step] = &[Step { after_ms: 300_000, action: Action::Stop }];

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_button_does_not_wait_for_the_disk() {
        let mut scene = Scene::start(PATIENT).await;
        let disk = Arc::clone(&scene.disk);
        let held = disk.lock().await;
        // A newer token is to be durable before it counts.
        scene.say(command(2, &[1], "go on")).await;
        scene.say(command(3, &[1], "go on")).await;
        scene.urgent.send(Input::Hook("button".to_owned(), Tier::Settle)).await.unwrap();
        scene.hears("stop").await;
        drop(held);
        assert_eq!(scene.answer().await, (2, proto::Verdict::Stopped));
        assert_eq!(scene.answer().await, (3, proto::Verdict::Stopped));
        drop(scene.urgent);
        drop(scene.calls);
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn nor_does_a_stop_for_a_holder_that_is_gone_or_silent() {
        let silent = &[Step { after_ms: 1_000, action: Action::Stop }];
        for steps in [PATIENT, silent] {
            let mut scene = Scene::start(steps).await;
            let disk = Arc::clone(&scene.disk);
            let held = disk.lock().await;
            scene.say(command(2, &[1], "go on")).await;
            if steps == PATIENT {
                // It is heard before what the holder had still said, and before what the disk is to take.
                scene.urgent.send(Input::Closed(HOLDER)).await.unwrap();
            }
            scene.hears("stop").await;
            drop(held);
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_person_is_said_to_hold_the_robot_when_a_gate_that_is_started_again_knows_it() {
        let mut scene = Scene::start(PATIENT).await;
        let disk = Arc::clone(&scene.disk);
        let held = disk.lock().await;
        let person = Some(proto::Holder { task: "person".to_owned(), epoch: 7 });
        let wanted = proto::Wanted { id: 7, grant: person.clone(), fence: 7, ..Default::default() };
        scene.urgent.send(Input::Wanted(1, wanted)).await.unwrap();
        // The robot first.
        scene.hears("stop").await;
        // What is asked afterwards is answered afterwards.
        scene.urgent.send(Input::Hook("button".to_owned(), Tier::Settle)).await.unwrap();
        let stopped = |status: &proto::Status| status.estop.as_ref().is_some_and(|e| e.tier == 1);
        loop {
            let status = scene.status.recv().await.unwrap();
            assert_ne!(status.holder, person, "nothing is written yet");
            if stopped(&status) {
                break;
            }
        }
        drop(held);
        while scene.status.recv().await.unwrap().holder != person {}
        drop((scene.urgent, scene.calls));
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_task_that_says_much_is_not_before_a_button() {
        let mut scene = Scene::start(PATIENT).await;
        let talks = scene.calls.clone();
        let talker = tokio::spawn(async move {
            let said =
                std::iter::repeat_with(|| Input::Call(HOLDER, Said::Retain(proto::Retain {})));
            for input in said {
                if talks.send(input).await.is_err() {
                    return;
                }
            }
        });
        scene.urgent.send(Input::Hook("button".to_owned(), Tier::Settle)).await.unwrap();
        scene.hears("stop").await;
        talker.abort();
    }
}
