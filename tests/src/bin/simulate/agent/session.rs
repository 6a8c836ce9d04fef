//! The agent's half of a session, as its `link` has it: a Hello with everything, reports until they are answered, heartbeats,
//! and another try whenever it breaks.

use std::collections::BTreeMap;
use std::time::Duration;

use muster_agent::assigned::decode;
use muster_agent::{DIAL_PAUSE, report_to_wire};
use muster_agent_core::event::Event;
use muster_agent_core::journal::Journal;
use muster_agent_core::plan::{self, Step};
use muster_agent_core::time::Boot;
use muster_agent_core::workload::{Fetch, Workload};
use muster_api::condition::{ACTUATORS_FENCED, Condition};
use muster_api::id::TaskUid;
use muster_api::kind::node::RuntimeStatus;
use muster_api::name::FunctionName;
use muster_api::pose::Pose;
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::Compute;
use muster_api::wire::agent::v1 as proto;
use muster_api::wire::agent_session::NodeReport;
use proto::agent_message::Body as Say;
use proto::controller_message::Body as Hear;

use super::gate::Hold;
use super::{Agent, Cell, Hands, What};
use crate::mutation::Mutation;
use crate::net::{Conn, Down, Up};

/// First and longest pause between two tries, milliseconds.
pub(super) const PAUSE: (u64, u64) = (millis(DIAL_PAUSE.0), millis(DIAL_PAUSE.1));
/// A connection on which nothing was heard for this long is given up.
const DEAF_AFTER: u64 = millis(muster_agent::DEAF_AFTER);

const fn millis(time: Duration) -> u64 {
    time.as_secs() * 1_000 + time.subsec_millis() as u64
}

/// With a planted fault: what stands by does not wait for as long as it is told.
fn begin_soon(assignment: &mut proto::Assignment) {
    let Ok(mut spec) = serde_json::from_slice::<serde_json::Value>(&assignment.spec) else {
        return;
    };
    if let Some(standby) = spec.get_mut("standby") {
        standby["after"] = "1s".into();
        assignment.spec = spec.to_string().into_bytes();
    }
}

/// One session.
#[derive(Debug)]
pub(super) struct Session {
    conn: Conn,
    begun: u64,
    hello_at: Boot,
    /// What the Hello said.
    hello: Vec<(TaskUid, u64)>,
    /// Once it is welcomed.
    journal: Option<Journal>,
    interval: u64,
    beats: BTreeMap<u64, Boot>,
    beat: u64,
    last_heard: u64,
    /// Of the newest heartbeat that was answered, milliseconds.
    round_trip: Option<u64>,
    /// What it said of the node last, but for where that is.
    node: proto::NodeState,
}

fn without_pose(state: &proto::NodeState) -> proto::NodeState {
    proto::NodeState { pose: None, ..state.clone() }
}

impl Session {
    pub(super) fn is_welcomed(&self) -> bool {
        self.journal.is_some()
    }

    /// The agent's end is closed.
    pub(super) fn end(self, hands: &mut Hands<'_>) {
        hands.net.send_up(self.conn, Up::End, hands.now, (hands.dice, hands.agenda));
    }
}

impl Agent {
    pub(super) fn dial(&mut self, hands: &mut Hands<'_>) {
        if hands.net.is_blocked(self.index) {
            self.redial(hands.now, DEAF_AFTER, hands);
            return;
        }
        let conn = hands.net.open(self.index);
        let hello_at = self.clock(hands.now);
        let state = self.state(hands);
        let node = without_pose(&state);
        let Some(life) = &mut self.life else { return };
        let told = life.tasks.iter().filter_map(|(uid, cell)| Some((uid, cell.told.as_ref()?)));
        let hello: Vec<(TaskUid, u64)> =
            told.clone().map(|(u, r)| (u.clone(), r.sequence)).collect();
        let message = proto::Hello {
            node: self.member.name.to_string(),
            incarnation: format!("{}-{}", self.boot, self.lives),
            version: "simulated".to_owned(),
            state: Some(state),
            tasks: told.map(|(uid, report)| report_to_wire(uid, report)).collect(),
        };
        life.session = Some(Session {
            conn,
            begun: hands.now,
            hello_at,
            hello,
            journal: None,
            interval: 600,
            beats: BTreeMap::new(),
            beat: 0,
            last_heard: hands.now,
            round_trip: None,
            node,
        });
        hands.net.send_up(conn, Up::Open, hands.now, (hands.dice, hands.agenda));
        self.say(Say::Hello(message), hands);
        hands.later(self.index, DEAF_AFTER, DEAF_AFTER, What::NoWelcome(self.lives, conn));
    }

    fn state(&self, hands: &Hands<'_>) -> proto::NodeState {
        let factor = if hands.mutation == Some(Mutation::Overcommit) { 2 } else { 1 };
        let all = Compute::new(MilliCpu(self.room.cpu * factor), Bytes(self.room.memory));
        let functions = |all: &[String]| all.iter().filter_map(|text| text.parse().ok()).collect();
        let runtime = RuntimeStatus {
            name: "process".to_owned(),
            available: true,
            version: String::new(),
            message: String::new(),
        };
        let hold = self.life.as_ref().map(|life| &life.hold);
        let actuators: Vec<FunctionName> = functions(&self.actuators);
        let (conditions, estop) = match (&self.gate, hold) {
            (Some(_), Some(hold)) => {
                (hold.standing().conditions(&actuators), hold.standing().estop())
            }
            _ if actuators.is_empty() => (Vec::new(), None),
            _ => (vec![Condition::new(ACTUATORS_FENCED, false, "NoGate", String::new())], None),
        };
        let mut state = proto::NodeState::from(&NodeReport {
            kind: self.member.kind,
            labels: BTreeMap::new(),
            capacity: all.clone(),
            allocatable: all,
            sensors: functions(&self.sensors),
            actuators,
            pose: self.pose(),
            runtimes: vec![runtime],
            conditions,
            speed: None,
            address: String::new(),
            battery: None,
            mission_locks: Vec::new(),
            estop,
            images: Vec::new(),
        });
        state.person_epoch = hold.map_or(0, Hold::person_epoch);
        state
    }

    /// Says what the node is, when that is news.
    pub(super) fn say_node(&mut self, hands: &mut Hands<'_>) {
        if !self.is_connected() {
            return;
        }
        let state = self.state(hands);
        let session = self.life.as_mut().and_then(|life| life.session.as_mut());
        let Some(session) = session.filter(|session| session.node != without_pose(&state)) else {
            return;
        };
        session.node = without_pose(&state);
        let (name, person) = (&self.member.name, state.person_epoch);
        let stopped = state.estop.as_ref().map(|estop| estop.tier);
        hands.log.say(
            hands.now,
            format_args!("{name} says how its gate stands: stopped {stopped:?}, person {person}"),
        );
        self.say(Say::Node(state), hands);
    }

    fn pose(&self) -> Option<Pose> {
        let (x, y) = self.place?;
        Some(Pose {
            map: "map".to_owned(),
            x,
            y,
            z: 0.0,
            yaw: 0.0,
            stamp: None,
            source: "simulated".to_owned(),
            localized: true,
            covariance: None,
        })
    }

    /// The robot is somewhere else.
    pub(crate) fn moved(&mut self, place: (f64, f64), hands: &mut Hands<'_>) {
        self.place = Some(place);
        let welcomed = self.is_connected();
        if let Some(pose) = self.pose().filter(|_| welcomed) {
            self.say(Say::Pose((&pose).into()), hands);
        }
    }

    fn say(&mut self, body: Say, hands: &mut Hands<'_>) {
        let Some(session) = self.life.as_ref().and_then(|life| life.session.as_ref()) else {
            return;
        };
        let message = Box::new(proto::AgentMessage { body: Some(body) });
        let chance = (&mut *hands.dice, &mut *hands.agenda);
        hands.net.send_up(session.conn, Up::Message(message), hands.now, chance);
    }

    /// Says one report once more, as after a time without an answer.
    pub(crate) fn say_again(&mut self, hands: &mut Hands<'_>) -> bool {
        let Some(life) = self.life.as_ref().filter(|_| self.is_connected()) else { return false };
        let told: Vec<_> =
            life.tasks.iter().filter_map(|(u, cell)| Some((u, cell.told.as_ref()?))).collect();
        let Some((uid, report)) = hands.dice.pick(&told) else { return false };
        let report = report_to_wire(uid, report);
        self.say(Say::Task(report), hands);
        true
    }

    /// The connection breaks: the agent is told now or later, or finds it out.
    pub(crate) fn cut(&mut self, hands: &mut Hands<'_>) {
        let session = self.life.as_mut().and_then(|life| life.session.take());
        if let Some(session) = session {
            hands.net.black_out(session.conn);
            self.redial(session.begun, 0, hands);
        }
    }

    /// `least`: how long this try takes at least, milliseconds.
    fn redial(&mut self, begun: u64, least: u64, hands: &mut Hands<'_>) {
        let Some(life) = &mut self.life else { return };
        life.session = None;
        if (hands.now + least).saturating_sub(begun) > PAUSE.1 {
            life.pause = PAUSE.0;
        }
        let wait = least + life.pause;
        life.pause = (life.pause * 2).min(PAUSE.1);
        hands.later(self.index, wait, wait, What::Dial(self.lives));
    }

    fn give_up(&mut self, hands: &mut Hands<'_>) {
        let Some(session) = self.life.as_mut().and_then(|life| life.session.take()) else { return };
        let begun = session.begun;
        session.end(hands);
        self.redial(begun, 0, hands);
    }

    pub(super) fn no_welcome(&mut self, conn: Conn, hands: &mut Hands<'_>) {
        let session = self.life.as_ref().and_then(|life| life.session.as_ref());
        if session.is_some_and(|s| s.conn == conn && s.journal.is_none()) {
            self.give_up(hands);
        }
    }

    pub(super) fn beat(&mut self, conn: Conn, hands: &mut Hands<'_>) {
        let at = self.clock(hands.now);
        let session = self.life.as_mut().and_then(|life| life.session.as_mut());
        let Some(session) = session.filter(|session| session.conn == conn) else { return };
        if hands.now - session.last_heard > DEAF_AFTER.max(session.interval * 4) {
            return self.give_up(hands);
        }
        session.beat += 1;
        session.beats.insert(session.beat, at);
        let (sequence, interval) = (session.beat, session.interval);
        let link = session
            .round_trip
            .map(|millis| proto::Link { round_trip_usec: millis * 1_000, late_permille: 0 });
        let usage = self.told(hands);
        let heartbeat = proto::Heartbeat { sequence, usage, link, ..proto::Heartbeat::default() };
        self.say(Say::Heartbeat(heartbeat), hands);
        self.say_reports(hands);
        hands.later(self.index, interval, interval, What::Beat(self.lives, conn));
    }

    /// What programs tell of topics and signals.
    fn told(&self, hands: &Hands<'_>) -> Vec<proto::TaskUsage> {
        let told = hands.truth.told;
        let live = self.kernel.attempts.iter();
        let tell = live.filter(|(_, attempt)| attempt.program.tells && attempt.exit.is_none());
        let say = |name: &str, value| proto::Told { name: name.to_owned(), value };
        tell.map(|((uid, _), _)| proto::TaskUsage {
            uid: uid.to_string(),
            usage: None,
            told: vec![say("/image", told.hz), say("tilt", told.tilt)],
        })
        .collect()
    }

    pub(super) fn say_reports(&mut self, hands: &mut Hands<'_>) {
        let now = self.clock(hands.now);
        let Some(life) = &mut self.life else { return };
        let journal = life.session.as_mut().and_then(|session| session.journal.as_mut());
        let Some(journal) = journal else { return };
        let mut due = Vec::new();
        for (uid, cell) in &life.tasks {
            let Some(report) = &cell.told else { continue };
            if hands.mutation == Some(Mutation::LostEnd) && report.content.phase.is_terminal() {
                continue;
            }
            if journal.is_due(uid, report.sequence, cell.acknowledged, now) {
                due.push(report_to_wire(uid, report));
            }
        }
        for report in due {
            self.say(Say::Task(report), hands);
        }
    }

    /// Something of the controller arrives.
    pub(crate) fn hear(&mut self, conn: Conn, what: Down, hands: &mut Hands<'_>) {
        if self.hear_orders(conn, &what, hands) {
            return;
        }
        let session = self.life.as_mut().and_then(|life| life.session.as_mut());
        let Some(session) = session.filter(|session| session.conn == conn) else { return };
        session.last_heard = hands.now;
        let begun = session.begun;
        let body = match what {
            Down::End => return self.redial(begun, 0, hands),
            Down::Message(message) => message.body,
            // On other connections.
            Down::Event(_) | Down::Order(_) => return,
        };
        match body {
            Some(Hear::Welcome(welcome)) => {
                let hello = std::mem::take(&mut session.hello);
                session.interval = u64::from(welcome.heartbeat_interval_ms);
                let at = session.hello_at;
                let now = Boot(hands.now.saturating_sub(self.booted_at));
                session.journal = Some(Journal::begun(hello, now));
                self.made_contact(at);
                let uids: Vec<TaskUid> =
                    self.life.iter().flat_map(|life| life.tasks.keys().cloned()).collect();
                for uid in uids {
                    self.tell(&uid, Event::Tick, hands);
                }
                self.beat(conn, hands);
                self.say_node(hands);
            }
            Some(Hear::Assignments(assignments)) => self.assign(assignments, hands),
            Some(Hear::Heartbeat(answer)) => {
                let sent = session.beats.remove(&answer.sequence);
                session.beats.retain(|sequence, _| *sequence > answer.sequence);
                if let Some(sent) = sent {
                    let now = hands.now.saturating_sub(self.booted_at);
                    session.round_trip = Some(now.saturating_sub(sent.0));
                    self.made_contact(sent);
                }
            }
            Some(Hear::Task(answer)) => {
                let uid = TaskUid::new(answer.uid);
                let cell = self.life.as_mut().and_then(|life| life.tasks.get_mut(&uid));
                if let Some(cell) = cell {
                    cell.acknowledged = cell.acknowledged.max(answer.sequence);
                }
            }
            _ => {}
        }
    }

    fn assign(&mut self, mut message: proto::Assignments, hands: &mut Hands<'_>) {
        let context = self.context(hands);
        let Some(life) = &mut self.life else { return };
        if hands.mutation == Some(Mutation::HastyStandby) {
            message.upserts.iter_mut().for_each(begin_soon);
        }
        for upsert in &message.upserts {
            if let Some(framework) = &upsert.framework {
                let uid = TaskUid::new(upsert.uid.as_str());
                hands.truth.launched.insert(uid, framework.id.clone());
            }
        }
        let keep = |wire: &proto::Assignment, spec| Agent::kept(wire, &spec);
        let (assignments, mut kept) = decode(message, |uid| life.tasks.contains_key(uid), keep);
        let known = life.tasks.iter().map(|(uid, cell)| (uid.clone(), cell.forgotten)).collect();
        let mut told = Vec::new();
        for step in plan::plan(assignments, &known).steps {
            let (uid, event) = match step {
                Step::Create(uid, desired) => {
                    let Some(kept) = kept.remove(&uid) else { continue };
                    let (workload, response) =
                        Workload::assigned(uid.clone(), desired, Fetch::Nothing, context);
                    life.tasks.insert(uid.clone(), Cell::new(workload, kept, response.effects));
                    (uid, None)
                }
                Step::Refuse(uid, why) => {
                    let Some(kept) = kept.remove(&uid) else { continue };
                    let (workload, response) = Workload::unreadable(uid.clone(), why, context);
                    life.tasks.insert(uid.clone(), Cell::new(workload, kept, response.effects));
                    (uid, None)
                }
                Step::Tell(uid, event) => (uid, Some(event)),
            };
            let Some(cell) = life.tasks.get_mut(&uid) else { continue };
            if let (Some(Event::Assigned(_)), Some(kept)) = (&event, kept.remove(&uid)) {
                cell.kept = kept;
            }
            cell.forgotten |= event == Some(Event::Forgotten);
            cell.inbox.extend(event);
            told.push(uid);
        }
        for uid in told {
            self.pump(&uid, hands);
        }
        self.look_at_others(hands);
    }
}
