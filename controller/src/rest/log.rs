//! GET …/tasks/NAME/log: the output of a task, streamed from its node.

use std::fmt;
use std::time::Duration;

use axum::response::Response;
use bytes::Bytes;
use futures::future::BoxFuture;
use futures::stream::{self, BoxStream, StreamExt as _};
use http::{HeaderValue, header};
use jiff::{SignedDuration, Timestamp};
use muster_api::kind::task::Task;
use muster_controller_core::project::pod::CONTAINER;

use super::failure::Failure;
use super::path::Object;
use super::query::Query;
use super::{Answer, Call, within};
use crate::store::{Key, Stored};

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
    /// Begin with what was written at this time.
    pub since: Option<Timestamp>,
    /// End after this many bytes.
    pub limit_bytes: Option<u64>,
}

impl LogOptions {
    fn read(query: &Query, now: Timestamp) -> Result<Self, Failure> {
        let ago = query.parse::<u32>("sinceSeconds")?;
        let since = match (ago, query.parse::<Timestamp>("sinceTime")?) {
            (Some(_), Some(_)) => {
                let what = "at most one of sinceTime or sinceSeconds may be specified";
                return Err(Failure::bad_request(what));
            }
            (Some(ago), None) => now.checked_sub(SignedDuration::from_secs(ago.into())).ok(),
            (None, since) => since,
        };
        Ok(Self {
            follow: query.flag("follow"),
            tail_lines: query.parse("tailLines")?,
            previous: query.flag("previous"),
            timestamps: query.flag("timestamps"),
            since,
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
    fn open(&self, task: Key, options: LogOptions) -> BoxFuture<'_, Result<Log, LogError>>;
}

/// A log, part by part.
pub type Log = BoxStream<'static, Result<Bytes, LogError>>;

/// A node that is there answers at once.
const ANSWERS: Duration = Duration::from_secs(10);
/// Between two parts of a log that is there.
const GAP: Duration = Duration::from_secs(30);

pub(super) async fn open(call: Call, target: Object) -> Answer {
    let key = target.key()?;
    let options = LogOptions::read(&call.query, call.context.clock.now())?;
    let stored = call.context.store.get(&key);
    let stored = stored.ok_or_else(|| Failure::not_found(target.entry, &key.name))?;
    check_container(call.query.text("container"), &key.name)?;
    if options.previous && !has_previous(&stored) {
        return Err(Failure::bad_request(format!(
            "previous terminated container {CONTAINER:?} in pod {:?} not found",
            key.name
        )));
    }
    let Some(source) = call.context.log_source() else {
        return Err(Failure::unavailable("no agent session service is running"));
    };
    let (limit, follow) = (options.limit_bytes, options.follow);
    let late = "the task's node did not answer in time";
    let stream = within(ANSWERS, late, begin(source.open(key, options), follow)).await?;
    let stream = if follow { stream } else { without_gaps(stream) };
    let stop = call.context.stop.clone().cancelled_owned();
    let stream = bounded(stream, limit).take_until(stop);
    let mut response = Response::new(call.context.streams.feed(stream)?);
    let text = HeaderValue::from_static("text/plain; charset=utf-8");
    response.headers_mut().insert(header::CONTENT_TYPE, text);
    Ok(response)
}

/// The log, once it is known that it can be read: with its first part, which is there at once where nothing is waited for.
async fn begin(
    opening: impl Future<Output = Result<Log, LogError>>,
    follow: bool,
) -> Result<Log, Failure> {
    let mut stream = opening.await.map_err(refusal)?.peekable();
    if !follow && std::pin::Pin::new(&mut stream).peek().await.is_some_and(Result::is_err) {
        let error = stream.next().await.and_then(Result::err);
        return Err(error.map_or_else(|| Failure::internal("the log cannot be read"), refusal));
    }
    Ok(stream.boxed())
}

/// Of a log that is not followed there is no part that comes late: it is broken off then.
fn without_gaps(log: Log) -> Log {
    let parts = stream::unfold(Some(log), |log| async {
        let mut log = log?;
        match tokio::time::timeout(GAP, log.next()).await {
            Ok(part) => Some((part?, Some(log))),
            Err(_) => Some((Err(LogError::Broken("its node says nothing more".to_owned())), None)),
        }
    });
    parts.boxed()
}

fn refusal(error: LogError) -> Failure {
    match error {
        LogError::Nothing(_) => Failure::bad_request(error.to_string()),
        LogError::Unreachable { .. } | LogError::Broken(_) => {
            Failure::unavailable(error.to_string())
        }
    }
}

/// Refuses a container that the view of a task does not have.
pub(super) fn check_container(container: Option<&str>, pod: &str) -> Result<(), Failure> {
    match container {
        Some(other) if other != CONTAINER => Err(Failure::bad_request(format!(
            "container {other:?} is not valid for pod {pod}; it is {CONTAINER:?}"
        ))),
        _ => Ok(()),
    }
}

/// Whether there was an attempt before the present one.
fn has_previous(stored: &Stored) -> bool {
    let task = crate::objects::read::<Task>(stored);
    task.and_then(|task| task.status).is_some_and(|status| status.attempt > 1)
}

/// The stream, cut after `limit` bytes.
fn bounded(stream: Log, limit: Option<u64>) -> Log {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn log(parts: impl futures::Stream<Item = Result<Bytes, LogError>> + Send + 'static) -> Log {
        parts.boxed()
    }

    #[tokio::test(start_paused = true)]
    async fn a_node_that_does_not_answer_is_not_waited_for() {
        let silent = || std::future::ready(Ok(log(stream::pending())));
        let late = within(ANSWERS, "too late", begin(silent(), false)).await;
        assert_eq!(late.err().map(|failure| failure.code()), Some(504));
        assert!(begin(silent(), true).await.is_ok(), "who follows waits for what is written");
        let never = std::future::pending();
        let late = within(ANSWERS, "too late", begin(never, true)).await;
        assert_eq!(late.err().map(|failure| failure.code()), Some(504));
    }

    #[tokio::test(start_paused = true)]
    async fn a_log_that_stops_half_way_is_broken_off() {
        let half = stream::iter([Ok(Bytes::from("a"))]).chain(stream::pending());
        let parts: Vec<_> = without_gaps(log(half)).collect().await;
        assert!(matches!(&parts[..], [Ok(a), Err(LogError::Broken(_))] if a == "a"), "{parts:?}");
    }

    #[tokio::test]
    async fn a_log_is_cut_after_its_limit() {
        let parts = || log(stream::iter(["abc", "def", "ghi"].map(|part| Ok(Bytes::from(part)))));
        let text = async |limit| {
            let parts: Vec<_> = bounded(parts(), limit).map(Result::unwrap).collect().await;
            String::from_utf8(parts.concat()).unwrap()
        };
        assert_eq!(text(None).await, "abcdefghi");
        assert_eq!(text(Some(5)).await, "abcde");
        assert_eq!(text(Some(0)).await, "");
    }
}
