//! The session over HTTP: JSON lines, for languages without gRPC and for curl.
//!
//! ```text
//!   POST /framework/v1/session                first line of the body: {"subscribe": {…}}; more calls may follow in it
//!     ◀ application/x-ndjson                  events, one a line, until the session ends
//!   POST /framework/v1/session/ID/calls       calls, one a line; ID is subscribed.sessionId. 202: they are taken
//! ```
//!
//! Lines are protobuf's JSON mapping of the same messages. The end of the first body does not end the session: curl ends it
//! at once. Closing the answer does.

use std::convert::Infallible;
use std::sync::Arc;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{Path, Request, State};
use axum::response::{IntoResponse as _, Response};
use axum::routing::post;
use futures::StreamExt as _;
use http::{StatusCode, header};
use muster_api::wire::framework::v1 as wire;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

use super::session::{self, Wire};
use super::{Frameworks, MAX_WIRE};
use crate::auth::Asker;
use crate::rest::failure::Failure;

/// Events on their way to the transport.
const OUT: usize = 16;
/// Longest line: a message of the largest size in base64, with what is around it.
const MAX_LINE: usize = MAX_WIRE / 3 * 4 + 4;

/// The routes.
pub fn router(frameworks: Arc<Frameworks>) -> Router {
    Router::new()
        .route("/framework/v1/session", post(open))
        .route("/framework/v1/session/{id}/calls", post(call))
        .with_state(frameworks)
}

async fn open(State(frameworks): State<Arc<Frameworks>>, request: Request) -> Response {
    let asker = Asker::of(&frameworks.context, request.extensions());
    if let Err(failure) = frameworks.admit(&asker) {
        return failure.into_response();
    }
    let (to_session, calls) = Wire::calls();
    let (out, events) = mpsc::channel(OUT);
    let (feed, body, ended) = (to_session.clone(), request.into_body(), out.downgrade());
    frameworks.tasks.spawn(async move {
        let read = tokio::select! {
            read = read_calls(body, &feed) => read,
            // The session is over; nothing here keeps the lines open then.
            () = feed.closed() => return,
        };
        if let (Err(problem), Some(out)) = (read, ended.upgrade()) {
            let error = wire::Error { reason: "Invalid".to_owned(), message: problem };
            let event = wire::event::Event::Error(error);
            drop(out.send(wire::Event { event: Some(event) }).await);
        }
    });
    let wire = Wire { asker, calls, keep_calls: Some(to_session), out };
    frameworks.tasks.spawn(session::run(Arc::clone(&frameworks), wire));
    let lines = ReceiverStream::new(events).map(|event| {
        let mut line = serde_json::to_vec(&event).unwrap_or_default();
        line.push(b'\n');
        Ok::<Bytes, Infallible>(line.into())
    });
    ([(header::CONTENT_TYPE, "application/x-ndjson")], Body::from_stream(lines)).into_response()
}

async fn call(
    State(frameworks): State<Arc<Frameworks>>,
    Path(id): Path<String>,
    request: Request,
) -> Response {
    let asker = Asker::of(&frameworks.context, request.extensions());
    if let Err(failure) = frameworks.admit(&asker) {
        return failure.into_response();
    }
    // Of somebody else's session nothing is told.
    let Some(calls) = frameworks.calls_of(&id, &asker.identity) else {
        let text = format!("there is no session {id}; it ended, or it is carried by gRPC");
        return Failure::new(StatusCode::NOT_FOUND, "NotFound", text).into_response();
    };
    match read_calls(request.into_body(), &calls).await {
        Ok(()) => StatusCode::ACCEPTED.into_response(),
        Err(problem) => Failure::bad_request(problem).into_response(),
    }
}

/// Reads calls, one a line, and hands them over; stops quietly when the session is over.
async fn read_calls(body: Body, calls: &mpsc::Sender<wire::Call>) -> Result<(), String> {
    let (mut chunks, mut rest, mut number) = (body.into_data_stream(), Vec::new(), 0_usize);
    loop {
        let chunk = chunks.next().await;
        let done = chunk.is_none();
        if let Some(chunk) = chunk {
            rest.extend_from_slice(&chunk.map_err(|e| format!("the body broke off: {e}"))?);
        }
        loop {
            let line_end = rest.iter().position(|b| *b == b'\n');
            // The last line may have no end.
            let last = (done && !rest.is_empty()).then_some(rest.len());
            let Some(end) = line_end.or(last) else { break };
            let line: Vec<u8> = rest.drain(..(end + 1).min(rest.len())).collect();
            number += 1;
            if line.iter().all(u8::is_ascii_whitespace) {
                continue;
            }
            let call = serde_json::from_slice(&line).map_err(|e| format!("line {number}: {e}"))?;
            if calls.send(call).await.is_err() {
                return Ok(());
            }
        }
        if rest.len() > MAX_LINE {
            return Err(format!("line {}: longer than {MAX_LINE} bytes", number + 1));
        }
        if done {
            return Ok(());
        }
    }
}
