//! The door of namespaces with a Quota: counts what their tasks ask for, and lets a new one pass or not.
//!
//! ```text
//!   create ──admit──▶ Door ── store's changes so far ──▶ present
//!                      │                                  + passing ──core::quota──▶ Pass | refusals
//!   commit, then the Pass is dropped: the store shows the task from now on
//! ```
//!
//! A look at the door first takes in every change that the store has published, and a commit is published before it is
//! acknowledged: between the Pass and the commit a task is counted as passing, afterwards as present, and never as
//! neither. A client that goes away in the middle of its own create leaves a moment in which its task is not counted; the
//! ledger gives nothing out twice even then.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use muster_api::id::TaskUid;
use muster_api::kind::quota::{QUOTA_NAME, Quota, QuotaSpec, TaskDefaults, Used};
use muster_api::kind::task::{Resources, Task};
use muster_api::phase::TaskPhase;
use muster_api::validate::Violations;
use muster_controller_core::quota::{Requests, asked, refusals};
use serde::Deserialize;
use serde_json::{Map, Value};

use crate::objects::{self, QUOTAS, TASKS};
use crate::store::{Change, Key, Store, Stored, Watcher};

/// Counts tasks of namespaces that have a Quota.
#[derive(Debug, Default)]
pub(crate) struct Door(Mutex<Counts>);

#[derive(Debug, Default)]
struct Counts {
    /// Opened with the first count.
    watcher: Option<Watcher>,
    namespaces: HashMap<Arc<str>, Counted>,
}

#[derive(Debug, Default)]
struct Counted {
    /// As the store shows them.
    present: Requests,
    /// Let in and not seen in the store yet.
    passing: Requests,
}

/// A task that was let in; it is counted until this is dropped, which is to be after its commit.
#[derive(Debug)]
pub(crate) struct Pass {
    door: Arc<Door>,
    namespace: Arc<str>,
    uid: TaskUid,
}

impl Drop for Pass {
    fn drop(&mut self) {
        let mut counts = self.door.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(counted) = counts.namespaces.get_mut(&self.namespace) {
            counted.passing.remove(&self.uid);
        }
    }
}

/// What of a stored task matters here.
#[derive(Deserialize)]
struct Seen {
    spec: SeenSpec,
    #[serde(default)]
    status: SeenStatus,
}

#[derive(Deserialize)]
struct SeenSpec {
    #[serde(default)]
    resources: Resources,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct SeenStatus {
    phase: TaskPhase,
}

fn is_tried_again(stored: &Stored) -> bool {
    let may_be = stored.mentions("reschedule") || stored.mentions("onOutOfRange");
    may_be && objects::read::<Task>(stored).is_some_and(|task| !task.outlook().is_over())
}

impl Counted {
    fn take_in(&mut self, change: Change, stored: &Stored) {
        let uid = TaskUid::new(&*stored.uid);
        self.passing.remove(&uid);
        let seen = (change == Change::Put).then(|| objects::read::<Seen>(stored)).flatten();
        match seen {
            // One that is about to be tried elsewhere asks for the same then.
            Some(task) if !task.status.phase.is_terminal() || is_tried_again(stored) => {
                self.present.put(&uid, asked(&task.spec.resources));
            }
            _ => self.present.remove(&uid),
        }
    }

    /// Counts anew what the store shows.
    fn list(&mut self, store: &Store, namespace: &str) {
        self.present = Requests::default();
        for stored in store.list(TASKS, Some(namespace)).items {
            self.take_in(Change::Put, &stored);
        }
    }

    fn sum(&self) -> Used {
        let mut sum = self.present.sum().clone();
        sum.add(self.passing.sum());
        sum
    }
}

impl Counts {
    /// Takes in everything that the store has published.
    fn catch_up(&mut self, store: &Store) {
        loop {
            let Some(watcher) = self.watcher.as_mut() else {
                // What is listed after this is at least as new.
                self.watcher = store.watch(TASKS, store.revision()).ok();
                for (namespace, counted) in &mut self.namespaces {
                    counted.list(store, namespace);
                }
                return;
            };
            match watcher.take() {
                Ok(events) if events.is_empty() => return,
                Ok(events) => {
                    for event in events {
                        let counted = event
                            .object
                            .key
                            .namespace()
                            .and_then(|namespace| self.namespaces.get_mut(namespace));
                        if let Some(counted) = counted {
                            counted.take_in(event.change, &event.object);
                        }
                    }
                }
                // Nobody asked for longer than history reaches back: counted anew.
                Err(_) => self.watcher = None,
            }
        }
    }

    fn of(&mut self, store: &Store, namespace: &str) -> &mut Counted {
        self.catch_up(store);
        if !self.namespaces.contains_key(namespace) {
            let mut counted = Counted::default();
            counted.list(store, namespace);
            self.namespaces.insert(namespace.into(), counted);
        }
        self.namespaces.get_mut(namespace).expect("it was just put there")
    }
}

/// The quota of a namespace.
pub(crate) fn of(store: &Store, namespace: &str) -> Option<QuotaSpec> {
    let stored = store.get(&Key::namespaced(QUOTAS, namespace, QUOTA_NAME))?;
    objects::read::<Quota>(&stored).map(|quota| quota.spec)
}

/// Whether what a task asks for is left when tasks ask for `used`, and `with` that come with it for more.
fn judge(quota: &QuotaSpec, used: &Used, asked: &Used, with: Used) -> Result<(), Violations> {
    let mut sum = used.clone();
    sum.add(&with);
    let alone = refusals(quota, used, asked);
    let mut violations = Violations::new();
    for refusal in refusals(quota, &sum, asked) {
        let together = alone.iter().all(|other| other.field != refusal.field);
        violations.forbidden(&refusal.field, refusal.to_string()).suggest(if together {
            "alone it would pass: apply fewer at once, end other tasks first, or have the Quota \"default\" raised"
        } else {
            "end other tasks first, or have the Quota \"default\" raised"
        });
    }
    if violations.is_empty() { Ok(()) } else { Err(violations) }
}

impl Door {
    /// Lets a new task in, or says everything that its namespace's quota does not leave. None: no quota.
    pub(crate) fn admit(
        self: &Arc<Self>,
        store: &Store,
        namespace: &str,
        uid: &str,
        resources: &Resources,
    ) -> Result<Option<Pass>, Violations> {
        let mut counts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(quota) = of(store, namespace) else {
            // What passed before the quota went is committed or not: nobody asks any more.
            counts.namespaces.remove(namespace);
            return Ok(None);
        };
        let (uid, asked) = (TaskUid::new(uid), asked(resources));
        let counted = counts.of(store, namespace);
        judge(&quota, &counted.sum(), &asked, Used::default())?;
        counted.passing.put(&uid, asked);
        drop(counts);
        Ok(Some(Pass { door: Arc::clone(self), namespace: namespace.into(), uid }))
    }

    /// Whether new tasks of a namespace would be let in one after the other, under `quota`. Nobody is let in: who asks
    /// beside this finds what there was before.
    pub(crate) fn rehearse<'a>(
        &self,
        store: &Store,
        (namespace, quota): (&str, &QuotaSpec),
        tasks: impl IntoIterator<Item = &'a Resources>,
    ) -> Vec<Result<(), Violations>> {
        let present = self.requested(store, namespace);
        let mut before = Used::default();
        let ask = |resources: &Resources| {
            let asked = asked(resources);
            let judged = judge(quota, &present, &asked, before.clone());
            if judged.is_ok() {
                before.add(&asked);
            }
            judged
        };
        tasks.into_iter().map(ask).collect()
    }

    /// What the tasks of a namespace ask for that have not ended.
    pub(crate) fn requested(&self, store: &Store, namespace: &str) -> Used {
        let mut counts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        counts.of(store, namespace).sum()
    }
}

/// Fills in what a task does not say and its namespace's quota has a default for.
pub(crate) fn fill_defaults(defaults: &TaskDefaults, task: &mut Value) {
    let Some(spec) = task.get_mut("spec").and_then(Value::as_object_mut) else { return };
    if spec.get("run").is_some_and(|run| run.get("executor").is_some_and(|e| !e.is_null())) {
        return;
    }
    let resources = spec.entry("resources").or_insert(Value::Null);
    if resources.is_null() {
        *resources = Value::Object(Map::new());
    }
    let Some(resources) = resources.as_object_mut() else { return };
    let TaskDefaults { cpu, memory, pids } = defaults;
    let mut fill = |name: &str, value: Option<Value>| {
        if let Some(value) = value
            && resources.get(name).is_none_or(Value::is_null)
        {
            resources.insert(name.to_owned(), value);
        }
    };
    fill("cpu", cpu.map(|cpu| cpu.to_string().into()));
    fill("memory", memory.map(|memory| memory.to_string().into()));
    fill("pids", pids.map(Value::from));
}

#[cfg(test)]
mod tests {
    use muster_api::quantity::{Bytes, MilliCpu};
    use serde_json::json;

    use super::*;

    #[test]
    fn only_what_is_not_said_is_filled_in() {
        let defaults =
            TaskDefaults { cpu: Some(MilliCpu(100)), memory: Some(Bytes(64 << 20)), pids: None };
        let filled = |spec: Value| {
            let mut task = json!({ "spec": spec });
            fill_defaults(&defaults, &mut task);
            task["spec"].take()
        };
        let process = json!({"process": {"command": ["true"]}});
        assert_eq!(
            filled(json!({"run": process, "resources": {"cpu": "2", "memory": null}})),
            json!({"run": process, "resources": {"cpu": "2", "memory": "64Mi"}})
        );
        assert_eq!(
            filled(json!({"run": process})),
            json!({"run": process, "resources": {"cpu": "100m", "memory": "64Mi"}})
        );
        let work = json!({"run": {"executor": {"task": "other"}}});
        assert_eq!(filled(work.clone()), work);
        // What is wrong is left for admission to say.
        assert_eq!(filled(json!({"resources": 3})), json!({"resources": 3}));
    }
}
