//! PATCH: JSON merge patch (RFC 7396), JSON patch (RFC 6902), server-side apply; for core kinds, which kubectl knows
//! itself, also its strategic merge.

use std::time::{Duration, Instant};

use axum::body::Body;
use bytes::Bytes;
use http::Request;
use json_patch::{Patch, PatchOperation};
use serde_json::Value;

use super::path::{Object, Verb};
use super::registry::Entry;
use super::update::{Options, change};
use super::{Answer, Call, admission, body, create, failure::Failure, metadata, owners, strategic};
use crate::store::{DEEPEST, is_deeper};

pub(super) const MERGE: &str = "application/merge-patch+json";
pub(super) const STRATEGIC: &str = "application/strategic-merge-patch+json";
pub(super) const JSON: &str = "application/json-patch+json";
pub(super) const APPLY: &str = "application/apply-patch+yaml";
/// As many operations as Kubernetes takes.
const OPERATIONS: usize = 10_000;
/// Bytes that all copies of a JSON patch may make, as in Kubernetes: each of thirty operations may double the object.
const COPIED: usize = 3 << 20;
/// A patch that is still not done by then is meant to keep us busy: nothing interrupts it, and others wait for its thread.
const WITHIN: Duration = Duration::from_secs(1);

/// A patch that was read.
pub(super) enum Change {
    Merge(Value),
    Strategic(Value),
    Json(Patch),
}

pub(super) async fn patch(call: Call, target: Object) -> Answer {
    let options = Options::read(&call, &target)?;
    if body::media_type(call.request.headers()) == APPLY {
        let (entry, as_it_is) = (target.entry, |config| Ok(config));
        return server_side(call, target, options, (entry, &as_it_is)).await;
    }
    let Call { context, request, .. } = call;
    let patch = of_request(request, target.entry.info.group.is_empty()).await?;
    change(&context, &target, &options, |present| apply(&patch, present)).await
}

/// What a configuration of a kind as it is shown is to the stored kind.
type Meaning<'a> = &'a (dyn Fn(Value) -> Result<Value, Failure> + Sync);

/// Server-side apply: creates what is not there yet. What is applied is of the kind that is `shown`, and means something of
/// the target's.
pub(super) async fn server_side(
    call: Call,
    target: Object,
    options: Options,
    (shown, meaning): (&'static Entry, Meaning<'_>),
) -> Answer {
    let force = call.query.flag("force");
    if call.query.text("fieldManager").is_none() {
        return Err(Failure::new(
            http::StatusCode::UNPROCESSABLE_ENTITY,
            "Invalid",
            "PatchOptions.meta.k8s.io \"\" is invalid: fieldManager: Required value: is required for apply patch",
        ));
    }
    let options = Options { applies: true, ..options };
    let Call { context, request, .. } = call;
    let bytes = body::bytes(request.into_body()).await?;
    let config = meaning(configuration(shown, &target, &bytes)?)?;
    let key = target.key()?;
    let entry = target.entry;
    let creates = shown.verbs.contains(&Verb::Create) && target.subresource.is_none();
    loop {
        if context.store.get(&key).is_some() {
            let make =
                |present: &Value| owners::applied(entry, present, &config, &options.writer, force);
            return change(&context, &target, &options, make).await;
        }
        if !creates {
            return Err(Failure::not_found(shown, &key.name));
        }
        let object = owners::applied(entry, &Value::Null, &config, &options.writer, force)?;
        match create::by_application(&context, &target, object, &options).await {
            // Somebody else was faster: it is there now.
            Err(failure) if failure.code() == 409 && context.store.get(&key).is_some() => {}
            answer => return answer,
        }
    }
}

/// What is applied: one object, in YAML (JSON is YAML), of the kind and name that the path has.
pub(super) fn configuration(
    shown: &Entry,
    target: &Object,
    bytes: &Bytes,
) -> Result<Value, Failure> {
    let text = std::str::from_utf8(bytes)
        .map_err(|_| Failure::bad_request("the body is not text in UTF-8"))?;
    let mut config: Value = serde_saphyr::from_str(text)
        .map_err(|error| Failure::bad_request(format!("the body is not YAML: {error}")))?;
    admission::identify(shown, &mut config)?;
    if config["metadata"]
        .get("managedFields")
        .is_some_and(|f| f.as_array().is_none_or(|l| !l.is_empty()))
    {
        return Err(Failure::bad_request("metadata.managedFields must be nil"));
    }
    if metadata::of(&mut config).is_none() {
        return Err(Failure::bad_request("metadata is not a JSON object"));
    }
    let name = target.name.as_deref().unwrap_or_default();
    for (field, path) in [("name", Some(name)), ("namespace", target.namespace.as_deref())] {
        let Some(path) = path else { continue };
        match metadata::text(&config, field) {
            None => config["metadata"][field] = path.into(),
            Some(said) if said == path => {}
            Some(said) => {
                return Err(Failure::bad_request(format!(
                    "the {field} of the object ({said}) does not match the {field} on the URL ({path})"
                )));
            }
        }
    }
    Ok(config)
}

/// The patch that a request brings.
pub(super) async fn of_request(request: Request<Body>, core: bool) -> Result<Change, Failure> {
    let (parts, body) = request.into_parts();
    let media = body::media_type(&parts.headers);
    if media != MERGE && media != JSON && !(core && media == STRATEGIC) {
        let strategic = if core { format!(", {STRATEGIC}") } else { String::new() };
        return Err(body::unsupported(&media, &format!("{JSON}, {MERGE}, {APPLY}{strategic}")));
    }
    read(&media, &body::bytes(body).await?)
}

pub(super) fn read(media: &str, bytes: &Bytes) -> Result<Change, Failure> {
    let value = body::parse(bytes)?;
    if media == STRATEGIC {
        return Ok(Change::Strategic(value));
    }
    if media == MERGE {
        if !value.is_object() {
            return Err(Failure::bad_request("a merge patch is a JSON object"));
        }
        return Ok(Change::Merge(value));
    }
    let patch: Patch = serde_json::from_value(value)
        .map_err(|error| Failure::bad_request(format!("the body is not a JSON patch: {error}")))?;
    if patch.0.len() > OPERATIONS {
        return Err(Failure::too_large(format!("a JSON patch may hold {OPERATIONS} operations")));
    }
    Ok(Change::Json(patch))
}

/// Whether a JSON patch is for a version, which it tests or sets.
fn names_version(patch: &Change) -> bool {
    const VERSION: &str = "/metadata/resourceVersion";
    match patch {
        Change::Json(patch) => patch.0.iter().any(|operation| operation.path().as_str() == VERSION),
        Change::Merge(_) | Change::Strategic(_) => false,
    }
}

/// What an object becomes by a patch.
pub(super) fn apply(patch: &Change, present: &Value) -> Result<Value, Failure> {
    let mut object = present.clone();
    // The patch says which version it is for, or none; what is there now is not the client's word.
    if let Some(metadata) = object["metadata"].as_object_mut().filter(|_| !names_version(patch)) {
        metadata.remove("resourceVersion");
    }
    match patch {
        Change::Strategic(patch) => strategic::merge(&mut object, patch)?,
        Change::Merge(patch) => json_patch::merge(&mut object, patch),
        Change::Json(patch) => operations(&mut object, patch)?,
    }
    Ok(object)
}

/// The operations one after the other, each only as long as what comes of it keeps to its limits. What is left of the object
/// after a refusal is of no use.
fn operations(object: &mut Value, patch: &Patch) -> Result<(), Failure> {
    let (mut copied, begin) = (0, Instant::now());
    for (index, operation) in patch.0.iter().enumerate() {
        if begin.elapsed() > WITHIN {
            return Err(Failure::too_large("the patch takes too long; send it in parts"));
        }
        limit(object, operation, &mut copied).map_err(|why| {
            Failure::too_large(format!("operation '/{index}' of the patch: {why}"))
        })?;
        json_patch::patch_unsafe(object, std::slice::from_ref(operation)).map_err(
            |mut error| {
                error.operation = index;
                let why = format!("the patch cannot be applied: {error}");
                Failure::new(http::StatusCode::UNPROCESSABLE_ENTITY, "Invalid", why)
            },
        )?;
    }
    Ok(())
}

/// Refuses an operation that would make the object too deep, or copy too much together with those before it.
fn limit(object: &Value, operation: &PatchOperation, copied: &mut usize) -> Result<(), String> {
    let (path, value) = match operation {
        PatchOperation::Add(add) => (&add.path, Some(&add.value)),
        PatchOperation::Replace(replace) => (&replace.path, Some(&replace.value)),
        PatchOperation::Move(one) => (&one.path, object.pointer(one.from.as_str())),
        PatchOperation::Copy(one) => (&one.path, object.pointer(one.from.as_str())),
        PatchOperation::Remove(_) | PatchOperation::Test(_) => return Ok(()),
    };
    // What is not there is refused by who looks for it.
    let Some(value) = value else { return Ok(()) };
    let room = DEEPEST.checked_sub(path.count());
    if room.is_none_or(|room| is_deeper(value, room)) {
        return Err(format!("more than {DEEPEST} lists and objects would lie in each other"));
    }
    if matches!(operation, PatchOperation::Copy(_)) {
        *copied += size(value);
    }
    if *copied > COPIED {
        return Err(format!("all copies together are larger than {COPIED} bytes"));
    }
    Ok(())
}

/// About as many bytes as the value has as JSON.
fn size(value: &Value) -> usize {
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) => 8,
        Value::String(text) => text.len() + 2,
        Value::Array(elements) => {
            2 + elements.iter().map(|element| size(element) + 1).sum::<usize>()
        }
        Value::Object(members) => {
            2 + members.iter().map(|(name, value)| name.len() + 4 + size(value)).sum::<usize>()
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn patched(object: &Value, operations: &Value) -> Result<Value, u16> {
        let patch = read(JSON, &operations.to_string().into()).map_err(|failure| failure.code())?;
        apply(&patch, object).map_err(|failure| failure.code())
    }

    #[test]
    fn copies_do_not_add_up_without_end() {
        let object = json!({"metadata": {"name": "n"}, "text": "x".repeat(1000)});
        let copy = |i: usize| json!({"op": "copy", "from": "", "path": format!("/x{i}")});
        let doubled = |times: usize| patched(&object, &(0..times).map(copy).collect());
        assert!(doubled(10).is_ok());
        assert_eq!(doubled(30), Err(413), "a gigabyte");
        let many = json!({"op": "copy", "from": "/text", "path": "/other"});
        let many: Value = (0..9_999).map(|_| many.clone()).collect();
        assert_eq!(
            patched(&object, &many),
            Err(413),
            "also where each takes the place of the one before"
        );
    }

    #[test]
    fn nothing_grows_deeper_than_can_be_stored() {
        let object = json!({"metadata": {}, "a": {}});
        let nest = |op: &'static str| {
            let one = |i: usize| match i % 2 {
                0 => {
                    json!([{"op": "add", "path": "/b", "value": {}}, {"op": op, "from": "/a", "path": "/b/a"}])
                }
                _ => {
                    json!([{"op": "add", "path": "/a", "value": {}}, {"op": op, "from": "/b", "path": "/a/b"}])
                }
            };
            (0..4_000).flat_map(move |i| one(i).as_array().cloned().unwrap_or_default()).collect()
        };
        for op in ["move", "copy"] {
            assert_eq!(patched(&object, &nest(op)), Err(413), "{op}");
        }
        let at = |depth: usize| {
            let value = (0..depth).fold(json!(1), |inner, _| json!([inner]));
            patched(&object, &json!([{"op": "add", "path": "/a/b", "value": value}]))
        };
        assert!(at(DEEPEST - 2).is_ok_and(|object| !is_deeper(&object, DEEPEST)));
        assert_eq!(at(DEEPEST - 1), Err(413));
    }

    #[test]
    fn a_refusal_names_its_operation() {
        let wrong =
            json!([{"op": "add", "path": "/a", "value": 1}, {"op": "remove", "path": "/b"}]);
        let patch = read(JSON, &wrong.to_string().into()).unwrap();
        let refused = apply(&patch, &json!({"metadata": {}})).unwrap_err();
        assert!(
            refused.message().contains("operation '/1' failed at path '/b'"),
            "{}",
            refused.message()
        );
    }
}
