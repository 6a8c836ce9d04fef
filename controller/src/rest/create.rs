//! POST: new objects.

use std::sync::Arc;

use axum::response::Response;
use http::{HeaderValue, StatusCode, header};
use muster_api::kind::task::Resources;
use muster_api::validate::Violations;
use serde::Deserialize as _;
use serde_json::Value;

use super::path::Object;
use super::query::FieldValidation;
use super::registry::Entry;
use super::update::Options;
use super::{Answer, Call, admission, body, failure::Failure, metadata, namespace};
use crate::context::Context;
use crate::depends;
use crate::objects::TASKS;
use crate::quota::{self, Pass};
use crate::store::{Op, Precondition, Resource, StoreError, Stored};

/// Random letters after a `generateName`. No vowels and no look-alikes, as in Kubernetes.
const SUFFIX: &[u8; 27] = b"bcdfghjklmnpqrstvwxz2456789";
const SUFFIX_LENGTH: usize = 5;
/// Names of five letters collide once in fourteen million; several times in a row is another fault.
const ATTEMPTS: usize = 8;

pub(super) async fn create(call: Call, target: Object) -> Answer {
    if target.name.is_some() {
        return Err(Failure::method(call.request.method()));
    }
    let (dry, mode) = (call.query.dry_run()?, call.query.field_validation()?);
    let Call { context, request, .. } = call;
    let (parts, body) = request.into_parts();
    let object = body::json(&parts.headers, body).await?;
    let namespace = target.namespace.as_deref();
    let request = New { entry: target.entry, namespace, mode, dry, owners: None };
    let (bytes, warnings) = store_new(&context, &request, object).await?;
    Ok(with_warnings(super::raw(StatusCode::CREATED, bytes), warnings))
}

/// Creates an object that is applied and is not there yet.
pub(super) async fn by_application(
    context: &Context,
    target: &Object,
    object: Value,
    options: &Options,
) -> Answer {
    let new = New {
        entry: target.entry,
        namespace: target.namespace.as_deref(),
        mode: options.mode,
        dry: options.dry,
        owners: object["metadata"].get("managedFields").cloned(),
    };
    let (bytes, warnings) = store_new(context, &new, object).await?;
    Ok(with_warnings(super::raw(StatusCode::CREATED, bytes), warnings))
}

/// Creates an object in this process, with everything that a POST checks.
///
/// # Errors
/// What a client would be told.
pub async fn create_object(
    context: &Context,
    resource: Resource,
    object: Value,
) -> Result<Arc<Stored>, Failure> {
    let entry = super::registry::of(resource)
        .ok_or_else(|| Failure::internal(format!("{resource} is not served")))?;
    let namespace = metadata::text(&object, "namespace").map(str::to_owned);
    let new = New {
        entry,
        namespace: namespace.as_deref(),
        mode: FieldValidation::Strict,
        dry: false,
        owners: None,
    };
    let prepared = prepare(context, &new, object)?;
    let _pass = pass(context, entry.resource, &prepared.object)?;
    commit(context, &new, prepared.object).await
}

/// A new object as a POST would store it, without storing it.
///
/// # Errors
/// What a client would be told.
pub(crate) fn prepare_object(
    context: &Context,
    resource: Resource,
    object: Value,
) -> Result<Value, Failure> {
    let entry = super::registry::of(resource)
        .ok_or_else(|| Failure::internal(format!("{resource} is not served")))?;
    let namespace = metadata::text(&object, "namespace").map(str::to_owned);
    let new = New {
        entry,
        namespace: namespace.as_deref(),
        mode: FieldValidation::Strict,
        dry: false,
        owners: None,
    };
    prepare(context, &new, object).map(|prepared| prepared.object)
}

/// That a namespace is there and not ending, as a condition of a transaction.
///
/// # Errors
/// What a client would be told when it is not.
pub(crate) fn namespace_guard(
    context: &Context,
    resource: Resource,
    namespace: &str,
) -> Result<Option<Op>, Failure> {
    let entry = super::registry::of(resource)
        .ok_or_else(|| Failure::internal(format!("{resource} is not served")))?;
    namespace::admit_into(context, entry, Some(namespace), "")
}

/// Lets a prepared task through its namespace's quota; to be kept until it is committed. Other kinds pass freely.
///
/// # Errors
/// Everything that the quota does not leave.
pub(crate) fn pass(
    context: &Context,
    resource: Resource,
    object: &Value,
) -> Result<Option<Pass>, Failure> {
    if resource != TASKS {
        return Ok(None);
    }
    let resources = resources_of(object)?;
    let text = |field: &str| metadata::text(object, field).unwrap_or_default();
    let door = &context.door;
    door.admit(&context.store, text("namespace"), text("uid"), &resources)
        .map_err(|violations| refused(text("name"), &violations))
}

/// As [`pass`], for who only asks.
fn would_pass(context: &Context, resource: Resource, object: &Value) -> Result<(), Failure> {
    let text = |field: &str| metadata::text(object, field).unwrap_or_default();
    let quota = quota::of(&context.store, text("namespace")).filter(|_| resource == TASKS);
    let Some(quota) = quota else { return Ok(()) };
    let resources = resources_of(object)?;
    let of = (text("namespace"), &quota);
    let judged = context.door.rehearse(&context.store, of, [&resources]);
    let violations = judged.into_iter().find_map(Result::err);
    violations.map_or(Ok(()), |violations| Err(refused(text("name"), &violations)))
}

/// What a task asks for.
pub(super) fn resources_of(task: &Value) -> Result<Resources, Failure> {
    match &task["spec"]["resources"] {
        Value::Null => Ok(Resources::default()),
        given => Resources::deserialize(given).map_err(|e| Failure::internal(e.to_string())),
    }
}

/// What a task is told that its namespace's quota does not let in.
pub(super) fn refused(name: &str, violations: &Violations) -> Failure {
    match super::registry::of(TASKS) {
        Some(entry) => Failure::invalid(entry, name, violations),
        None => Failure::internal("tasks are not served"),
    }
}

/// What is asked for.
struct New<'a> {
    entry: &'static Entry,
    namespace: Option<&'a str>,
    mode: FieldValidation,
    dry: bool,
    /// Whose its fields are, when somebody keeps account.
    owners: Option<Value>,
}

async fn store_new(
    context: &Context,
    new: &New<'_>,
    object: Value,
) -> Result<(bytes::Bytes, Vec<HeaderValue>), Failure> {
    let prepared = prepare(context, new, object)?;
    if new.dry {
        let name = metadata::text(&prepared.object, "name").unwrap_or_default();
        if context.store.get(&new.entry.key(new.namespace, name)).is_some() {
            return Err(Failure::already_exists(new.entry, name));
        }
        namespace::admit_into(context, new.entry, new.namespace, name)?;
        would_pass(context, new.entry.resource, &prepared.object)?;
        return Ok((prepared.object.to_string().into(), prepared.warnings));
    }
    let _pass = pass(context, new.entry.resource, &prepared.object)?;
    let stored = commit(context, new, prepared.object).await?;
    Ok((stored.bytes.clone(), prepared.warnings))
}

/// The object as it would be stored.
fn prepare(
    context: &Context,
    new: &New<'_>,
    mut object: Value,
) -> Result<admission::Admitted, Failure> {
    let info = new.entry.info;
    admission::identify(new.entry, &mut object)?;
    if info.has_status
        && let Some(fields) = object.as_object_mut()
    {
        fields.remove("status");
    }
    let Some(own) = metadata::of(&mut object) else {
        return Err(Failure::bad_request("metadata is not a JSON object"));
    };
    if own.get("resourceVersion").and_then(Value::as_str).is_some_and(|rv| !rv.is_empty()) {
        return Err(Failure::bad_request(
            "resourceVersion should not be set on objects to be created",
        ));
    }
    match (own.get("namespace").and_then(Value::as_str).filter(|ns| !ns.is_empty()), new.namespace)
    {
        (Some(body), Some(path)) if body != path => {
            return Err(Failure::bad_request(format!(
                "the namespace of the object ({body}) does not match the namespace of the request ({path})"
            )));
        }
        (None, Some(path)) => {
            own.insert("namespace".into(), path.into());
        }
        (None, None) if info.namespaced => {
            return Err(Failure::bad_request("an object of this kind needs a namespace"));
        }
        _ => {}
    }
    if new.entry.resource == TASKS
        && let Some(quota) = new.namespace.and_then(|ns| quota::of(&context.store, ns))
    {
        quota::fill_defaults(&quota.defaults, &mut object);
    }
    let Some(own) = metadata::of(&mut object) else {
        return Err(Failure::bad_request("metadata is not a JSON object"));
    };
    metadata::begin(context, own, !info.group.is_empty());
    if own.get("name").and_then(Value::as_str).is_none_or(str::is_empty)
        && let Some(prefix) = own.get("generateName").and_then(Value::as_str)
    {
        let name = format!("{prefix}{}", suffix());
        own.insert("name".into(), name.into());
    }
    let name = metadata::text(&object, "name").unwrap_or_default().to_owned();
    let mut admitted = admission::admit(new.entry, &name, object, new.mode)?;
    if new.entry.resource == TASKS {
        depends::check(&context.store, &admitted.object)
            .map_err(|violations| Failure::invalid(new.entry, &name, &violations))?;
    }
    if let Some(owners) = &new.owners {
        admitted.object["metadata"]["managedFields"] = owners.clone();
    }
    if info.kind == "Namespace" {
        namespace::complete(&mut admitted.object);
    }
    Ok(admitted)
}

/// Stores it, in a namespace that is there and not ending at the moment of the commit.
async fn commit(
    context: &Context,
    new: &New<'_>,
    mut object: Value,
) -> Result<Arc<Stored>, Failure> {
    let prefix = metadata::text(&object, "generateName").map(str::to_owned);
    for _ in 0..ATTEMPTS {
        let name = metadata::text(&object, "name").unwrap_or_default().to_owned();
        let key = new.entry.key(new.namespace, &name);
        let guard = namespace::admit_into(context, new.entry, new.namespace, &name)?;
        let mut ops: Vec<Op> = guard.into_iter().collect();
        ops.push(Op::Put {
            key: key.clone(),
            value: object.clone(),
            precondition: Precondition::Absent,
        });
        match context.store.apply(ops).await {
            Ok(mut stored) => {
                return stored.pop().ok_or_else(|| Failure::internal("nothing was stored"));
            }
            Err(StoreError::AlreadyExists { .. }) if prefix.is_some() => {
                let prefix = prefix.as_deref().unwrap_or_default();
                object["metadata"]["name"] = format!("{prefix}{}", suffix()).into();
            }
            // The namespace changed in between: look at it again.
            Err(
                StoreError::Conflict { key: changed, .. } | StoreError::NotFound { key: changed },
            ) if changed != key => {}
            Err(error) => return Err(Failure::of_store(new.entry, &name, &error)),
        }
    }
    Err(Failure::unavailable("the namespace keeps changing"))
}

fn suffix() -> String {
    let random = uuid::Uuid::new_v4();
    let letters = random.as_bytes().iter().take(SUFFIX_LENGTH);
    letters.map(|byte| char::from(SUFFIX[usize::from(*byte) % SUFFIX.len()])).collect()
}

pub(super) fn with_warnings(mut response: Response, warnings: Vec<HeaderValue>) -> Response {
    for warning in warnings {
        response.headers_mut().append(header::WARNING, warning);
    }
    response
}
