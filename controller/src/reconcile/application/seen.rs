//! What is known beside the applications themselves: nodes, what agents measured, and who is to be looked at.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::application::Application;
use muster_api::kind::node::Node;
use muster_api::name::NodeName;
use muster_controller_core::offload::run::scales::is_scale;
use muster_controller_core::offload::run::view::{NodeSeen, TaskSeen};

use crate::context::Context;
use crate::objects::{self, APPLICATIONS, NODES, QUOTAS, TASKS};
use crate::reconcile::owned::{Whose, silence};
use crate::store::{Change, Key, Stored};

/// How long an attempt must have run before its mean use of cpu says something: starting is not what it does later.
const LEARNED_AFTER: Duration = Duration::from_secs(10);

/// Nodes, and who is to be looked at.
#[derive(Debug, Default)]
pub(super) struct Seen {
    applications: BTreeSet<Key>,
    /// Kept only while there are applications, whom alone they concern.
    nodes: Option<BTreeMap<String, NodeSeen>>,
    dirty: BTreeSet<Key>,
}

impl Seen {
    pub(super) fn take_in(&mut self, change: Change, stored: &Arc<Stored>) {
        let key = &stored.key;
        if key.resource == APPLICATIONS && change == Change::Delete {
            self.applications.remove(key);
            if self.applications.is_empty() {
                self.nodes = None;
            }
        } else if key.resource == APPLICATIONS {
            self.applications.insert(key.clone());
            self.mark(key.clone());
        } else if key.resource == NODES {
            self.take_in_node(change, stored);
        } else if key.resource == TASKS && stored.mentions("Application") {
            self.mark_owner(stored);
        } else if key.resource == QUOTAS {
            // Tasks that were refused may be let in now.
            let same = |app: &&Key| app.namespace() == key.namespace();
            self.dirty.extend(self.applications.iter().filter(same).cloned());
        }
    }

    fn mark_owner(&mut self, task: &Stored) {
        let Some(whose) = objects::read::<Whose>(task) else { return };
        let Some(owner) = whose.controller().filter(|owner| owner.kind == "Application") else {
            return;
        };
        let namespace = task.key.namespace().unwrap_or_default();
        let key = Key::namespaced(APPLICATIONS, namespace, owner.name.as_str());
        if self.applications.contains(&key) {
            self.mark(key);
        }
    }

    fn take_in_node(&mut self, change: Change, stored: &Stored) {
        let Some(nodes) = &mut self.nodes else { return };
        let node = (change == Change::Put).then(|| objects::read::<Node>(stored)).flatten();
        let view = node.map(|node| NodeSeen::of(&node));
        let name = stored.key.name.to_string();
        // Nodes are written for much that concerns no application.
        if nodes.get(&name) == view.as_ref() {
            return;
        }
        match view {
            Some(view) => drop(nodes.insert(name, view)),
            None => drop(nodes.remove(&name)),
        }
        self.dirty.extend(self.applications.iter().cloned());
    }

    /// Learns of the nodes, when there are applications and they are not known. They may be ahead of events that are still
    /// to come: those only say again what is known.
    pub(super) fn fill_nodes(&mut self, context: &Context) {
        if self.nodes.is_none() && !self.applications.is_empty() {
            self.nodes = Some(BTreeMap::new());
            for stored in context.store.list(NODES, None).items {
                self.take_in_node(Change::Put, &stored);
            }
        }
    }

    /// The nodes that concern an application, with what is measured of their links now.
    pub(super) fn nodes_of(
        &self,
        context: &Context,
        application: &Application,
        now: Timestamp,
    ) -> BTreeMap<String, NodeSeen> {
        let spec = &application.spec;
        let parts = application.status.iter().flat_map(|status| &status.parts);
        let mut named: BTreeSet<&str> =
            parts.flat_map(|part| part.tasks()).map(|task| task.scale.as_str()).collect();
        named.insert(&spec.home);
        let concerns = |(name, node): &(&String, &NodeSeen)| {
            named.contains(name.as_str()) || is_scale(spec, name, node)
        };
        let all = self.nodes.iter().flatten().filter(concerns);
        let mut nodes: BTreeMap<String, NodeSeen> =
            all.map(|(name, node)| (name.clone(), node.clone())).collect();
        let Some(live) = context.live() else { return nodes };
        for (name, node) in &mut nodes {
            // The longer one: a robot counts from its last contact, whatever happened to the controller since.
            let written = node.view.silent_since;
            node.view.silent_since = written
                .map(|since| silence(context, name, now).map_or(since, |here| here.min(since)));
            let Ok(name) = NodeName::new(name.clone()) else { continue };
            if let Some(link) = live.sessions.link(&name) {
                node.link.round_trip = Some(link.round_trip);
            }
        }
        nodes
    }

    /// An application is to be looked at.
    pub(super) fn mark(&mut self, key: Key) {
        self.dirty.insert(key);
    }

    pub(super) fn is_dirty(&self) -> bool {
        !self.dirty.is_empty()
    }

    /// The applications to look at.
    pub(super) fn take_dirty(&mut self) -> BTreeSet<Key> {
        std::mem::take(&mut self.dirty)
    }
}

/// The tasks with what agents measured of them last.
pub(super) fn measured(
    context: &Context,
    mut tasks: BTreeMap<String, TaskSeen>,
    now: Timestamp,
) -> BTreeMap<String, TaskSeen> {
    let Some(live) = context.live() else { return tasks };
    for task in tasks.values_mut() {
        let node = task.view.node.clone().and_then(|node| NodeName::new(node).ok());
        let Some(usage) = node.and_then(|node| live.sessions.usage_of(&node, &task.uid)) else {
            continue;
        };
        task.tells = usage.told.iter().map(|t| (t.name.clone(), t.value)).collect();
        let counted = usage.usage.unwrap_or_default().cpu_total_usec;
        let ran = task.view.started.map(|at| now.duration_since(at));
        let ran = ran.and_then(|ran| Duration::try_from(ran).ok());
        task.used = ran
            .filter(|ran| *ran >= LEARNED_AFTER)
            .map(|ran| counted as f64 / 1e6 / ran.as_secs_f64());
    }
    tasks
}
