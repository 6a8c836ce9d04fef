//! GET …/tasks/NAME/log: the output of a task, streamed from its node.

use std::fmt;

use axum::body::Body;
use axum::response::Response;
use bytes::Bytes;
use futures::StreamExt as _;
use futures::future::BoxFuture;
use futures::stream::BoxStream;
use http::{HeaderValue, header};

use super::failure::Failure;
use super::path::Object;
use super::query::Query;
use super::{Answer, Call};
use crate::store::Key;

/// What of a log is asked for.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LogOptions {
    /// Go on with what is written from now on.
    pub follow: bool,
    /// Begin with this many lines before the end.
    pub tail_lines: Option<u64>,
    /// Of the attempt before the present one.
    pub previous: bool,
    /// Put the time before each line, RFC 3339.
    pub timestamps: bool,
    /// Begin this long ago, s.
    pub since_seconds: Option<u64>,
    /// End after this many bytes.
    pub limit_bytes: Option<u64>,
}

impl LogOptions {
    fn read(query: &Query) -> Result<Self, Failure> {
        Ok(Self {
            follow: query.flag("follow")?,
            tail_lines: query.parse("tailLines")?,
            previous: query.flag("previous")?,
            timestamps: query.flag("timestamps")?,
            since_seconds: query.parse("sinceSeconds")?,
            limit_bytes: query.parse("limitBytes")?,
        })
    }
}

/// Why there is no log.
#[derive(Debug, Clone, thiserror::Error)]
pub enum LogError {
    /// The task has not been on a node, or has no previous attempt.
    #[error("there is no log: {0}")]
    Nothing(String),
    /// The node is not connected.
    #[error("node {node:?} cannot be reached")]
    Unreachable {
        /// Which.
        node: String,
    },
    /// The agent could not read it, or the connection broke.
    #[error("the log broke off: {0}")]
    Broken(String),
}

/// Who can open the log of a task; the agent sessions are.
pub trait LogSource: fmt::Debug + Send + Sync {
    /// Opens the log of the task `task`. The stream ends with the log; with `follow`, when the task has ended. Dropping it
    /// ends the reading at the agent.
    fn open(
        &self,
        task: Key,
        options: LogOptions,
    ) -> BoxFuture<'_, Result<BoxStream<'static, Result<Bytes, LogError>>, LogError>>;
}

pub(super) async fn open(call: Call, target: Object) -> Answer {
    let key = target.key()?;
    let options = LogOptions::read(&call.query)?;
    if call.context.store.get(&key).is_none() {
        return Err(Failure::not_found(target.entry, &key.name));
    }
    let Some(source) = call.context.log_source() else {
        return Err(Failure::unavailable("no agent session service is running"));
    };
    let limit = options.limit_bytes;
    let stream = source.open(key, options).await.map_err(|error| match error {
        LogError::Nothing(_) => Failure::bad_request(error.to_string()),
        LogError::Unreachable { .. } | LogError::Broken(_) => {
            Failure::unavailable(error.to_string())
        }
    })?;
    let stop = call.context.stop.clone().cancelled_owned();
    let stream = bounded(stream, limit).take_until(stop);
    let mut response = Response::new(Body::from_stream(stream));
    let text = HeaderValue::from_static("text/plain; charset=utf-8");
    response.headers_mut().insert(header::CONTENT_TYPE, text);
    Ok(response)
}

/// The stream, cut after `limit` bytes.
fn bounded(
    stream: BoxStream<'static, Result<Bytes, LogError>>,
    limit: Option<u64>,
) -> BoxStream<'static, Result<Bytes, LogError>> {
    let Some(limit) = limit else { return stream };
    let mut left = usize::try_from(limit).unwrap_or(usize::MAX);
    stream
        .map(move |item| {
            item.map(|mut bytes| {
                bytes.truncate(left);
                left -= bytes.len();
                (bytes, left)
            })
        })
        .scan(false, |ended, item| {
            let over = std::mem::replace(ended, matches!(item, Ok((_, 0)) | Err(_)));
            futures::future::ready((!over).then(|| item.map(|(bytes, _)| bytes)))
        })
        .boxed()
}
