//! The one task that asks the core and carries out what it says. Everything that happens comes in as an [`Input`], in order.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use bytes::Bytes;
use muster_agent_core::gate::{
    Conn, DEEPEST, Effect, Event, Gate, Grant, Kept, Response, Source, StopReason, Tier, Token,
    Verdict,
};
use muster_agent_core::time::Boot;
use muster_api::id::{Epoch, TaskUid};
use muster_api::kind::lease::DEFAULT_GROUP;
use muster_api::wire::gate::v1 as proto;
use proto::call::Call as Said;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::Instant;

use super::door::{self, Back};
use super::driver::Driver;
use super::settings::Settings;
use super::{AGENT_SOCKET, GateError, SOCKET, TASKS_DIR, hook, keeper};
use crate::clock;
use crate::durable::{self, Keep};

/// Inputs that may wait. Whoever says more waits until they were looked at.
const INPUTS: usize = 256;

/// What a gate that begins must know.
const KEPT: &str = "kept.json";

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
    DriverGone(usize, String),
    Hook(String, Tier),
}

struct Hall {
    dir: PathBuf,
    /// What the agent knows these settings by.
    digest: String,
    core: Gate,
    drivers: Vec<Driver>,
    /// Why a driver is not there.
    missing: Vec<Option<String>>,
    /// By token.
    seats: BTreeMap<String, TaskUid>,
    conns: BTreeMap<Conn, (TaskUid, Back<proto::Event>)>,
    /// The newest connection; its way back is gone when it does not read.
    agent: Option<(u64, Option<Back<proto::Status>>)>,
    wanted: u64,
    /// When the agent last said something.
    heard: Instant,
    silent: u64,
    gives_back: Option<Grant>,
    wake: Option<Boot>,
}

/// Runs until it is told to end.
pub(super) async fn serve(dir: PathBuf, settings: Settings) -> Result<(), GateError> {
    let system = |what| move |source| GateError::System { what, source };
    let kept: Kept = durable::read_json(&dir.join(KEPT))?.unwrap_or_default();
    let mut end = signal(SignalKind::terminate()).map_err(system("hear signals"))?;
    let tasks = door::listen(&dir.join(TASKS_DIR).join(SOCKET), 0o666)
        .map_err(system("listen for tasks"))?;
    let agents =
        door::listen(&dir.join(AGENT_SOCKET), 0o600).map_err(system("listen for agents"))?;
    let (inputs, mut received) = mpsc::channel(INPUTS);
    let (core, response) = Gate::start(settings.core(), kept);
    let driver =
        |(at, driver): (usize, &_)| Driver::start(at, Clone::clone(driver), inputs.clone());
    let drivers: Vec<Driver> = settings.drivers.iter().enumerate().map(driver).collect();
    let mut others = JoinSet::new();
    for hook in settings.estop.clone() {
        others.spawn(hook::follow(hook, inputs.clone()));
    }
    others.spawn(door::tasks(tasks, inputs.clone()));
    others.spawn(door::agents(agents, inputs));
    let mut hall = Hall {
        digest: keeper::digest(&settings),
        missing: vec![Some("it has not been reached yet".to_owned()); drivers.len()],
        dir,
        core,
        drivers,
        seats: BTreeMap::new(),
        conns: BTreeMap::new(),
        agent: None,
        wanted: 0,
        heard: Instant::now(),
        silent: 0,
        gives_back: None,
        wake: None,
    };
    tracing::info!(newest = %hall.core.newest(), estop = %hall.core.estop().tier(), "the gate starts");
    let ended = hall.run(response, &mut received, &mut end).await;
    // Nobody stands before the drivers any more.
    hall.drivers.iter().for_each(Driver::stop);
    tokio::time::sleep(LAST_STOP).await;
    ended
}

impl Hall {
    /// Until it is told to end, or cannot go on.
    async fn run(
        &mut self,
        first: Response,
        received: &mut mpsc::Receiver<Input>,
        end: &mut Signal,
    ) -> Result<(), GateError> {
        self.carry_out(first, None).await?;
        let mut looks = tokio::time::interval(STUCK / 4);
        loop {
            // Cancel-safe: a signal, a receiver, a sleep and a tick.
            tokio::select! {
                _ = end.recv() => return Ok(()),
                Some(input) = received.recv() => self.take(input).await?,
                () = crate::driver::sleep_until(self.wake) => self.event(&Event::Tick).await?,
                _ = looks.tick() => {
                    if self.agent.is_some() && self.heard.elapsed() > STUCK {
                        tracing::warn!("the agent says nothing");
                        // Its connection ends with its way back; it comes again when it can.
                        self.agent = None;
                        self.event(&Event::AgentGone).await?;
                    }
                }
            }
        }
    }

    async fn take(&mut self, input: Input) -> Result<(), GateError> {
        match input {
            Input::Opened { conn, token, back, admit } => {
                let Some(task) = self.seats.get(&token).cloned() else { return Ok(()) };
                let registered =
                    proto::Registered { group: DEFAULT_GROUP.to_owned(), task: task.to_string() };
                let event = proto::event::Event::Registered(registered);
                let _ = back.try_send(proto::Event { event: Some(event) });
                self.conns.insert(conn, (task.clone(), back));
                let _ = admit.send(());
                self.event(&Event::Opened(conn, task)).await
            }
            Input::Call(conn, call) => self.call(conn, call).await,
            Input::Closed(conn) => {
                self.conns.remove(&conn);
                self.event(&Event::Closed(conn)).await
            }
            Input::AgentCame(life, back) => {
                // What an earlier one wanted is not what this one waits for.
                (self.wanted, self.heard) = (0, Instant::now());
                self.agent = Some((life, Some(back)));
                Ok(())
            }
            Input::Wanted(life, wanted) => self.wanted(life, &wanted).await,
            Input::AgentGone(life) => {
                if self.agent.take_if(|(newest, _)| *newest == life).is_none() {
                    return Ok(());
                }
                tracing::info!("the agent is gone");
                self.event(&Event::AgentGone).await
            }
            Input::DriverBack(at) => {
                self.missing[at] = None;
                self.event(&Event::DriverBack).await?;
                self.tell_agent();
                Ok(())
            }
            Input::DriverGone(at, why) => {
                if self.missing[at].as_ref() != Some(&why) {
                    tracing::warn!(driver = at, why, "a driver is not there");
                    self.missing[at] = Some(why);
                    self.tell_agent();
                }
                Ok(())
            }
            Input::Hook(name, tier) => self.event(&Event::EStop(Source::Local(name), tier)).await,
        }
    }

    async fn call(&mut self, conn: Conn, call: Said) -> Result<(), GateError> {
        // It was put out, and what it says was under way.
        if !self.conns.contains_key(&conn) {
            return Ok(());
        }
        match call {
            Said::Register(_) => self.put_out(conn).await,
            Said::Retain(_) => self.event(&Event::Retain(conn)).await,
            Said::Command(command) => {
                let verdict = self.command(conn, &command).await?;
                self.answer(conn, command.id, verdict).await
            }
            Said::Delegate(delegate) => {
                let Some(token) = token(delegate.lease.as_ref()) else {
                    return self.answer(conn, delegate.id, proto::Verdict::NotHolder).await;
                };
                let event = Event::Delegate(conn, token, TaskUid::new(delegate.task));
                let response = self.core.handle(&event, clock::boot());
                let verdict = self.carry_out(response, None).await?;
                self.answer(conn, delegate.id, verdict).await
            }
        }
    }

    async fn command(
        &mut self,
        conn: Conn,
        command: &proto::Command,
    ) -> Result<proto::Verdict, GateError> {
        let Some(token) = token(command.lease.as_ref()) else {
            return Ok(proto::Verdict::NotHolder);
        };
        let drives = |driver: &Driver| {
            driver.settings.actuators.iter().any(|a| a.to_string() == command.actuator)
        };
        let driver = self.drivers.iter().position(drives);
        let response = self.core.handle(&Event::Command(conn, token), clock::boot());
        self.carry_out(response, driver.map(|at| (at, &command.data))).await
    }

    async fn event(&mut self, event: &Event) -> Result<(), GateError> {
        let response = self.core.handle(event, clock::boot());
        self.carry_out(response, None).await.map(drop)
    }

    /// Carries out what the core says, in order; `command` is what [`Effect::Forward`] forwards. Returns what is to be answered.
    async fn carry_out(
        &mut self,
        response: Response,
        command: Option<(usize, &Bytes)>,
    ) -> Result<proto::Verdict, GateError> {
        let (mut taken, mut verdict) = (false, proto::Verdict::Unspecified);
        let mut tell = false;
        for effect in response.effects {
            match effect {
                // A gate that cannot remember does not go on: it ends with a stop, and another one begins with one.
                Effect::Keep(kept) => {
                    // What was told to the drivers goes out before the disk is waited for.
                    tokio::task::yield_now().await;
                    durable::write_json(&self.dir.join(KEPT), &kept, Keep::PowerCut)?;
                }
                Effect::Stop(why) => self.stop(why),
                Effect::Hold => self.drivers.iter().for_each(Driver::hold),
                Effect::Cut => self.drivers.iter().for_each(Driver::cut),
                Effect::Forward => {
                    taken = command.is_some_and(|(at, data)| {
                        data.len() <= LONGEST && self.drivers[at].command(data)
                    });
                }
                Effect::Answer(Verdict::Ok) if command.is_some() && !taken => {
                    verdict = proto::Verdict::NoDriver;
                }
                Effect::Answer(said) => verdict = wire(said),
                Effect::Silent => (self.silent, tell) = (self.silent + 1, true),
                Effect::GiveBack(grant) => (self.gives_back, tell) = (Some(grant), true),
                Effect::Report => tell = true,
            }
        }
        self.wake = response.wake;
        let cut = self.core.estop().tier() == Tier::Cut;
        self.drivers.iter().for_each(|driver| driver.keep_off(cut));
        if tell {
            self.tell_agent();
        }
        Ok(verdict)
    }

    fn stop(&self, why: StopReason) {
        tracing::info!(%why, "stop");
        self.drivers.iter().for_each(Driver::stop);
    }

    /// Takes the agent's word: seats first, so that whoever lost his cannot go on in the grant's place.
    async fn wanted(&mut self, life: u64, wanted: &proto::Wanted) -> Result<(), GateError> {
        if self.agent.as_ref().is_none_or(|(newest, _)| *newest != life) {
            return Ok(());
        }
        self.heard = Instant::now();
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
            self.put_out(conn).await?;
        }
        let grant = wanted.grant.as_ref();
        let grant =
            grant.map(|g| Grant { epoch: Epoch(g.epoch), holder: TaskUid::new(g.task.clone()) });
        if self.gives_back.is_some() && self.gives_back != grant {
            self.gives_back = None;
        }
        self.event(&Event::Granted(grant)).await?;
        if let Some(estop) = wanted.estop {
            let tier = match estop {
                0 => Tier::None,
                1 => Tier::Settle,
                _ => Tier::Cut,
            };
            self.event(&Event::EStop(Source::Controller, tier)).await?;
        }
        self.event(&Event::Release(wanted.release)).await?;
        if wanted.leaves_for_ms > 0 {
            self.event(&Event::AgentLeaves { back_within_ms: wanted.leaves_for_ms.into() }).await?;
        }
        self.wanted = wanted.id;
        self.tell_agent();
        Ok(())
    }

    async fn put_out(&mut self, conn: Conn) -> Result<(), GateError> {
        // Its way back goes, and with it the connection.
        self.conns.remove(&conn);
        self.event(&Event::Closed(conn)).await
    }

    async fn answer(
        &mut self,
        conn: Conn,
        id: u64,
        verdict: proto::Verdict,
    ) -> Result<(), GateError> {
        let answer = proto::Answer {
            id,
            verdict: verdict.into(),
            holder: self.core.holder().map(holder),
            newest: Some(lease(self.core.newest())),
        };
        let event = proto::Event { event: Some(proto::event::Event::Answer(answer)) };
        let full = self.conns.get(&conn).is_some_and(|(_, back)| back.try_send(event).is_err());
        if full { self.put_out(conn).await } else { Ok(()) }
    }

    /// How things stand. An agent that does not read is put out: it comes again, and hears everything.
    fn tell_agent(&mut self) {
        let Some((_, Some(back))) = &self.agent else { return };
        let estop = self.core.estop();
        let demand = |(source, tier): (&Source, Tier)| proto::Demand {
            source: source.to_string(),
            tier: tier as u32,
        };
        let driver = |(driver, missing): (&Driver, &Option<String>)| proto::Driver {
            actuators: driver.settings.actuators.iter().map(ToString::to_string).collect(),
            error: missing.clone().unwrap_or_default(),
        };
        let status = proto::Status {
            wanted: self.wanted,
            holder: self.core.holder().map(holder),
            newest: Some(lease(self.core.newest())),
            estop: Some(proto::EStop {
                tier: estop.tier() as u32,
                number: estop.number(),
                demands: estop.demands().map(demand).collect(),
            }),
            drivers: self.drivers.iter().zip(&self.missing).map(driver).collect(),
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
