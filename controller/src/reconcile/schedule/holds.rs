//! Tasks that are not considered for a place, whatever the nodes are like: see [`muster_controller_core::hold`]. Looked at
//! again when the task changes, or something that it names.

use std::sync::Arc;

use muster_api::id::TaskUid;
use muster_api::kind::task::{NodeRefusal, TaskSpec};
use muster_controller_core::hold::Hold;
use muster_controller_core::schedule::Wait;

use super::{Scheduler, Waiting};
use crate::configs;
use crate::store::Key;

impl Scheduler {
    /// Why a task is not considered for a place, by what the store says now.
    pub(super) fn holds(&self, key: &Key, spec: &TaskSpec) -> Arc<[NodeRefusal]> {
        let namespace = key.namespace().unwrap_or_default();
        configs::holds(&self.context.store, namespace, spec).iter().map(Hold::refusal).collect()
    }

    /// What waiting tasks name has changed.
    pub(super) fn look_at_holds(&mut self, source: &Key) {
        let names = |waiting: &Waiting| {
            waiting.stored.key.namespace() == source.namespace()
                && waiting.demand.spec.references().iter().any(|(kind, name)| {
                    configs::key_of(*kind, source.namespace().unwrap_or_default(), name) == *source
                })
        };
        let named = self.waiting.iter().filter(|(_, waiting)| names(waiting));
        let uids: Vec<TaskUid> = named.map(|(uid, _)| uid.clone()).collect();
        for uid in uids {
            let Some(waiting) = self.waiting.get(&uid) else { continue };
            let holds = self.holds(&waiting.stored.key, &waiting.demand.spec);
            if !holds.is_empty() {
                self.cluster.unnominate(&uid);
            }
            if let Some(waiting) = self.waiting.get_mut(&uid) {
                waiting.holds = holds;
            }
        }
    }

    /// Who is considered for a place.
    pub(super) fn placeable(&self) -> impl Iterator<Item = &Waiting> {
        self.waiting.values().filter(|w| w.holds.is_empty())
    }

    /// Who is not, with the reasons.
    pub(super) fn held(&self) -> impl Iterator<Item = Wait> {
        let held = self.waiting.values().filter(|w| !w.holds.is_empty());
        held.map(|w| Wait { uid: w.demand.uid.clone(), why: Arc::clone(&w.holds) })
    }
}
