//! The gate: who may command a robot's actuators, decided for each command; and when the robot is stopped.
//!
//! One gate a conflict group. Its executor (the gate process) is the only one that talks to the drivers of the group. An
//! [`Event`] goes in, a [`Response`] comes out; effects are carried out in their order, and an answer is the last of them, so
//! whoever reads an answer knows that what it says has happened.
//!
//! | file | holds |
//! |---|---|
//! | `token` | which of two lease tokens is newer |
//! | `estop` | the emergency stop, apart from leases |
//! | `ladder` | what follows when whoever drives is silent |
//!
//! What it promises:
//!
//! - A command is forwarded only for the task that the controller granted the robot last, or for whom that task delegated to,
//!   and never with a token older than one that was accepted before.
//! - A grant that is taken back counts before that is answered. The robot is stopped with it.
//! - The robot is stopped when whoever drove it is gone or silent, when the agent is gone, when the gate starts, and when any
//!   source demands an emergency stop. No command is ever repeated.
//!
//! Rules of tokens and delegation: Spot's lease service (bosdyn.api.lease).

mod estop;
mod ladder;
#[cfg(test)]
mod tests;
mod token;

use std::collections::BTreeMap;
use std::fmt;

use muster_api::id::{Epoch, TaskUid};
use serde::{Deserialize, Serialize};

use crate::time::Boot;
pub use estop::{EStop, Source};
use ladder::Ladder;
pub use ladder::{Action, DEFAULT as DEFAULT_LADDER, Step};
pub use muster_api::kind::node::estop::EStopTier as Tier;
pub use token::{DEEPEST, Relation, Token, TokenError};

/// A connection to the gate. Numbers are never used twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Conn(pub u64);

/// The controller's grant.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Grant {
    /// Its number.
    pub epoch: Epoch,
    /// Whose it is.
    pub holder: TaskUid,
}

/// What must not be forgotten: a gate that was started again knows it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Kept {
    /// The newest token that was granted or accepted.
    pub newest: Token,
    /// What is demanded.
    pub estop: EStop,
}

impl Default for Kept {
    fn default() -> Self {
        Kept { newest: Token::root(Epoch(0)), estop: EStop::default() }
    }
}

/// How the gate is set up.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Settings {
    /// What follows when whoever drives is silent.
    pub ladder: Vec<Step>,
    /// How long the robot may go on when the agent is gone, milliseconds.
    pub agent_grace_ms: u64,
}

impl Default for Settings {
    fn default() -> Self {
        Settings { ladder: DEFAULT_LADDER.to_vec(), agent_grace_ms: 0 }
    }
}

/// What happens to a gate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event {
    /// The agent says whose the robot is: all that counts, said at the start of each connection and at each change.
    Granted(Option<Grant>),
    /// What was granted before this number never counts again, whether somebody holds the robot or not. Said after
    /// the grant that counts: one with this number is the person's.
    Fenced(Epoch),
    /// The agent is going down in order, and back within this time, milliseconds.
    AgentLeaves {
        /// At most so long is the robot without it.
        back_within_ms: u64,
    },
    /// The agent's connection is gone.
    AgentGone,
    /// A task has shown who it is.
    Opened(Conn, TaskUid),
    /// A connection is gone.
    Closed(Conn),
    /// A command for a driver.
    Command(Conn, Token),
    /// A sign of life.
    Retain(Conn),
    /// Whoever holds the robot lets this task drive with this token and with those under it.
    Delegate(Conn, Token, TaskUid),
    /// A source says how far the robot must be stopped.
    EStop(Source, Tier),
    /// A person releases the stops up to this number.
    Release(u64),
    /// A driver is there again; its last command is not known.
    DriverBack,
    /// Time has passed.
    Tick,
}

/// What is said to a command or a delegation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// It was handed to the driver; the delegation counts.
    Ok,
    /// A newer token was accepted or delegated before.
    Older,
    /// The grant was this task's, and was taken back.
    Revoked,
    /// The token is not this task's.
    NotHolder,
    /// The gate does not know the grant, or whether it still counts: the agent has not said so yet, or is gone.
    Unknown,
    /// An emergency stop is in force.
    Stopped,
}

/// Why the robot is stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StopReason {
    /// The gate begins and does not know what was commanded before.
    GateStarts,
    /// The driver begins, or is there again.
    DriverStarts,
    /// Whoever drove is gone.
    HolderGone,
    /// The grant was taken back, or given to another.
    Revoked,
    /// Whoever drives is silent.
    Silent,
    /// The agent is gone.
    AgentGone,
    /// An emergency stop.
    EStop(Tier),
}

impl fmt::Display for StopReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            StopReason::GateStarts => f.write_str("the gate starts"),
            StopReason::DriverStarts => f.write_str("the driver starts"),
            StopReason::HolderGone => f.write_str("whoever drove is gone"),
            StopReason::Revoked => f.write_str("the lease was taken back"),
            StopReason::Silent => f.write_str("whoever drives is silent"),
            StopReason::AgentGone => f.write_str("the agent is gone"),
            StopReason::EStop(tier) => write!(f, "emergency stop, {tier}"),
        }
    }
}

/// What is to be done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Effect {
    /// Before the next effect this is durable.
    Keep(Kept),
    /// Every driver of the group gets its stop command.
    Stop(StopReason),
    /// Every driver of the group gets its hold command.
    Hold,
    /// Every driver cuts the motors' power.
    Cut,
    /// The command of this event goes to its driver.
    Forward,
    /// The event's connection is answered.
    Answer(Verdict),
    /// The agent is told: the ladder's log step.
    Silent,
    /// The agent is told: the holder's right is given back.
    GiveBack(Grant),
    /// The agent is told how things stand.
    Report,
}

/// What comes out of an event.
#[must_use]
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Response {
    /// In their order.
    pub effects: Vec<Effect>,
    /// When a tick is wanted.
    pub wake: Option<Boot>,
}

/// The agent's hold on the gate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Grip {
    /// It is there.
    Held,
    /// It is gone, and the robot may go on until then.
    Until(Boot),
    /// It is gone.
    Lost,
}

/// Who gave the last command that was accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Driving {
    conn: Conn,
    commanded: Boot,
    /// Nothing has stopped the robot since.
    moves: bool,
}

/// A right that was handed on.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Delegate {
    token: Token,
    to: TaskUid,
}

/// One conflict group's gate.
#[derive(Debug)]
pub struct Gate {
    settings: Settings,
    kept: Kept,
    grant: Option<Grant>,
    /// The grant before: its task is told that it was revoked.
    former: Option<Grant>,
    delegates: Vec<Delegate>,
    conns: BTreeMap<Conn, TaskUid>,
    driving: Option<Driving>,
    ladder: Ladder,
    /// The last sign of life of whoever may drive, once somebody has driven with the grant.
    alive: Option<Boot>,
    grip: Grip,
}

impl Gate {
    /// A gate that starts, with what an earlier one kept. The first thing it does is to stop the robot: what was commanded
    /// before is not known.
    pub fn start(settings: Settings, kept: Kept) -> (Gate, Response) {
        let ladder = Ladder::new(settings.ladder.clone());
        let tier = kept.estop.tier();
        let gate = Gate {
            settings,
            kept,
            grant: None,
            former: None,
            delegates: Vec::new(),
            conns: BTreeMap::new(),
            driving: None,
            ladder,
            alive: None,
            grip: Grip::Lost,
        };
        let mut effects = vec![Effect::Stop(StopReason::GateStarts)];
        if tier == Tier::Cut {
            effects.push(Effect::Cut);
        }
        (gate, Response { effects, wake: None })
    }

    /// Who holds the robot, and the newest token.
    #[must_use]
    pub fn holder(&self) -> Option<&Grant> {
        self.grant.as_ref()
    }

    /// The newest token that was granted or accepted.
    #[must_use]
    pub fn newest(&self) -> &Token {
        &self.kept.newest
    }

    /// What is demanded.
    #[must_use]
    pub fn estop(&self) -> &EStop {
        &self.kept.estop
    }

    /// A command was forwarded, and nothing has stopped the robot since.
    #[must_use]
    pub fn is_driven(&self) -> bool {
        self.driving.is_some_and(|driving| driving.moves)
    }

    /// Takes in one event.
    pub fn handle(&mut self, event: &Event, now: Boot) -> Response {
        let mut effects = Vec::new();
        // What is due comes first: a command that comes too late does not undo the stop before it.
        self.pass_time(now, &mut effects);
        match event {
            Event::Granted(grant) => self.granted(grant.as_ref(), &mut effects),
            Event::Fenced(fence) => self.fenced(*fence, &mut effects),
            Event::AgentLeaves { back_within_ms } => {
                if self.grip == Grip::Held {
                    self.grip = Grip::Until(now.plus(*back_within_ms));
                }
            }
            Event::AgentGone => self.agent_gone(now, &mut effects),
            Event::Opened(conn, task) => drop(self.conns.insert(*conn, task.clone())),
            Event::Closed(conn) => {
                self.conns.remove(conn);
                // Its task has ended, or will say something again: that it is silent is the runtime's to judge.
                if self
                    .grant
                    .as_ref()
                    .is_some_and(|grant| !self.conns.values().any(|task| *task == grant.holder))
                {
                    self.alive = None;
                }
                if self.driving.is_some_and(|driving| driving.conn == *conn) {
                    self.stop(StopReason::HolderGone, &mut effects);
                }
            }
            Event::Command(conn, token) => {
                self.lives(*conn, now);
                self.command(*conn, token, now, &mut effects);
            }
            Event::Retain(conn) => self.lives(*conn, now),
            Event::Delegate(conn, token, to) => {
                self.lives(*conn, now);
                let verdict = self.delegate(*conn, token, to, &mut effects);
                effects.push(Effect::Answer(verdict));
            }
            Event::EStop(source, tier) => self.demand(source, *tier, &mut effects),
            Event::Release(number) => {
                let mut estop = self.kept.estop.clone();
                estop.release(*number);
                self.set_estop(estop, &mut effects);
            }
            Event::DriverBack => self.stop(StopReason::DriverStarts, &mut effects),
            Event::Tick => {}
        }
        Response { effects, wake: self.wake() }
    }

    fn wake(&self) -> Option<Boot> {
        let silent = self.driving.and_then(|driving| self.ladder.next(driving.commanded));
        let grip = match self.grip {
            Grip::Until(when) => Some(when),
            Grip::Held | Grip::Lost => None,
        };
        silent.into_iter().chain(grip).chain(self.given_back_at()).min()
    }

    fn pass_time(&mut self, now: Boot, effects: &mut Vec<Effect>) {
        if let Grip::Until(when) = self.grip
            && when <= now
        {
            self.grip = Grip::Lost;
            self.stop(StopReason::AgentGone, effects);
        }
        if self.given_back_at().is_some_and(|when| when <= now) {
            self.alive = None;
            effects.extend(self.grant.clone().map(Effect::GiveBack));
        }
        let Some(driving) = self.driving else { return };
        for action in self.ladder.due(driving.commanded, now) {
            match action {
                Action::Log => effects.push(Effect::Silent),
                Action::Hold => effects.push(Effect::Hold),
                Action::Stop => {
                    self.driving = Some(Driving { moves: false, ..driving });
                    effects.push(Effect::Stop(StopReason::Silent));
                }
                Action::Release => {}
            }
        }
    }

    /// The grant is given back when neither its holder nor a delegate has said anything for that long. A robot that is stopped
    /// meanwhile changes nothing in that.
    fn given_back_at(&self) -> Option<Boot> {
        let steps = self.settings.ladder.iter().filter(|step| step.action == Action::Release);
        let after = steps.map(|step| step.after_ms).min()?;
        Some(self.alive?.plus(after))
    }

    /// A sign of life, if it is of one who may drive.
    fn lives(&mut self, conn: Conn, now: Boot) {
        let Some(task) = self.conns.get(&conn) else { return };
        let holds = self.grant.as_ref().is_some_and(|grant| grant.holder == *task);
        if self.alive.is_some() && (holds || self.delegates.iter().any(|d| d.to == *task)) {
            self.alive = Some(now);
        }
    }

    /// The robot is stopped, and nobody drives it until the next command.
    fn stop(&mut self, why: StopReason, effects: &mut Vec<Effect>) {
        self.driving = None;
        self.ladder.rest();
        effects.push(Effect::Stop(why));
        // A stop takes the place of what waits for a driver, so a cut that is in force is said again.
        if self.kept.estop.tier() == Tier::Cut {
            effects.push(Effect::Cut);
        }
    }

    fn granted(&mut self, grant: Option<&Grant>, effects: &mut Vec<Effect>) {
        self.grip = Grip::Held;
        let newest = self.kept.newest.epoch;
        // An agent that was started again on an older record must not bring an older holder back; nor may two tasks have one
        // number. Such a grant is none: whoever held the robot does not hold it any more, either.
        let counts = |grant: &&Grant| match &self.grant {
            _ if grant.epoch > newest => true,
            Some(present) => *grant == present,
            None => {
                let again = self.former.as_ref().is_none_or(|former| former == *grant);
                grant.epoch == newest && again
            }
        };
        let grant = grant.filter(counts);
        if grant == self.grant.as_ref() {
            return;
        }
        let before = std::mem::replace(&mut self.grant, grant.cloned());
        self.delegates.clear();
        self.alive = None;
        // The robot first, the record after. The new holder hears of its right when the record is there.
        if before.is_some() {
            self.former = before;
            self.stop(StopReason::Revoked, effects);
        }
        if let Some(grant) = grant.filter(|grant| grant.epoch > newest) {
            self.kept.newest = Token::root(grant.epoch);
            effects.push(Effect::Keep(self.kept.clone()));
        }
        effects.push(Effect::Report);
    }

    /// Durable like a grant: the agent may forget it, and a gate that is started again must not.
    fn fenced(&mut self, fence: Epoch, effects: &mut Vec<Effect>) {
        if fence <= self.kept.newest.epoch {
            return;
        }
        if let Some(before) = self.grant.take() {
            self.former = Some(before);
            self.delegates.clear();
            self.alive = None;
            self.stop(StopReason::Revoked, effects);
        }
        self.kept.newest = Token::root(fence);
        effects.extend([Effect::Keep(self.kept.clone()), Effect::Report]);
    }

    fn agent_gone(&mut self, now: Boot, effects: &mut Vec<Effect>) {
        match (self.grip, self.settings.agent_grace_ms) {
            // It said so before.
            (Grip::Until(_) | Grip::Lost, _) => {}
            (Grip::Held, 0) => {
                self.grip = Grip::Lost;
                self.stop(StopReason::AgentGone, effects);
            }
            (Grip::Held, grace) => self.grip = Grip::Until(now.plus(grace)),
        }
    }

    fn command(&mut self, conn: Conn, token: &Token, now: Boot, effects: &mut Vec<Effect>) {
        let verdict = self.judge(conn, token);
        if verdict == Verdict::Ok {
            self.accept(token, effects);
            self.driving = Some(Driving { conn, commanded: now, moves: true });
            self.alive = Some(now);
            self.ladder.commanded();
            effects.push(Effect::Forward);
        }
        effects.push(Effect::Answer(verdict));
    }

    /// Whether this connection may use this token now.
    fn judge(&self, conn: Conn, token: &Token) -> Verdict {
        let Some(task) = self.conns.get(&conn) else { return Verdict::NotHolder };
        if self.kept.estop.tier() > Tier::None {
            return Verdict::Stopped;
        }
        let was_mine = |former: &&Grant| former.holder == *task && former.epoch == token.epoch;
        if self.former.as_ref().filter(was_mine).is_some_and(|f| self.grant.as_ref() != Some(f)) {
            return Verdict::Revoked;
        }
        if self.grip == Grip::Lost || token.epoch > self.kept.newest.epoch {
            return Verdict::Unknown;
        }
        if matches!(token.relation(&self.kept.newest), Relation::Older | Relation::Super) {
            return Verdict::Older;
        }
        if self.owns(task, token) { Verdict::Ok } else { Verdict::NotHolder }
    }

    fn owns(&self, task: &TaskUid, token: &Token) -> bool {
        let Some(grant) = &self.grant else { return false };
        token.epoch == grant.epoch
            && (*task == grant.holder
                || self.delegates.iter().any(|d| d.to == *task && token.is_under(&d.token)))
    }

    fn accept(&mut self, token: &Token, effects: &mut Vec<Effect>) {
        if self.kept.newest == *token {
            return;
        }
        self.kept.newest = token.clone();
        self.delegates.retain(|d| d.token.relation(token) != Relation::Older);
        effects.push(Effect::Keep(self.kept.clone()));
    }

    fn delegate(
        &mut self,
        conn: Conn,
        token: &Token,
        to: &TaskUid,
        effects: &mut Vec<Effect>,
    ) -> Verdict {
        let verdict = self.judge(conn, token);
        // The grant itself is the controller's to give; and nobody hands on what was handed to himself, but a part of it.
        let mine = |d: &Delegate| Some(&d.to) == self.conns.get(&conn) && d.token == *token;
        if verdict == Verdict::Ok && (token.sequence.is_empty() || self.delegates.iter().any(mine))
        {
            return Verdict::NotHolder;
        }
        if verdict == Verdict::Ok {
            self.accept(token, effects);
            self.delegates.retain(|d| d.token != *token);
            self.delegates.push(Delegate { token: token.clone(), to: to.clone() });
        }
        verdict
    }

    fn demand(&mut self, source: &Source, tier: Tier, effects: &mut Vec<Effect>) {
        let mut estop = self.kept.estop.clone();
        estop.demand(source, tier);
        self.set_estop(estop, effects);
    }

    fn set_estop(&mut self, estop: EStop, effects: &mut Vec<Effect>) {
        if estop == self.kept.estop {
            return;
        }
        let (before, tier) = (self.kept.estop.tier(), estop.tier());
        self.kept.estop = estop;
        if tier > before {
            // The robot first, the record after: the disk may be slow.
            self.stop(StopReason::EStop(tier), effects);
        }
        effects.push(Effect::Keep(self.kept.clone()));
        effects.push(Effect::Report);
    }
}
