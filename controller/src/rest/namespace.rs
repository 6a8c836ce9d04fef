//! Namespaces: the default one, who may create inside, and how one ends.
//!
//! Deleting a namespace sets it Terminating. A create names the namespace's revision as a condition of its own commit,
//! so none slips in after that; `finalize` deletes what is inside and then the namespace.

use std::sync::Arc;
use std::time::Duration;

use muster_api::kind::namespace::DEFAULT;
use serde_json::{Value, json};

use super::failure::Failure;
use super::registry::{self, Entry, View};
use super::{delete, metadata};
use crate::context::Context;
use crate::objects;
use crate::store::{Key, Op, Precondition, Resource, StoreError, WatchEnd};

const NAMESPACES: Resource = Resource::new("namespaces");
/// After a failure of the store; its next commit may pass.
const RETRY: Duration = Duration::from_secs(1);
/// While a namespace ends, any write may be what it waits for, and everything in it is looked at again: not for each write of
/// a busy cluster.
const PAUSE: Duration = Duration::from_millis(200);

/// Creates the namespace of those who name none.
///
/// # Errors
/// When the store fails.
pub async fn bootstrap(context: &Context) -> Result<(), StoreError> {
    let mut object = json!({
        "apiVersion": "v1",
        "kind": "Namespace",
        "metadata": {
            "name": DEFAULT,
            "uid": uuid::Uuid::new_v4().to_string(),
            "creationTimestamp": context.stamp(),
        },
    });
    complete(&mut object);
    match context.store.create(Key::cluster(NAMESPACES, DEFAULT), object).await {
        Ok(_) | Err(StoreError::AlreadyExists { .. }) => Ok(()),
        Err(error) => Err(error),
    }
}

/// What every namespace has: its phase, and the label by which it can be selected.
pub(super) fn complete(object: &mut Value) {
    let name = object["metadata"]["name"].clone();
    object["metadata"]["labels"]["kubernetes.io/metadata.name"] = name;
    object["status"] = json!({"phase": "Active"});
}

/// Marks a namespace that ends; leaves other kinds alone.
pub(super) fn terminate(object: &mut Value) {
    if object["kind"] == "Namespace" {
        object["status"]["phase"] = "Terminating".into();
    }
}

/// Whether the end of this object is [`finalize`]'s to bring about.
pub(super) fn is_ours_to_end(resource: Resource) -> bool {
    resource == NAMESPACES
}

/// The condition under which an object may be created in `namespace`; none for cluster-scoped kinds.
pub(super) fn admit_into(
    context: &Context,
    entry: &Entry,
    namespace: Option<&str>,
    name: &str,
) -> Result<Option<Op>, Failure> {
    let Some(namespace) = namespace.filter(|_| entry.info.namespaced) else { return Ok(None) };
    let key = Key::cluster(NAMESPACES, namespace);
    let Some(present) = context.store.get(&key) else {
        let namespaces = registry::of(NAMESPACES)
            .ok_or_else(|| Failure::internal("namespaces are not served"))?;
        return Err(Failure::not_found(namespaces, namespace));
    };
    if metadata::is_ending(&present.value()) {
        let why = format!(
            "{} {name:?} is forbidden: unable to create new content in namespace {namespace} \
             because it is being terminated",
            entry.qualified()
        );
        let cause = format!("namespace {namespace} is being terminated");
        return Err(Failure::denied(why).about(entry, name).because(
            "NamespaceTerminating",
            &cause,
            "metadata.namespace",
        ));
    }
    Ok(Some(objects::unchanged(&present)))
}

/// Empties and removes namespaces that end. Level-triggered: each round looks at all of them; what wakes it is only a
/// hint.
pub(crate) async fn finalize(context: Arc<Context>) {
    loop {
        let seen = context.store.revision();
        let mut waiting = false;
        let mut failed = false;
        for namespace in context.store.list(NAMESPACES, None).items {
            if !metadata::is_ending(&namespace.value()) {
                continue;
            }
            waiting = true;
            if let Err(failure) = empty(&context, &namespace.key).await {
                tracing::warn!(namespace = %namespace.key.name, message = failure.message(),
                    "cannot end the namespace yet");
                failed = true;
            }
        }
        let woken = async {
            if failed {
                tokio::time::sleep(RETRY).await;
                return true;
            }
            if waiting {
                tokio::time::sleep(PAUSE).await;
            }
            changed(&context, seen, waiting).await
        };
        // Both arms are cancel safe: the next round looks at everything again.
        tokio::select! {
            () = context.stop.cancelled() => return,
            woken = woken => if !woken { return },
        }
    }
}

/// Ready when there may be something to do; false when the store is gone.
async fn changed(context: &Context, seen: u64, waiting: bool) -> bool {
    // While a namespace ends, the end of any object may be what it waits for.
    let watched =
        if waiting { context.store.watch_all(seen) } else { context.store.watch(NAMESPACES, seen) };
    match watched {
        Ok(mut watcher) => !matches!(watcher.next().await, Err(WatchEnd::Closed)),
        Err(_) => true,
    }
}

/// Deletes what is inside, and the namespace when nothing is left.
async fn empty(context: &Context, key: &Key) -> Result<(), Failure> {
    let mut left = false;
    for entry in
        registry::all().iter().filter(|entry| entry.info.namespaced && entry.view == View::Stored)
    {
        for stored in context.store.list(entry.resource, Some(&key.name)).items {
            left = true;
            if delete::waits_for_others(&stored) {
                continue;
            }
            match delete::delete_object(context, &stored.key).await {
                Ok(_) => {}
                Err(failure) if failure.code() == 404 => {}
                Err(failure) => return Err(failure),
            }
        }
    }
    let Some(namespace) = context.store.get(key) else { return Ok(()) };
    if left || metadata::has_finalizers(&namespace.value()) {
        return Ok(());
    }
    let precondition = Precondition::revision(namespace.revision);
    match context.store.delete(key.clone(), precondition).await {
        // A change of the namespace wakes the next round.
        Ok(_) | Err(StoreError::NotFound { .. } | StoreError::Conflict { .. }) => Ok(()),
        Err(error) => Err(Failure::internal(crate::app::chain(&error))),
    }
}
