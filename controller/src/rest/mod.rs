//! Kubernetes API conventions over the store.
//!
//! Every request is first read as a verb on a `path::Target`, then authorised, then answered by one file a verb:
//!
//! | file | answers |
//! |---|---|
//! | [`path`] | URL + method → target and verb |
//! | `query`, `body`, `protobuf` | parameters; bodies with their limit |
//! | `registry` | what is served: one entry a kind |
//! | `discovery`, `openapi` | /api, /apis, resource lists, /version; schemas of everything |
//! | `rendered` | changes as many watchers see them, rendered once |
//! | `stream`, `lasting` | answers that last, and their places; they end with the right to them |
//! | `form` | whole objects, their metadata, or tables |
//! | [`create`], `list`, `watch`, `update`, `patch`, [`delete`] | verbs on objects |
//! | `owners`, `strategic` | server-side apply and field owners; kubectl's merge of core kinds |
//! | `metadata`, `admission` | server-owned fields; violations, unknown fields |
//! | `selector` | label and field selectors |
//! | [`namespace`] | the default namespace; ending of namespaces |
//! | [`token`], `join`, `enrol` | join tokens; certificates for agents; which agent speaks for a node |
//! | `user_token` | tokens of users |
//! | `scale` | how many tasks a set has, as `autoscaling/v1` Scale |
//! | `core_view`, `eviction`, `metrics_api` | what is written through core kinds; `kubectl drain`, `kubectl top` |
//! | `review` | what a client may do, and who it is |
//! | `fence` | a person's word that a node is off |
//! | `lease` | a person's hold on a robot's actuators |
//! | `offers` | what frameworks are offered, and why they are not |
//! | `poses` | where robots are now |
//! | `together` | what objects have wrong only all together |
//! | `transaction` | several objects in one commit, while what was planned still holds |
//! | `sets` | what TaskSets among planned objects would do |
//! | `question` | plan, why, usage: answers that are no objects |
//! | `exec` | programs that clients run in tasks |
//! | [`log`] | logs of tasks |
//! | [`failure`] | every refusal as a `metav1.Status` |

mod admission;
mod body;
mod core_view;
pub mod create;
pub mod delete;
mod discovery;
pub(crate) mod enrol;
mod eviction;
mod exec;
pub mod failure;
mod fence;
mod form;
pub(crate) mod host;
#[cfg(test)]
mod hostile;
mod join;
mod lasting;
mod launched;
mod lease;
mod list;
pub mod log;
mod metadata;
mod metrics_api;
pub mod namespace;
mod offers;
mod openapi;
mod owners;
mod patch;
pub mod path;
mod poses;
mod position;
mod protobuf;
pub(crate) mod query;
mod question;
pub(crate) mod registry;
mod rendered;
pub(crate) mod review;
mod scale;
mod selector;
mod sets;
mod strategic;
mod stream;
mod together;
pub mod token;
mod transaction;
mod update;
pub(crate) mod user_token;
mod watch;

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use axum::extract::State;
use axum::response::{IntoResponse as _, Response};
use http::{HeaderValue, Method, Request, StatusCode, header};
use serde_json::Value;

use crate::audit::entry::Entry;
use crate::auth::{self, Asker, Identity};
use crate::context::Context;
pub use body::Bodies;
use body::Room;
use failure::Failure;
use path::{Object, Subresource, Target, Verb};
use query::Query;
use registry::View;

/// An answer that takes longer than this is a fault of ours, and the client should hear of it.
const TIMEOUT: Duration = Duration::from_secs(60);
/// A body that takes longer is of a client that is gone. It takes up no place meanwhile: a few hundred clients that are slow,
/// or mean to be, would keep out everybody.
const BODY: Duration = Duration::from_secs(30);

pub use rendered::Rendered;
pub use stream::Streams;
pub(crate) use update::operation as replacement;

/// Bytes, ready to be an answer.
pub(crate) type Answer = Result<Response, Failure>;

/// One request, read.
pub(crate) struct Call {
    pub(crate) context: Arc<Context>,
    pub(crate) asker: Asker,
    pub(crate) query: Query,
    pub(crate) request: Request<Body>,
}

/// The REST half of the port. Unknown paths are answered too, with a Status.
pub fn router(context: Arc<Context>) -> Router {
    Router::new().fallback(handle).with_state(context)
}

async fn handle(State(context): State<Arc<Context>>, request: Request<Body>) -> Response {
    let start = Instant::now();
    let read = path::read(request.method(), request.uri());
    let labels = read.as_ref().map_or(("unknown", "none"), |(verb, target)| {
        (verb.as_str(), target.resource().unwrap_or("none"))
    });
    let long = matches!(
        &read,
        Ok((Verb::Watch, _))
            | Ok((_, Target::Objects(Object { subresource: Some(Subresource::Log), .. })))
    );
    let answer = match read {
        Err(failure) => Err(failure),
        Ok((verb, target)) => answer(context, (verb, target, long), request).await,
    };
    let response = answer.unwrap_or_else(Failure::into_response);
    let code = response.status().as_u16().to_string();
    metrics::counter!("muster_http_requests_total",
        "verb" => labels.0, "resource" => labels.1, "code" => code)
    .increment(1);
    if !long {
        metrics::histogram!("muster_http_request_seconds", "verb" => labels.0)
            .record(start.elapsed());
    }
    response
}

/// Answers who may ask; what changes something has its line in the audit log before it is answered.
async fn answer(
    context: Arc<Context>,
    (verb, target, long): (Verb, Target, bool),
    request: Request<Body>,
) -> Answer {
    let asker = Asker::of(&context, request.extensions());
    let mut entry = Entry::begin(&context, &asker, (verb, &target), &request);
    if let Some(entry) = &mut entry {
        entry.ready().await?;
    }
    if long && matches!(asker.identity, Identity::User { .. }) {
        // Reads: they have no entry.
        asker.needs(&auth::asked(verb, &target))?;
        let lasts = lasting::Right::new(&context, &asker.identity, (verb, &target));
        return Ok(lasts.over(admitted(context, asker, (verb, target, long), request).await?));
    }
    let answer = match asker.needs(&auth::asked(verb, &target)) {
        Ok(()) => admitted(context, asker, (verb, target, long), request).await,
        Err(failure) => Err(failure),
    };
    match entry {
        Some(entry) => entry.end(answer).await,
        None => answer,
    }
}

/// Takes the request whole, finds it a place, and answers it in time. One that lasts needs no place and has no deadline.
async fn admitted(
    context: Arc<Context>,
    asker: Asker,
    (verb, target, long): (Verb, Target, bool),
    request: Request<Body>,
) -> Answer {
    let late = "the request did not come in time";
    // The room of its body is taken until it is answered.
    let received = receive(&context.bodies, &asker.identity, &target, request);
    let (request, _room) = within(BODY, late, received).await?;
    let query = Query::read(request.uri())?;
    let call = Call { context: Arc::clone(&context), asker, query, request };
    if long {
        return dispatch(call, verb, target).await;
    }
    // Whether it lives is asked when it is busy, above all.
    let place = context.places.try_acquire();
    if place.is_err() && !matches!(target, Target::Health(_)) {
        return Err(Failure::too_many());
    }
    let late = "the request was not answered in time";
    within(TIMEOUT, late, dispatch(call, verb, target)).await
}

/// What comes of it, or that it was late.
async fn within<T>(
    limit: Duration,
    late: &str,
    work: impl Future<Output = Result<T, Failure>>,
) -> Result<T, Failure> {
    match tokio::time::timeout(limit, work).await {
        Ok(done) => done,
        Err(_) => Err(Failure::timeout(late)),
    }
}

/// The request with its body.
async fn receive(
    bodies: &Bodies,
    identity: &Identity,
    target: &Target,
    request: Request<Body>,
) -> Result<(Request<Body>, Option<Room>), Failure> {
    if matches!(*request.method(), Method::GET | Method::HEAD) {
        return Ok((request, None));
    }
    // Whole, before anything of it is refused: who still writes when the answer comes does not read it, and sees a broken
    // connection instead.
    let (parts, body) = request.into_parts();
    let (bytes, room) = bodies.of(identity).gather(body, body::limit(target)).await?;
    Ok((Request::from_parts(parts, Body::from(bytes)), room))
}

async fn dispatch(call: Call, verb: Verb, target: Target) -> Answer {
    match target {
        Target::Health(probe) => health(&call.context, probe),
        Target::Metrics => Ok(call.context.metrics.render().into_response()),
        Target::Version => Ok(json(StatusCode::OK, &discovery::version())),
        Target::Discovery(what) => discovery::answer(&call.request, what),
        Target::OpenApi(of) => openapi::answer(&call.request, of),
        Target::Review(review) => review::answer(call, review).await,
        Target::Measured(measured) => metrics_api::answer(&call, &measured),
        Target::Join => join::join(call).await,
        Target::Plan => question::plan(call).await,
        Target::Check => together::check(call).await,
        Target::Transaction => transaction::transaction(call).await,
        Target::Usage => question::usage(&call),
        Target::Offers => offers::list(call).await,
        Target::Poses if verb == Verb::Watch => poses::watch(&call),
        Target::Poses => poses::list(&call),
        Target::Tokens(id) => token::answer(call, verb, id).await,
        Target::UserTokens(id) => user_token::answer(call, verb, id).await,
        Target::Objects(object) => objects(call, verb, object).await,
    }
}

async fn objects(call: Call, verb: Verb, object: Object) -> Answer {
    if !object.allows(verb) {
        return Err(Failure::method_not_allowed(verb, &object));
    }
    if object.subresource == Some(Subresource::Log) {
        return log::open(call, object).await;
    }
    if object.subresource == Some(Subresource::Why) {
        return question::why(call, object).await;
    }
    if object.subresource == Some(Subresource::Pose) {
        return poses::of_node(&call, &object);
    }
    if object.subresource == Some(Subresource::Fence) {
        return fence::fence(call, object).await;
    }
    if let Some(Subresource::Lease(step)) = object.subresource {
        return lease::answer(call, object, step).await;
    }
    if object.subresource == Some(Subresource::Position) {
        return position::set(call, object).await;
    }
    if object.subresource == Some(Subresource::Scale) {
        return scale::answer(call, verb, object).await;
    }
    if matches!(object.subresource, Some(Subresource::Exec | Subresource::Attach)) {
        return exec::open(call, object).await;
    }
    if object.subresource == Some(Subresource::Eviction) {
        return eviction::evict(call, object).await;
    }
    if object.entry.view != View::Stored && matches!(verb, Verb::Update | Verb::Patch) {
        return core_view::write(call, verb, object).await;
    }
    match verb {
        Verb::Get => list::get(&call, &object),
        Verb::List => list::list(call, object).await,
        Verb::Watch => watch::watch(&call, &object),
        Verb::Create => create::create(call, object).await,
        Verb::Update => update::replace(call, object).await,
        Verb::Patch => patch::patch(call, object).await,
        Verb::Delete => delete::delete(call, object).await,
        Verb::DeleteCollection => delete::collection(call, object).await,
    }
}

fn health(context: &Context, probe: path::Probe) -> Answer {
    if probe == path::Probe::Ready && (context.stop.is_cancelled() || !context.store.is_open()) {
        return Ok((StatusCode::SERVICE_UNAVAILABLE, "not ready: shutting down\n").into_response());
    }
    Ok("ok".into_response())
}

/// A JSON tree as an answer.
pub(crate) fn json(code: StatusCode, value: &Value) -> Response {
    raw(code, Body::from(value.to_string()))
}

/// Rendered JSON as an answer.
pub(crate) fn raw(code: StatusCode, body: impl Into<Body>) -> Response {
    let mut response = Response::new(body.into());
    *response.status_mut() = code;
    let json = HeaderValue::from_static("application/json");
    response.headers_mut().insert(header::CONTENT_TYPE, json);
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn what_is_not_answered_in_time_is_a_timeout() {
        let never = std::future::pending::<Answer>();
        let failure = within(TIMEOUT, "too late", never).await.unwrap_err();
        assert_eq!((failure.code(), failure.message()), (504, "too late"));
        let soon = async {
            tokio::time::sleep(TIMEOUT / 2).await;
            Ok(7)
        };
        assert_eq!(within(TIMEOUT, "too late", soon).await.unwrap(), 7);
    }

    #[tokio::test(start_paused = true)]
    async fn a_body_that_does_not_come_is_not_waited_for() {
        let never =
            Body::from_stream(futures::stream::pending::<Result<bytes::Bytes, std::io::Error>>());
        let request = Request::post("/apis/muster.dev/v1alpha1/join").body(never).unwrap();
        let (_, target) = path::read(request.method(), request.uri()).unwrap();
        let bodies = Bodies::default();
        let received = receive(&bodies, &Identity::Anonymous, &target, request);
        let late = within(BODY, "too late", received).await;
        assert_eq!(late.unwrap_err().code(), 504);
    }

    #[tokio::test]
    async fn strangers_send_little_and_take_no_room_of_others() {
        let bodies = Bodies::default();
        let send = async |identity: Identity, path: &str, size: usize| {
            let request = Request::post(path).body(Body::from(vec![b' '; size])).unwrap();
            let (_, target) = path::read(request.method(), request.uri()).unwrap();
            let received = receive(&bodies, &identity, &target, request).await;
            received.map_err(|failure| failure.code())
        };
        let (join, plan) = ("/apis/muster.dev/v1alpha1/join", "/apis/muster.dev/v1alpha1/plan");
        let admin = || Identity::Admin { name: "a".into() };
        assert_eq!(send(Identity::Anonymous, join, 65 << 10).await.err(), Some(413));
        assert_eq!(send(admin(), join, 65 << 10).await.err(), Some(413));
        let mut held = Vec::new();
        let full = loop {
            match send(Identity::Anonymous, join, 60 << 10).await {
                Ok(one) => held.push(one),
                Err(code) => break code,
            }
        };
        assert_eq!(full, 429, "after {} of them", held.len());
        assert!(held.len() >= 16);
        let large = send(admin(), plan, 3 << 20).await;
        assert!(large.is_ok(), "those who are known have room of their own");
        held.clear();
        assert!(send(Identity::Anonymous, join, 60 << 10).await.is_ok());
    }
}
