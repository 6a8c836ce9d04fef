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
//! | `form` | whole objects, their metadata, or tables |
//! | [`create`], `list`, `watch`, `update`, `patch`, [`delete`] | verbs on objects |
//! | `owners`, `strategic` | server-side apply and field owners; kubectl's merge of core kinds |
//! | `metadata`, `admission` | server-owned fields; violations, unknown fields |
//! | `selector` | label and field selectors |
//! | [`namespace`] | the default namespace; ending of namespaces |
//! | [`token`], `join`, `enrol` | join tokens; certificates for agents; which agent speaks for a node |
//! | `scale` | how many tasks a set has, as `autoscaling/v1` Scale |
//! | `core_node`, `eviction`, `metrics_api` | what is written through core kinds; `kubectl drain`, `kubectl top` |
//! | `review` | what a client may do, and who it is |
//! | `fence` | a person's word that a node is off |
//! | `offers` | what frameworks are offered, and why they are not |
//! | `poses` | where robots are now |
//! | `together` | what objects have wrong only all together |
//! | `question` | plan, why, usage: answers that are no objects |
//! | [`log`] | logs of tasks |
//! | [`failure`] | every refusal as a `metav1.Status` |

mod admission;
mod body;
mod core_node;
pub mod create;
pub mod delete;
mod discovery;
pub(crate) mod enrol;
mod eviction;
pub mod failure;
mod fence;
mod form;
mod join;
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
mod protobuf;
mod query;
mod question;
pub(crate) mod registry;
mod review;
mod scale;
mod selector;
mod strategic;
mod together;
pub mod token;
mod update;
mod watch;

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use axum::extract::State;
use axum::response::{IntoResponse as _, Response};
use http::{HeaderValue, Method, Request, StatusCode, header};
use serde_json::Value;
use tokio::sync::Semaphore;

use crate::auth::{Identity, Permission, permits};
use crate::context::Context;
use failure::Failure;
use path::{Object, Subresource, Target, Verb};
use query::Query;
use registry::View;

/// An answer that takes longer than this is a fault of ours, and the client should hear of it.
const TIMEOUT: Duration = Duration::from_secs(60);
/// Requests that are worked on at once, without those that last (watches, logs). A client that finds them all taken is
/// told to come back: a queue would only make everybody late. One core answers thousands in a second.
const AT_ONCE: usize = 512;
static PLACES: Semaphore = Semaphore::const_new(AT_ONCE);

/// Bytes, ready to be an answer.
pub(crate) type Answer = Result<Response, Failure>;

/// One request, read.
pub(crate) struct Call {
    pub(crate) context: Arc<Context>,
    pub(crate) identity: Identity,
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
        Ok((verb, target)) if long => dispatch(context, verb, target, request).await,
        Ok((verb, target)) => {
            // Whether it lives is asked when it is busy, above all.
            let place = PLACES.try_acquire();
            if place.is_err() && !matches!(target, Target::Health(_)) {
                Err(Failure::too_many())
            } else {
                within(TIMEOUT, dispatch(context, verb, target, request)).await
            }
        }
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

/// The answer, or that there was none in time.
async fn within(limit: Duration, answer: impl Future<Output = Answer>) -> Answer {
    match tokio::time::timeout(limit, answer).await {
        Ok(answer) => answer,
        Err(_) => Err(Failure::timeout("the request was not answered in time")),
    }
}

async fn dispatch(
    context: Arc<Context>,
    verb: Verb,
    target: Target,
    request: Request<Body>,
) -> Answer {
    let identity = request.extensions().get::<Identity>().cloned().unwrap_or(Identity::Anonymous);
    match permits(&identity, verb, &target) {
        Permission::Granted => {}
        Permission::WhoAreYou => {
            return Err(Failure::unauthorized("a client certificate is needed"));
        }
        Permission::Denied => return Err(Failure::forbidden(&identity.name(), verb, &target)),
    }
    let request = match *request.method() {
        Method::GET | Method::HEAD => request,
        _ => {
            // Whole, before anything of it is refused: who still writes when the answer comes does not read it, and
            // sees a broken connection instead.
            let (parts, body) = request.into_parts();
            let bytes = body::bytes(body).await?;
            Request::from_parts(parts, Body::from(bytes))
        }
    };
    let query = Query::read(request.uri())?;
    let call = Call { context, identity, query, request };
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
        Target::Usage => question::usage(&call),
        Target::Offers => offers::list(call.context).await,
        Target::Poses if verb == Verb::Watch => poses::watch(&call),
        Target::Poses => poses::list(&call),
        Target::Tokens(id) => token::answer(call, verb, id).await,
        Target::Objects(object) => objects(call, verb, object).await,
    }
}

async fn objects(call: Call, verb: Verb, object: Object) -> Answer {
    if object.subresource == Some(Subresource::Log) {
        return log::open(call, object).await;
    }
    if object.subresource == Some(Subresource::Why) {
        return question::why(call, object).await;
    }
    if !object.allows(verb) {
        return Err(Failure::method_not_allowed(verb, &object));
    }
    if object.subresource == Some(Subresource::Pose) {
        return poses::of_node(&call, &object);
    }
    if object.subresource == Some(Subresource::Fence) {
        return fence::fence(call, object).await;
    }
    if object.subresource == Some(Subresource::Scale) {
        return scale::answer(call, verb, object).await;
    }
    if object.subresource == Some(Subresource::Eviction) {
        return eviction::evict(call, object).await;
    }
    if object.entry.view == View::Node && matches!(verb, Verb::Update | Verb::Patch) {
        return core_node::write(call, verb, object).await;
    }
    match verb {
        Verb::Get => list::get(&call, &object),
        Verb::List => list::list(&call, &object),
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
