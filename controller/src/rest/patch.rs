//! PATCH: JSON merge patch (RFC 7396), JSON patch (RFC 6902), server-side apply; for core kinds, which kubectl knows
//! itself, also its strategic merge.

use axum::body::Body;
use bytes::Bytes;
use http::Request;
use json_patch::Patch;
use serde_json::Value;

use super::path::{Object, Verb};
use super::update::{Options, change};
use super::{Answer, Call, admission, body, create, failure::Failure, metadata, owners, strategic};

const MERGE: &str = "application/merge-patch+json";
const STRATEGIC: &str = "application/strategic-merge-patch+json";
const JSON: &str = "application/json-patch+json";
const APPLY: &str = "application/apply-patch+yaml";
/// As many operations as Kubernetes takes.
const OPERATIONS: usize = 10_000;

/// A patch that was read.
pub(super) enum Change {
    Merge(Value),
    Strategic(Value),
    Json(Patch),
}

pub(super) async fn patch(call: Call, target: Object) -> Answer {
    let options = Options::read(&call, &target)?;
    if body::media_type(call.request.headers()) == APPLY {
        return server_side(call, target, options).await;
    }
    let Call { context, request, .. } = call;
    let patch = of_request(request, target.entry.info.group.is_empty()).await?;
    change(&context, &target, &options, |present| apply(&patch, present)).await
}

/// Server-side apply: creates what is not there yet.
async fn server_side(call: Call, target: Object, options: Options) -> Answer {
    let force = call.query.flag("force")?;
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
    let config = configuration(&target, &bytes)?;
    let key = target.key()?;
    let entry = target.entry;
    loop {
        if context.store.get(&key).is_some() {
            let make =
                |present: &Value| owners::applied(entry, present, &config, &options.writer, force);
            return change(&context, &target, &options, make).await;
        }
        if target.subresource.is_some() || !entry.verbs.contains(&Verb::Create) {
            return Err(Failure::not_found(entry, &key.name));
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
fn configuration(target: &Object, bytes: &Bytes) -> Result<Value, Failure> {
    let text = std::str::from_utf8(bytes)
        .map_err(|_| Failure::bad_request("the body is not text in UTF-8"))?;
    let mut config: Value = serde_saphyr::from_str(text)
        .map_err(|error| Failure::bad_request(format!("the body is not YAML: {error}")))?;
    admission::identify(target.entry, &mut config)?;
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

fn read(media: &str, bytes: &Bytes) -> Result<Change, Failure> {
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
        return Err(Failure::new(
            http::StatusCode::PAYLOAD_TOO_LARGE,
            "RequestEntityTooLarge",
            format!("a JSON patch may hold {OPERATIONS} operations"),
        ));
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
        Change::Json(patch) => json_patch::patch(&mut object, patch).map_err(|error| {
            Failure::new(
                http::StatusCode::UNPROCESSABLE_ENTITY,
                "Invalid",
                format!("the patch cannot be applied: {error}"),
            )
        })?,
    }
    Ok(object)
}
