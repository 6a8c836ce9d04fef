//! One machine's kernel, and the shims above its processes: modelled. A shim outlives the agent, keeps the time of an order to
//! end, ends what has lost the controller for too long, and keeps how an attempt ended. What a reboot ends leaves no trace.

use std::collections::BTreeMap;

use muster_agent_core::observed::{End, Exit, Observed, Started};
use muster_agent_core::time::Wall;
use muster_api::id::TaskUid;
use muster_api::kind::task::depend::DependencyCondition;

use crate::invariant::Violation;
use crate::truth::{Cause, Live, Takes, Truth};

/// What is to be started.
#[derive(Debug, Clone)]
pub(crate) struct Program {
    /// Of its task.
    pub(crate) name: String,
    pub(crate) takes: Takes,
    pub(crate) grace_ms: u64,
    /// It may run so long without contact, milliseconds.
    pub(crate) stop_after_ms: Option<u64>,
    /// It tells of a topic and of a signal.
    pub(crate) tells: bool,
    /// Its node may begin it by itself, without contact, when nothing else of the part runs.
    pub(crate) standby: bool,
    /// It ends by itself, soon and badly.
    pub(crate) crashes: bool,
    /// Tasks that must have come so far before it begins.
    pub(crate) waits_for: Vec<(String, DependencyCondition)>,
}

/// An attempt, as its shim knows it.
#[derive(Debug)]
pub(crate) struct Attempt {
    pub(crate) program: Program,
    pub(crate) started: Wall,
    /// When it was started, milliseconds since boot.
    pub(crate) since: u64,
    pub(crate) exit: Option<Exit>,
    /// It was told to end.
    pub(crate) ordered: bool,
    pub(crate) disconnected: bool,
}

/// The processes of one machine.
#[derive(Debug, Default)]
pub(crate) struct Kernel {
    pub(crate) attempts: BTreeMap<(TaskUid, u32), Attempt>,
    /// The newest launch of each task: an older one that has not begun never will.
    claims: BTreeMap<TaskUid, u64>,
}

impl Kernel {
    /// A launch that may begin as long as nobody claims the task after it.
    pub(crate) fn claim(&mut self, uid: &TaskUid) -> u64 {
        let claim = self.claims.entry(uid.clone()).or_default();
        *claim += 1;
        *claim
    }

    /// The program of a launch begins. False: it was claimed meanwhile.
    ///
    /// # Errors
    ///
    /// What must never be.
    pub(crate) fn begin(
        &mut self,
        (uid, attempt, claim): (&TaskUid, u32, u64),
        (node, since, started): (usize, u64, Wall),
        program: Program,
        truth: &mut Truth,
    ) -> Result<bool, Violation> {
        if self.claims.get(uid) != Some(&claim) {
            return Ok(false);
        }
        truth.may_begin(&program.name, &program.waits_for)?;
        truth.names.insert(program.name.clone(), uid.clone());
        truth.begins_alone(uid, &program)?;
        truth.begins(uid, Live { node, attempt, takes: program.takes })?;
        let begun =
            Attempt { program, started, since, exit: None, ordered: false, disconnected: false };
        self.attempts.insert((uid.clone(), attempt), begun);
        Ok(true)
    }

    /// The attempt's last process is gone. None: it was before.
    pub(crate) fn end(
        &mut self,
        uid: &TaskUid,
        attempt: u32,
        end: End,
        at: Wall,
        truth: &mut Truth,
    ) -> Option<Exit> {
        let known = self.attempts.get_mut(&(uid.clone(), attempt)).filter(|a| a.exit.is_none())?;
        let exit = Exit {
            end,
            oom_killed: false,
            disconnected: known.disconnected,
            started_at: Some(known.started),
            finished_at: at,
        };
        known.exit = Some(exit.clone());
        let cause = match (known.disconnected, known.ordered) {
            (true, _) => Cause::Disconnected,
            (false, true) => Cause::Order,
            (false, false) => Cause::Itself,
        };
        truth.ends(uid, cause, Some(exit.clone()));
        Some(exit)
    }

    /// What is found of an attempt; a launch that has not begun never will.
    pub(crate) fn find(&mut self, uid: &TaskUid, attempt: u32) -> Observed {
        self.claim(uid);
        match self.attempts.get(&(uid.clone(), attempt)) {
            None => Observed::NeverStarted,
            Some(Attempt { exit: Some(exit), .. }) => Observed::Ended(exit.clone()),
            Some(known) => Observed::Running(Started { at: known.started }),
        }
    }

    /// Removes what is left of a task. False: a process of it lives.
    pub(crate) fn remove(&mut self, uid: &TaskUid) -> bool {
        let mut of_task = self.attempts.iter().filter(|((of, _), _)| of == uid);
        if of_task.any(|(_, attempt)| attempt.exit.is_none()) {
            return false;
        }
        self.attempts.retain(|(of, _), _| of != uid);
        true
    }

    /// The machine is started anew.
    pub(crate) fn reboot(&mut self, truth: &mut Truth) {
        for ((uid, _), _) in self.attempts.iter().filter(|(_, attempt)| attempt.exit.is_none()) {
            truth.ends(uid, Cause::Reboot, None);
        }
        self.attempts.retain(|_, attempt| attempt.exit.is_some());
        for claim in self.claims.values_mut() {
            *claim += 1;
        }
    }

    /// The live attempts.
    pub(crate) fn live(&self) -> Vec<(TaskUid, u32)> {
        let live = self.attempts.iter().filter(|(_, attempt)| attempt.exit.is_none());
        live.map(|(id, _)| id.clone()).collect()
    }
}
