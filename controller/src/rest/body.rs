//! Bodies, of a limited size: JSON, and what kubectl sends in protobuf.

use axum::body::Body;
use bytes::{Bytes, BytesMut};
use http::{HeaderMap, StatusCode, header};
use muster_api::validate::Violations;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::failure::Failure;
use super::protobuf::{self, PROTOBUF};

/// As much as Kubernetes takes.
const LIMIT: usize = 3 << 20;
/// How much of a body that is too large is read before it is refused, bytes.
const PATIENCE: usize = 4 * LIMIT;

/// The media type of the body without its parameters, in lower case.
pub(super) fn media_type(headers: &HeaderMap) -> String {
    let value = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let value = value.unwrap_or_default();
    value.split(';').next().unwrap_or_default().trim().to_ascii_lowercase()
}

pub(super) fn unsupported(found: &str, supported: &str) -> Failure {
    let message = format!(
        "the body of the request was in an unknown format ({found:?}): accepted media types include: {supported}"
    );
    Failure::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "UnsupportedMediaType", message)
}

/// The whole body.
pub(super) async fn bytes(body: Body) -> Result<Bytes, Failure> {
    use http_body_util::BodyExt as _;
    let (mut body, mut bytes, mut seen) = (body, BytesMut::new(), 0);
    // What is too much is read a while longer, and dropped: who still writes does not read the answer.
    while seen <= PATIENCE
        && let Some(frame) = body.frame().await
    {
        let frame = frame
            .map_err(|error| Failure::bad_request(format!("cannot read the body: {error}")))?;
        let data = frame.into_data().unwrap_or_default();
        seen += data.len();
        if seen <= LIMIT {
            bytes.extend_from_slice(&data);
        }
    }
    if seen > LIMIT {
        return Err(Failure::new(
            StatusCode::PAYLOAD_TOO_LARGE,
            "RequestEntityTooLarge",
            format!("the body is larger than {LIMIT} bytes"),
        ));
    }
    Ok(bytes.freeze())
}

/// A JSON body; a request that does not say what it sends is taken to send JSON.
pub(super) async fn json(headers: &HeaderMap, body: Body) -> Result<Value, Failure> {
    let found = media_type(headers);
    if found == PROTOBUF {
        return protobuf::json(&bytes(body).await?);
    }
    if !matches!(found.as_str(), "" | "application/json") {
        return Err(unsupported(&found, "application/json"));
    }
    parse(&bytes(body).await?)
}

/// A JSON body that may be left out.
pub(super) async fn optional_json(headers: &HeaderMap, body: Body) -> Result<Value, Failure> {
    let found = media_type(headers);
    let bytes = bytes(body).await?;
    if bytes.is_empty() {
        return Ok(Value::Null);
    }
    if found == PROTOBUF {
        return protobuf::json(&bytes);
    }
    if !matches!(found.as_str(), "" | "application/json") {
        return Err(unsupported(&found, "application/json"));
    }
    parse(&bytes)
}

/// A body as what it should be; 422 with the field's path, for unknown fields too.
pub(super) fn typed<T: DeserializeOwned>(what: &str, body: Value) -> Result<T, Failure> {
    serde_path_to_error::deserialize(body).map_err(|error| {
        let mut violations = Violations::new();
        let unknown = error.inner().to_string();
        match unknown.split_once(", expected") {
            Some((_, known)) if unknown.starts_with("unknown field") => violations
                .not_supported(error.path().to_string(), "is not a field")
                .suggest(format!("expected{known}")),
            _ => drop(violations.invalid(error.path().to_string(), unknown)),
        }
        Failure::invalid_body(what, &violations)
    })
}

pub(super) fn parse(bytes: &[u8]) -> Result<Value, Failure> {
    serde_json::from_slice(bytes)
        .map_err(|error| Failure::bad_request(format!("the body is not JSON: {error}")))
}
