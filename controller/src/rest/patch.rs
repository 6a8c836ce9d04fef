//! PATCH: JSON merge patch (RFC 7396) and JSON patch (RFC 6902). kubectl patches the kinds that it knows itself with a
//! strategic merge; for those that hold only maps beside their metadata it is the same as a merge patch.

use axum::body::Body;
use bytes::Bytes;
use http::{HeaderValue, Request, header};
use json_patch::Patch;
use serde_json::Value;

use super::path::Object;
use super::update::{Options, change};
use super::{Answer, Call, body, failure::Failure};

const MERGE: &str = "application/merge-patch+json";
const STRATEGIC: &str = "application/strategic-merge-patch+json";
const JSON: &str = "application/json-patch+json";
/// As many operations as Kubernetes takes.
const OPERATIONS: usize = 10_000;

/// A patch that was read.
pub(super) enum Change {
    Merge(Value),
    Json(Patch),
}

pub(super) async fn patch(call: Call, target: Object) -> Answer {
    let options = Options::read(&call)?;
    let Call { context, request, .. } = call;
    let maps_only = matches!(target.entry.info.kind, "ConfigMap" | "Secret");
    let request = if maps_only { as_merge(request) } else { request };
    let patch = of_request(request).await?;
    change(&context, &target, &options, |present| apply(&patch, present)).await
}

/// The request with a strategic merge patch taken for a merge patch. Its directives are no fields and are refused as such.
fn as_merge(mut request: Request<Body>) -> Request<Body> {
    if body::media_type(request.headers()) == STRATEGIC {
        request.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static(MERGE));
    }
    request
}

/// The patch that a request brings.
pub(super) async fn of_request(request: Request<Body>) -> Result<Change, Failure> {
    let (parts, body) = request.into_parts();
    let media = body::media_type(&parts.headers);
    if media != MERGE && media != JSON {
        return Err(body::unsupported(&media, &format!("{JSON}, {MERGE}")));
    }
    read(&media, &body::bytes(body).await?)
}

fn read(media: &str, bytes: &Bytes) -> Result<Change, Failure> {
    let value = body::parse(bytes)?;
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

/// What an object becomes by a patch.
pub(super) fn apply(patch: &Change, present: &Value) -> Result<Value, Failure> {
    let mut object = present.clone();
    // The patch says which version it is for, or none; what is there now is not the client's word.
    if let Some(metadata) = object["metadata"].as_object_mut() {
        metadata.remove("resourceVersion");
    }
    match patch {
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
