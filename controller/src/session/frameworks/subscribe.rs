//! The first call of a session: who the framework is, and its Framework object.

use std::sync::Arc;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{MicroTime, ObjectMeta, OwnerReference};
use muster_api::kind::framework::{Framework, FrameworkSpec};
use muster_api::kind::namespace::DEFAULT;
use muster_api::name::check_name;
use muster_api::wire::framework::v1 as wire;
use muster_api::wire::framework_session::spec_from_wire;

use super::Frameworks;
use crate::context::Context;
use crate::objects::{self, FRAMEWORKS};
use crate::reconcile::desk::FrameworkUid;
use crate::rest::create;
use crate::store::{Key, Stored};

/// A framework that may go on.
#[derive(Debug)]
pub(super) struct Guest {
    pub(super) uid: FrameworkUid,
    pub(super) key: Key,
    pub(super) spec: FrameworkSpec,
    /// It was known before.
    pub(super) returned: bool,
    /// It can dial agents.
    pub(super) direct: bool,
}

/// Why a Subscribe is refused: one CamelCase word, and a sentence.
#[derive(Debug)]
pub(super) struct Refused(pub(super) &'static str, pub(super) String);

fn invalid(message: impl std::fmt::Display) -> Refused {
    Refused("Invalid", message.to_string())
}

/// Registers a framework, or takes it up again where it was.
///
/// # Errors
///
/// What the framework is told before its session ends.
pub(super) async fn subscribe(
    frameworks: &Frameworks,
    call: &wire::Subscribe,
) -> Result<Guest, Refused> {
    let context = &frameworks.context;
    check_name(&call.name).map_err(|e| invalid(format!("name: {e}")))?;
    let spec = spec_from_wire(call).map_err(invalid)?;
    let violations = spec.violations();
    if !violations.is_empty() {
        let list: Vec<String> = violations.iter().map(ToString::to_string).collect();
        return Err(invalid(list.join("; ")));
    }
    let namespace = if call.namespace.is_empty() { DEFAULT } else { &call.namespace };
    let key = Key::namespaced(FRAMEWORKS, namespace, call.name.as_str());
    let Some(stored) = context.store.get(&key) else {
        let registered = register(context, key, spec, &call.framework_id).await?;
        return Ok(Guest { direct: call.direct, ..registered });
    };
    if stored.mentions("deletionTimestamp") {
        return Err(Refused(
            "Ending",
            format!("{key} is being removed; subscribe again when it is gone"),
        ));
    }
    if call.framework_id.is_empty() {
        return Err(Refused("AlreadyExists", in_the_way(frameworks, &key, &stored)));
    }
    if *stored.uid != *call.framework_id {
        return Err(gone(&call.framework_id));
    }
    let uid: FrameworkUid = (*stored.uid).into();
    write_connected(context, &key, &uid, Some(&spec)).await?;
    Ok(Guest { uid, key, spec, returned: true, direct: call.direct })
}

fn in_the_way(frameworks: &Frameworks, key: &Key, stored: &Stored) -> String {
    let name = &key.name;
    if frameworks.is_connected(&stored.uid) {
        return format!("a framework {name} is connected; take another name");
    }
    format!(
        "a framework {name} is known and away; subscribe with its id to take its tasks over, or \
         `muster delete framework {name}` to end it and them"
    )
}

fn gone(id: &str) -> Refused {
    let text = format!(
        "there is no framework {id} (any more): it was torn down, deleted, or away for longer than its failover timeout; \
         subscribe without an id to begin anew"
    );
    Refused("UnknownFramework", text)
}

async fn register(
    context: &Context,
    key: Key,
    spec: FrameworkSpec,
    id: &str,
) -> Result<Guest, Refused> {
    if !id.is_empty() {
        return Err(gone(id));
    }
    let mut object = Framework::new(&key.name, spec.clone());
    object.metadata.namespace = key.namespace().map(str::to_owned);
    let created = create::create_object(context, FRAMEWORKS, objects::to_value(&object)).await;
    let stored = created.map_err(|failure| match failure.code() {
        409 => Refused("AlreadyExists", format!("a framework {} exists", key.name)),
        404 | 403 => invalid(failure.message()),
        _ => Refused("Unavailable", failure.message().to_owned()),
    })?;
    let uid: FrameworkUid = (*stored.uid).into();
    write_connected(context, &key, &uid, None).await?;
    Ok(Guest { uid, key, spec, returned: false, direct: false })
}

/// Writes that a session is open.
async fn write_connected(
    context: &Context,
    key: &Key,
    uid: &FrameworkUid,
    spec: Option<&FrameworkSpec>,
) -> Result<(), Refused> {
    let now = context.clock.now();
    let written = objects::change(&context.store, key, |stored, mut object: Framework| {
        if *stored.uid != **uid {
            return None;
        }
        if let Some(spec) = spec {
            object.spec = spec.clone();
        }
        let status = object.status.get_or_insert_default();
        status.connected = true;
        status.suppressed = false;
        status.subscribed_at = Some(MicroTime(now));
        status.disconnected_at = None;
        Some(vec![objects::replace(stored, &object)])
    })
    .await;
    match written {
        Ok(Some(_)) => Ok(()),
        Ok(None) => Err(gone(uid)),
        Err(error) => Err(Refused("Unavailable", crate::app::chain(&error))),
    }
}

/// Writes what a framework wants now.
pub(super) async fn write_spec(
    context: &Context,
    key: &Key,
    uid: &FrameworkUid,
    spec: &FrameworkSpec,
) {
    let written = objects::change(&context.store, key, |stored, mut object: Framework| {
        if *stored.uid != **uid || object.spec == *spec {
            return None;
        }
        object.spec = spec.clone();
        Some(vec![objects::replace(stored, &object)])
    });
    if let Err(error) = written.await {
        // It holds for the offers; only the object shows the older wish until the next change.
        tracing::warn!(framework = %key, error = crate::app::chain(&error), "a wish is not written");
    }
}

/// Writes that a framework is away from now on: its failover timeout runs.
///
/// # Errors
///
/// When the store fails.
pub(crate) async fn write_away(
    context: &Context,
    key: &Key,
    uid: &str,
) -> Result<(), crate::store::StoreError> {
    let now = context.clock.now();
    objects::change(&context.store, key, |stored, mut object: Framework| {
        let status = object.status.get_or_insert_default();
        if *stored.uid != *uid || !status.connected {
            return None;
        }
        status.connected = false;
        status.offers = 0;
        status.disconnected_at = Some(MicroTime(now));
        Some(vec![objects::replace(stored, &object)])
    })
    .await
    .map(drop)
}

/// The object of a framework as an owner of others.
pub(super) fn owner(key: &Key, uid: &FrameworkUid) -> serde_json::Value {
    serde_json::json!({
        "apiVersion": muster_api::API_VERSION,
        "kind": "Framework",
        "name": &*key.name,
        "uid": &**uid,
        "controller": true,
    })
}

/// The framework that owns an object.
pub(crate) fn owning(metadata: &ObjectMeta) -> Option<&OwnerReference> {
    metadata.owner_references.iter().flatten().find(|o| o.kind == "Framework")
}

/// Its uid.
pub(crate) fn owner_of(metadata: &ObjectMeta) -> Option<Arc<str>> {
    owning(metadata).map(|o| o.uid.as_str().into())
}
