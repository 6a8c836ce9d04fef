//! The tasks of all frameworks, as the store last said: `updates` keeps it, a moment behind.

use std::collections::HashMap;
use std::sync::Mutex;

use muster_api::kind::task::Task;

use super::session::is_open;
use super::subscribe::owner_of;
use crate::reconcile::desk::FrameworkUid;
use crate::session::lock;
use crate::store::{Key, Stored};

#[derive(Debug)]
struct Entry {
    key: Key,
    /// None: nobody owns it any more.
    framework: Option<FrameworkUid>,
    /// It holds something of a node.
    holds: bool,
    /// Its end waits for an acknowledgement.
    open: bool,
}

type Orphan = (Key, Box<str>, Option<FrameworkUid>);

/// Tasks by their uids.
#[derive(Debug, Default)]
pub(crate) struct Roster(Mutex<HashMap<Box<str>, Entry>>);

impl Roster {
    pub(super) fn put(&self, stored: &Stored, task: &Task) {
        let entry = Entry {
            key: stored.key.clone(),
            framework: owner_of(&task.metadata),
            holds: task.status.as_ref().is_some_and(|s| s.phase.holds_node()),
            open: is_open(task),
        };
        lock(&self.0).insert(stored.uid.clone(), entry);
    }

    /// The key of a task, and whose it is.
    pub(super) fn find(&self, uid: &str) -> Option<(Key, Option<FrameworkUid>)> {
        lock(&self.0).get(uid).map(|entry| (entry.key.clone(), entry.framework.clone()))
    }

    pub(super) fn remove(&self, uid: &str) {
        lock(&self.0).remove(uid);
    }

    pub(super) fn keep_only(&self, is_there: impl Fn(&str) -> bool) {
        lock(&self.0).retain(|uid, _| is_there(uid));
    }

    /// How many tasks of each framework hold something of a node.
    pub(crate) fn holding(&self) -> HashMap<FrameworkUid, u32> {
        let mut counts: HashMap<FrameworkUid, u32> = HashMap::new();
        for entry in lock(&self.0).values().filter(|entry| entry.holds) {
            if let Some(framework) = &entry.framework {
                *counts.entry(FrameworkUid::clone(framework)).or_default() += 1;
            }
        }
        counts
    }

    /// Tasks that wait for the acknowledgement of a framework that is not present: key, uid, framework.
    pub(crate) fn orphans(&self, is_present: impl Fn(&str) -> bool) -> Vec<Orphan> {
        let orphaned =
            |entry: &Entry| entry.open && !entry.framework.as_ref().is_some_and(|f| is_present(f));
        let roster = lock(&self.0);
        let orphans = roster.iter().filter(|(_, entry)| orphaned(entry));
        orphans.map(|(uid, e)| (e.key.clone(), uid.clone(), e.framework.clone())).collect()
    }
}
