//! Puts a new Task in the place of one that has failed on its node and is to be tried on another: see
//! [`muster_controller_core::reschedule`].
//!
//! The old object goes and the new one comes in one transaction, under the same name: at no moment is there none, or are
//! there two. What belongs to the task (`metadata.ownerReferences`) belongs to the new one from then on. A task whose
//! attempts are used up stays, and says what was tried where.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta;
use muster_api::kind::task::{Task, TaskStatus};
use muster_controller_core::reschedule::{Step, step};
use serde_json::Value;

use super::{again, next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, TASKS};
use crate::rest::create::namespace_guard;
use crate::store::{Change, Key, Op, StoreError, Stored};

/// Works until dropped.
pub async fn run(context: Arc<Context>) {
    again(&context, "failed tasks are not tried elsewhere yet", follow).await;
}

/// What belongs to tasks.
#[derive(Debug, Default)]
struct Belongings {
    /// By the uid of the task.
    by_owner: HashMap<String, BTreeSet<Key>>,
    owners: BTreeMap<Key, Vec<String>>,
}

impl Belongings {
    fn take_in(&mut self, change: Change, stored: &Stored) {
        let key = &stored.key;
        for owner in self.owners.remove(key).into_iter().flatten() {
            if let Some(keys) = self.by_owner.get_mut(&owner) {
                keys.remove(key);
                if keys.is_empty() {
                    self.by_owner.remove(&owner);
                }
            }
        }
        if change == Change::Delete || !stored.mentions("ownerReferences") {
            return;
        }
        let object = stored.value();
        let owners: Vec<String> = references(&object)
            .filter(|owner| owner["kind"] == "Task")
            .filter_map(|owner| owner["uid"].as_str().map(str::to_owned))
            .collect();
        for owner in &owners {
            self.by_owner.entry(owner.clone()).or_default().insert(key.clone());
        }
        if !owners.is_empty() {
            self.owners.insert(key.clone(), owners);
        }
    }

    /// What hands everything that belongs to one task over to another.
    fn hand_over(&self, context: &Context, task: &Key, from: &str, to: &str) -> Vec<Op> {
        let keys = self.by_owner.get(from).into_iter().flatten();
        let keys = keys.filter(|key| key.namespace() == task.namespace());
        let present = keys.filter_map(|key| context.store.get(key));
        present.filter_map(|stored| hand_over(&stored, from, to)).collect()
    }
}

fn references(object: &Value) -> impl Iterator<Item = &Value> {
    object.pointer("/metadata/ownerReferences").and_then(Value::as_array).into_iter().flatten()
}

fn hand_over(stored: &Stored, from: &str, to: &str) -> Option<Op> {
    let mut object = stored.value();
    let owners = object.pointer_mut("/metadata/ownerReferences")?.as_array_mut()?;
    let owner = owners.iter_mut().find(|owner| owner["uid"] == from)?;
    owner["uid"] = to.into();
    Some(Op::replace(stored.key.clone(), object, stored.revision))
}

/// Looks at every task, then at what changes; ends when it must begin anew.
async fn follow(context: &Context) -> Result<(), StoreError> {
    let mut watcher = watch_from_now(&context.store).await;
    let mut belongings = Belongings::default();
    let mut failed: BTreeSet<Key> = BTreeSet::new();
    for stored in context.store.list_all() {
        take_in(Change::Put, &stored, &mut belongings, &mut failed);
    }
    loop {
        while let Some(key) = failed.pop_first() {
            consider(context, &belongings, &key).await?;
        }
        let Some(events) = next_events(&mut watcher).await else { return Ok(()) };
        for event in &events {
            take_in(event.change, &event.object, &mut belongings, &mut failed);
        }
    }
}

fn take_in(
    change: Change,
    stored: &Stored,
    belongings: &mut Belongings,
    failed: &mut BTreeSet<Key>,
) {
    belongings.take_in(change, stored);
    let concerns = ["reschedule", "onOutOfRange"];
    if change == Change::Put
        && stored.key.resource == TASKS
        && concerns.iter().any(|field| stored.mentions(field))
        && stored.mentions("Failed")
    {
        failed.insert(stored.key.clone());
    }
}

async fn consider(context: &Context, belongings: &Belongings, key: &Key) -> Result<(), StoreError> {
    let mut new = None;
    objects::change_watched(&context.store, key, |stored, mut task: Task| {
        new = None;
        match step(&task, context.clock.now()) {
            Step::Nothing => None,
            Step::Conclude { reason, message } => {
                let status = task.status.get_or_insert_default();
                (status.reason, status.message) = (reason.to_owned(), message);
                Some(vec![objects::replace(stored, &task)])
            }
            Step::Again(status) => {
                let next = successor(context, task, *status);
                let mut ops = vec![Op::remove(stored.key.clone(), stored.revision)];
                ops.push(objects::create(stored.key.clone(), &next));
                let uid = objects::uid_of(&next.metadata);
                ops.extend(belongings.hand_over(context, key, &stored.uid, uid));
                // A namespace that ends takes its tasks with it, and nothing new.
                let namespace = stored.key.namespace().unwrap_or_default();
                ops.extend(namespace_guard(context, TASKS, namespace).ok()?);
                new = Some(next);
                Some(ops)
            }
        }
    })
    .await?;
    if let Some(task) = new {
        tell(context, &task);
    }
    Ok(())
}

/// The same task as a new object.
fn successor(context: &Context, task: Task, status: TaskStatus) -> Task {
    let ObjectMeta {
        name,
        generate_name,
        namespace,
        labels,
        annotations,
        owner_references,
        managed_fields,
        ..
    } = task.metadata;
    let mut metadata = ObjectMeta {
        name,
        generate_name,
        namespace,
        labels,
        annotations,
        owner_references,
        managed_fields,
        ..ObjectMeta::default()
    };
    objects::stamp_new(&mut metadata, context.clock.now());
    Task { metadata, spec: task.spec, status: Some(status) }
}

fn tell(context: &Context, task: &Task) {
    let Some(last) = task.status.as_ref().and_then(|status| status.earlier.last()) else { return };
    let message = format!("ended on {} ({}); is tried again", last.node, last.end());
    tracing::info!(task = %objects::task_key(task), node = last.node, reason = last.reason, "a task is tried again");
    metrics::counter!("muster_reschedules_total").increment(1);
    context.events.warn_task(task, "Rescheduled", message);
}
