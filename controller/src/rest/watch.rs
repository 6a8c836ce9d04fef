//! GET with `watch=true`: changes as JSON lines.
//!
//! The stream is a cursor over the store's ring; nothing is buffered for a slow client beyond the chunk being sent, and
//! one that falls behind gets an ERROR event with 410, lists and comes back.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use bytes::Bytes;
use futures::stream;
use http::StatusCode;
use serde_json::{Value, json};
use tokio::time::{Instant, Interval, MissedTickBehavior};
use tokio_util::sync::CancellationToken;

use super::failure::Failure;
use super::form::Form;
use super::path::Object;
use super::registry::Entry;
use super::selector::Selection;
use super::{Answer, Call};
use crate::store::{Change, Event, Snapshot, Stored, WatchEnd, WatchError, Watcher};

/// How long a watch lasts that names no time. Clients come back by themselves; connections of clients that are
/// gone without a word do not stay for ever.
const DEFAULT_TIMEOUT: Duration = Duration::from_secs(45 * 60);
/// A client that resumes from its last bookmark must still be within the ring.
const BOOKMARK: Duration = Duration::from_secs(30);
/// As in a list: as much as is joined before it is sent.
const CHUNK: usize = 64 << 10;

pub(super) fn watch(call: &Call, target: &Object) -> Answer {
    let selection = Selection::read(target.entry, target.namespace.as_deref(), &call.query)?;
    let bookmarks = call.query.flag("allowWatchBookmarks")?;
    let form = Form::read(call.request.headers(), &call.query)?;
    let store = &call.context.store;
    let asked = call.query.revision()?;
    // The old way (no or zero revision) and the new (sendInitialEvents) of "first tell me what there is".
    let streaming = call.query.flag("sendInitialEvents")?;
    let said = call.query.text("sendInitialEvents").is_some();
    let initial = streaming || (!said && asked.unwrap_or_default() == 0);
    let mut queue = VecDeque::new();
    let from = if initial {
        let Snapshot { revision, items } =
            store.list(target.entry.resource, target.namespace.as_deref());
        queue.extend(items);
        revision
    } else {
        asked.filter(|asked| *asked > 0).unwrap_or_else(|| store.revision())
    };
    let ended = match store.watch(target.entry.resource, from) {
        Ok(watcher) => Ok(watcher),
        Err(WatchError::Expired(expired)) => Err(Failure::expired(expired)),
        Err(WatchError::Ahead { asked, current }) => return Err(Failure::ahead(asked, current)),
    };
    let body = match ended {
        // As Kubernetes does: the watch begins, and its first event is its end.
        Err(failure) => Body::from(line("ERROR", failure.status().to_string().as_bytes())),
        Ok(watcher) => {
            let seconds = call.query.parse::<u64>("timeoutSeconds")?.filter(|s| *s > 0);
            let lasts = seconds.map_or(DEFAULT_TIMEOUT, Duration::from_secs);
            let mut ticks = tokio::time::interval_at(Instant::now() + BOOKMARK, BOOKMARK);
            ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
            let following = Following {
                entry: target.entry,
                form,
                selection,
                watcher,
                initial: queue,
                announce: streaming && bookmarks,
                bookmarks,
                ticks,
                end: Instant::now() + lasts,
                stop: call.context.stop.clone(),
                ended: false,
            };
            Body::from_stream(stream::unfold(following, |mut following| async move {
                let chunk = following.next().await?;
                Some((Ok::<_, std::convert::Infallible>(chunk), following))
            }))
        }
    };
    Ok(super::raw(StatusCode::OK, body))
}

/// A watch in progress.
struct Following {
    entry: &'static Entry,
    form: Form,
    selection: Selection,
    watcher: Watcher,
    /// What there was at the beginning and is not yet sent.
    initial: VecDeque<Arc<Stored>>,
    /// The end of the beginning is still to be announced.
    announce: bool,
    bookmarks: bool,
    ticks: Interval,
    end: Instant,
    stop: CancellationToken,
    ended: bool,
}

impl Following {
    async fn next(&mut self) -> Option<Bytes> {
        let mut chunk = Vec::new();
        while !self.ended && chunk.is_empty() {
            if !self.initial.is_empty() || self.announce {
                self.begin(&mut chunk);
                continue;
            }
            // Every arm is cancel safe: the watcher keeps what it has not returned, and the rest are clocks.
            tokio::select! {
                events = self.watcher.next() => self.take(events, &mut chunk),
                _ = self.ticks.tick(), if self.bookmarks => {
                    chunk.extend(self.bookmark(false));
                }
                () = tokio::time::sleep_until(self.end) => {
                    self.ended = true;
                    if self.bookmarks {
                        chunk.extend(self.bookmark(false));
                    }
                }
                () = self.stop.cancelled() => self.ended = true,
            }
        }
        (!chunk.is_empty()).then(|| Bytes::from(chunk))
    }

    fn begin(&mut self, chunk: &mut Vec<u8>) {
        while chunk.len() < CHUNK {
            let Some(stored) = self.initial.pop_front() else {
                if std::mem::take(&mut self.announce) {
                    chunk.extend(self.bookmark(true));
                }
                return;
            };
            if self.selection.matches(&stored) {
                chunk.extend(line("ADDED", &self.form.object(self.entry, &stored)));
            }
        }
    }

    fn take(&mut self, events: Result<Vec<Event>, WatchEnd>, chunk: &mut Vec<u8>) {
        match events {
            Ok(events) => {
                for event in events {
                    if let Some(kind) = kind(&self.selection, &event) {
                        chunk.extend(line(kind, &self.form.object(self.entry, &event.object)));
                    }
                }
            }
            Err(WatchEnd::Expired(expired)) => {
                self.ended = true;
                let status = Failure::expired(expired).status().to_string();
                chunk.extend(line("ERROR", status.as_bytes()));
            }
            Err(WatchEnd::Closed) => self.ended = true,
        }
    }

    fn bookmark(&self, initial: bool) -> Vec<u8> {
        let info = self.entry.info;
        let mut object: Value = json!({
            "kind": info.kind,
            "apiVersion": info.api_version(),
            "metadata": {
                "resourceVersion": self.watcher.revision().to_string(),
                "creationTimestamp": null,
            },
        });
        if initial {
            object["metadata"]["annotations"] = json!({"k8s.io/initial-events-end": "true"});
        }
        line("BOOKMARK", object.to_string().as_bytes())
    }
}

/// What an event is to somebody who sees only the selection.
fn kind(selection: &Selection, event: &Event) -> Option<&'static str> {
    let before = event.previous.as_ref().is_some_and(|previous| selection.matches(previous));
    let after = event.change == Change::Put && selection.matches(&event.object);
    match (before, after) {
        (false, true) => Some("ADDED"),
        (true, true) => Some("MODIFIED"),
        (true, false) => Some("DELETED"),
        (false, false) => None,
    }
}

fn line(kind: &str, object: &[u8]) -> Vec<u8> {
    let mut line = Vec::with_capacity(object.len() + 32);
    line.extend_from_slice(b"{\"type\":\"");
    line.extend_from_slice(kind.as_bytes());
    line.extend_from_slice(b"\",\"object\":");
    line.extend_from_slice(object);
    line.extend_from_slice(b"}\n");
    line
}
