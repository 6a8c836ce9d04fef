//! Bodies, of a limited size each and all together: JSON, and what kubectl sends in protobuf.

use std::sync::Arc;

use axum::body::Body;
use bytes::{Bytes, BytesMut};
use http::{HeaderMap, StatusCode, header};
use http_body_util::BodyExt as _;
use muster_api::validate::Violations;
use serde::de::DeserializeOwned;
use serde_json::Value;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::failure::Failure;
use super::path::Target;
use super::protobuf::{self, PROTOBUF};
use crate::auth::Identity;

/// As much as Kubernetes takes.
const LIMIT: usize = 3 << 20;
/// A request to join is a token and a request for a certificate, some kilobytes; anybody may send one.
const JOIN: usize = 64 << 10;
/// Objects that are planned, checked or stored together: each is held against the others.
const TOGETHER: usize = 1000;
/// Of a body that is too large, so many times as much as may be is read before it is refused.
const PATIENCE: usize = 4;
/// Bytes of all bodies that are being received or worked on, of those who showed a certificate.
const ROOM: usize = 128 << 20;
/// The same of strangers: all that they do is to join.
const STRANGERS: usize = 2 << 20;

/// Room for what clients send: a request without any is to come back.
#[derive(Debug)]
pub struct Bodies {
    known: Space,
    strangers: Space,
}

impl Default for Bodies {
    fn default() -> Self {
        let space = |bytes| Space(Arc::new(Semaphore::new(bytes)));
        Self { known: space(ROOM), strangers: space(STRANGERS) }
    }
}

impl Bodies {
    pub(super) fn of(&self, identity: &Identity) -> &Space {
        match identity {
            Identity::Anonymous => &self.strangers,
            _ => &self.known,
        }
    }
}

/// Room for bodies, a permit a byte.
#[derive(Debug)]
pub(super) struct Space(Arc<Semaphore>);

/// What a body takes of it.
pub(super) type Room = OwnedSemaphorePermit;

/// The most bytes that a body for this may have.
pub(super) fn limit(target: &Target) -> usize {
    if matches!(target, Target::Join) { JOIN } else { LIMIT }
}

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

impl Space {
    /// The whole body, and the room that it takes up.
    pub(super) async fn gather(
        &self,
        mut body: Body,
        limit: usize,
    ) -> Result<(Bytes, Option<Room>), Failure> {
        let (mut bytes, mut seen, mut taken) = (BytesMut::new(), 0, None::<Room>);
        // What is too much is read a while longer, and dropped: who still writes does not read the answer.
        while seen <= PATIENCE * limit
            && let Some(frame) = body.frame().await
        {
            let data = frame.map_err(unreadable)?.into_data().unwrap_or_default();
            seen += data.len();
            if seen > limit {
                bytes.clear();
                taken = None;
                continue;
            }
            let more = self.take(data.len())?;
            match &mut taken {
                Some(taken) => taken.merge(more),
                None => taken = Some(more),
            }
            bytes.extend_from_slice(&data);
        }
        if seen > limit {
            return Err(Failure::too_large(format!("the body is larger than {limit} bytes")));
        }
        Ok((bytes.freeze(), taken))
    }

    fn take(&self, bytes: usize) -> Result<Room, Failure> {
        let bytes = u32::try_from(bytes).map_err(|_| Failure::too_many())?;
        Arc::clone(&self.0).try_acquire_many_owned(bytes).map_err(|_| Failure::too_many())
    }
}

fn unreadable(error: axum::Error) -> Failure {
    Failure::bad_request(format!("cannot read the body: {error}"))
}

/// The whole body of a request that was received.
pub(super) async fn bytes(body: Body) -> Result<Bytes, Failure> {
    body.collect().await.map(|body| body.to_bytes()).map_err(unreadable)
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

/// Refuses more objects than are judged together.
pub(super) fn check_count(objects: usize) -> Result<(), Failure> {
    match objects > TOGETHER {
        true => Err(Failure::too_large(format!(
            "{objects} objects are more than the {TOGETHER} that are taken together; send them in parts"
        ))),
        false => Ok(()),
    }
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
