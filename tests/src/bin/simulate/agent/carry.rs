//! What the core decides, carried out over the modelled kernel and disk.

use muster_agent_core::depend::{self, Seen};
use muster_agent_core::event::{Effect, Event, Failure, Outcome};
use muster_agent_core::observed::{End, Exit};
use muster_agent_core::workload::State;
use muster_api::id::TaskUid;

use super::{Agent, Cell, Hands, Record, What, removed_alive};
use crate::mutation::Mutation;

/// As the real driver waits for its gate, and looks whether it may go on, milliseconds.
const GATE_WITHIN: u64 = 5_000;
const LOOK_EVERY: u64 = 3;
/// Between two tries of the agent to make a record durable, milliseconds.
const WRITE_AGAIN: u64 = 1_000;

/// Whether it may connect to the gate, and with which grant it drives.
fn seat(cell: &Cell) -> Option<Option<u64>> {
    cell.workload.state.may_be_live().then_some(cell.kept.program.takes.drives)
}

impl Agent {
    /// Goes on with a task until it waits for something.
    pub(super) fn pump(&mut self, uid: &TaskUid, hands: &mut Hands<'_>) {
        let Some(mut cell) = self.life.as_mut().and_then(|life| life.tasks.remove(uid)) else {
            return;
        };
        let mut published = false;
        while !cell.writing && !cell.dropped {
            if let Some(effect) = cell.effects.pop_front() {
                published |= effect == Effect::Publish;
                self.carry(uid, &mut cell, effect, hands);
            } else if let Some(event) = cell.inbox.pop_front() {
                let context = self.context(hands);
                let before = cell.workload.state.clone();
                let response = cell.workload.handle(event, context);
                if cell.workload.state != before {
                    let (name, state) = (self.name(), &cell.workload.state);
                    hands.log.say(
                        hands.now,
                        format_args!("{name}: {} {state:?}", cell.kept.program.name),
                    );
                }
                cell.effects = response.effects.into();
                self.admit(uid, seat(&cell), hands);
            } else {
                break;
            }
        }
        let dropped = cell.dropped;
        if let Some(life) = self.life.as_mut().filter(|_| !dropped) {
            life.tasks.insert(uid.clone(), cell);
        }
        if published {
            self.say_reports(hands);
            self.look_at_others(hands);
        }
    }

    /// The gate knows whether the task may connect.
    pub(super) fn seat(&mut self, uid: &TaskUid, hands: &mut Hands<'_>) {
        let cell = self.life.as_ref().and_then(|life| life.tasks.get(uid));
        if let Some(seat) = cell.map(seat) {
            self.admit(uid, seat, hands);
        }
    }

    /// Tells tasks how those stand that they wait for, where that is news.
    pub(super) fn look_at_others(&mut self, hands: &mut Hands<'_>) {
        let Some(life) = &self.life else { return };
        let seen = |uid: &str| {
            let cell = life.tasks.get(&TaskUid::new(uid))?;
            let report = cell.told.as_ref()?;
            Some(Seen {
                phase: report.content.phase.into(),
                ready: report.content.ready,
                attempt: cell.workload.attempt,
                known: !matches!(cell.workload.state, State::Recovering { .. }),
            })
        };
        let mut news = Vec::new();
        for (uid, cell) in &life.tasks {
            let depends = &cell.workload.desired.depends;
            let now = (!depends.is_empty()).then(|| depend::standing(depends, seen));
            if now.is_some() && now != cell.standing {
                news.extend(now.map(|now| (uid.clone(), now)));
            }
        }
        for (uid, standing) in news {
            let cell = self.life.as_mut().and_then(|life| life.tasks.get_mut(&uid));
            cell.into_iter().for_each(|cell| cell.standing = Some(standing.clone()));
            self.tell(&uid, Event::Dependencies(standing), hands);
        }
    }

    fn carry(&mut self, uid: &TaskUid, cell: &mut Cell, effect: Effect, hands: &mut Hands<'_>) {
        match effect {
            Effect::Persist => {
                cell.writing = true;
                hands.later(self.index, 0, 10, What::Written(self.lives, uid.clone()));
            }
            Effect::Publish => cell.told = Some(cell.workload.report.clone()),
            Effect::WakeAt(at) => {
                let wait = (self.booted_at + at.0).saturating_sub(hands.now).max(1);
                hands.later(self.index, wait, wait, What::Wake(self.lives, uid.clone()));
            }
            Effect::Launch(attempt) => {
                let wanted = self.life.as_ref().map_or(0, |life| life.hold.newest());
                let clear = cell.kept.program.takes.drives.is_none() || self.gate.is_none();
                let until = if clear { 0 } else { hands.now + GATE_WITHIN };
                self.launch(uid, attempt, (wanted, until), hands);
            }
            Effect::Watch(attempt) => {
                let id = (uid.clone(), attempt);
                match self.kernel.attempts.get(&id).and_then(|known| known.exit.clone()) {
                    Some(exit) => self.say_exit(uid, attempt, exit, hands),
                    None => {
                        self.life.iter_mut().for_each(|life| life.watches.extend([id.clone()]));
                    }
                }
            }
            Effect::Drop => {
                self.disk.remove(uid);
                cell.dropped = true;
            }
            Effect::Remove => {
                cell.told = None;
                hands.later(self.index, 0, 20, What::Perform(self.lives, uid.clone(), effect));
            }
            Effect::Find(_) | Effect::Stop { .. } => {
                hands.later(self.index, 0, 20, What::Perform(self.lives, uid.clone(), effect));
            }
            // Only of what is fetched: processes of the host are there.
            Effect::Prepare(_) | Effect::CancelPrepare => {}
        }
    }

    pub(super) fn written(&mut self, uid: TaskUid, hands: &mut Hands<'_>) {
        if hands.now < self.full_until {
            let again = What::Written(self.lives, uid);
            return hands.later(self.index, WRITE_AGAIN, WRITE_AGAIN, again);
        }
        let cell = self.life.as_mut().and_then(|life| life.tasks.get_mut(&uid));
        let Some(cell) = cell else { return };
        cell.writing = false;
        let record =
            Record { boot: self.boot, kept: cell.kept.clone(), workload: cell.workload.clone() };
        self.keep(uid.clone(), record, hands);
        self.pump(&uid, hands);
    }

    fn answer(&mut self, uid: &TaskUid, attempt: u32, outcome: Outcome, hands: &mut Hands<'_>) {
        let answer = Box::new(Event::Attempt(attempt, outcome));
        hands.later(self.index, 0, 20, What::Answer(self.lives, uid.clone(), answer));
    }

    /// Starts an attempt when its gate counts what was `wanted`; `until`: it waits so long for that, 0: it need not.
    pub(super) fn launch(
        &mut self,
        uid: &TaskUid,
        attempt: u32,
        (wanted, until): (u64, u64),
        hands: &mut Hands<'_>,
    ) {
        if until > 0 && self.life.as_ref().is_none_or(|life| !life.hold.counts(wanted)) {
            if hands.now >= until {
                let (reason, message) = ("GateDown".to_owned(), "it does not answer".to_owned());
                let failure = Failure { reason, message, retry: true };
                return self.answer(uid, attempt, Outcome::LaunchFailed(failure), hands);
            }
            let (life, uid) = (self.lives, uid.clone());
            let again = What::Cleared { life, uid, attempt, wanted, until };
            return hands.later(self.index, LOOK_EVERY, LOOK_EVERY, again);
        }
        let claim = self.kernel.claim(uid);
        let luck = hands.dice.between(0, 59) + if hands.truth.calm { 3 } else { 0 };
        if luck == 0 {
            let (reason, message) = ("NodeError".to_owned(), "cannot fork".to_owned());
            let failure = Failure { reason, message, retry: true };
            return self.answer(uid, attempt, Outcome::LaunchFailed(failure), hands);
        }
        if luck == 1 {
            return self.answer(uid, attempt, Outcome::LaunchUnclear, hands);
        }
        let (boot, life, uid) = (self.boot, self.lives, uid.clone());
        let start = What::Start { boot, life, uid, attempt, claim, unclear: luck == 2 };
        hands.later(self.index, 0, 20, start);
    }

    /// A runtime does what it was asked.
    pub(super) fn perform(&mut self, uid: &TaskUid, effect: &Effect, hands: &mut Hands<'_>) {
        let fails = hands.dice.one_in(40) && !hands.truth.calm;
        match effect {
            Effect::Find(attempt) if fails => {
                self.answer(uid, *attempt, Outcome::FindFailed, hands)
            }
            Effect::Find(attempt) => {
                let found = self.kernel.find(uid, *attempt);
                self.answer(uid, *attempt, Outcome::Found(found), hands);
            }
            Effect::Stop { attempt, .. } if fails => {
                self.answer(uid, *attempt, Outcome::StopFailed, hands);
            }
            Effect::Stop { attempt, grace_ms } => self.stop(uid, *attempt, *grace_ms, hands),
            Effect::Remove => {
                let lies = hands.mutation == Some(Mutation::DoubleLease);
                let done = !fails && (self.kernel.remove(uid) || lies);
                if !done && !fails {
                    hands.break_with(removed_alive(uid));
                }
                let event = if done { Event::Removed } else { Event::RemoveFailed };
                self.tell(uid, event, hands);
            }
            _ => {}
        }
    }

    /// The shim has the order, and keeps its time.
    fn stop(&mut self, uid: &TaskUid, attempt: u32, grace_ms: u64, hands: &mut Hands<'_>) {
        let wall = self.wall(hands);
        let Some(known) = self.kernel.attempts.get_mut(&(uid.clone(), attempt)) else { return };
        if known.exit.is_some() {
            return;
        }
        if !known.ordered {
            hands.truth.ordered.push((hands.now, uid.clone()));
        }
        known.ordered = true;
        hands
            .log
            .say(hands.now, format_args!("{} is to end {uid}, {grace_ms} ms", self.member.name));
        let (drives, started) = (known.program.takes.drives, known.started);
        if hands.mutation == Some(Mutation::DeafToStops) {
            return;
        }
        if drives.is_some() && hands.mutation == Some(Mutation::DoubleLease) {
            let (oom_killed, disconnected) = (false, false);
            let (started_at, finished_at) = (Some(started), wall);
            let end = End::Signaled(9);
            let exit = Exit { end, oom_killed, disconnected, started_at, finished_at };
            return self.answer(uid, attempt, Outcome::Exited(exit), hands);
        }
        // Most programs go when they are asked to, some only when they are killed.
        let asked = hands.dice.one_in(4);
        let wait = if asked { grace_ms.max(1) } else { hands.dice.between(1, grace_ms.max(1)) };
        let end = match hands.dice.between(0, 2) {
            _ if asked => End::Signaled(9),
            0 => End::Exited(0),
            1 => End::Exited(143),
            _ => End::Signaled(15),
        };
        let (boot, uid) = (self.boot, uid.clone());
        hands.later(self.index, wait, wait, What::Ends { boot, uid, attempt, end });
    }
}
