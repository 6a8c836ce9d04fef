//! Which set a change concerns: who controls which task, which tasks nobody controls, and the nodes as sets see them.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use muster_api::kind::node::Node;
use muster_api::kind::taskset::TaskSet;
use muster_api::selector::{LabelSelector, Labels};
use muster_controller_core::taskset::view::{NodeView, TaskView};

use crate::objects::{self, NODES, REVISIONS, TASK_SETS, TASKS};
use crate::reconcile::owned::Whose;
use crate::store::{Change, Key, Stored};

/// What is remembered of a set.
#[derive(Debug)]
struct Set {
    key: Key,
    selector: LabelSelector,
}

/// Who belongs to whom.
#[derive(Debug, Default)]
pub(super) struct Index {
    /// By uid.
    sets: HashMap<Box<str>, Set>,
    /// Every task, and the uid of its controller.
    tasks: BTreeMap<Key, Option<String>>,
    /// Tasks by the uid of their controller.
    controlled: HashMap<String, BTreeSet<Key>>,
    /// Tasks with labels that nobody controls.
    loose: BTreeMap<Key, Labels>,
    /// Kept only while there are sets, whom alone they concern: ten thousand of them are tens of megabytes.
    nodes: Option<BTreeMap<String, NodeView>>,
    /// Those of them that are not heard.
    silent: BTreeSet<String>,
    dirty: BTreeSet<Key>,
}

impl Index {
    pub(super) fn take_in(&mut self, change: Change, stored: &Arc<Stored>) {
        let resource = stored.key.resource;
        if resource == TASKS {
            self.take_in_task(change, stored);
        } else if resource == NODES {
            self.take_in_node(change, stored);
        } else if resource == TASK_SETS {
            self.take_in_set(change, stored);
        } else if resource == REVISIONS
            && let Some(whose) = objects::read::<Whose>(stored)
            && let Some(owner) = whose.controller()
        {
            self.mark_uid(&owner.uid);
        }
    }

    fn take_in_set(&mut self, change: Change, stored: &Arc<Stored>) {
        if change == Change::Delete {
            self.sets.remove(&stored.uid);
            if self.sets.is_empty() {
                self.nodes = None;
            }
            return;
        }
        let Some(set) = objects::read::<TaskSet>(stored) else { return };
        let selector = set.spec.selects(&stored.key.name);
        self.sets.insert(stored.uid.clone(), Set { key: stored.key.clone(), selector });
        self.dirty.insert(stored.key.clone());
    }

    fn take_in_task(&mut self, change: Change, stored: &Arc<Stored>) {
        let key = &stored.key;
        if let Some(Some(before)) = self.tasks.remove(key) {
            if let Some(keys) = self.controlled.get_mut(&before) {
                keys.remove(key);
            }
            self.mark_uid(&before);
        }
        self.loose.remove(key);
        if change == Change::Delete {
            // Its name is free for a set that wants it.
            self.mark_namesakes(key);
            return;
        }
        let whose = objects::read::<Whose>(stored);
        let controller = whose.as_ref().and_then(Whose::controller).map(|owner| owner.uid.clone());
        self.tasks.insert(key.clone(), controller.clone());
        match (controller, whose.and_then(|w| w.metadata.labels)) {
            (Some(uid), _) => {
                self.mark_uid(&uid);
                self.controlled.entry(uid).or_default().insert(key.clone());
            }
            (None, Some(labels)) => {
                let takes = |set: &&Set| {
                    set.key.namespace() == key.namespace() && set.selector.matches(&labels)
                };
                self.dirty.extend(self.sets.values().filter(takes).map(|set| set.key.clone()));
                self.loose.insert(key.clone(), labels);
            }
            (None, None) => {}
        }
    }

    /// There are sets, and the nodes are not known yet.
    pub(super) fn lacks_nodes(&self) -> bool {
        self.nodes.is_none() && !self.sets.is_empty()
    }

    /// Every node there is. They may be ahead of the events that are still to come: those only say again what is known
    /// already, or what is known for a moment more.
    pub(super) fn take_in_nodes<'a>(&mut self, all: impl IntoIterator<Item = &'a Arc<Stored>>) {
        self.nodes = Some(BTreeMap::new());
        self.silent.clear();
        all.into_iter().for_each(|stored| self.take_in_node(Change::Put, stored));
    }

    fn take_in_node(&mut self, change: Change, stored: &Arc<Stored>) {
        let Some(nodes) = &mut self.nodes else { return };
        let node = (change == Change::Put).then(|| objects::read::<Node>(stored)).flatten();
        let view = node.map(|node| NodeView::of(&node));
        let name = stored.key.name.to_string();
        // Nodes are written with every placement; few of those changes concern a set.
        if nodes.get(&name) == view.as_ref() {
            return;
        }
        if view.as_ref().is_some_and(|view| view.silent_since.is_some()) {
            self.silent.insert(name.clone());
        } else {
            self.silent.remove(&name);
        }
        match view {
            Some(view) => drop(nodes.insert(name, view)),
            None => drop(nodes.remove(&name)),
        }
        self.dirty.extend(self.sets.values().map(|set| set.key.clone()));
    }

    fn mark_uid(&mut self, uid: &str) {
        if let Some(set) = self.sets.get(uid) {
            self.dirty.insert(set.key.clone());
        }
    }

    fn mark_namesakes(&mut self, task: &Key) {
        let of = |set: &&Set| {
            let rest = task.name.strip_prefix(&*set.key.name);
            set.key.namespace() == task.namespace() && rest.is_some_and(|r| r.starts_with('-'))
        };
        self.dirty.extend(self.sets.values().filter(of).map(|set| set.key.clone()));
    }

    /// A set is to be looked at.
    pub(super) fn mark(&mut self, key: Key) {
        self.dirty.insert(key);
    }

    pub(super) fn is_dirty(&self) -> bool {
        !self.dirty.is_empty()
    }

    /// The sets to look at.
    pub(super) fn take_dirty(&mut self) -> BTreeSet<Key> {
        std::mem::take(&mut self.dirty)
    }

    pub(super) fn nodes(&self) -> &BTreeMap<String, NodeView> {
        const NONE: &BTreeMap<String, NodeView> = &BTreeMap::new();
        self.nodes.as_ref().unwrap_or(NONE)
    }

    /// Nodes that are not heard.
    pub(super) fn silent(&self) -> &BTreeSet<String> {
        &self.silent
    }

    /// The tasks of a set, and those that it could take in, in the order of their names.
    pub(super) fn tasks_of(
        &self,
        uid: &str,
        namespace: &str,
        selector: &LabelSelector,
    ) -> BTreeSet<Key> {
        let first = Key::namespaced(TASKS, namespace, "");
        let loose = self.loose.range(first..).take_while(|(k, _)| k.namespace() == Some(namespace));
        let loose = loose.filter(|(_, labels)| selector.matches(labels)).map(|(key, _)| key);
        // Who is named as an owner by an object of another namespace is not.
        let own = self.controlled.get(uid).into_iter().flatten();
        own.filter(|key| key.namespace() == Some(namespace)).chain(loose).cloned().collect()
    }

    /// Names that begin as those of a set's tasks do and belong to other tasks. The index may still know a task that is
    /// gone from the store, whose name is free: `is_there` says so.
    pub(super) fn names(
        &self,
        set: &Key,
        tasks: &[TaskView],
        is_there: impl Fn(&Key) -> bool,
    ) -> BTreeSet<String> {
        let prefix = format!("{}-", set.name);
        let namespace = set.namespace().unwrap_or_default();
        let first = Key::namespaced(TASKS, namespace, prefix.as_str());
        let same = self.tasks.range(first..).map(|(key, _)| key);
        let same = same
            .take_while(|key| key.namespace() == Some(namespace) && key.name.starts_with(&prefix));
        let others = same.filter(|key| tasks.iter().all(|t| *t.name != *key.name));
        others.filter(|key| is_there(key)).map(|key| key.name.to_string()).collect()
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_name_of_a_task_that_is_gone_is_free_before_its_event_comes() {
        let object = json!({
            "apiVersion": muster_api::API_VERSION, "kind": "Task", "metadata": {"name": "watch-0", "namespace": "lab"},
            "spec": {"run": {"process": {"command": ["true"]}}},
        });
        let bytes = serde_json::to_vec(&object).expect("JSON").into();
        let key = Key::namespaced(TASKS, "lab", "watch-0");
        let mut index = Index::default();
        index.take_in(Change::Put, &Arc::new(Stored::new(key, 1, "u".into(), bytes)));
        let set = Key::namespaced(TASK_SETS, "lab", "watch");
        let taken: Vec<String> = index.names(&set, &[], |_| true).into_iter().collect();
        assert_eq!(taken, ["watch-0"]);
        assert!(index.names(&set, &[], |_| false).is_empty());
    }

    /// The set would delete what has the same name in its own namespace.
    #[test]
    fn a_task_of_another_namespace_is_none_of_the_set_that_it_names() {
        let owner = json!([{
            "apiVersion": muster_api::API_VERSION, "kind": "TaskSet", "name": "watch", "uid": "s", "controller": true,
        }]);
        let mut index = Index::default();
        for namespace in ["lab", "other"] {
            let object = json!({
                "apiVersion": muster_api::API_VERSION, "kind": "Task",
                "metadata": {"name": "watch-0", "namespace": namespace, "ownerReferences": owner},
                "spec": {"run": {"process": {"command": ["true"]}}},
            });
            let bytes = serde_json::to_vec(&object).expect("JSON").into();
            let key = Key::namespaced(TASKS, namespace, "watch-0");
            index.take_in(Change::Put, &Arc::new(Stored::new(key, 1, "u".into(), bytes)));
        }
        let tasks: Vec<Key> =
            index.tasks_of("s", "lab", &LabelSelector::default()).into_iter().collect();
        assert_eq!(tasks, [Key::namespaced(TASKS, "lab", "watch-0")]);
    }
}
