//! A machine with its agent. Real: what decides, which is the agent's core (workloads, plans of assignments, the journal of
//! reports) and the decoding of what the controller sends. Modelled: what carries that out, as `driver`, `supervisor` and
//! `link` of the agent do, over a modelled kernel and disk; effects of a task one after the other, a write before what follows
//! it, answers in any time.

mod carry;
mod gate;
mod session;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use muster_agent_core::depend::Standing;
use muster_agent_core::event::{Context, Effect, Event, Outcome};
use muster_agent_core::observed::{End, Exit};
use muster_agent_core::report::Report;
use muster_agent_core::time::{Boot, Now, Wall};
use muster_agent_core::workload::Workload;
use muster_api::id::TaskUid;
use muster_api::kind::node::NodeKind;
use muster_api::kind::task::TaskSpec;
use muster_api::wire::agent::v1 as proto;
use muster_api::wire::gate::v1 as gate_proto;

use crate::agenda::{Agenda, Due};
use crate::applications::{GLANCE, LOOK};
use crate::controller::{EPOCH, Member};
use crate::dice::Dice;
use crate::invariant::{Invariant, Violation};
use crate::kernel::{Kernel, Program};
use crate::log::Log;
use crate::mutation::Mutation;
use crate::net::{Conn, Net};
use crate::truth::{Room, Takes, Truth};
use gate::{Gateway, Hold};
use session::Session;

/// What a machine may use of the world.
pub(crate) struct Hands<'a> {
    pub(crate) now: u64,
    pub(crate) dice: &'a mut Dice,
    pub(crate) agenda: &'a mut Agenda,
    pub(crate) net: &'a mut Net,
    pub(crate) truth: &'a mut Truth,
    pub(crate) log: &'a mut Log,
    pub(crate) broken: &'a mut Option<Violation>,
    pub(crate) mutation: Option<Mutation>,
}

impl Hands<'_> {
    fn later(&mut self, node: usize, low: u64, high: u64, what: What) {
        let at = self.now + self.dice.between(low, high);
        self.agenda.at(at, Due::Machine(node, what));
    }

    pub(crate) fn break_with(&mut self, violation: Violation) {
        self.log.say(self.now, format_args!("BROKEN {violation}"));
        self.broken.get_or_insert(violation);
    }
}

/// Something that happens on a machine. What an agent waits for names its life: it comes to no later one.
#[derive(Debug)]
pub(crate) enum What {
    /// The agent is started.
    Begin,
    /// It dials the controller.
    Dial(u32),
    /// It sends a heartbeat.
    Beat(u32, Conn),
    /// It has waited for a welcome for long enough.
    NoWelcome(u32, Conn),
    /// A record is on the disk.
    Written(u32, TaskUid),
    /// A deadline of a task.
    Wake(u32, TaskUid),
    /// A runtime does what it was asked.
    Perform(u32, TaskUid, Effect),
    /// A runtime answers.
    Answer(u32, TaskUid, Box<Event>),
    /// A shim starts its program.
    Start {
        boot: u64,
        life: u32,
        uid: TaskUid,
        attempt: u32,
        claim: u64,
        unclear: bool,
    },
    /// A process ends.
    Ends {
        boot: u64,
        uid: TaskUid,
        attempt: u32,
        end: End,
    },
    /// A shim looks when contact was last.
    Guard {
        boot: u64,
        uid: TaskUid,
        attempt: u32,
    },
    /// What may drive waits until its gate counts what was wanted by then, or for too long.
    Cleared {
        life: u32,
        uid: TaskUid,
        attempt: u32,
        wanted: u64,
        until: u64,
    },
    /// The agent comes to its gate. It dials for orders, and looks whether they are heard still.
    Attach(u32),
    DialOrders(u32),
    OrdersLook(u32, Conn),
    /// Between one gate and one life of its agent.
    ToGate(u32, u32, Box<gate_proto::Wanted>),
    FromGate(u32, u32, Box<gate_proto::Status>),
    /// A gate's record is on the disk.
    GateWritten(u32),
    /// The button on the robot is let go.
    LetGo,
}

/// What is kept of a task beside the core's state.
#[derive(Debug, Clone)]
pub(crate) struct Kept {
    program: Program,
}

/// A task's record on the agent's disk.
#[derive(Debug, Clone)]
struct Record {
    boot: u64,
    kept: Kept,
    workload: Workload,
}

/// A task in one life of the agent: its driver.
#[derive(Debug)]
struct Cell {
    workload: Workload,
    kept: Kept,
    inbox: VecDeque<Event>,
    effects: VecDeque<Effect>,
    /// A write is under way; everything else of the task waits for it.
    writing: bool,
    /// What is shown to the session, and the newest that was answered.
    told: Option<Report>,
    acknowledged: u64,
    /// What it was told of those that it waits for.
    standing: Option<Standing>,
    forgotten: bool,
    dropped: bool,
}

/// One life of the agent.
#[derive(Debug, Default)]
struct Life {
    tasks: BTreeMap<TaskUid, Cell>,
    watches: BTreeSet<(TaskUid, u32)>,
    session: Option<Session>,
    hold: Hold,
    pause: u64,
}

/// A machine.
#[derive(Debug)]
pub(crate) struct Agent {
    pub(crate) index: usize,
    pub(crate) member: Member,
    pub(crate) room: Room,
    pub(crate) sensors: Vec<String>,
    pub(crate) actuators: Vec<String>,
    pub(crate) place: Option<(f64, f64)>,
    pub(crate) kernel: Kernel,
    /// None: nothing stands before its drivers.
    pub(crate) gate: Option<Gateway>,
    disk: BTreeMap<TaskUid, Record>,
    /// How far its date is off, milliseconds.
    pub(crate) skew: i64,
    /// Until when its disk is full.
    pub(crate) full_until: u64,
    boot: u64,
    booted_at: u64,
    contact: Option<Boot>,
    life: Option<Life>,
    /// Number of the present life, or of the last one.
    lives: u32,
}

impl Agent {
    pub(crate) fn new(index: usize, member: Member, room: Room, gated: bool) -> Agent {
        let robot = member.kind == NodeKind::Robot;
        let some = |word: &str| if robot { vec![word.to_owned()] } else { Vec::new() };
        Agent {
            index,
            member,
            room,
            sensors: some("kinect:ImageGen"),
            actuators: some("base:Drive"),
            place: robot.then_some((index as f64 * 10.0, 0.0)),
            kernel: Kernel::default(),
            gate: gated.then(Gateway::default),
            disk: BTreeMap::new(),
            skew: 0,
            full_until: 0,
            boot: 1,
            booted_at: 0,
            contact: None,
            life: None,
            lives: 0,
        }
    }

    pub(crate) fn name(&self) -> &str {
        self.member.name.as_str()
    }

    pub(crate) fn is_up(&self) -> bool {
        self.life.is_some()
    }

    /// Its session was welcomed and lasts.
    pub(crate) fn is_connected(&self) -> bool {
        self.life.as_ref().and_then(|life| life.session.as_ref()).is_some_and(Session::is_welcomed)
    }

    /// Tasks with a report that nobody has answered.
    pub(crate) fn unheard(&self) -> Vec<String> {
        let cells = self.life.iter().flat_map(|life| life.tasks.values());
        let unheard =
            cells.filter(|c| c.told.as_ref().is_some_and(|r| r.sequence > c.acknowledged));
        unheard.map(|cell| cell.kept.program.name.clone()).collect()
    }

    /// The date, as its clock has it.
    fn wall(&self, hands: &Hands<'_>) -> Wall {
        Wall(EPOCH + hands.now.cast_signed() + self.skew)
    }

    fn clock(&self, now: u64) -> Boot {
        Boot(now.saturating_sub(self.booted_at))
    }

    fn context(&self, hands: &Hands<'_>) -> Context {
        let now = Now { boot: self.clock(hands.now), wall: self.wall(hands) };
        Context { now, contact: self.contact }
    }

    fn made_contact(&mut self, sent: Boot) {
        self.contact = self.contact.max(Some(sent));
    }

    /// The agent is killed; what it had started goes on. A write that was under way is there or is not.
    pub(crate) fn crash(&mut self, hands: &mut Hands<'_>) {
        let Some(life) = self.life.take() else { return };
        for (uid, cell) in life.tasks.into_iter().filter(|(_, cell)| cell.writing) {
            if hands.dice.one_in(2) {
                let record = Record { boot: self.boot, kept: cell.kept, workload: cell.workload };
                self.keep(uid, record, hands);
            }
        }
        if let Some(session) = life.session {
            session.end(hands);
        }
        life.hold.end(hands);
        self.leave_gate(hands);
    }

    fn keep(&mut self, uid: TaskUid, record: Record, hands: &Hands<'_>) {
        if hands.mutation != Some(Mutation::DoubleRun) && hands.now >= self.full_until {
            self.disk.insert(uid, record);
        }
    }

    /// The power fails; the machine is there again in a moment, and its agent with it.
    pub(crate) fn reboot(&mut self, hands: &mut Hands<'_>) {
        self.crash(hands);
        self.kill_gate(hands);
        self.kernel.reboot(hands.truth);
        self.boot += 1;
        let down = hands.dice.between(500, 8_000);
        self.booted_at = hands.now + down;
        self.contact = None;
        hands.later(self.index, down, down, What::Begin);
    }

    /// Something happens here.
    pub(crate) fn handle(&mut self, what: What, hands: &mut Hands<'_>) {
        match what {
            What::Begin => self.begin(hands),
            What::Start { boot, life, uid, attempt, claim, unclear } => {
                if boot == self.boot {
                    self.start(life, (&uid, attempt, claim), unclear, hands);
                }
            }
            What::Ends { boot, uid, attempt, end } => {
                if boot == self.boot {
                    self.end(&uid, attempt, end, hands);
                }
            }
            What::Guard { boot, uid, attempt } => {
                if boot == self.boot {
                    self.guard(&uid, attempt, hands);
                }
            }
            What::GateWritten(gate) => self.gate_written(gate, hands),
            What::ToGate(gate, life, wanted) => self.reaches_gate((gate, life), &wanted, hands),
            What::LetGo => drop(self.button(false, hands)),
            What::Cleared { life, .. }
            | What::Attach(life)
            | What::DialOrders(life)
            | What::OrdersLook(life, _)
            | What::FromGate(life, ..)
            | What::Dial(life)
            | What::Beat(life, _)
            | What::NoWelcome(life, _)
            | What::Written(life, _)
            | What::Wake(life, _)
            | What::Perform(life, ..)
            | What::Answer(life, ..)
                if life != self.lives || self.life.is_none() => {}
            What::Cleared { uid, attempt, wanted, until, .. } => {
                self.launch(&uid, attempt, (wanted, until), hands);
            }
            What::Attach(_) => self.attach(hands),
            What::DialOrders(_) => self.dial_orders(hands),
            What::OrdersLook(_, conn) => self.look_at_orders(conn, hands),
            What::FromGate(_, gate, status) => self.hear_gate(gate, *status, hands),
            What::Dial(_) => self.dial(hands),
            What::Beat(_, conn) => self.beat(conn, hands),
            What::NoWelcome(_, conn) => self.no_welcome(conn, hands),
            What::Written(_, uid) => self.written(uid, hands),
            What::Wake(_, uid) => self.tell(&uid, Event::Tick, hands),
            What::Perform(_, uid, effect) => self.perform(&uid, &effect, hands),
            What::Answer(_, uid, event) => self.tell(&uid, *event, hands),
        }
    }

    /// A life of the agent begins with what its disk has.
    fn begin(&mut self, hands: &mut Hands<'_>) {
        if self.life.is_some() || hands.now < self.booted_at {
            return;
        }
        self.lives += 1;
        let mut life = Life { pause: session::PAUSE.0, ..Life::default() };
        let context = self.context(hands);
        for (uid, record) in &self.disk {
            let bytes = serde_json::to_vec(&record.workload).expect("a workload is JSON");
            let mut workload: Workload = serde_json::from_slice(&bytes).expect("it was written so");
            let response = workload.restored(record.boot == self.boot, context);
            let told = response.effects.contains(&Effect::Publish).then(|| workload.report.clone());
            let forgotten = workload.forgotten;
            let mut cell = Cell::new(workload, record.kept.clone(), response.effects);
            (cell.told, cell.forgotten) = (told, forgotten);
            life.tasks.insert(uid.clone(), cell);
        }
        hands.log.say(
            hands.now,
            format_args!("{} begins with {} records", self.name(), self.disk.len()),
        );
        let uids: Vec<TaskUid> = life.tasks.keys().cloned().collect();
        self.life = Some(life);
        for uid in &uids {
            self.seat(uid, hands);
        }
        for uid in uids {
            self.pump(&uid, hands);
        }
        self.look_at_others(hands);
        self.hold_gate(hands);
        hands.later(self.index, 1, 20, What::Dial(self.lives));
    }

    fn tell(&mut self, uid: &TaskUid, event: Event, hands: &mut Hands<'_>) {
        let cell = self.life.as_mut().and_then(|life| life.tasks.get_mut(uid));
        let Some(cell) = cell else { return };
        cell.inbox.push_back(event);
        self.pump(uid, hands);
    }

    fn start(
        &mut self,
        life: u32,
        (uid, attempt, claim): (&TaskUid, u32, u64),
        unclear: bool,
        hands: &mut Hands<'_>,
    ) {
        let Some(Kept { program }) = self.kept_of(uid).cloned() else { return };
        let (since, started) = (self.clock(hands.now).0, self.wall(hands));
        let (stop_after, name) = (program.stop_after_ms, program.name.clone());
        let crashes = program.crashes;
        let begun = self.kernel.begin(
            (uid, attempt, claim),
            (self.index, since, started),
            program,
            hands.truth,
        );
        match begun {
            Err(violation) => return hands.break_with(violation),
            Ok(false) => return,
            Ok(true) => {}
        }
        hands
            .log
            .say(hands.now, format_args!("{} runs {name} ({uid}) attempt {attempt}", self.name()));
        if let Some(limit) = stop_after {
            let (boot, uid) = (self.boot, uid.clone());
            hands.later(self.index, limit, limit, What::Guard { boot, uid, attempt });
        }
        if crashes {
            let (boot, uid) = (self.boot, uid.clone());
            let ends = What::Ends { boot, uid, attempt, end: End::Exited(1) };
            hands.later(self.index, 20, 1_500, ends);
        } else if !hands.truth.calm && hands.dice.one_in(3) {
            let end = End::Exited(i32::try_from(hands.dice.between(0, 2)).unwrap_or(1));
            let (boot, uid) = (self.boot, uid.clone());
            hands.later(self.index, 50, 30_000, What::Ends { boot, uid, attempt, end });
        }
        let started = muster_agent_core::observed::Started { at: started };
        let outcome = if unclear { Outcome::LaunchUnclear } else { Outcome::Launched(started) };
        let answer = Box::new(Event::Attempt(attempt, outcome));
        hands.later(self.index, 0, 20, What::Answer(life, uid.clone(), answer));
    }

    /// What a launch of the task starts. The shim has it on its own disk.
    fn kept_of(&self, uid: &TaskUid) -> Option<&Kept> {
        let cell = self.life.as_ref().and_then(|life| life.tasks.get(uid)).map(|cell| &cell.kept);
        cell.or_else(|| self.disk.get(uid).map(|record| &record.kept))
    }

    /// A process ends, by itself or by its shim.
    pub(crate) fn end(&mut self, uid: &TaskUid, attempt: u32, end: End, hands: &mut Hands<'_>) {
        let at = self.wall(hands);
        let Some(exit) = self.kernel.end(uid, attempt, end, at, hands.truth) else { return };
        hands.log.say(
            hands.now,
            format_args!("{} ended {uid} attempt {attempt}: {:?}", self.name(), exit.end),
        );
        self.lets_go(uid, hands);
        let id = (uid.clone(), attempt);
        if self.life.as_mut().is_some_and(|life| life.watches.remove(&id)) {
            self.say_exit(uid, attempt, exit, hands);
        }
    }

    fn say_exit(&mut self, uid: &TaskUid, attempt: u32, exit: Exit, hands: &mut Hands<'_>) {
        let answer = Box::new(Event::Attempt(attempt, Outcome::Exited(exit)));
        hands.later(self.index, 0, 20, What::Answer(self.lives, uid.clone(), answer));
    }

    /// The shim's own look: it ends what has had no contact for too long.
    fn guard(&mut self, uid: &TaskUid, attempt: u32, hands: &mut Hands<'_>) {
        let now = self.clock(hands.now).0;
        let contact = self.contact.map(|at| at.0);
        let Some(known) = self.kernel.attempts.get_mut(&(uid.clone(), attempt)) else { return };
        let Some(limit) = known.program.stop_after_ms.filter(|_| known.exit.is_none()) else {
            return;
        };
        let last = contact.unwrap_or(known.since);
        let (boot, uid) = (self.boot, uid.clone());
        if now.saturating_sub(last) < limit {
            let wait = last + limit - now;
            return hands.later(self.index, wait, wait, What::Guard { boot, uid, attempt });
        }
        known.disconnected = true;
        let grace = known.program.grace_ms;
        hands.log.say(hands.now, format_args!("{} lost contact: ends {uid}", self.member.name));
        let end = End::Signaled(15);
        hands.later(self.index, 1, grace.max(1), What::Ends { boot, uid, attempt, end });
    }

    fn kept(wire: &proto::Assignment, spec: &TaskSpec) -> Kept {
        let reserved = spec.resources.reserved();
        let stop_after = spec.stop_after_disconnect();
        let takes = Takes {
            drives: wire.lease.as_ref().map(|lease| lease.epoch),
            cpu: reserved.cpu.0,
            memory: reserved.memory.0,
        };
        let stop_after_ms =
            stop_after.map(|s| u64::try_from(s.as_duration().as_millis()).unwrap_or(u64::MAX));
        let grace_ms = u64::from(spec.grace_period_seconds) * 1_000;
        let waits_for =
            spec.depends_on.iter().map(|one| (one.task.clone(), one.condition)).collect();
        let name = wire.name.clone();
        let process = spec.run.process.as_ref();
        let runs = |what| process.is_some_and(|process| process.command == [what]);
        let (crashes, tells) = (runs("crash"), runs(LOOK) || runs(GLANCE));
        let standby = spec.standby.is_some() && runs(LOOK);
        let program =
            Program { name, takes, grace_ms, stop_after_ms, tells, standby, crashes, waits_for };
        Kept { program }
    }
}

impl Cell {
    fn new(workload: Workload, kept: Kept, effects: Vec<Effect>) -> Cell {
        Cell {
            workload,
            kept,
            inbox: VecDeque::new(),
            effects: effects.into(),
            writing: false,
            told: None,
            acknowledged: 0,
            standing: None,
            forgotten: false,
            dropped: false,
        }
    }
}

/// A removal of what lives.
fn removed_alive(uid: &TaskUid) -> Violation {
    Invariant::WorkOutlivesItsManagers.broken(format!("{uid} is removed while it lives"))
}
