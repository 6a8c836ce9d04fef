//! What really runs: the kernels of all machines together, as no part of muster sees them. The invariants are held against
//! this, at every start of a process.

use std::collections::BTreeMap;

use muster_agent_core::gate::{Relation, Token};
use muster_agent_core::observed::Exit;
use muster_api::id::TaskUid;
use muster_api::kind::task::depend::DependencyCondition;

use crate::applications::{Told, part_of};
use crate::invariant::{Invariant, Violation};
use crate::kernel::Program;

/// What a process takes of its node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Takes {
    /// It may drive the robot, by the grant of this number.
    pub(crate) drives: Option<u64>,
    /// Millicores.
    pub(crate) cpu: u64,
    /// Bytes.
    pub(crate) memory: u64,
}

/// Why an attempt is over.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Cause {
    /// Its program ended, or its shim was killed.
    Itself,
    /// It was ended by order.
    Order,
    /// Contact was lost for too long.
    Disconnected,
    /// The machine was started anew.
    Reboot,
}

/// A live attempt.
#[derive(Debug, Clone)]
pub(crate) struct Live {
    pub(crate) node: usize,
    pub(crate) attempt: u32,
    pub(crate) takes: Takes,
}

/// An attempt that is over.
#[derive(Debug, Clone)]
pub(crate) struct Over {
    pub(crate) attempt: u32,
    pub(crate) cause: Cause,
    /// None: nothing of it is left, its exit code neither.
    pub(crate) exit: Option<Exit>,
}

/// A node's machine: millicores and bytes that tasks may have.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Room {
    pub(crate) cpu: u64,
    pub(crate) memory: u64,
}

/// A command that a driver was handed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Command {
    pub(crate) task: TaskUid,
    pub(crate) token: Token,
}

/// One that began to drive while another could: right only if a person had taken the robot from the older one.
#[derive(Debug)]
pub(crate) struct Beside {
    pub(crate) node: usize,
    /// The grant of the older one.
    pub(crate) older: u64,
    pub(crate) how: String,
}

/// Every process that was ever started, and every command that passed.
#[derive(Debug, Default)]
pub(crate) struct Truth {
    rooms: Vec<Room>,
    /// What those tell that do.
    pub(crate) told: Told,
    /// Of the nodes.
    node_names: Vec<String>,
    /// Which part each live task is.
    parts: BTreeMap<TaskUid, String>,
    /// No program ends by itself any more, but those that must.
    pub(crate) calm: bool,
    /// Which nodes have a gate.
    gated: Vec<bool>,
    /// The newest command of each robot.
    commands: BTreeMap<usize, Command>,
    /// The newest grant of each robot that a person was told is theirs.
    persons: BTreeMap<usize, u64>,
    /// Tasks of nodes that a person called off: he may have erred, and what they do is his.
    written_off: BTreeMap<TaskUid, u32>,
    pub(crate) beside: Vec<Beside>,
    /// Every task that ever began; no name is used twice.
    pub(crate) names: BTreeMap<String, TaskUid>,
    pub(crate) live: BTreeMap<TaskUid, Live>,
    pub(crate) over: BTreeMap<TaskUid, Over>,
    /// Which framework's id launched a task, as its agent was told: it may be over before anybody looks at the store.
    pub(crate) launched: BTreeMap<TaskUid, String>,
    /// Live attempts that were ordered to end, until somebody has looked why.
    pub(crate) ordered: Vec<(u64, TaskUid)>,
}

impl Truth {
    /// By node what it has, and whether it has a gate.
    pub(crate) fn new(rooms: Vec<Room>, node_names: Vec<String>, gated: Vec<bool>) -> Truth {
        Truth { rooms, node_names, gated, ..Truth::default() }
    }

    /// A process begins.
    ///
    /// # Errors
    ///
    /// What must never be.
    pub(crate) fn begins(&mut self, uid: &TaskUid, live: Live) -> Result<(), Violation> {
        if let Some(other) = self.live.get(uid) {
            return Err(Invariant::NothingRunsTwice.broken(format!(
                "{uid}: attempt {} begins on node {} beside attempt {} on node {}",
                live.attempt, live.node, other.attempt, other.node
            )));
        }
        if let Some(over) = self.over.get(uid) {
            if over.attempt >= live.attempt {
                return Err(Invariant::NothingRunsTwice.broken(format!(
                    "{uid}: attempt {} begins after attempt {} was over",
                    live.attempt, over.attempt
                )));
            }
            if matches!(over.cause, Cause::Order | Cause::Disconnected) {
                return Err(Invariant::WorkOutlivesItsManagers.broken(format!(
                    "{uid}: attempt {} was ended ({:?}), and attempt {} begins",
                    over.attempt, over.cause, live.attempt
                )));
            }
        }
        self.begins_to_drive(uid, &live)?;
        let here = self.live.values().filter(|other| other.node == live.node);
        let (cpu, memory) = here
            .fold((live.takes.cpu, live.takes.memory), |(cpu, memory), other| {
                (cpu + other.takes.cpu, memory + other.takes.memory)
            });
        let room = self.rooms[live.node];
        if cpu > room.cpu || memory > room.memory {
            return Err(Invariant::NoOversubscription.broken(format!(
                "node {}: with {uid} its processes take {cpu}m cpu and {memory} bytes, it has {}m and {}",
                live.node, room.cpu, room.memory
            )));
        }
        self.live.insert(uid.clone(), live);
        Ok(())
    }

    /// The index of a node.
    pub(crate) fn node_named(&self, name: &str) -> Option<usize> {
        self.node_names.iter().position(|node| node == name)
    }

    /// What a robot begins by itself was away, and has surely ended.
    ///
    /// # Errors
    ///
    /// When it lives.
    pub(crate) fn begins_alone(
        &mut self,
        uid: &TaskUid,
        program: &Program,
    ) -> Result<(), Violation> {
        let Some(part) = part_of(&program.name) else { return Ok(()) };
        let mut others = self.parts.iter().filter(|(other, of)| *of == part && *other != uid);
        let lives = |other: &TaskUid| self.live.contains_key(other) && !self.is_written_off(other);
        if let Some((other, _)) = others.find(|(other, _)| program.standby && lives(other)) {
            let how = format!("{} ({uid}) begins by itself, and {other} lives", program.name);
            return Err(Invariant::NothingRunsTwice.broken(how));
        }
        self.parts.insert(uid.clone(), part.to_owned());
        Ok(())
    }

    /// Somebody says that these are gone.
    pub(crate) fn write_off(&mut self, tasks: &[TaskUid]) {
        tasks.iter().for_each(|uid| *self.written_off.entry(uid.clone()).or_default() += 1);
    }

    /// He was told that they are not; what others were believed before stays.
    pub(crate) fn take_back(&mut self, tasks: &[TaskUid]) {
        for uid in tasks {
            self.written_off.entry(uid.clone()).and_modify(|times| *times -= 1);
        }
    }

    pub(crate) fn is_written_off(&self, uid: &TaskUid) -> bool {
        self.written_off.get(uid).is_some_and(|times| *times > 0)
    }

    /// Who has the actuators is alone with them, but for those from whom a person took them.
    fn begins_to_drive(&mut self, uid: &TaskUid, live: &Live) -> Result<(), Violation> {
        let Some(epoch) = live.takes.drives else { return Ok(()) };
        let drives = |other: &Live| other.takes.drives.filter(|_| other.node == live.node);
        let others = self.live.iter().filter_map(|(uid, other)| Some((uid, drives(other)?)));
        for (driver, other) in others {
            let how = format!(
                "node {}: {uid} ({epoch}) begins to drive while {driver} ({other}) does",
                live.node
            );
            self.beside.push(Beside { node: live.node, older: epoch.min(other), how });
        }
        self.is_alone(live.node, uid, epoch)
    }

    /// Where no gate stands before the drivers, whoever lives drives.
    fn is_alone(&self, node: usize, uid: &TaskUid, epoch: u64) -> Result<(), Violation> {
        match self.gated[node] {
            true => Ok(()),
            false => self.is_no_persons(node, uid, epoch),
        }
    }

    fn is_no_persons(&self, node: usize, uid: &TaskUid, epoch: u64) -> Result<(), Violation> {
        let person = self.persons.get(&node).copied().unwrap_or(0);
        if epoch >= person || self.is_written_off(uid) {
            return Ok(());
        }
        let how = format!(
            "node {node}: {uid} drives by grant {epoch}, and a person was told that {person} counts"
        );
        Err(Invariant::OneDriver.broken(how))
    }

    /// A person was told that this grant is theirs.
    ///
    /// # Errors
    ///
    /// Somebody drives against it.
    pub(crate) fn person_holds(&mut self, node: usize, epoch: u64) -> Result<(), Violation> {
        let known = self.persons.entry(node).or_default();
        *known = epoch.max(*known);
        let here = self.live.iter().filter(|(_, live)| live.node == node);
        here.filter_map(|(uid, live)| Some((uid, live.takes.drives?)))
            .try_for_each(|(uid, epoch)| self.is_alone(node, uid, epoch))
    }

    /// A driver is handed a command.
    ///
    /// # Errors
    ///
    /// It is of somebody who may not command the robot any more.
    pub(crate) fn is_commanded(&mut self, node: usize, command: Command) -> Result<(), Violation> {
        let Command { task, token } = &command;
        if self.live.get(task).is_none_or(|live| live.node != node) {
            let how = format!("node {node}: a command of {task} passes, which does not live there");
            return Err(Invariant::OneDriver.broken(how));
        }
        if let Some(last) = self.commands.get(&node) {
            let older = matches!(token.relation(&last.token), Relation::Older | Relation::Super);
            if older || (*token == last.token && *task != last.task) {
                let how = format!(
                    "node {node}: {task} commands with {token} after {} did with {}",
                    last.task, last.token
                );
                return Err(Invariant::OneDriver.broken(how));
            }
        }
        self.is_no_persons(node, task, token.epoch.0)?;
        self.commands.insert(node, command);
        Ok(())
    }

    /// Those that a task waits for have come so far once (the kernel cannot know what was so when the agent looked).
    ///
    /// # Errors
    ///
    /// When one of them has not.
    pub(crate) fn may_begin(
        &self,
        name: &str,
        waits_for: &[(String, DependencyCondition)],
    ) -> Result<(), Violation> {
        for (other, condition) in waits_for {
            let uid = self.names.get(other);
            let come = uid.is_some_and(|uid| match condition {
                DependencyCondition::Succeeded => {
                    let over = self.over.get(uid).and_then(|over| over.exit.as_ref());
                    over.is_some_and(|exit| exit.code() == Some(0))
                }
                DependencyCondition::Running | DependencyCondition::Ready => true,
            });
            if !come {
                let how = format!("{name} begins before {other} was {condition:?}");
                return Err(Invariant::EverythingEndsOrExplainsItself.broken(how));
            }
        }
        Ok(())
    }

    /// No process of the attempt is left.
    pub(crate) fn ends(&mut self, uid: &TaskUid, cause: Cause, exit: Option<Exit>) {
        if let Some(live) = self.live.remove(uid) {
            self.parts.remove(uid);
            self.over.insert(uid.clone(), Over { attempt: live.attempt, cause, exit });
        }
    }
}
