//! The first call of a session: who the framework is, and its Framework object.

use std::sync::Arc;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{MicroTime, ObjectMeta, OwnerReference};
use muster_api::kind::framework::{Framework, FrameworkSpec, NONCE_ANNOTATION};
use muster_api::kind::namespace::DEFAULT;
use muster_api::name::check_name;
use muster_api::wire::framework::v1 as wire;
use muster_api::wire::framework_session::spec_from_wire;
use muster_controller_core::access::Verb;

use super::{Frameworks, session_in};
use crate::audit::Line;
use crate::auth::Asker;
use crate::context::Context;
use crate::objects::{self, FRAMEWORKS};
use crate::reconcile::desk::FrameworkUid;
use crate::rest::create;
use crate::store::{Key, StoreError, Stored};

/// Longest nonce: a random UUID has 36 characters.
const MAX_NONCE: usize = 64;

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

/// What a session is told that has to go.
pub(super) const LATER: &str = "a later session of this framework began, or it was removed";

fn invalid(message: impl std::fmt::Display) -> Refused {
    Refused("Invalid", message.to_string())
}

/// Registers a framework, or finds it where it was. That it is connected is written by [`write_connected`], after its session
/// has been taken in.
///
/// # Errors
///
/// What the framework is told before its session ends.
pub(super) async fn subscribe(
    frameworks: &Frameworks,
    asker: &Asker,
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
    asker
        .needs(&session_in(Some(namespace), Some(&call.name)))
        .map_err(|failure| Refused("Forbidden", failure.message().to_owned()))?;
    let Some(stored) = context.store.get(&key) else {
        let registered = register(context, (key, asker), spec, call).await?;
        return Ok(Guest { direct: call.direct, ..registered });
    };
    if stored.mentions("deletionTimestamp") {
        return Err(Refused(
            "Ending",
            format!("{key} is being removed; subscribe again when it is gone"),
        ));
    }
    // For it, it is registered now.
    let unheard = call.framework_id.is_empty() && is_of_this_run(&stored, &call.nonce);
    if call.framework_id.is_empty() && !unheard {
        return Err(Refused("AlreadyExists", in_the_way(frameworks, &key, &stored)));
    }
    if *stored.uid != *call.framework_id && !unheard {
        return Err(gone(&call.framework_id));
    }
    let uid: FrameworkUid = (*stored.uid).into();
    Ok(Guest { uid, key, spec, returned: !unheard, direct: call.direct })
}

/// Whether the framework was registered by this run of it, which has not heard of that.
fn is_of_this_run(stored: &Stored, nonce: &str) -> bool {
    let object = objects::read::<Framework>(stored);
    let annotations = object.and_then(|object| object.metadata.annotations).unwrap_or_default();
    !nonce.is_empty() && annotations.get(NONCE_ANNOTATION).is_some_and(|known| known == nonce)
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
    (key, asker): (Key, &Asker),
    spec: FrameworkSpec,
    call: &wire::Subscribe,
) -> Result<Guest, Refused> {
    if !call.framework_id.is_empty() {
        return Err(gone(&call.framework_id));
    }
    if call.nonce.len() > MAX_NONCE {
        return Err(invalid(format!("nonce: is longer than {MAX_NONCE} bytes")));
    }
    let mut object = Framework::new(&key.name, spec.clone());
    object.metadata.namespace = key.namespace().map(str::to_owned);
    if !call.nonce.is_empty() {
        let nonce = (NONCE_ANNOTATION.to_owned(), call.nonce.clone());
        object.metadata.annotations = Some([nonce].into());
    }
    context.audit.ready(context.clock.now()).await.map_err(|error| {
        let why = format!("nothing is written while the audit log cannot be: {error}");
        Refused("Unavailable", why)
    })?;
    let created = create::create_object(context, FRAMEWORKS, objects::to_value(&object)).await;
    let stored = created.map_err(|failure| match failure.code() {
        // Perhaps by an earlier try of the same run: the next one finds it, and whose it is.
        409 => Refused("Unavailable", format!("a framework {} was just registered", key.name)),
        404 | 403 => invalid(failure.message()),
        _ => Refused("Unavailable", failure.message().to_owned()),
    })?;
    let line = Line {
        time: context.clock.now(),
        namespace: key.namespace().map(str::to_owned),
        name: Some(key.name.to_string()),
        uid: Some(stored.uid.to_string()),
        code: Some(201),
        ..Line::of(&asker.identity, Verb::Create, "frameworks")
    };
    // Without it the framework is registered all the same.
    drop(context.audit.write(line).await);
    let uid: FrameworkUid = (*stored.uid).into();
    Ok(Guest { uid, key, spec, returned: false, direct: false })
}

/// Writes that a session is open, and what the framework wants in it. The session is the framework's present one when this
/// is called: an absence of an earlier one that is written late finds it and writes nothing.
///
/// # Errors
///
/// What the framework is told before its session ends.
pub(super) async fn write_connected(
    frameworks: &Frameworks,
    guest: &Guest,
    number: u64,
) -> Result<(), Refused> {
    let Guest { uid, key, spec, .. } = guest;
    let context = &frameworks.context;
    let now = context.clock.now();
    let written = objects::change(&context.store, key, |stored, mut object: Framework| {
        // A later session writes what it wants itself.
        if *stored.uid != **uid || !frameworks.is_session(uid, number) {
            return None;
        }
        object.spec = spec.clone();
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
        Ok(None) if frameworks.is_session(uid, number) => Err(gone(uid)),
        Ok(None) => Err(Refused("Cut", LATER.to_owned())),
        Err(error) => Err(Refused("Unavailable", crate::app::chain(&error))),
    }
}

/// Writes what a framework wants now.
///
/// # Errors
///
/// When the store fails.
pub(super) async fn write_spec(
    context: &Context,
    key: &Key,
    uid: &FrameworkUid,
    spec: &FrameworkSpec,
) -> Result<(), StoreError> {
    objects::change(&context.store, key, |stored, mut object: Framework| {
        if *stored.uid != **uid || object.spec == *spec {
            return None;
        }
        object.spec = spec.clone();
        Some(vec![objects::replace(stored, &object)])
    })
    .await
    .map(drop)
}

/// Writes whether a framework has a session, where its object says something else. Without one it is away from now on.
///
/// # Errors
///
/// When the store fails.
pub(crate) async fn write_presence(
    frameworks: &Frameworks,
    key: &Key,
    uid: &str,
) -> Result<(), StoreError> {
    let context = &frameworks.context;
    let now = context.clock.now();
    objects::change(&context.store, key, |stored, mut object: Framework| {
        let status = object.status.get_or_insert_default();
        // At every try: a session may have begun since, and what it writes must not be undone.
        let connected = frameworks.is_connected(uid);
        if *stored.uid != *uid || status.connected == connected {
            return None;
        }
        status.connected = connected;
        if connected {
            status.disconnected_at = None;
        } else {
            status.offers = 0;
            status.disconnected_at = Some(MicroTime(now));
        }
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

/// The framework that launched a task. Only the controller writes such a reference (`rest::launched`), so that it is to a
/// framework of the task's namespace.
pub(crate) fn owning(metadata: &ObjectMeta) -> Option<&OwnerReference> {
    muster_controller_core::owner::controller(metadata)
        .filter(|owner| owner.kind == "Framework" && owner.api_version == muster_api::API_VERSION)
}

/// Its uid.
pub(crate) fn owner_of(metadata: &ObjectMeta) -> Option<Arc<str>> {
    owning(metadata).map(|o| o.uid.as_str().into())
}
