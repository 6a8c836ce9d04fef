//! What really runs: the kernels of all machines together, as no part of muster sees them. The invariants are held against
//! this, at every start of a process.

use std::collections::BTreeMap;

use muster_agent_core::observed::Exit;
use muster_api::id::TaskUid;
use muster_api::kind::task::depend::DependencyCondition;

use crate::invariant::{Invariant, Violation};

/// What a process takes of its node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Takes {
    /// It may drive the robot.
    pub(crate) drives: bool,
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

/// Every process that was ever started.
#[derive(Debug, Default)]
pub(crate) struct Truth {
    pub(crate) rooms: Vec<Room>,
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
        if live.takes.drives
            && let Some((driver, other)) =
                self.live.iter().find(|(_, other)| other.node == live.node && other.takes.drives)
        {
            return Err(Invariant::OneDriver.broken(format!(
                "node {}: attempt {} of {uid} begins to drive while attempt {} of {driver} does",
                live.node, live.attempt, other.attempt
            )));
        }
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
            self.over.insert(uid.clone(), Over { attempt: live.attempt, cause, exit });
        }
    }
}
