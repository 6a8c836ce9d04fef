//! Tasks that are not considered for a place, whatever the nodes are like: see [`muster_controller_core::hold`]. Looked at
//! again when the task changes, or something that it names (a ConfigMap, a Secret, another task), or when it has waited
//! long enough after it failed elsewhere.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use muster_api::id::TaskUid;
use muster_api::kind::task::{NodeRefusal, TaskSpec, TaskStatus};
use muster_controller_core::hold::Hold;
use muster_controller_core::reschedule;
use muster_controller_core::schedule::Wait;

use tokio::time::Instant;

use super::{Scheduler, Waiting};
use crate::store::Key;
use crate::{configs, depends};

/// Longest wait for a time of the wall clock.
const LOOK_AGAIN: Duration = Duration::from_secs(30);

impl Scheduler {
    /// Why a task is not considered for a place, by what the store says now.
    pub(super) fn holds(
        &self,
        key: &Key,
        spec: &TaskSpec,
        past: Option<&TaskStatus>,
    ) -> Arc<[NodeRefusal]> {
        let namespace = key.namespace().unwrap_or_default();
        let store = &self.context.store;
        let others = depends::holds(store, namespace, spec);
        let configs = configs::holds(store, namespace, spec);
        let now = self.context.clock.now();
        let rests = past.and_then(|past| reschedule::hold(spec, past, now));
        let tried = past.filter(|_| rests.is_some()).map(reschedule::refusals);
        let holds = rests.iter().chain(&others).chain(&configs).map(Hold::refusal);
        holds.chain(tried.into_iter().flatten()).collect()
    }

    /// Looks again at the tasks that have waited long enough. Says when the next one has.
    pub(super) fn wake_rested(&mut self) -> Option<Instant> {
        let now = self.context.clock.now();
        let mut due = BTreeSet::new();
        while self.resting.first().is_some_and(|(until, _)| *until <= now) {
            due.extend(self.resting.pop_first().map(|(_, uid)| uid));
        }
        self.look_again_at(due);
        let (until, _) = self.resting.first()?;
        // The clock of the machine may be set: an early look is a look for nothing, and none is late for longer than this.
        Some(Instant::now() + until.duration_since(now).unsigned_abs().min(LOOK_AGAIN))
    }

    /// What waiting tasks name has changed.
    pub(super) fn look_at_holds(&mut self, source: &Key) {
        let namespace = source.namespace().unwrap_or_default();
        let names = |waiting: &Waiting| {
            let spec = &waiting.demand.spec;
            waiting.stored.key.namespace() == source.namespace()
                && spec
                    .references()
                    .iter()
                    .any(|(kind, name)| configs::key_of(*kind, namespace, name) == *source)
        };
        let named = self.waiting.iter().filter(|(_, waiting)| names(waiting));
        let uids = named.map(|(uid, _)| uid.clone()).collect();
        self.look_again_at(uids);
    }

    fn look_again_at(&mut self, uids: BTreeSet<TaskUid>) {
        for uid in uids {
            let Some(waiting) = self.waiting.get(&uid) else { continue };
            self.decided = None;
            let Waiting { stored, demand, past, .. } = waiting;
            let holds = self.holds(&stored.key, &demand.spec, past.as_deref());
            if !holds.is_empty() {
                self.cluster.unnominate(&uid);
            }
            if let Some(waiting) = self.waiting.get_mut(&uid) {
                waiting.holds = holds;
            }
        }
    }

    /// Remembers whom a task waits for.
    pub(super) fn take_in_dependencies(&mut self, uid: &TaskUid, key: &Key, spec: &TaskSpec) {
        for other in depends::keys(key.namespace().unwrap_or_default(), spec) {
            self.dependents.entry(other).or_default().insert(uid.clone());
        }
    }

    /// A task changed that others may wait for. Most are waited for by nobody.
    pub(super) fn look_at_dependents(&mut self, of: &Key) {
        let Some(uids) = self.dependents.get_mut(of) else { return };
        uids.retain(|uid| self.waiting.contains_key(uid));
        let uids = uids.clone();
        if uids.is_empty() {
            self.dependents.remove(of);
        }
        self.look_again_at(uids);
    }

    /// Who is considered for a place: not who may have one already.
    pub(super) fn placeable(&self) -> impl Iterator<Item = &Waiting> {
        let waits = |w: &&Waiting| self.cluster.node_of(&w.demand.uid).is_none();
        self.waiting.values().filter(|w| w.holds.is_empty()).filter(waits)
    }

    /// Who is not, with the reasons.
    pub(super) fn held(&self) -> impl Iterator<Item = Wait> {
        let held = self.waiting.values().filter(|w| !w.holds.is_empty());
        held.map(|w| Wait { uid: w.demand.uid.clone(), why: Arc::clone(&w.holds), brief: false })
    }
}

/// Until when a task that was tried before is held back.
pub(super) fn resting_until(past: Option<&TaskStatus>) -> Option<Timestamp> {
    past?.not_before.as_ref().map(|at| at.0)
}
