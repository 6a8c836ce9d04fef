//! GET with `watch=true`: changes as JSON lines.
//!
//! The stream is a cursor over the store's ring; nothing is held for a slow client beyond the chunk being sent, and
//! one that falls behind gets an ERROR event with 410, lists and comes back. One that does not read at all is cut off.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use bytes::Bytes;
use futures::stream;
use http::StatusCode;
use tokio::time::{Instant, Interval, MissedTickBehavior, Sleep};
use tokio_util::sync::WaitForCancellationFutureOwned;

use super::failure::Failure;
use super::form::Form;
use super::path::Object;
use super::registry::{Entry, View};
use super::rendered::Sight;
use super::selector::Selection;
use super::{Answer, Call};
use crate::context::Context;
use crate::store::{Change, Event, Snapshot, Stored, WatchEnd, WatchError, Watcher};

/// A client that resumes from its last bookmark must still be within the ring.
const BOOKMARK: Duration = Duration::from_secs(30);
/// Who was woken for what it did not ask for looks again so much later: a thousand watchers of a hundredth each would spend
/// more than a core on being woken by five hundred writes in a second. Nobody sees ten milliseconds.
const PAUSE: Duration = Duration::from_millis(10);
/// As in a list: as much as is joined before it is sent.
const CHUNK: usize = 64 << 10;

pub(super) fn watch(call: &Call, target: &Object) -> Answer {
    super::list::check_match(&call.query, true)?;
    let selection = Selection::read(target.entry, target.namespace.as_deref(), &call.query)?;
    let bookmarks = call.query.flag("allowWatchBookmarks");
    let form = Form::read(call.request.headers(), &call.query)?;
    let store = &call.context.store;
    let asked = call.query.revision()?;
    // The old way (no or zero revision) and the new (sendInitialEvents) of "first tell me what there is".
    let streaming = call.query.flag("sendInitialEvents");
    let said = call.query.text("sendInitialEvents").is_some();
    let initial = streaming || (!said && asked.unwrap_or_default() == 0);
    super::list::not_ahead(call, asked.unwrap_or_default())?;
    let lasts = call.query.lasts()?;
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
            let mut ticks = tokio::time::interval_at(Instant::now() + BOOKMARK, BOOKMARK);
            ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
            let following = Following {
                context: Arc::clone(&call.context),
                entry: target.entry,
                form,
                selection,
                watcher,
                initial: queue,
                announce: streaming && bookmarks,
                bookmarks,
                ticks,
                pause: Box::pin(tokio::time::sleep(PAUSE)),
                pauses: false,
                end: Box::pin(tokio::time::sleep(lasts)),
                stop: Box::pin(call.context.stop.clone().cancelled_owned()),
                ended: false,
            };
            let chunks = stream::unfold(following, |mut following| async move {
                Some((following.next().await?, following))
            });
            call.context.streams.follow(chunks)?
        }
    };
    Ok(super::raw(StatusCode::OK, body))
}

/// A watch in progress.
struct Following {
    context: Arc<Context>,
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
    // Made once: a thousand watchers are woken by each write, and most of them go on waiting.
    pause: Pin<Box<Sleep>>,
    /// Nothing of what came last was asked for.
    pauses: bool,
    end: Pin<Box<Sleep>>,
    stop: Pin<Box<WaitForCancellationFutureOwned>>,
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
                events = self.watcher.next(), if !self.pauses => self.take(events, &mut chunk),
                () = self.pause.as_mut(), if self.pauses => self.pauses = false,
                _ = self.ticks.tick(), if self.bookmarks => {
                    chunk.extend(self.bookmark(false));
                }
                () = self.end.as_mut() => {
                    self.ended = true;
                    if self.bookmarks {
                        chunk.extend(self.bookmark(false));
                    }
                }
                () = self.stop.as_mut() => self.ended = true,
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
                    if chunk.len() >= CHUNK {
                        // What there is no room for is looked at again when this was sent.
                        self.watcher.rewind(event.revision() - 1);
                        break;
                    }
                    if let Some((kind, before)) = seen(&self.selection, &event) {
                        chunk.extend(line(kind, &self.show(&event, before)));
                    }
                }
                if chunk.is_empty() {
                    self.pauses = true;
                    self.pause.as_mut().reset(Instant::now() + PAUSE);
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
        let object = self.form.bookmark(self.entry, self.watcher.revision(), initial);
        line("BOOKMARK", object.to_string().as_bytes())
    }

    /// What the watcher is shown of a change: the object, or what it was before.
    fn show(&self, event: &Event, before: bool) -> Bytes {
        let make = || match event.previous.as_ref().filter(|_| before) {
            Some(previous) => self.form.object(self.entry, &previous.at(event.revision())),
            None => self.form.object(self.entry, &event.object),
        };
        let view = self.entry.view;
        match self.form {
            // As it is stored.
            Form::Whole if view == View::Stored && !before => make(),
            // Its ages are those of the moment.
            Form::Table(..) => make(),
            form => {
                let sight = Sight { revision: event.revision(), before, view, form };
                self.context.rendered.of(sight, make)
            }
        }
    }
}

/// What an event is to somebody who sees only the selection, and whether they see the object as it was before: of one that
/// leaves the selection the last state that was in it, as Kubernetes does.
fn seen(selection: &Selection, event: &Event) -> Option<(&'static str, bool)> {
    let before = event.previous.as_ref().filter(|previous| selection.matches(previous));
    let after = event.change == Change::Put && selection.matches(&event.object);
    match (before.is_some(), after) {
        (false, true) => Some(("ADDED", false)),
        (true, true) => Some(("MODIFIED", false)),
        (true, false) => Some(("DELETED", event.change != Change::Delete)),
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
