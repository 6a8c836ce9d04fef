//! Keeps the tasks of TaskSets as the sets say.
//!
//! ```text
//!   store.watch_all ──▶ Index (who belongs to whom, nodes) ──▶ sets to look at
//!   one look: store ──▶ Snapshot ──core::taskset::plan──▶ Plan ──▶ one transaction (status + actions)
//! ```
//!
//! A look reads the set and its tasks from the store and not from memory, and its transaction holds only while the set
//! is what was read: what was decided twice is written once. A conflict is another look. What the status remembers is
//! written with the actions that it explains, so a crash in between leaves nothing half done.

mod index;
mod write;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use muster_api::condition::{Condition, set_condition};
use muster_api::kind::taskset::{TaskSet, TaskSetStatus};
use muster_api::kind::taskset_revision::TaskSetRevision;
use muster_controller_core::taskset::view::{RevisionView, TaskView};
use muster_controller_core::taskset::{Snapshot, plan};

use super::owned::{Later, Next, as_owner, silence};
use super::{again, next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, NODES, QUOTAS, REVISIONS};
use crate::store::{Change, Key, StoreError, Stored};
use index::Index;
use write::Outcome;
pub(crate) use write::spec_at;

/// When a look could not be carried out because something else refused it (a namespace that ends).
const LATER: Duration = Duration::from_secs(5);

/// When a node is expected to be heard: agents are back within seconds of a controller's start.
const SOON: Duration = Duration::from_millis(500);

/// Works until dropped.
pub async fn run(context: Arc<Context>) {
    again(&context, "task sets are not looked after", follow).await;
}

/// Looks at every set, then at those that something changed for; ends when it must begin anew.
async fn follow(context: &Context) -> Result<(), StoreError> {
    let mut watcher = watch_from_now(&context.store).await;
    let mut index = Index::default();
    for stored in context.store.list_all() {
        index.take_in(Change::Put, &stored);
    }
    let mut later = Later::default();
    loop {
        if index.lacks_nodes() {
            index.take_in_nodes(&context.store.list(NODES, None).items);
        }
        for key in index.take_dirty() {
            later.remove(&key);
            match look(context, &index, &key).await? {
                Next::Nothing => {}
                Next::At(when) => later.insert(key, when, context.clock.now()),
                Next::Again => index.mark(key),
            }
        }
        let wait = later.next(index.is_dirty());
        tokio::select! {
            // Cancel safe: events that were not returned are returned by the next call.
            events = next_events(&mut watcher) => {
                let Some(events) = events else { return Ok(()) };
                for event in &events {
                    index.take_in(event.change, &event.object);
                    let key = &event.object.key;
                    if key.resource == QUOTAS {
                        // Those that wait may wait for room in it.
                        let same = |set: &&Key| set.namespace() == key.namespace();
                        later.keys().filter(same).for_each(|set| index.mark(set.clone()));
                    }
                }
            }
            () = wait => later.due().for_each(|key| index.mark(key.clone())),
        }
    }
}

async fn look(context: &Context, index: &Index, key: &Key) -> Result<Next, StoreError> {
    let Some(stored) = context.store.get(key) else { return Ok(Next::Nothing) };
    let Some(set) = objects::read::<TaskSet>(&stored) else { return Ok(Next::Nothing) };
    if set.metadata.deletion_timestamp.is_some() {
        // Its tasks end or stay with it, as whoever deleted it said; that is the garbage collector's.
        return Ok(Next::Nothing);
    }
    let now = context.clock.now();
    let revisions = revisions(context, &stored, &key.name);
    let tasks = tasks(context, index, &stored, &set);
    let nothing = TaskSetStatus::default();
    let snapshot = Snapshot {
        name: &key.name,
        spec: &set.spec,
        generation: set.metadata.generation.unwrap_or_default(),
        status: set.status.as_ref().unwrap_or(&nothing),
        revisions: &revisions,
        tasks: &tasks,
        nodes: index.nodes(),
        silent: &silent_since(context, index, now),
        taken: &index.names(key, &tasks, |other| context.store.get(other).is_some()),
    };
    let mut plan = plan(&snapshot, now);
    for said in std::mem::take(&mut plan.conditions) {
        let condition = Condition::new(said.condition, said.status, said.reason, said.message);
        set_condition(&mut plan.status.conditions, condition, &Time(now));
    }
    Ok(match write::carry_out(context, &stored, &set, &plan).await? {
        Outcome::Done => plan.look_again.map_or(Next::Nothing, Next::At),
        Outcome::Raced => Next::Again,
        Outcome::Away => Next::At(now.checked_add(SOON).unwrap_or(now)),
        Outcome::Refused(why) => {
            tracing::warn!(set = %key, why, "a task set cannot go on yet");
            Next::At(now.checked_add(LATER).unwrap_or(now))
        }
    })
}

/// When silent nodes were heard last: dates may have jumped since.
fn silent_since(context: &Context, index: &Index, now: Timestamp) -> BTreeMap<String, Timestamp> {
    let since = |name: &String| Some((name.clone(), silence(context, name, now)?));
    index.silent().iter().filter_map(since).collect()
}

fn revisions(context: &Context, set: &Stored, name: &str) -> Vec<RevisionView> {
    let owner = as_owner(&set.key, &set.uid, "TaskSet");
    let all = context.store.list(REVISIONS, set.key.namespace()).items.into_iter();
    let of_set = all.filter(|s| s.mentions(name)).filter_map(|s| objects::read(&s));
    let named = of_set.filter(|r: &TaskSetRevision| {
        let labels = r.metadata.labels.as_ref();
        labels.and_then(|l| l.get(muster_api::kind::taskset::SET_LABEL)).is_some_and(|n| n == name)
    });
    named.filter_map(|revision| RevisionView::of(&revision, &owner)).collect()
}

fn tasks(context: &Context, index: &Index, stored: &Stored, set: &TaskSet) -> Vec<TaskView> {
    let selector = set.spec.selects(&stored.key.name);
    let keys = index.tasks_of(&stored.uid, stored.key.namespace().unwrap_or_default(), &selector);
    let present = keys.iter().filter_map(|key| context.store.get(key));
    let owner = as_owner(&stored.key, &stored.uid, "TaskSet");
    let views = present.filter_map(|s| TaskView::of(&objects::read(&s)?, &owner, &selector));
    views.collect()
}
