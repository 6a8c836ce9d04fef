//! A robot's gate, and the agent's hold on it. Real: what decides, which is the gate's core; what the agent wants of it, and what
//! of its standing the controller is told. Modelled: the gate's process as its `hall` is, with its disk and the connections of
//! tasks; the stream of orders, as `link` has it; drivers, which always read.

use std::collections::{BTreeMap, BTreeSet};

use muster_agent::gate::{Standing, Wanted};
use muster_agent_core::gate::{
    Conn as Door, Effect, Event, Gate, Grant, Kept, Response, Settings, Source, Tier, Token,
    Verdict,
};
use muster_agent_core::time::Boot;
use muster_api::id::{Epoch, TaskUid};
use muster_api::wire::agent::v1::NodeOrder;
use muster_api::wire::gate::v1 as proto;

use super::{Agent, Hands, What};
use crate::mutation::Mutation;
use crate::net::{Conn, Down, Up};
use crate::truth::Command;

/// Between the agent and its gate, milliseconds: always the same, so that what is said keeps its order.
const ON_THE_WAY: u64 = 1;
/// A gate that is gone is started again after this.
const START_AGAIN: u64 = 200;
/// Between two tries to write its record.
const WRITE_AGAIN: u64 = 1_000;
/// Between two tries to hear orders, and how long a connection may be gone without a word.
const PAUSE: u64 = 500;
const GONE_AFTER: u64 = 2_000;

/// A robot's gate: what its disk has, and its process.
#[derive(Debug, Default)]
pub(crate) struct Gateway {
    disk: Kept,
    hall: Option<Hall>,
    /// Number of the present process, or of the last one.
    lives: u32,
}

/// One process of the gate.
#[derive(Debug)]
struct Hall {
    core: Gate,
    /// Tasks that may connect, and those that have.
    seats: BTreeSet<TaskUid>,
    doors: BTreeMap<TaskUid, Door>,
    opened: u64,
    agent: Option<u32>,
    /// The newest that is wanted, and the newest that counts.
    asked: u64,
    wanted: u64,
    record: Record,
    /// Whose grant counts, also for a gate that is started again.
    durable: Option<Grant>,
    stops: u64,
}

/// What is being made durable, what comes after it, and what waits for both.
#[derive(Debug, Default)]
struct Record {
    writing: Option<Kept>,
    next: Option<Kept>,
    waits: Vec<(Command, u64)>,
}

/// One life of the agent's hold on its gate.
#[derive(Debug, Default)]
pub(super) struct Hold {
    wanted: Wanted,
    standing: Standing,
    gate: Option<u32>,
    orders: Option<Conn>,
    heard: bool,
    /// With a planted fault: what the agent says without asking its gate.
    forged: u64,
}

impl Hold {
    /// What was wanted up to this number counts.
    pub(super) fn counts(&self, wanted: u64) -> bool {
        self.standing.counts(wanted)
    }

    /// The newest that is wanted.
    pub(super) fn newest(&self) -> u64 {
        self.wanted.id()
    }

    pub(super) fn standing(&self) -> &Standing {
        &self.standing
    }

    /// The agent's process is gone.
    pub(super) fn end(self, hands: &mut Hands<'_>) {
        if let Some(conn) = self.orders {
            hands.net.send_up(conn, Up::End, hands.now, (hands.dice, hands.agenda));
        }
    }

    /// The person's grant that counts.
    pub(super) fn person_epoch(&self) -> u64 {
        self.standing.person_epoch().max(self.forged)
    }
}

impl Hall {
    /// What comes of an event; whether the agent is to be told.
    fn event(&mut self, event: &Event, now: Boot, about: Option<Command>) -> Carried {
        let response = self.core.handle(event, now);
        self.carry_out(response, about)
    }

    fn carry_out(&mut self, response: Response, about: Option<Command>) -> Carried {
        // Nothing wakes it: what is due at some time is done before what comes next, and nobody sees it earlier.
        let mut carried = Carried::default();
        let mut forward = false;
        for effect in response.effects {
            match effect {
                Effect::Keep(kept) => match self.record.writing {
                    None => {
                        self.record.writing = Some(kept);
                        carried.write = true;
                    }
                    Some(_) => self.record.next = Some(kept),
                },
                Effect::Stop(_) => self.stops += 1,
                Effect::Forward => forward = true,
                Effect::Answer(verdict) => carried.verdict = Some(verdict),
                Effect::Report | Effect::Silent | Effect::GiveBack(_) => carried.tell = true,
                // Drivers do what they are told.
                Effect::Hold | Effect::Cut => {}
            }
        }
        match about.filter(|_| forward) {
            Some(command) if self.record.writing.is_some() => {
                self.record.waits.push((command, self.stops));
                carried.verdict = None;
            }
            forwarded => carried.forwarded = forwarded,
        }
        carried
    }

    /// Takes the agent's word, in the order of the real one.
    fn wanted(&mut self, wanted: &proto::Wanted, now: Boot) -> Carried {
        let mut all = Carried::default();
        if let Some(tier) = wanted.estop {
            all.and(self.event(
                &Event::EStop(Source::Controller, Tier::from_number(tier)),
                now,
                None,
            ));
        }
        all.and(self.event(&Event::Release(wanted.release), now, None));
        self.seats = wanted.seats.iter().map(|seat| TaskUid::new(seat.task.as_str())).collect();
        let gone = self.doors.keys().filter(|task| !self.seats.contains(*task));
        for task in gone.cloned().collect::<Vec<_>>() {
            all.and(self.close(&task, now));
        }
        let grant = wanted.grant.as_ref();
        let grant =
            grant.map(|g| Grant { epoch: Epoch(g.epoch), holder: TaskUid::new(g.task.as_str()) });
        all.and(self.event(&Event::Granted(grant), now, None));
        all.and(self.event(&Event::Fenced(Epoch(wanted.fence)), now, None));
        if wanted.leaves_for_ms > 0 {
            let back_within_ms = wanted.leaves_for_ms.into();
            all.and(self.event(&Event::AgentLeaves { back_within_ms }, now, None));
        }
        self.asked = wanted.id;
        if self.record.writing.is_none() {
            self.wanted = wanted.id;
        }
        all.tell = true;
        all
    }

    fn close(&mut self, task: &TaskUid, now: Boot) -> Carried {
        match self.doors.remove(task) {
            Some(door) => self.event(&Event::Closed(door), now, None),
            None => Carried::default(),
        }
    }

    fn status(&mut self) -> proto::Status {
        if self.record.writing.is_none() {
            self.durable = self.core.holder().cloned();
        }
        let estop = self.core.estop();
        let demand = |(source, tier): (&Source, Tier)| proto::Demand {
            source: source.to_string(),
            tier: tier.number(),
        };
        proto::Status {
            wanted: self.wanted,
            holder: self.durable.as_ref().filter(|grant| Some(*grant) == self.core.holder()).map(
                |grant| proto::Holder { task: grant.holder.to_string(), epoch: grant.epoch.0 },
            ),
            estop: Some(proto::EStop {
                tier: estop.tier().number(),
                number: estop.number(),
                demands: estop.demands().map(demand).collect(),
            }),
            drivers: vec![proto::Driver {
                actuators: vec!["base:Drive".to_owned()],
                ..proto::Driver::default()
            }],
            ..proto::Status::default()
        }
    }
}

/// What comes of an event at the gate.
#[derive(Debug, Default)]
struct Carried {
    write: bool,
    tell: bool,
    verdict: Option<Verdict>,
    forwarded: Option<Command>,
}

impl Carried {
    fn and(&mut self, other: Carried) {
        self.write |= other.write;
        self.tell |= other.tell;
    }
}

/// The gate's process, the agent's hold on it, what people order.
impl Agent {
    /// The agent has begun: it wants of its gate what its records say, and hears what people decide.
    pub(super) fn hold_gate(&mut self, hands: &mut Hands<'_>) {
        if self.gate.is_some() {
            let life = self.lives;
            hands.later(self.index, 1, 1, What::Attach(life));
            hands.later(self.index, 1, 20, What::DialOrders(life));
        }
    }

    /// It comes to its gate, and starts one where there is none.
    pub(super) fn attach(&mut self, hands: &mut Hands<'_>) {
        let (now, life) = (self.clock(hands.now), self.lives);
        let Some(gate) = &mut self.gate else { return };
        if gate.hall.is_none() {
            gate.lives += 1;
            let (core, first) = Gate::start(Settings::default(), gate.disk.clone());
            let mut hall = Hall {
                core,
                seats: BTreeSet::new(),
                doors: BTreeMap::new(),
                opened: 0,
                agent: None,
                asked: 0,
                wanted: 0,
                record: Record::default(),
                durable: None,
                stops: 0,
            };
            let _ = hall.carry_out(first, None);
            let _ = hall.event(&Event::DriverBack, now, None);
            gate.hall = Some(hall);
        }
        let lives = gate.lives;
        if let Some(hall) = &mut gate.hall {
            (hall.agent, hall.asked, hall.wanted) = (Some(life), 0, 0);
        }
        if let Some(hold) = self.life.as_mut().map(|life| &mut life.hold) {
            hold.gate = Some(lives);
        }
        self.say_wanted(hands);
    }

    /// Everything that is wanted of the gate goes there.
    fn say_wanted(&mut self, hands: &mut Hands<'_>) {
        let Some(hold) = self.life.as_ref().map(|life| &life.hold) else { return };
        let Some(gate) = hold.gate else { return };
        let said = What::ToGate(gate, self.lives, Box::new(hold.wanted.message()));
        hands.later(self.index, ON_THE_WAY, ON_THE_WAY, said);
    }

    pub(super) fn reaches_gate(
        &mut self,
        (gate, life): (u32, u32),
        wanted: &proto::Wanted,
        hands: &mut Hands<'_>,
    ) {
        self.at_gate(
            hands,
            |hall, now| match hall.agent == Some(life) {
                true => hall.wanted(wanted, now),
                false => Carried::default(),
            },
            Some(gate),
        );
    }

    /// Something happens at the gate, if it is there (and is this one).
    fn at_gate(
        &mut self,
        hands: &mut Hands<'_>,
        happens: impl FnOnce(&mut Hall, Boot) -> Carried,
        only: Option<u32>,
    ) -> Option<Verdict> {
        let now = self.clock(hands.now);
        let gate = self.gate.as_mut()?;
        let lives = gate.lives;
        let hall = gate.hall.as_mut().filter(|_| only.is_none_or(|only| only == lives))?;
        let carried = happens(hall, now);
        let told = carried.tell.then(|| (hall.agent, hall.status()));
        if carried.write {
            hands.later(self.index, 0, 10, What::GateWritten(lives));
        }
        if let Some((Some(life), status)) = told {
            let said = What::FromGate(life, lives, Box::new(status));
            hands.later(self.index, ON_THE_WAY, ON_THE_WAY, said);
        }
        if let Some(command) = carried.forwarded {
            self.is_driven(command, hands);
        }
        carried.verdict
    }

    fn is_driven(&self, command: Command, hands: &mut Hands<'_>) {
        if let Err(violation) = hands.truth.is_commanded(self.index, command) {
            hands.break_with(violation);
        }
    }

    /// The gate's record is on the disk, and what waited for it goes on.
    pub(super) fn gate_written(&mut self, number: u32, hands: &mut Hands<'_>) {
        let full = hands.now < self.full_until;
        let Some(gate) = self.gate.as_mut().filter(|gate| gate.lives == number) else { return };
        let Some(hall) = &mut gate.hall else { return };
        if full {
            // The newest is written at the next try.
            hall.record.writing = hall.record.next.take().or_else(|| hall.record.writing.take());
            return hands.later(self.index, WRITE_AGAIN, WRITE_AGAIN, What::GateWritten(number));
        }
        let Some(kept) = hall.record.writing.take() else { return };
        gate.disk = kept;
        let mut waits = Vec::new();
        match hall.record.next.take() {
            Some(next) => {
                hall.record.writing = Some(next);
                hands.later(self.index, 0, 10, What::GateWritten(number));
            }
            None => {
                hall.wanted = hall.asked;
                let stops = hall.stops;
                waits = std::mem::take(&mut hall.record.waits);
                // One that waited while the robot was stopped comes too late.
                waits.retain(|(_, then)| *then == stops);
            }
        }
        for (command, _) in waits {
            self.is_driven(command, hands);
        }
        let tell = |_: &mut Hall, _| Carried { tell: true, ..Carried::default() };
        self.at_gate(hands, tell, Some(number));
    }

    /// The gate says how it stands.
    pub(super) fn hear_gate(&mut self, gate: u32, status: proto::Status, hands: &mut Hands<'_>) {
        let Some(hold) = self.life.as_mut().map(|life| &mut life.hold) else { return };
        if hold.gate != Some(gate) || hold.standing.status.as_ref() == Some(&status) {
            return;
        }
        let told = |status: &proto::Status| (status.holder.clone(), status.estop.clone());
        let news = hold.standing.status.as_ref().map(told) != Some(told(&status));
        hold.standing.status = Some(status);
        if news {
            self.say_node(hands);
        }
    }

    /// Says who may connect to the gate.
    pub(super) fn admit(
        &mut self,
        uid: &TaskUid,
        seat: Option<Option<u64>>,
        hands: &mut Hands<'_>,
    ) {
        if self.gate.is_none() {
            return;
        }
        let Some(hold) = self.life.as_mut().map(|life| &mut life.hold) else { return };
        let news = match seat {
            Some(epoch) => hold.wanted.seat(uid, uid.as_str(), epoch),
            None => hold.wanted.unseat(uid),
        };
        if news {
            self.say_wanted(hands);
        }
    }

    /// The agent's process is gone.
    pub(super) fn leave_gate(&mut self, hands: &mut Hands<'_>) {
        self.at_gate(
            hands,
            |hall, now| {
                hall.agent = None;
                hall.event(&Event::AgentGone, now, None)
            },
            None,
        );
    }

    /// The agent goes down in order.
    pub(crate) fn leave(&mut self, hands: &mut Hands<'_>) {
        let Some(hold) = self.life.as_mut().map(|life| &mut life.hold) else { return };
        hold.wanted.leave();
        let (wanted, gate) = (hold.wanted.message(), hold.gate);
        self.at_gate(hands, |hall, now| hall.wanted(&wanted, now), Some(gate.unwrap_or(0)));
    }

    /// `kill -9` of the gate. A record that was on its way is there or is not.
    pub(crate) fn kill_gate(&mut self, hands: &mut Hands<'_>) -> bool {
        let Some(gate) = &mut self.gate else { return false };
        let Some(hall) = gate.hall.take() else { return false };
        if let Some(kept) = hall.record.writing.filter(|_| hands.now >= self.full_until)
            && hands.dice.one_in(2)
        {
            gate.disk = kept;
        }
        let life = self.lives;
        if let Some(hold) = self.life.as_mut().map(|life| &mut life.hold) {
            (hold.gate, hold.standing) = (None, Standing::default());
            self.say_node(hands);
            hands.later(self.index, START_AGAIN, START_AGAIN, What::Attach(life));
        }
        true
    }

    /// A button on the robot is pressed, or let go.
    pub(crate) fn button(&mut self, pressed: bool, hands: &mut Hands<'_>) -> bool {
        let tier = if pressed { Tier::Settle } else { Tier::None };
        let source = Source::Local("button".to_owned());
        let there = self.gate.as_ref().is_some_and(|gate| gate.hall.is_some());
        self.at_gate(hands, |hall, now| hall.event(&Event::EStop(source, tier), now, None), None);
        there
    }

    /// A process of a task is gone, and its connection with it.
    pub(super) fn lets_go(&mut self, uid: &TaskUid, hands: &mut Hands<'_>) {
        self.at_gate(hands, |hall, now| hall.close(uid, now), None);
    }

    /// A task commands the robot. None: nobody answers it now.
    pub(crate) fn command(&mut self, command: Command, hands: &mut Hands<'_>) -> Option<Verdict> {
        let happens = |hall: &mut Hall, now| {
            // What tasks say waits until the record is durable; whoever shows nothing that counts is put out.
            if hall.record.writing.is_some() || !hall.seats.contains(&command.task) {
                return Carried::default();
            }
            if !hall.doors.contains_key(&command.task) {
                hall.opened += 1;
                let door = Door(hall.opened);
                hall.doors.insert(command.task.clone(), door);
                let opened = Event::Opened(door, command.task.clone());
                let _ = hall.event(&opened, now, None);
            }
            let door = hall.doors[&command.task];
            let event = Event::Command(door, command.token.clone());
            hall.event(&event, now, Some(command))
        };
        self.at_gate(hands, happens, None)
    }

    /// Whoever holds the robot lets another task drive with this token.
    pub(crate) fn delegate(
        &mut self,
        from: &TaskUid,
        token: Token,
        to: &TaskUid,
        hands: &mut Hands<'_>,
    ) {
        let happens = |hall: &mut Hall, now| match hall.doors.get(from) {
            Some(door) if hall.record.writing.is_none() => {
                hall.event(&Event::Delegate(*door, token, to.clone()), now, None)
            }
            _ => Carried::default(),
        };
        self.at_gate(hands, happens, None);
    }

    /// Dials for the orders of people.
    pub(super) fn dial_orders(&mut self, hands: &mut Hands<'_>) {
        let (index, life) = (self.index, self.lives);
        let Some(hold) = self.life.as_mut().map(|life| &mut life.hold) else { return };
        if hold.orders.is_some() {
            return;
        }
        if hands.net.is_blocked(index) {
            return hands.later(index, GONE_AFTER, GONE_AFTER, What::DialOrders(life));
        }
        let conn = hands.net.open(index);
        hold.orders = Some(conn);
        hands.net.send_up(conn, Up::Orders, hands.now, (hands.dice, hands.agenda));
        hands.later(index, GONE_AFTER, GONE_AFTER, What::OrdersLook(life, conn));
    }

    /// Whether anything passes on the connection still.
    pub(super) fn look_at_orders(&mut self, conn: Conn, hands: &mut Hands<'_>) {
        let (index, life) = (self.index, self.lives);
        if self.life.as_ref().is_none_or(|life| life.hold.orders != Some(conn)) {
            return;
        }
        if !hands.net.is_dead(conn) {
            return hands.later(index, GONE_AFTER, GONE_AFTER, What::OrdersLook(life, conn));
        }
        hands.net.send_up(conn, Up::End, hands.now, (hands.dice, hands.agenda));
        self.lose_orders(hands);
    }

    fn lose_orders(&mut self, hands: &mut Hands<'_>) {
        let Some(hold) = self.life.as_mut().map(|life| &mut life.hold) else { return };
        (hold.orders, hold.heard) = (None, false);
        hands.later(self.index, PAUSE, PAUSE, What::DialOrders(self.lives));
    }

    /// Something comes on that connection. False: it is another one.
    pub(super) fn hear_orders(&mut self, conn: Conn, what: &Down, hands: &mut Hands<'_>) -> bool {
        let hold = self.life.as_mut().map(|life| &mut life.hold);
        let Some(hold) = hold.filter(|hold| hold.orders == Some(conn)) else { return false };
        match what {
            Down::Order(order) => {
                hold.heard = true;
                self.is_ordered(order, hands);
            }
            Down::End => self.lose_orders(hands),
            Down::Message(_) | Down::Event(_) => {}
        }
        true
    }

    fn is_ordered(&mut self, order: &NodeOrder, hands: &mut Hands<'_>) {
        let Some(hold) = self.life.as_mut().map(|life| &mut life.hold) else { return };
        let mut order = *order;
        if hands.mutation == Some(Mutation::ForgedHold) {
            hold.forged = if order.lease_held { order.lease_fence } else { 0 };
            (order.lease_fence, order.lease_held) = (0, false);
        }
        if hold.wanted.order(&order) {
            self.say_wanted(hands);
        }
        if hands.mutation == Some(Mutation::ForgedHold) {
            self.say_node(hands);
        }
    }

    /// Where something is still under way between the robot's gate, its agent and people.
    pub(crate) fn gate_unsettled(&self) -> Option<&'static str> {
        let gate = self.gate.as_ref()?;
        let hold = &self.life.as_ref()?.hold;
        if gate.hall.is_none() {
            return Some("its gate is gone");
        }
        if !hold.heard {
            return Some("nobody hears what people order");
        }
        (!hold.counts(hold.newest())).then_some("its gate does not count what is wanted")
    }

    /// How far it is stopped; none: nothing stands before its drivers.
    pub(crate) fn stopped(&self) -> Option<Tier> {
        Some(self.gate.as_ref()?.hall.as_ref()?.core.estop().tier())
    }

    /// Which grant counts at the gate.
    pub(crate) fn granted(&self) -> Option<&Grant> {
        self.gate.as_ref()?.hall.as_ref()?.core.holder()
    }
}
