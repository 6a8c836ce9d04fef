//! The line of a REST request, from before it is carried out until it is answered.

use std::sync::Arc;

use axum::body::Body;
use axum::response::Response;
use http::{HeaderValue, Request, StatusCode, header};
use http_body_util::BodyExt as _;
use muster_controller_core::access::{Asked, Verb};
use serde::Deserialize;

use super::{Line, Named};
use crate::auth::{self, Asker, Identity};
use crate::context::Context;
use crate::rest::Answer;
use crate::rest::failure::Failure;
use crate::rest::path::{Object, Subresource, Target};
use crate::rest::query::Query;
use crate::serve::Peer;

/// What Kubernetes calls the id of a request.
const AUDIT_ID: &str = "audit-id";
/// In the form in which Kubernetes warns.
const NOT_WRITTEN: HeaderValue = HeaderValue::from_static(
    "299 - \"it was carried out, and its line in the audit log is not written\"",
);

/// The line of a request that is being carried out. Dropped before its end, it is written as one that nobody knows the
/// outcome of: its client left, and it may have been carried out.
pub(crate) struct Entry {
    context: Arc<Context>,
    line: Option<Line>,
    /// Nobody said who they are: only what was let in is written.
    stranger: bool,
    /// It is not carried out while lines cannot be written.
    waits: bool,
}

impl Entry {
    /// Of a request that writes; none for others.
    pub(crate) fn begin(
        context: &Arc<Context>,
        asker: &Asker,
        (verb, target): (Verb, &Target),
        request: &Request<Body>,
    ) -> Option<Self> {
        if !writes(verb, target) || is_dry(target, request) {
            return None;
        }
        let mut line = Line {
            from: request.extensions().get::<Peer>().map(|peer| peer.0.to_string()),
            ..Line::of(&asker.identity, verb, target.resource().unwrap_or_default())
        };
        match target {
            Target::Objects(object) => {
                line.group = object.entry.info.group;
                line.subresource = object.subresource.map(|subresource| subresource.as_str());
                if let Asked::Right(action) = auth::of_object(verb, object) {
                    line.namespace = action.namespace.map(str::to_owned);
                    line.name = action.name.map(str::to_owned);
                }
            }
            Target::Tokens(id) | Target::UserTokens(id) => line.name = id.clone(),
            _ => {}
        }
        let stranger = asker.identity == Identity::Anonymous;
        let (context, waits) = (Arc::clone(context), !stops(verb, target));
        Some(Self { context, line: Some(line), stranger, waits })
    }

    /// Whether it may be carried out.
    ///
    /// # Errors
    /// 503 while no lines can be written, unless it only stops or takes away.
    pub(crate) async fn ready(&mut self) -> Result<(), Failure> {
        if !self.waits {
            return Ok(());
        }
        let line = self.line.take();
        self.context.audit.ready(self.context.clock.now()).await.map_err(|error| {
            let why = format!("nothing is written while the audit log cannot be: {error}");
            Failure::unavailable(why)
        })?;
        self.line = line;
        Ok(())
    }

    /// Writes the line. The answer with its id; where the line is not written, with a warning: what was carried out is not
    /// answered as if it were not.
    pub(crate) async fn end(mut self, answer: Answer) -> Answer {
        if self.stranger && answer.is_err() {
            self.line = None;
        }
        let Some(mut line) = self.line.clone() else { return answer };
        line.time = self.context.clock.now();
        let answer = match answer {
            Ok(response) => Ok(self.read(&mut line, response).await),
            Err(failure) => {
                line.code = Some(failure.code());
                line.reason = Some(failure.reason().to_owned());
                line.objects.extend(failure.ended().iter().cloned());
                Err(failure)
            }
        };
        // From here on it is queued, whoever leaves.
        self.line = None;
        let id = HeaderValue::from_str(&line.request_id);
        let written = self.context.audit.write(line).await;
        let mut response = answer?;
        if let Ok(id) = id {
            response.headers_mut().insert(AUDIT_ID, id);
        }
        if written.is_err() {
            response.headers_mut().append(header::WARNING, NOT_WRITTEN);
        }
        Ok(response)
    }

    /// What the answer says of the object.
    async fn read(&self, line: &mut Line, response: Response) -> Response {
        line.code = Some(response.status().as_u16());
        line.objects.extend(response.extensions().get::<Named>().cloned());
        let json = response.headers().get(header::CONTENT_TYPE);
        let json = json.is_some_and(|media| media.as_bytes().starts_with(b"application/json"));
        if !json || response.status() == StatusCode::SWITCHING_PROTOCOLS {
            return response;
        }
        let (parts, body) = response.into_parts();
        // Answers to writes are in memory, whole; what lasts was not asked for by a write.
        let bytes = match body.collect().await {
            Ok(body) => body.to_bytes(),
            Err(_) => return Response::from_parts(parts, Body::empty()),
        };
        if let Ok(told) = serde_json::from_slice::<Told>(&bytes) {
            told.into_line(line);
        }
        Response::from_parts(parts, Body::from(bytes))
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        let Some(mut line) = self.line.take().filter(|_| !self.stranger) else { return };
        line.time = self.context.clock.now();
        self.context.audit.post(line);
    }
}

/// Whether something may be different afterwards.
fn writes(verb: Verb, target: &Target) -> bool {
    let changes = matches!(
        target,
        Target::Objects(_)
            | Target::Tokens(_)
            | Target::UserTokens(_)
            | Target::Transaction
            | Target::Join
    );
    changes && !verb.reads()
}

/// Whether it only stops something, takes something away, or gives a robot to a person: a disk that is full is no reason to let
/// a robot go on.
fn stops(verb: Verb, target: &Target) -> bool {
    let object = match target {
        Target::Tokens(_) | Target::UserTokens(_) => return verb == Verb::Delete,
        Target::Objects(object) => object,
        _ => return false,
    };
    match (object.entry.info.kind, object.subresource) {
        (_, Some(Subresource::Fence | Subresource::Lease(_) | Subresource::Eviction)) => true,
        // Emergency stops and their release are in it, and `kubectl cordon`.
        ("Node", None) => matches!(verb, Verb::Patch | Verb::Update),
        // With the last four their tasks end, or what somebody may.
        ("Task" | "Pod" | "TaskSet" | "Application" | "Framework" | "Access", None) => {
            matches!(verb, Verb::Delete | Verb::DeleteCollection)
        }
        _ => false,
    }
}

/// Nothing is stored of it. What knows no dry run is a write, whatever its query says.
fn is_dry(target: &Target, request: &Request<Body>) -> bool {
    let knows = matches!(
        target,
        Target::Objects(Object {
            subresource: None
                | Some(Subresource::Status | Subresource::Scale | Subresource::Eviction),
            ..
        })
    );
    let query = Query::read(request.uri());
    knows && query.and_then(|query| query.dry_run()).unwrap_or(false)
}

/// What an answer to a write may be: an object, a Status about one, a list, or what a transaction made.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Told {
    kind: Option<String>,
    metadata: Identified,
    details: Identified,
    items: Vec<Told>,
    objects: Vec<Told>,
    refusals: Vec<serde::de::IgnoredAny>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Identified {
    namespace: Option<String>,
    name: Option<String>,
    uid: Option<String>,
}

impl Told {
    fn into_line(self, line: &mut Line) {
        let Identified { namespace, name, uid } = self.metadata;
        line.uid = uid.or(self.details.uid);
        line.name = line.name.take().or(name);
        line.namespace = line.namespace.take().or(namespace);
        let objects = self.items.into_iter().chain(self.objects);
        line.objects.extend(objects.map(|told| Named {
            kind: told.kind,
            namespace: told.metadata.namespace,
            name: told.metadata.name,
            uid: told.metadata.uid,
        }));
        if !self.refusals.is_empty() {
            line.reason = Some("Refused".to_owned());
        }
    }
}
