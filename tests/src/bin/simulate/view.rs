//! The controller's books as the store has them, read again where they changed, and what must hold of them at every revision.

use std::collections::BTreeMap;
use std::sync::Arc;

use muster_api::id::TaskUid;
use muster_api::kind::application::Application;
use muster_api::kind::framework::Framework;
use muster_api::kind::lease::{HolderKind, Lease, LeaseHolder};
use muster_api::kind::node::Node;
use muster_api::kind::task::Task;
use muster_api::kind::taskset::TaskSet;
use muster_api::phase::TaskPhase;
use muster_controller::objects::{APPLICATIONS, FRAMEWORKS, LEASES, NODES, TASK_SETS, TASKS};
use muster_controller::store::{Key, Resource, Store, Stored};
use serde::de::DeserializeOwned;

use crate::invariant::{Invariant, Violation};

/// Objects of one kind, each read once a revision.
#[derive(Debug)]
pub(crate) struct Kind<T> {
    resource: Resource,
    pub(crate) objects: BTreeMap<Key, (u64, TaskUid, T)>,
}

impl<T: DeserializeOwned> Kind<T> {
    fn new(resource: Resource) -> Self {
        Kind { resource, objects: BTreeMap::new() }
    }

    /// Gives what was there before of every object that changed.
    fn follow(&mut self, store: &Store) -> Result<Vec<(Key, Option<T>)>, Violation> {
        let items = store.list(self.resource, None).items;
        let mut changed = Vec::new();
        if items.len() != self.objects.len()
            || items.iter().any(|s| !self.objects.contains_key(&s.key))
        {
            self.objects.retain(|key, _| items.iter().any(|stored| stored.key == *key));
        }
        for stored in items {
            if self
                .objects
                .get(&stored.key)
                .is_some_and(|(revision, ..)| *revision == stored.revision)
            {
                continue;
            }
            let object = parse(&stored)?;
            let uid = TaskUid::new(&*stored.uid);
            let before =
                self.objects.insert(stored.key.clone(), (stored.revision, uid.clone(), object));
            let same = before.filter(|(_, was, _)| *was == uid).map(|(_, _, object)| object);
            changed.push((stored.key.clone(), same));
        }
        Ok(changed)
    }

    pub(crate) fn all(&self) -> impl Iterator<Item = (&Key, &TaskUid, &T)> {
        self.objects.iter().map(|(key, (_, uid, object))| (key, uid, object))
    }
}

fn parse<T: DeserializeOwned>(stored: &Arc<Stored>) -> Result<T, Violation> {
    stored.parse().map_err(|error| {
        Invariant::NothingAcknowledgedIsLost
            .broken(format!("{} does not read: {error}", stored.key))
    })
}

/// Why a task ended that was on a node which a person said is off.
pub(crate) const FENCED: &str = "NodeFenced";

/// The store's tasks, nodes, leases and frameworks.
#[derive(Debug)]
pub(crate) struct View {
    pub(crate) revision: u64,
    pub(crate) tasks: Kind<Task>,
    pub(crate) nodes: Kind<Node>,
    pub(crate) leases: Kind<Lease>,
    pub(crate) frameworks: Kind<Framework>,
    pub(crate) sets: Kind<TaskSet>,
    pub(crate) applications: Kind<Application>,
    /// Tasks of frameworks that are there: their names, and the uids of their owners.
    pub(crate) owners: BTreeMap<TaskUid, (String, String)>,
    /// The highest epoch that each lease ever had.
    epochs: BTreeMap<Key, u64>,
    /// By node the newest grant to a person: what was granted before never counts again.
    pub(crate) fences: BTreeMap<String, u64>,
    /// Tasks that have ended with their nodes since somebody looked, and the nodes.
    pub(crate) called_off: Vec<(TaskUid, String)>,
    /// What changed at the last look, for the log.
    pub(crate) news: Vec<String>,
    /// Since when a task waits without a reason, milliseconds.
    pub(crate) mute: BTreeMap<TaskUid, u64>,
}

impl Default for View {
    fn default() -> Self {
        View {
            revision: 0,
            tasks: Kind::new(TASKS),
            nodes: Kind::new(NODES),
            leases: Kind::new(LEASES),
            frameworks: Kind::new(FRAMEWORKS),
            sets: Kind::new(TASK_SETS),
            applications: Kind::new(APPLICATIONS),
            owners: BTreeMap::new(),
            epochs: BTreeMap::new(),
            fences: BTreeMap::new(),
            called_off: Vec::new(),
            news: Vec::new(),
            mute: BTreeMap::new(),
        }
    }
}

impl View {
    /// Takes in what has changed.
    ///
    /// # Errors
    ///
    /// What must not be.
    pub(crate) fn follow(&mut self, store: &Store, now: u64) -> Result<(), Violation> {
        if store.revision() < self.revision {
            return Err(Invariant::NothingAcknowledgedIsLost.broken(format!(
                "the store is at revision {}, and was seen at {}",
                store.revision(),
                self.revision
            )));
        }
        if store.revision() == self.revision {
            return Ok(());
        }
        self.revision = store.revision();
        self.nodes.follow(store)?;
        self.leases.follow(store)?;
        self.frameworks.follow(store)?;
        self.sets.follow(store)?;
        self.applications.follow(store)?;
        let changed = self.tasks.follow(store)?;
        self.lives_follow(changed)?;
        self.one_driver()?;
        self.no_oversubscription()?;
        self.explain(now);
        Ok(())
    }

    pub(crate) fn task(&self, uid: &TaskUid) -> Option<&Task> {
        self.tasks.all().find(|(_, of, _)| *of == uid).map(|(_, _, task)| task)
    }

    /// Nothing ends twice, nothing goes back.
    fn lives_follow(&mut self, changed: Vec<(Key, Option<Task>)>) -> Result<(), Violation> {
        for (key, before) in changed {
            let Some((_, _, after)) = self.tasks.objects.get(&key) else { continue };
            if let Some(owner) = controller(after, "Framework") {
                let uid = TaskUid::new(after.metadata.uid.as_deref().unwrap_or_default());
                self.owners.insert(uid, (key.name.to_string(), owner.to_owned()));
            }
            let (was, is) = (before.as_ref().map_or(TaskPhase::Pending, phase), phase(after));
            if was != is {
                let on = after.status.as_ref().and_then(|s| s.node.as_deref()).unwrap_or_default();
                self.news.push(format!("{}: {was}, now {is} {on}", key.name));
                if after.status.as_ref().is_some_and(|s| s.reason == FENCED) {
                    let uid = TaskUid::new(after.metadata.uid.as_deref().unwrap_or_default());
                    self.called_off.push((uid, on.to_owned()));
                }
            }
            let grant = |task: &Task| Some(task.status.as_ref()?.lease.as_ref()?.epoch);
            let (had, has) = (before.as_ref().and_then(grant), grant(after));
            if had.is_some() && has.is_some() && had != has {
                let how = format!("{key} had {had:?}, and has {has:?}");
                return Err(Invariant::OneDriver.broken(how));
            }
            if was.is_terminal() && was != is {
                let how = format!("{key} was {was}, and is {is}");
                return Err(Invariant::WorkOutlivesItsManagers.broken(how));
            }
            if !was.is_terminal() && was != TaskPhase::Pending && is == TaskPhase::Pending {
                return Err(
                    Invariant::NothingRunsTwice.broken(format!("{key} was {was}, and waits again"))
                );
            }
        }
        Ok(())
    }

    /// A lease is held by one task that holds the robot, and its epoch only grows.
    fn one_driver(&mut self) -> Result<(), Violation> {
        for (key, _, lease) in self.leases.all() {
            let status = lease.status.clone().unwrap_or_default();
            let highest = self.epochs.entry(key.clone()).or_default();
            if status.epoch.0 < *highest {
                let how = format!("{key} goes from epoch {highest} to {}", status.epoch.0);
                return Err(Invariant::OneDriver.broken(how));
            }
            *highest = status.epoch.0;
            let fence = status.fence.map_or(0, |fence| fence.0);
            let known = self.fences.entry(lease.spec.node.clone()).or_default();
            if fence < *known || fence > status.epoch.0 {
                let how = format!("{key} is fenced up to {fence}, and was up to {known}");
                return Err(Invariant::OneDriver.broken(how));
            }
            *known = fence;
            let task = |holder: &LeaseHolder| holder.kind == HolderKind::Task;
            let Some(holder) = status.holder.filter(task) else { continue };
            let held = self.tasks.all().find(|(_, uid, _)| **uid == holder.uid);
            let holds = held.is_some_and(|(_, _, task)| {
                let status = task.status.as_ref();
                status.is_some_and(|s| {
                    s.phase.holds_node() && s.lease.as_ref().is_some_and(|l| l.name == *key.name)
                })
            });
            if !holds {
                let how =
                    format!("{key} is held by {}, which does not hold the robot", holder.name);
                return Err(Invariant::OneDriver.broken(how));
            }
        }
        let mut drivers: BTreeMap<&str, &Key> = BTreeMap::new();
        for (key, _, task) in self.tasks.all() {
            let Some(status) = task.status.as_ref().filter(|s| s.phase.holds_node()) else {
                continue;
            };
            let Some(lease) = &status.lease else { continue };
            // From whom a person took it, runs on without it.
            let node = status.node.as_deref().unwrap_or_default();
            if self.fences.get(node).is_some_and(|fence| lease.epoch.0 < *fence) {
                continue;
            }
            if let Some(other) = drivers.insert(&lease.name, key) {
                let how = format!("{key} and {other} both have {}", lease.name);
                return Err(Invariant::OneDriver.broken(how));
            }
        }
        Ok(())
    }

    fn no_oversubscription(&self) -> Result<(), Violation> {
        for (key, _, node) in self.nodes.all() {
            let Some(status) = &node.status else { continue };
            let (mut cpu, mut memory) = (0, 0);
            for (_, _, task) in self.tasks.all() {
                let on = task.status.as_ref().filter(|s| s.phase.holds_node());
                if on.is_some_and(|s| s.node.as_deref() == Some(&*key.name)) {
                    let reserved = task.spec.resources.reserved();
                    cpu += reserved.cpu.0;
                    memory += reserved.memory.0;
                }
            }
            let has = &status.allocatable;
            if cpu > has.cpu.0 || memory > has.memory.0 {
                return Err(Invariant::NoOversubscription.broken(format!(
                    "{key} has {}m and {} bytes; {cpu}m and {memory} are reserved",
                    has.cpu.0, has.memory.0
                )));
            }
        }
        Ok(())
    }

    fn explain(&mut self, now: u64) {
        let waits = |task: &Task| {
            let said = task.status.as_ref().is_some_and(|status| !status.why.is_empty());
            phase(task) == TaskPhase::Pending && !said && task.metadata.deletion_timestamp.is_none()
        };
        let mute = self.tasks.all().filter(|(_, _, task)| waits(task));
        let mute =
            mute.map(|(_, uid, _)| (uid.clone(), self.mute.get(uid).copied().unwrap_or(now)));
        self.mute = mute.collect();
    }
}

/// The object of this kind that a task belongs to.
pub(crate) fn controller<'a>(task: &'a Task, kind: &str) -> Option<&'a str> {
    let owners = task.metadata.owner_references.iter().flatten();
    owners.filter(|owner| owner.kind == kind).map(|owner| &*owner.uid).next()
}

/// Where a task is.
pub(crate) fn phase(task: &Task) -> TaskPhase {
    task.status.as_ref().map_or(TaskPhase::Pending, |status| status.phase)
}
