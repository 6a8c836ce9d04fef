//! POST: new objects.

use std::collections::BTreeMap;
use std::sync::Arc;

use axum::response::Response;
use http::{HeaderValue, StatusCode, header};
use muster_api::kind::namespace::DEFAULT;
use muster_api::kind::quota::{QUOTA_NAME, QuotaSpec};
use muster_api::kind::task::Resources;
use muster_api::validate::Violations;
use serde::Deserialize as _;
use serde_json::Value;

use super::path::Object;
use super::query::FieldValidation;
use super::registry::Entry;
use super::update::Options;
use super::{
    Answer, Call, admission, body, failure::Failure, host, launched, metadata, namespace, together,
};
use crate::auth::Asker;
use crate::context::Context;
use crate::depends;
use crate::objects::{self, TASKS};
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
    let Call { context, asker, request, .. } = call;
    let (parts, body) = request.into_parts();
    let object = body::json(&parts.headers, body).await?;
    let namespace = target.namespace.as_deref();
    let (asker, with) = (Some(&asker), With::default());
    let request = New { entry: target.entry, namespace, mode, dry, asker, owners: None, with };
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
        asker: Some(&options.asker),
        owners: object["metadata"].get("managedFields").cloned(),
        with: With::default(),
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
    let namespace = metadata::text(&object, "namespace").map(str::to_owned);
    let new = ours(resource, namespace.as_deref())?;
    let prepared = prepare(context, &new, object)?;
    let _pass = pass(context, new.entry.resource, &prepared.object)?;
    commit(context, &new, prepared).await.map(|(stored, _)| stored)
}

/// What the controller itself makes, held to every rule.
fn ours(resource: Resource, namespace: Option<&str>) -> Result<New<'_>, Failure> {
    let entry = super::registry::of(resource)
        .ok_or_else(|| Failure::internal(format!("{resource} is not served")))?;
    let mode = FieldValidation::Strict;
    Ok(New { entry, namespace, mode, dry: false, asker: None, owners: None, with: With::default() })
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
    let namespace = metadata::text(&object, "namespace").map(str::to_owned);
    let new = ours(resource, namespace.as_deref())?;
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

/// A new object of a transaction.
pub(super) fn prepare_with(
    (context, asker): (&Context, &Asker),
    entry: &'static Entry,
    namespace: Option<&str>,
    object: Value,
    with: With<'_>,
) -> Result<Value, Failure> {
    let mode = FieldValidation::Strict;
    let asker = Some(asker);
    let new = New { entry, namespace, mode, dry: false, asker, owners: None, with };
    prepare(context, &new, object).map(|prepared| prepared.object)
}

/// As [`pass`], of a transaction. One that brings its namespace's quota itself is held to that by [`judge`].
pub(super) fn pass_with(
    context: &Context,
    resource: Resource,
    object: &Value,
    with: With<'_>,
) -> Result<Option<Pass>, Failure> {
    let namespace = metadata::text(object, "namespace").unwrap_or_default();
    match resource == TASKS && with.brings_quota(namespace) {
        true => Ok(None),
        false => pass(context, resource, object),
    }
}

/// What of a transaction's new tasks the quotas do not let in that it brings itself: all tasks of a namespace together, in
/// their order, before anybody else can ask. By their place among `with.objects`.
pub(super) fn judge(context: &Context, with: With<'_>) -> Vec<(usize, Failure)> {
    let mut asked: BTreeMap<&str, Vec<(usize, &Value)>> = BTreeMap::new();
    for (index, object) in with.objects.iter().enumerate().filter(|(_, o)| o["kind"] == "Task") {
        let namespace = metadata::text(object, "namespace").unwrap_or(DEFAULT);
        asked.entry(namespace).or_default().push((index, object));
    }
    asked.retain(|namespace, _| with.brings_quota(namespace));
    let mut refusals = Vec::new();
    for (namespace, tasks) in asked {
        let Some(quota) = with.quota_of(context, namespace) else { continue };
        let asking = tasks.into_iter().filter_map(|(index, task)| {
            let mut full = task.clone();
            quota::fill_defaults(&quota.defaults, &mut full);
            // What cannot be read is refused by itself, with its place.
            Some((index, task, resources_of(&full).ok()?))
        });
        let asking: Vec<_> = asking.collect();
        let wanted = asking.iter().map(|(.., resources)| resources);
        let judged = context.door.rehearse(&context.store, (namespace, &quota), wanted);
        for ((index, task, _), judged) in asking.iter().zip(judged) {
            let name = metadata::text(task, "name").unwrap_or_default();
            refusals.extend(judged.err().map(|violations| (*index, refused(name, &violations))));
        }
    }
    refusals
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

/// What is stored in the same transaction.
#[derive(Clone, Copy, Default)]
pub(super) struct With<'a> {
    /// New objects, as they were sent.
    pub(super) objects: &'a [Value],
}

impl With<'_> {
    /// The quota that there is then.
    fn quota_of(&self, context: &Context, namespace: &str) -> Option<QuotaSpec> {
        together::quota_of(context, self.objects, namespace)
    }

    fn brings_quota(&self, namespace: &str) -> bool {
        objects::among(self.objects, "Quota", (namespace, QUOTA_NAME)).is_some()
    }
}

/// What is asked for.
struct New<'a> {
    entry: &'static Entry,
    namespace: Option<&'a str>,
    mode: FieldValidation,
    dry: bool,
    /// Who makes it; none: the controller itself.
    asker: Option<&'a Asker>,
    /// Whose its fields are, when somebody keeps account.
    owners: Option<Value>,
    with: With<'a>,
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
        return Ok((admission::render(&prepared.object)?, prepared.warnings));
    }
    let _pass = pass(context, new.entry.resource, &prepared.object)?;
    let (stored, warnings) = commit(context, new, prepared).await?;
    Ok((stored.bytes.clone(), warnings))
}

/// A new object as it would be stored.
struct Prepared {
    object: Value,
    warnings: Vec<HeaderValue>,
    /// What its name was made of; none: the client named it.
    prefix: Option<String>,
}

/// The object as it would be stored.
fn prepare(context: &Context, new: &New<'_>, mut object: Value) -> Result<Prepared, Failure> {
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
        && let Some(quota) = new.namespace.and_then(|ns| new.with.quota_of(context, ns))
    {
        quota::fill_defaults(&quota.defaults, &mut object);
    }
    let Some(own) = metadata::of(&mut object) else {
        return Err(Failure::bad_request("metadata is not a JSON object"));
    };
    metadata::begin(context, own, !info.group.is_empty());
    let unnamed = own.get("name").and_then(Value::as_str).is_none_or(str::is_empty);
    let prefix = own.get("generateName").and_then(Value::as_str).filter(|_| unnamed);
    let prefix = prefix.map(str::to_owned);
    if let Some(prefix) = &prefix {
        own.insert("name".into(), format!("{prefix}{}", suffix()).into());
    }
    let name = metadata::text(&object, "name").unwrap_or_default().to_owned();
    let mut admitted = admission::admit(new.entry, &name, object, new.mode)?;
    if let Some(asker) = new.asker {
        launched::check(&Value::Null, &admitted.object)
            .into_result(())
            .and_then(|()| host::check(asker, &Value::Null, &admitted.object).into_result(()))
            .map_err(|violations| Failure::invalid(new.entry, &name, &violations))?;
    }
    if new.entry.resource == TASKS {
        depends::check(&context.store, new.with.objects, &admitted.object)
            .map_err(|violations| Failure::invalid(new.entry, &name, &violations))?;
    }
    if let Some(owners) = &new.owners {
        admitted.object["metadata"]["managedFields"] = owners.clone();
    }
    if info.kind == "Namespace" {
        namespace::complete(&mut admitted.object);
    }
    let admission::Admitted { object, warnings } = admitted;
    Ok(Prepared { object, warnings, prefix })
}

/// Stores it, in a namespace that is there and not ending at the moment of the commit.
async fn commit(
    context: &Context,
    new: &New<'_>,
    prepared: Prepared,
) -> Result<(Arc<Stored>, Vec<HeaderValue>), Failure> {
    let Prepared { mut object, warnings, prefix } = prepared;
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
                let stored = stored.pop();
                let stored = stored.ok_or_else(|| Failure::internal("nothing was stored"))?;
                return Ok((stored, warnings));
            }
            Err(error @ StoreError::AlreadyExists { .. }) => match &prefix {
                Some(prefix) => {
                    object["metadata"]["name"] = format!("{prefix}{}", suffix()).into();
                }
                None => return Err(Failure::of_store(new.entry, &name, &error)),
            },
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
