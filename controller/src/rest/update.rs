//! PUT, and the read-modify-write that PUT and PATCH share.

use std::sync::Arc;

use http::{HeaderValue, StatusCode};
use muster_api::kind;
use muster_api::kind::application::Application;
use muster_api::kind::namespace::Namespace;
use muster_api::kind::node::Node;
use muster_api::kind::quota::Quota;
use muster_api::kind::task::Task;
use muster_api::kind::taskset::TaskSet;
use muster_api::validate::Violations;
use serde::Deserialize as _;
use serde_json::Value;

use super::create::with_warnings;
use super::owners::Writer;
use super::path::{Object, Subresource};
use super::query::FieldValidation;
use super::registry::{Entry, View};
use super::{Answer, Call, admission, body, failure::Failure, host, launched, metadata, owners};
use crate::auth::Asker;
use crate::context::Context;
use crate::objects;
use crate::store::{Op, Precondition, Store, StoreError, Stored};

/// How a change is made.
pub(super) struct Options {
    pub(super) mode: FieldValidation,
    pub(super) dry: bool,
    /// Who makes it.
    pub(super) asker: Asker,
    /// Whose the fields are then.
    pub(super) writer: Writer,
    /// The change is an application: it says itself whose the fields are.
    pub(super) applies: bool,
}

impl Options {
    pub(super) fn read(call: &Call, target: &Object) -> Result<Self, Failure> {
        let mut options = Self::of_call(call)?;
        options.writer.subresource = match target.subresource {
            Some(Subresource::Status) => "status",
            Some(Subresource::Scale) => "scale",
            _ => "",
        };
        let entry = target.entry;
        options.writer.view = (entry.view != View::Stored).then(|| entry.info.api_version());
        Ok(options)
    }

    /// Of whole objects.
    pub(super) fn of_call(call: &Call) -> Result<Self, Failure> {
        let (name, time) = (manager(call), call.context.stamp());
        let writer = Writer { name, subresource: "", view: None, time };
        let (mode, dry) = (call.query.field_validation()?, call.query.dry_run()?);
        Ok(Self { mode, dry, asker: call.asker.clone(), writer, applies: false })
    }
}

/// The client's own name for itself, or the first word of its user agent.
fn manager(call: &Call) -> String {
    let agent = call.request.headers().get(http::header::USER_AGENT);
    let agent = agent.and_then(|value| value.to_str().ok()).unwrap_or_default();
    let agent = agent.split('/').next().filter(|word| !word.is_empty()).unwrap_or("unknown");
    call.query.text("fieldManager").unwrap_or(agent).chars().take(128).collect()
}

pub(super) async fn replace(call: Call, target: Object) -> Answer {
    let options = Options::read(&call, &target)?;
    let Call { context, request, .. } = call;
    let (parts, body) = request.into_parts();
    let mut object = body::json(&parts.headers, body).await?;
    admission::identify(target.entry, &mut object)?;
    change(&context, &target, &options, |_| Ok(object.clone())).await
}

/// Changes one object by `make`, which is given the present one, and again when somebody else was faster. When the
/// object that `make` returns names a resourceVersion, it is that version or 409.
pub(super) async fn change(
    context: &Context,
    target: &Object,
    options: &Options,
    make: impl Fn(&Value) -> Result<Value, Failure>,
) -> Answer {
    let key = target.key()?;
    let entry = target.entry;
    loop {
        let present =
            context.store.get(&key).ok_or_else(|| Failure::not_found(entry, &key.name))?;
        let next = next(target, &present, options, &make)?;
        let done = |bytes: bytes::Bytes| {
            Ok(with_warnings(super::raw(StatusCode::OK, bytes), next.warnings.clone()))
        };
        if options.dry {
            return done(admission::render(&next.object)?);
        }
        match write(&context.store, &present, &next.object).await {
            Ok(stored) => return done(stored.bytes.clone()),
            Err(StoreError::Conflict { .. }) if !next.pinned => {}
            Err(error) => return Err(Failure::of_store(entry, &key.name, &error)),
        }
    }
}

/// Writes what an object becomes: nothing when nothing changed, a removal when it was only waiting to be let go. The client
/// relies on an answer of either kind.
async fn write(
    store: &Store,
    present: &Arc<Stored>,
    object: &Value,
) -> Result<Arc<Stored>, StoreError> {
    let op = operation(present, object).unwrap_or_else(|| objects::unchanged(present));
    let mut written = store.apply(vec![op]).await?;
    Ok(written.pop().unwrap_or_else(|| Arc::clone(present)))
}

/// The same as an operation, while the object is what it was; none: nothing changed.
pub(crate) fn operation(present: &Stored, object: &Value) -> Option<Op> {
    let old = present.value();
    if *object == old {
        return None;
    }
    let let_go = metadata::is_ending(object)
        && metadata::has_finalizers(&old)
        && !metadata::has_finalizers(object)
        && !super::delete::is_held(present.key.resource, object)
        && !super::namespace::is_ours_to_end(present.key.resource);
    let key = present.key.clone();
    let precondition = Precondition::revision(present.revision);
    Some(if let_go {
        Op::Delete { key, precondition }
    } else {
        Op::Put { key, value: object.clone(), precondition }
    })
}

/// What an object becomes by `make`, as [`change`] would store it.
pub(super) fn becomes(
    target: &Object,
    present: &Stored,
    options: &Options,
    make: impl Fn(&Value) -> Result<Value, Failure>,
) -> Result<Value, Failure> {
    next(target, present, options, make).map(|next| next.object)
}

struct Next {
    object: Value,
    warnings: Vec<HeaderValue>,
    /// The client named a version.
    pinned: bool,
}

fn next(
    target: &Object,
    present: &Stored,
    options: &Options,
    make: impl Fn(&Value) -> Result<Value, Failure>,
) -> Result<Next, Failure> {
    let entry = target.entry;
    let name = &*present.key.name;
    let old = present.value();
    let mut new = make(&old)?;
    admission::identify(entry, &mut new)?;
    let pinned = check_identity(target, present, &new)?;
    if target.subresource == Some(Subresource::Status) {
        let status = new.get("status").cloned();
        let mut object = old.clone();
        match (status, object.as_object_mut()) {
            (Some(status), Some(fields)) => drop(fields.insert("status".into(), status)),
            (None, Some(fields)) => drop(fields.remove("status")),
            (_, None) => {}
        }
        check_status(entry, name, &object)?;
        admission::check_depth(&object)?;
        let said = new["metadata"].get("managedFields").cloned();
        set_owners(entry, &old, &mut object, said, options);
        return Ok(Next { object, warnings: Vec::new(), pinned });
    }
    let Some(own) = metadata::of(&mut new) else {
        return Err(Failure::bad_request("metadata is not a JSON object"));
    };
    let said = own.get("managedFields").cloned();
    metadata::carry(&old, own);
    if entry.info.has_status
        && let Some(fields) = new.as_object_mut()
    {
        match old.get("status") {
            Some(status) => fields.insert("status".into(), status.clone()),
            None => fields.remove("status"),
        };
    }
    let mut admitted = admission::admit(entry, name, new, options.mode)?;
    kind::admit_change(entry.info, &old, &admitted.object)
        .map_err(|violations| Failure::invalid(entry, name, &violations))?;
    launched::check(&old, &admitted.object)
        .into_result(())
        .and_then(|()| host::check(&options.asker, &old, &admitted.object).into_result(()))
        .map_err(|violations| Failure::invalid(entry, name, &violations))?;
    check_finalizers(entry, name, &old, &admitted.object)?;
    metadata::count(&old, &mut admitted.object);
    set_owners(entry, &old, &mut admitted.object, said, options);
    Ok(Next { object: admitted.object, warnings: admitted.warnings, pinned })
}

/// Says whose the fields of a changed object are; `said` is what the client's object says of that.
fn set_owners(entry: &Entry, old: &Value, new: &mut Value, said: Option<Value>, options: &Options) {
    let owners = if options.applies {
        said
    } else {
        owners::after_update(entry, (old, new), said.as_ref(), &options.writer)
    };
    let Some(metadata) = metadata::of(new) else { return };
    match owners {
        Some(owners) => drop(metadata.insert("managedFields".into(), owners)),
        None => drop(metadata.remove("managedFields")),
    }
}

/// Refuses a status that does not read as its kind: everything that works on the object would have to leave it alone
/// from then on.
fn check_status(entry: &Entry, name: &str, object: &Value) -> Result<(), Failure> {
    let read = match entry.info.kind {
        "Task" => Task::deserialize(object).map(drop),
        "Application" => Application::deserialize(object).map(drop),
        "TaskSet" => TaskSet::deserialize(object).map(drop),
        "Node" => Node::deserialize(object).map(drop),
        "Namespace" => Namespace::deserialize(object).map(drop),
        "Quota" => Quota::deserialize(object).map(drop),
        _ => Ok(()),
    };
    read.map_err(|error| {
        let mut violations = Violations::new();
        violations.invalid("status", error.to_string());
        Failure::invalid(entry, name, &violations)
    })
}

/// Holds what the client says about the object's identity against the object. Returns whether it named a version.
fn check_identity(target: &Object, present: &Stored, new: &Value) -> Result<bool, Failure> {
    let (entry, key) = (target.entry, &present.key);
    let name = &*key.name;
    match metadata::text(new, "name") {
        Some(said) if said != name => {
            return Err(Failure::bad_request(format!(
                "the name of the object ({said}) does not match the name on the URL ({name})"
            )));
        }
        _ => {}
    }
    match (metadata::text(new, "namespace"), key.namespace()) {
        (Some(said), Some(is)) if said != is => {
            return Err(Failure::bad_request(format!(
                "the namespace of the object ({said}) does not match the namespace on the URL ({is})"
            )));
        }
        _ => {}
    }
    if let Some(uid) = metadata::text(new, "uid")
        && *uid != *present.uid
    {
        let why = format!(
            "Precondition failed: UID in precondition: {uid}, UID in object meta: {}",
            present.uid
        );
        return Err(Failure::conflict(entry, name, why));
    }
    match metadata::text(new, "resourceVersion") {
        None => Ok(false),
        Some(said) if said == present.revision.to_string() => Ok(true),
        Some(said) if said.parse::<u64>().is_ok() => Err(Failure::stale(entry, name)),
        Some(said) => {
            Err(Failure::bad_request(format!("resourceVersion {said:?} is not a number")))
        }
    }
}

/// Nobody may ask to be waited for by an object that is already ending.
fn check_finalizers(entry: &Entry, name: &str, old: &Value, new: &Value) -> Result<(), Failure> {
    if !metadata::is_ending(old) {
        return Ok(());
    }
    let list =
        |object: &Value| object["metadata"]["finalizers"].as_array().cloned().unwrap_or_default();
    let before = list(old);
    if list(new).iter().all(|finalizer| before.contains(finalizer)) {
        return Ok(());
    }
    let mut violations = Violations::new();
    violations.forbidden(
        "metadata.finalizers",
        "no new finalizers can be added if the object is being deleted",
    );
    Err(Failure::invalid(entry, name, &violations))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::store::memory;

    #[tokio::test]
    async fn a_client_is_told_that_nothing_changes_where_the_disk_has_the_same() {
        let (store, failures) = memory::start_failing().await;
        let key = objects::node_key("r1");
        let object = |n| json!({"metadata": {"name": "r1", "uid": "u"}, "spec": {"n": n}});
        let present = store.create(key, object(1)).await.expect("it is new");
        let same = present.value();
        assert_eq!(write(&store, &present, &same).await.expect("the disk is well"), present);
        failures.mislead_next(1);
        write(&store, &present, &object(2)).await.expect_err("it seems to fail");
        let said = write(&store, &present, &same).await;
        assert!(matches!(said, Err(StoreError::Conflict { .. })), "{said:?}");
    }
}
