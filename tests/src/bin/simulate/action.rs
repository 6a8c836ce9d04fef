//! What can happen to a cluster, by how often it does. A step is one action, and then a while in which everything works.

use muster_agent_core::observed::{End, Loss};

use crate::agenda::Due;
use crate::agent::What;
use crate::dice::{self, Dice};
use crate::framework::Deed;
use crate::world::{Cast, World};

/// What a step does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Action {
    /// Somebody wants a task, or wants one gone.
    Apply,
    Delete,
    /// Time passes.
    Pass,
    /// A robot is somewhere else.
    Move,
    /// A program ends, or its shim is killed.
    Exit,
    KillShim,
    /// `kill -9`, and started again after a while.
    CrashController,
    CrashAgent,
    Reboot,
    /// A commit fails; it is there, and is said to have failed; commits take long.
    FailCommit,
    MisleadCommit,
    SlowDisk,
    /// An agent's disk is full.
    FillDisk,
    /// A connection breaks; a report is said twice; nothing passes, one way or both; the network is slow.
    Cut,
    Repeat,
    Partition,
    SlowNet,
    /// The controller's date is off; an agent's is.
    Skew,
    SkewAgent,
    /// A person says that a node is off; that nothing new begins on it, or may again.
    Fence,
    Cordon,
    Uncordon,
    /// A person wants a robot's actuators, whoever has them or if they are free; gives them back.
    Take,
    Acquire,
    Return,
    /// A person stops a robot, and releases it; somebody presses its button; its gate is killed.
    EStop,
    Release,
    Button,
    KillGate,
    /// Somebody wants a set, another number of its tasks, others in their place, or it gone.
    CreateSet,
    ScaleSet,
    ChangeSet,
    DeleteSet,
    /// Somebody wants an application, another policy of it, or it gone; what its part tells is not as it should be.
    CreateApplication,
    ChangeApplication,
    DeleteApplication,
    Violate,
    /// A framework launches, declines, ends a task, asks for the state of all.
    Accept,
    Decline,
    Kill,
    Reconcile,
    /// A framework is stopped for a while, loses its connection, is killed and comes back or stays away, ends itself.
    Freeze,
    CutFramework,
    CrashFramework,
    TearDown,
}

/// How often each is drawn.
const WEIGHTS: [(Action, u64); 37] = [
    (Action::Apply, 60),
    (Action::Delete, 40),
    (Action::Pass, 60),
    (Action::Move, 20),
    (Action::Exit, 25),
    (Action::KillShim, 2),
    (Action::CrashController, 6),
    (Action::CrashAgent, 12),
    (Action::Reboot, 3),
    (Action::FailCommit, 5),
    (Action::MisleadCommit, 5),
    (Action::SlowDisk, 5),
    (Action::FillDisk, 3),
    (Action::Cut, 12),
    (Action::Repeat, 15),
    (Action::Partition, 10),
    (Action::SlowNet, 5),
    (Action::Skew, 3),
    (Action::SkewAgent, 3),
    (Action::Fence, 8),
    (Action::Cordon, 4),
    (Action::Uncordon, 8),
    (Action::Take, 8),
    (Action::Acquire, 4),
    (Action::Return, 10),
    (Action::EStop, 3),
    (Action::Release, 6),
    (Action::Button, 2),
    (Action::KillGate, 4),
    (Action::Accept, 40),
    (Action::Decline, 8),
    (Action::Kill, 10),
    (Action::Reconcile, 4),
    (Action::Freeze, 4),
    (Action::CutFramework, 6),
    (Action::CrashFramework, 5),
    (Action::TearDown, 2),
];

/// The same of sets, in runs that have some.
const OF_SETS: [(Action, u64); 4] = [
    (Action::CreateSet, 12),
    (Action::ScaleSet, 8),
    (Action::ChangeSet, 16),
    (Action::DeleteSet, 3),
];

/// The same of applications.
const OF_APPLICATIONS: [(Action, u64); 4] = [
    (Action::CreateApplication, 30),
    (Action::ChangeApplication, 6),
    (Action::DeleteApplication, 2),
    (Action::Violate, 16),
];

/// What was done.
#[derive(Debug, Default, Clone)]
pub(crate) struct Tally {
    pub(crate) done: u64,
    pub(crate) skipped: u64,
}

/// Tasks that are there at once; more only make every step slower.
const CROWD: usize = 14;
/// What is left to others of that.
const OTHERS: usize = 5;

impl Action {
    pub(crate) fn drawn(dice: &mut Dice, cast: Cast) -> Action {
        let sets = OF_SETS.iter().filter(|_| cast.sets);
        let applications = OF_APPLICATIONS.iter().filter(|_| cast.applications);
        let weights = || WEIGHTS.iter().chain(sets.clone()).chain(applications.clone());
        let all: u64 = weights().map(|(_, weight)| weight).sum();
        let mut at = dice.between(0, all - 1);
        for (action, weight) in weights() {
            if at < *weight {
                return *action;
            }
            at -= weight;
        }
        Action::Pass
    }
}

impl World {
    /// One step: an action, a while, a look at every invariant.
    pub(crate) fn step(&mut self, step: u64) {
        self.dice = dice::of(self.seed, step + 1);
        self.log.step = step;
        let action = Action::drawn(&mut self.dice, self.cast);
        let done = self.act(action);
        if done {
            self.tally.done += 1;
        } else {
            self.tally.skipped += 1;
        }
        let words = if done { "" } else { ": nothing to do it to" };
        self.log.say(self.now, format_args!("= {action:?}{words}"));
        let wait = match self.dice.between(0, 19) {
            0..=12 => self.dice.between(0, 60),
            13..=18 => self.dice.between(60, 800),
            _ => self.dice.between(1_000, 8_000),
        };
        self.run_to(self.now + wait);
        self.drive();
        self.check();
    }

    /// False: there was nothing to do it to.
    fn act(&mut self, action: Action) -> bool {
        let nodes = self.agents.len() as u64 - 1;
        let index = usize::try_from(self.dice.between(0, nodes)).unwrap_or(0);
        match action {
            Action::Pass => true,
            Action::Apply => self.apply(),
            Action::Delete => {
                let wanted = self.users.wishes.iter().filter(|(_, wish)| !wish.asked_to_go);
                let all: Vec<_> = wanted.map(|(uid, _)| uid.clone()).collect();
                let Some(uid) = self.dice.pick(&all).cloned() else { return false };
                self.ask(|users, _| users.delete(&uid))
            }
            Action::Move => {
                let place = (self.dice.between(0, 30) as f64, 0.0);
                let robot = self.agents[index].place.is_some();
                if robot {
                    self.with_agent(index, |agent, hands| agent.moved(place, hands));
                }
                robot
            }
            Action::Exit | Action::KillShim => self.end_one(index, action == Action::KillShim),
            Action::CrashController => {
                let up = self.up_since.is_some();
                if up {
                    self.crash_controller();
                    let wait = self.dice.between(20, 4_000);
                    self.agenda.at(self.now + wait, Due::Controller);
                }
                up
            }
            Action::CrashAgent => {
                let up = self.agents[index].is_up();
                let orderly = self.dice.one_in(3);
                self.with_agent(index, |agent, hands| {
                    if orderly {
                        agent.leave(hands);
                    }
                    agent.crash(hands);
                });
                let wait = self.dice.between(1, 6_000);
                self.agenda.at(self.now + wait, Due::Machine(index, What::Begin));
                up
            }
            Action::Reboot => {
                self.with_agent(index, |agent, hands| agent.reboot(hands));
                true
            }
            Action::FailCommit | Action::MisleadCommit | Action::SlowDisk => self.hurt_disk(action),
            Action::FillDisk => {
                let until = self.now + self.dice.between(100, 5_000);
                self.agents[index].full_until = until;
                true
            }
            Action::Cut => {
                let connected = self.agents[index].is_connected();
                self.with_agent(index, |agent, hands| agent.cut(hands));
                connected
            }
            Action::Repeat => self.with_agent(index, |agent, hands| agent.say_again(hands)),
            Action::Partition => {
                let (up, down) = *self
                    .dice
                    .pick(&[(true, false), (false, true), (true, true)])
                    .unwrap_or(&(true, true));
                let ends = (self.agents.len() + self.frameworks.len()) as u64 - 1;
                let index = usize::try_from(self.dice.between(0, ends)).unwrap_or(0);
                self.net.block(index, up, down);
                if let Some(framework) = index.checked_sub(self.agents.len()) {
                    self.ping(self.frameworks[framework].conn());
                }
                let long = if self.dice.one_in(3) { 30_000 } else { 4_000 };
                let wait = self.dice.between(100, long);
                self.log.say(
                    self.now,
                    format_args!("node {index} is cut off for {wait} ms: {up} {down}"),
                );
                self.agenda.at(self.now + wait, Due::Heal(index));
                true
            }
            Action::SlowNet => {
                self.net.slowest = *self.dice.pick(&[1, 5, 50, 700]).unwrap_or(&5);
                true
            }
            Action::Skew => {
                let millis = self.dice.between(0, 120_000).cast_signed() - 60_000;
                self.house.skew.set(millis);
                true
            }
            Action::SkewAgent => {
                let millis = self.dice.between(0, 120_000).cast_signed() - 60_000;
                self.agents[index].skew = millis;
                true
            }
            Action::Fence => {
                let name = self.agents[index].name().to_owned();
                let tasks = self.may_end_on(index);
                self.truth.write_off(&tasks);
                self.ask(|users, _| Some(users.fence(&name, tasks)))
            }
            Action::Take | Action::Acquire | Action::Return => self.hold(action, index),
            Action::EStop | Action::Release => self.stop_robot(action, index),
            Action::Button => {
                let wait = self.dice.between(0, 3_000);
                self.agenda.at(self.now + wait, Due::Machine(index, What::LetGo));
                self.with_agent(index, |agent, hands| agent.button(true, hands))
            }
            Action::KillGate => self.with_agent(index, |agent, hands| agent.kill_gate(hands)),
            Action::CreateSet | Action::ScaleSet | Action::ChangeSet | Action::DeleteSet => {
                self.act_on_set(action)
            }
            Action::CreateApplication
            | Action::ChangeApplication
            | Action::DeleteApplication
            | Action::Violate => self.act_on_application(action),
            Action::Accept
            | Action::Decline
            | Action::Kill
            | Action::Reconcile
            | Action::Freeze
            | Action::CutFramework
            | Action::CrashFramework
            | Action::TearDown => self.act_on_framework(action),
            Action::Cordon | Action::Uncordon => {
                let name = self.agents[index].name().to_owned();
                self.ask(|users, _| Some(users.cordon(&name, action == Action::Cordon)))
            }
        }
    }

    fn act_on_framework(&mut self, action: Action) -> bool {
        let most = self.frameworks.len() as u64 - 1;
        let index = usize::try_from(self.dice.between(0, most)).unwrap_or(0);
        let end = self.frameworks[index].end;
        let (up, conn) = (self.frameworks[index].is_up(), self.frameworks[index].conn());
        match action {
            Action::Accept => self.with_framework(end, |f, hands| f.accept(hands)),
            Action::Decline => self.with_framework(end, |f, hands| f.decline(hands)),
            Action::Reconcile => self.with_framework(end, |f, hands| f.reconcile(hands)),
            Action::TearDown => self.with_framework(end, |f, hands| f.tear_down(hands)),
            Action::Kill => {
                let killed = self.with_framework(end, |f, hands| f.kill(hands));
                self.users.may_end.extend(killed.clone());
                killed.is_some()
            }
            Action::Freeze => {
                let wait = self.dice.between(200, 50_000);
                self.frameworks[index].frozen |= up;
                self.let_read(end);
                self.ping(conn);
                self.agenda.at(self.now + wait, Due::Framework(end, Deed::Thaw));
                up
            }
            Action::CutFramework => {
                let Some(conn) = conn else { return false };
                self.net.black_out(conn);
                self.ping(Some(conn));
                if self.dice.one_in(2) {
                    self.with_framework(end, |f, hands| f.lose(hands));
                }
                true
            }
            _ => {
                let wait = self.dice.between(10, 60_000);
                self.with_framework(end, |f, hands| f.crash(hands));
                self.agenda.at(self.now + wait, Due::Framework(end, Deed::Begin));
                up
            }
        }
    }

    fn apply(&mut self) -> bool {
        let others = if self.cast.sets || self.cast.applications { OTHERS } else { 0 };
        if self.users.wishes.len() + others >= CROWD {
            return false;
        }
        let name = format!("t{}", self.log.step);
        let nodes: Vec<String> = self.agents.iter().map(|agent| agent.name().to_owned()).collect();
        let nodes: Vec<&str> = nodes.iter().map(String::as_str).collect();
        self.ask(|users, dice| Some(users.create(&name, dice, &nodes)))
    }

    fn end_one(&mut self, index: usize, kill_shim: bool) -> bool {
        let live = self.agents[index].kernel.live();
        let Some((uid, attempt)) = self.dice.pick(&live).cloned() else { return false };
        let code = i32::try_from(self.dice.between(0, 2)).unwrap_or(0);
        let end = if kill_shim { End::Lost(Loss::Shim) } else { End::Exited(code) };
        self.with_agent(index, |agent, hands| agent.end(&uid, attempt, end, hands));
        true
    }

    fn hurt_disk(&mut self, action: Action) -> bool {
        self.failed_at = self.now;
        let disk = self.house.disk.clone();
        let commits = u32::try_from(self.dice.between(1, 3)).unwrap_or(1);
        match action {
            Action::FailCommit => disk.failures().fail_next(commits),
            Action::MisleadCommit => disk.failures().mislead_next(commits),
            _ => {
                let most = *self.dice.pick(&[0, 2, 10, 200]).unwrap_or(&2);
                let mut millis = || std::time::Duration::from_millis(self.dice.between(0, most));
                disk.set_latency(millis(), millis());
            }
        }
        true
    }
}
