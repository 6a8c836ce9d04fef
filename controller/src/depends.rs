//! Tasks that wait for others: what holds them, what their agents are told, and rings that are refused.

use std::collections::BTreeSet;

use muster_api::kind::task::depend::{self, DependencyCondition, Graph};
use muster_api::kind::task::{Outlook, Task, TaskSpec, TaskStatus};
use muster_api::validate::Violations;
use muster_api::wire::agent::v1 as wire;
use muster_controller_core::hold::Hold;
use serde_json::Value;

use crate::objects::{self, TASKS};
use crate::store::{Key, Store};

fn key_of(namespace: &str, name: &str) -> Key {
    Key::namespaced(TASKS, namespace, name)
}

fn task(store: &Store, namespace: &str, name: &str) -> Option<Task> {
    objects::read(&*store.get(&key_of(namespace, name))?)
}

/// The keys of the tasks that a task of `namespace` waits for.
pub(crate) fn keys<'a>(namespace: &'a str, spec: &'a TaskSpec) -> impl Iterator<Item = Key> + 'a {
    spec.depends_on.iter().map(move |one| key_of(namespace, &one.task))
}

/// What holds a task of `namespace`.
#[must_use]
pub(crate) fn holds(store: &Store, namespace: &str, spec: &TaskSpec) -> Vec<Hold> {
    let hold = |one: &depend::DependsOn| {
        let name = one.task.clone();
        let Some(task) = task(store, namespace, &name) else {
            return Some(Hold::DependencyNotFound { task: name });
        };
        let why = unmet(one.condition, &task)?;
        Some(Hold::DependencyNotMet { task: name, why })
    };
    spec.depends_on.iter().filter_map(hold).collect()
}

/// The same when `objects`, manifests that were admitted, are stored as well: a task among them is there, and has not
/// begun.
#[must_use]
pub(crate) fn holds_with(
    store: &Store,
    objects: &[Value],
    namespace: &str,
    spec: &TaskSpec,
) -> Vec<Hold> {
    let planned = |name: &str| objects::among(objects, "Task", (namespace, name)).is_some();
    let hold = |hold: Hold| match hold {
        Hold::DependencyNotFound { task } if planned(&task) => {
            Hold::DependencyNotMet { task, why: "is created with it".to_owned() }
        }
        other => other,
    };
    holds(store, namespace, spec).into_iter().map(hold).collect()
}

/// What the agent of a placed task is told of those that it waits for.
#[must_use]
pub(crate) fn to_wire(store: &Store, namespace: &str, spec: &TaskSpec) -> Vec<wire::Dependency> {
    let dependency = |one: &depend::DependsOn| {
        let task = task(store, namespace, &one.task);
        let mut told = wire::Dependency {
            task: one.task.clone(),
            condition: wire::DependencyCondition::from(one.condition).into(),
            restart: one.restart,
            ..wire::Dependency::default()
        };
        match task {
            // One that has succeeded may be removed. Another one must be there again.
            None => {
                told.met = one.condition == DependencyCondition::Succeeded;
                told.unmet = "is not there".to_owned();
            }
            Some(task) => {
                let unmet = unmet(one.condition, &task);
                (told.met, told.unmet) = (unmet.is_none(), unmet.unwrap_or_default());
                told.uid = task.metadata.uid.unwrap_or_default();
                told.attempt = task.status.unwrap_or_default().attempt;
            }
        }
        told
    };
    spec.depends_on.iter().map(dependency).collect()
}

/// What a task that others wait for lacks, a clause whose subject is that task.
fn unmet(condition: DependencyCondition, task: &Task) -> Option<String> {
    if let Outlook::Again { .. } = task.outlook() {
        return Some("has failed on its node and is about to be tried again".to_owned());
    }
    let TaskStatus { phase, ready, .. } = task.status.clone().unwrap_or_default();
    condition.unmet(phase, ready)
}

/// Whether nothing will run again under its name by itself.
fn is_over(task: &Value) -> bool {
    serde_json::from_value::<Task>(task.clone()).is_ok_and(|task| task.outlook().is_over())
}

/// Refuses a new task that would wait for itself.
///
/// Two that are created in the same moment can still close a ring; both wait then, and each says for which.
///
/// `planned`: objects that are stored in the same moment.
pub(crate) fn check(store: &Store, planned: &[Value], object: &Value) -> Result<(), Violations> {
    let first = depend::named(object);
    let metadata = &object["metadata"];
    let (Some(name), Some(namespace)) = (metadata["name"].as_str(), metadata["namespace"].as_str())
    else {
        return Ok(());
    };
    let mut graph = Graph::new();
    let mut left = first.clone();
    let mut seen: BTreeSet<String> = BTreeSet::from([name.to_owned()]);
    graph.insert(name.to_owned(), first);
    while let Some(next) = left.pop() {
        if !seen.insert(next.clone()) {
            continue;
        }
        let stored = store.get(&key_of(namespace, &next)).filter(|s| s.mentions("dependsOn"));
        // What has ended waits for nobody.
        let stored = stored.map(|stored| stored.value()).filter(|task| !is_over(task));
        let value = stored.or_else(|| objects::among(planned, "Task", (namespace, &next)).cloned());
        let more = value.as_ref().map(depend::named).unwrap_or_default();
        left.extend(more.iter().cloned());
        graph.insert(next, more);
    }
    match depend::cycle(&graph, name) {
        Some(ring) => Err(depend::ring_refusal(object, &ring, "")),
        None => Ok(()),
    }
}
