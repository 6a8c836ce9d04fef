//! Runs the parts of Applications and moves them.
//!
//! ```text
//!   store.watch_all, sessions ──▶ Seen (nodes, who is to be looked at)
//!   one look: store ──▶ Snapshot ──core::offload::run::plan──▶ Plan ──▶ one transaction (status + tasks)
//! ```
//!
//! A look reads the application and its tasks from the store, and its transaction holds only while the application is what
//! was read. What the status remembers is written with the tasks that it explains: a crash in between leaves nothing half
//! done. Every application is looked at each period of its own, and when it, one of its tasks or a node changes.

mod seen;
mod write;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::application::{Application, ApplicationStatus, task_name};
use muster_api::kind::task::Task;
use muster_controller_core::offload::run::view::TaskSeen;
use muster_controller_core::offload::run::{Snapshot, plan};

use super::owned::{Later, Next, as_owner};
use super::{again, next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, APPLICATIONS, TASKS};
use crate::store::{Change, Key, StoreError, Stored};
use seen::Seen;
use write::Outcome;

/// Between two rounds of looks: nodes change all the time, and a step of a move is not late by this.
const PAUSE: Duration = Duration::from_millis(50);
/// When tasks were refused that something else may let in later (a quota, a namespace).
const LATER: Duration = Duration::from_secs(5);

/// Works until dropped.
pub async fn run(context: Arc<Context>) {
    again(&context, "applications are not looked after", follow).await;
}

/// Looks at every application, then at those that something changed for; ends when it must begin anew.
async fn follow(context: &Context) -> Result<(), StoreError> {
    let mut watcher = watch_from_now(&context.store).await;
    let mut seen = Seen::default();
    for stored in context.store.list(APPLICATIONS, None).items {
        seen.take_in(Change::Put, &stored);
    }
    let mut waiting = Later::default();
    loop {
        seen.fill_nodes(context);
        for key in seen.take_dirty() {
            waiting.remove(&key);
            match look(context, &seen, &key).await? {
                Next::Nothing => {}
                Next::At(when) => waiting.insert(key, when, context.clock.now()),
                Next::Again => seen.mark(key),
            }
        }
        tokio::time::sleep(PAUSE).await;
        let wait = waiting.next(seen.is_dirty());
        tokio::select! {
            // Cancel safe: events that were not returned are returned by the next call.
            events = next_events(&mut watcher) => {
                let Some(events) = events else { return Ok(()) };
                events.iter().for_each(|event| seen.take_in(event.change, &event.object));
            }
            () = wait => waiting.due().for_each(|key| seen.mark(key.clone())),
        }
    }
}

async fn look(context: &Context, seen: &Seen, key: &Key) -> Result<Next, StoreError> {
    let Some(stored) = context.store.get(key) else { return Ok(Next::Nothing) };
    let Some(application) = objects::read::<Application>(&stored) else { return Ok(Next::Nothing) };
    if application.metadata.deletion_timestamp.is_some() {
        // Its tasks end or stay with it, as whoever deleted it said; that is the garbage collector's.
        return Ok(Next::Nothing);
    }
    let now = context.clock.now();
    let nothing = ApplicationStatus::default();
    let status = application.status.as_ref().unwrap_or(&nothing);
    let nodes = seen.nodes_of(context, &application, now);
    let tasks = seen::measured(context, tasks(context, &stored, status), now);
    let mut refused = BTreeMap::new();
    // What is refused is left out of the next plan; there are fewer new tasks than parts, so it ends.
    loop {
        let snapshot = Snapshot {
            name: &key.name,
            spec: &application.spec,
            generation: application.metadata.generation.unwrap_or_default(),
            status,
            tasks: &tasks,
            nodes: &nodes,
            taken: &taken(context, key, &application, status),
            refused: &refused,
        };
        let plan = plan(&snapshot, now);
        let waits = if refused.is_empty() { plan.look_again } else { later(now) };
        match write::carry_out(context, &stored, &application, &plan).await? {
            Outcome::Done => return Ok(Next::At(waits)),
            Outcome::Raced => return Ok(Next::Again),
            Outcome::Refused(more) => {
                let known = refused.len();
                refused.extend(more);
                if refused.len() == known {
                    return Ok(Next::At(later(now)));
                }
            }
        }
    }
}

fn later(now: Timestamp) -> Timestamp {
    now.checked_add(LATER).unwrap_or(now)
}

/// The tasks that the status names and that are the application's.
fn tasks(
    context: &Context,
    stored: &Stored,
    status: &ApplicationStatus,
) -> BTreeMap<String, TaskSeen> {
    let namespace = stored.key.namespace().unwrap_or_default();
    let owner = as_owner(&stored.key, &stored.uid, "Application");
    let named = status.parts.iter().flat_map(|part| part.tasks());
    let read = |name: &String| {
        let task = context.store.get(&Key::namespaced(TASKS, namespace, name.as_str()))?;
        TaskSeen::of(&objects::read::<Task>(&task)?, &owner)
    };
    named.filter_map(|task| Some((task.name.clone(), read(&task.name)?))).collect()
}

/// Names that new tasks of the application would have and that are taken: for each part, up to the first that is free.
fn taken(
    context: &Context,
    key: &Key,
    application: &Application,
    status: &ApplicationStatus,
) -> BTreeSet<String> {
    let namespace = key.namespace().unwrap_or_default();
    let mut taken = BTreeSet::new();
    for part in &application.spec.parts {
        let attempts = status.part(&part.name).map_or(0, |part| part.attempts);
        let names = (attempts + 1..).map(|number| task_name(&key.name, &part.name, number));
        let there =
            |name: &String| context.store.get(&Key::namespaced(TASKS, namespace, name.as_str()));
        taken.extend(names.take_while(|name| there(name).is_some()));
    }
    taken
}
