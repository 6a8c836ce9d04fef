//! Deletes what lost its owner (`metadata.ownerReferences`), and finishes deletions that wait for
//! dependents: `propagationPolicy` Foreground and Orphan put a finalizer on the owner, and this loop
//! takes it off when its condition holds.
//!
//! It keeps uids and references of everything in memory, fed by the store; an object goes when it
//! names owners and none of them lives. A reference to something that never existed, or that is in
//! another namespace, or has another name or kind, is as good as one to something that is gone, as in
//! Kubernetes.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::OwnerReference;
use muster_controller_core::owner::Owner;
use serde::Deserialize;
use serde_json::Value;

use super::{RETRY, next_events, watch_from_now};
use crate::context::Context;
use crate::objects;
use crate::rest::delete::{delete_object, is_left_over, waits_for_others};
use crate::rest::{registry, replacement};
use crate::store::{Change, Key, StoreError, Stored};

const FOREGROUND: &str = "foregroundDeletion";
const ORPHAN: &str = "orphan";
/// Between two rounds while deletions wait: one round for the writes of so long, and not one for each.
const PAUSE: Duration = Duration::from_millis(100);

/// Why it begins anew, with a look at everything.
#[derive(Debug, thiserror::Error)]
enum Failed {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("an object is not deleted: {0}")]
    End(String),
}

#[derive(Debug, Default)]
struct Graph {
    /// Every live object.
    live: HashMap<Box<str>, Key>,
    /// Owners of each object that has some.
    owners: BTreeMap<Key, Vec<OwnerReference>>,
    /// Objects that name each owner.
    dependents: HashMap<String, BTreeSet<Key>>,
    /// Owners whose deletion waits for this loop.
    waiting: BTreeMap<Key, Box<str>>,
}

impl Graph {
    fn take_in(&mut self, change: Change, stored: &Stored) {
        for owner in self.owners.remove(&stored.key).into_iter().flatten() {
            if let Some(keys) = self.dependents.get_mut(&owner.uid) {
                keys.remove(&stored.key);
            }
        }
        self.waiting.remove(&stored.key);
        if change == Change::Delete {
            self.live.remove(&stored.uid);
            return;
        }
        if stored.uid.is_empty() {
            return;
        }
        self.live.insert(stored.uid.clone(), stored.key.clone());
        if stored.mentions("ownerReferences") {
            let owners = owners_of(stored);
            for owner in &owners {
                self.dependents.entry(owner.uid.clone()).or_default().insert(stored.key.clone());
            }
            if !owners.is_empty() {
                self.owners.insert(stored.key.clone(), owners);
            }
        }
        let waits = || stored.mentions(FOREGROUND) || stored.mentions(ORPHAN);
        if stored.mentions("deletionTimestamp") && (waits() || is_left_over(stored)) {
            self.waiting.insert(stored.key.clone(), stored.uid.clone());
        }
    }

    /// Whether the object is there and still names the owners that are known here: events may be on their way that say
    /// whom it belongs to now.
    fn is_present(&self, context: &Context, key: &Key) -> bool {
        let present = context.store.get(key).map(|stored| owners_of(&stored));
        present.as_ref().is_some_and(|owners| self.owners.get(key) == Some(owners))
    }

    fn lost(&self, key: &Key) -> bool {
        self.owners
            .get(key)
            .is_some_and(|owners| !owners.iter().any(|owner| self.is_live(owner, key)))
    }

    fn is_live(&self, owner: &OwnerReference, dependent: &Key) -> bool {
        let live = self.live.get(owner.uid.as_str());
        live.is_some_and(|key| counts(owner, (key, &owner.uid), dependent))
    }

    /// What the object owns.
    fn owned_by(&self, key: &Key, uid: &str) -> Vec<&Key> {
        let is_owned = |dependent: &&Key| {
            let mut owners = self.owners.get(*dependent).into_iter().flatten();
            owners.any(|owner| counts(owner, (key, uid), dependent))
        };
        self.dependents.get(uid).into_iter().flatten().filter(is_owned).collect()
    }
}

/// Whether a reference in `dependent` is to the object of that key and uid, by any kind that it is shown as.
fn counts(reference: &OwnerReference, (key, uid): (&Key, &str), dependent: &Key) -> bool {
    let mut shown = registry::all().iter().filter(|entry| entry.resource == key.resource);
    shown.any(|entry| {
        let api_version = entry.info.api_version();
        let (kind, name) = (entry.info.kind, &*key.name);
        let owner =
            Owner { api_version: &api_version, kind, namespace: key.namespace(), name, uid };
        owner.is_named_by(reference, dependent.namespace())
    })
}

/// The part of an object that names its owners.
#[derive(Deserialize)]
struct Belonging {
    metadata: Belongs,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Belongs {
    #[serde(default)]
    owner_references: Option<Vec<OwnerReference>>,
}

fn owners_of(stored: &Stored) -> Vec<OwnerReference> {
    let references = stored.parse::<Belonging>().ok().and_then(|o| o.metadata.owner_references);
    references.into_iter().flatten().filter(|reference| !reference.uid.is_empty()).collect()
}

/// Works until dropped.
pub async fn run(context: Arc<Context>) {
    loop {
        if let Err(error) = follow(&context).await {
            tracing::warn!(error = crate::app::chain(&error), "garbage is not collected yet");
            tokio::time::sleep(RETRY).await;
        }
    }
}

async fn follow(context: &Context) -> Result<(), Failed> {
    let mut watcher = watch_from_now(&context.store).await;
    let mut graph = Graph::default();
    for stored in context.store.list_all() {
        graph.take_in(Change::Put, &stored);
    }
    let mut look: BTreeSet<Key> = graph.owners.keys().cloned().collect();
    loop {
        for key in std::mem::take(&mut look) {
            if graph.lost(&key) && graph.is_present(context, &key) {
                tracing::info!(%key, "its owner is gone, deleting it");
                end(context, &key).await?;
            }
        }
        for (key, uid) in graph.waiting.clone() {
            finish(context, &graph, &key, &uid).await?;
        }
        if !graph.waiting.is_empty() {
            // Each round looks at all that an ending object waits for.
            tokio::time::sleep(PAUSE).await;
        }
        let Some(events) = next_events(&mut watcher).await else { return Ok(()) };
        for event in &events {
            graph.take_in(event.change, &event.object);
            match event.change {
                Change::Put => {
                    look.insert(event.object.key.clone());
                }
                Change::Delete => look.extend(
                    graph.dependents.get(&*event.object.uid).into_iter().flatten().cloned(),
                ),
            }
        }
    }
}

/// Does what a waiting deletion waits for, and takes the finalizer off when that is done.
async fn finish(context: &Context, graph: &Graph, key: &Key, uid: &str) -> Result<(), Failed> {
    let Some(stored) = context.store.get(key) else { return Ok(()) };
    let object = stored.value();
    let has = |name: &str| {
        object
            .pointer("/metadata/finalizers")
            .and_then(Value::as_array)
            .is_some_and(|f| f.iter().any(|x| x == name))
    };
    let dependents = graph.owned_by(key, uid);
    if has(ORPHAN) {
        for dependent in dependents {
            update(context, dependent, |object| remove_reference(object, uid)).await?;
        }
        return update(context, key, |object| remove_finalizer(object, ORPHAN)).await;
    }
    if !has(FOREGROUND) {
        return if is_left_over(&stored) { end(context, key).await } else { Ok(()) };
    }
    let mut left = 0;
    for dependent in dependents {
        let Some(stored) = context.store.get(dependent) else { continue };
        left += 1;
        if !waits_for_others(&stored) {
            end(context, dependent).await?;
        }
    }
    if left == 0 {
        update(context, key, |object| remove_finalizer(object, FOREGROUND)).await
    } else {
        Ok(())
    }
}

/// Ends an object. A refusal (it went already, it may not go) leaves nothing to do here.
async fn end(context: &Context, key: &Key) -> Result<(), Failed> {
    match delete_object(context, key).await {
        Err(failure) if failure.code() >= 500 => Err(Failed::End(failure.message().to_owned())),
        Ok(_) | Err(_) => Ok(()),
    }
}

/// Changes an object, in one transaction with its end when that was the last thing that it waited for.
async fn update(
    context: &Context,
    key: &Key,
    change: impl Fn(&mut Value) -> bool + Send + Sync,
) -> Result<(), Failed> {
    loop {
        let Some(present) = context.store.get(key) else { return Ok(()) };
        let mut object = present.value();
        if !change(&mut object) {
            return Ok(());
        }
        let Some(op) = replacement(&present, &object) else { return Ok(()) };
        match context.store.apply_one(op).await {
            Ok(_) => return Ok(()),
            Err(error) if objects::is_race(&error) => tokio::task::yield_now().await,
            Err(error) => return Err(error.into()),
        }
    }
}

fn remove_finalizer(object: &mut Value, name: &str) -> bool {
    let Some(list) = object.pointer_mut("/metadata/finalizers").and_then(Value::as_array_mut)
    else {
        return false;
    };
    let before = list.len();
    list.retain(|f| f != name);
    list.len() != before
}

fn remove_reference(object: &mut Value, uid: &str) -> bool {
    let Some(list) = object.pointer_mut("/metadata/ownerReferences").and_then(Value::as_array_mut)
    else {
        return false;
    };
    let before = list.len();
    list.retain(|r| r["uid"] != uid);
    list.len() != before
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::objects::TASK_SETS;
    use crate::store::{Op, Precondition, Resource, memory};

    #[test]
    fn an_owner_of_another_namespace_owns_nothing() {
        let mut graph = Graph::default();
        let mut put = |key: &Key, value: Value| {
            let bytes = serde_json::to_vec(&value).expect("JSON").into();
            let uid = value["metadata"]["uid"].as_str().unwrap_or_default().into();
            graph.take_in(Change::Put, &Stored::new(key.clone(), 1, uid, bytes));
        };
        let set = Key::namespaced(TASK_SETS, "lab", "watch");
        put(&set, json!({"metadata": {"name": "watch", "namespace": "lab", "uid": "s"}}));
        let map = |ns| Key::namespaced(Resource::new("configmaps"), ns, "m");
        for namespace in ["lab", "other"] {
            let owner = json!([{
                "apiVersion": muster_api::API_VERSION, "kind": "TaskSet", "name": "watch", "uid": "s",
            }]);
            let own = json!({"name": "m", "namespace": namespace, "uid": namespace, "ownerReferences": owner});
            put(&map(namespace), json!({"metadata": own}));
        }
        assert_eq!(graph.owned_by(&set, "s"), [&map("lab")]);
        assert!(!graph.lost(&map("lab")) && graph.lost(&map("other")));
    }

    /// Its last finalizer was taken off, and it was not removed: the controller ended in between.
    #[tokio::test]
    async fn what_is_left_over_is_removed() {
        let dir = tempfile::tempdir().expect("a directory");
        let context = crate::context::for_tests(dir.path(), memory::start().await);
        let key = Key::namespaced(Resource::new("configmaps"), "default", "left");
        let metadata = json!({
            "name": "left", "namespace": "default", "uid": "u", "finalizers": [],
            "deletionTimestamp": "2026-01-02T03:04:05Z", "deletionGracePeriodSeconds": 0,
        });
        let value = json!({"apiVersion": "v1", "kind": "ConfigMap", "metadata": metadata});
        let put = Op::Put { key: key.clone(), value, precondition: Precondition::Absent };
        context.store.apply_one(put).await.expect("it is written");
        let mut watcher = watch_from_now(&context.store).await;
        let _collects =
            tokio_util::task::AbortOnDropHandle::new(tokio::spawn(run(Arc::clone(&context))));
        let gone = async {
            while context.store.get(&key).is_some() {
                next_events(&mut watcher).await.expect("it does not fall behind");
            }
        };
        tokio::time::timeout(Duration::from_secs(60), gone).await.expect("it goes");
    }
}
