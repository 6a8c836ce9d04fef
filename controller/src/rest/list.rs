//! GET: one object, or a collection in pages.
//!
//! A list is sent as it is joined from stored bytes, in chunks, so that ten thousand objects are never rendered or
//! held twice. A page names its revision and its last key in `continue`; the rest is taken from that revision.

use std::sync::Arc;

use axum::body::Body;
use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use bytes::Bytes;
use futures::stream;
use http::StatusCode;
use serde::{Deserialize, Serialize};

use super::failure::Failure;
use super::form::Form;
use super::path::Object;
use super::registry::Entry;
use super::selector::Selection;
use super::{Answer, Call};
use crate::store::{Key, Snapshot, Stored};

/// Objects are joined up to this size: large enough for full TLS records, small enough to be nothing.
const CHUNK: usize = 64 << 10;

pub(super) fn get(call: &Call, target: &Object) -> Answer {
    let key = target.key()?;
    let form = Form::read(call.request.headers(), &call.query)?;
    match call.context.store.get(&key) {
        Some(stored) => Ok(form.answer(StatusCode::OK, target.entry, &stored)),
        None => Err(Failure::not_found(target.entry, &key.name)),
    }
}

/// Where a list goes on.
#[derive(Debug, Serialize, Deserialize)]
struct Continue {
    revision: u64,
    namespace: Option<String>,
    name: String,
}

impl Continue {
    fn write(revision: u64, key: &Key) -> String {
        let token = Self {
            revision,
            namespace: key.namespace().map(str::to_owned),
            name: (*key.name).into(),
        };
        let json = serde_json::to_vec(&token).expect("texts and a number serialize");
        URL_SAFE_NO_PAD.encode(json)
    }

    fn read(text: &str) -> Result<Self, Failure> {
        let json = URL_SAFE_NO_PAD.decode(text).ok();
        json.and_then(|json| serde_json::from_slice(&json).ok())
            .ok_or_else(|| Failure::bad_request("continue key is not valid"))
    }
}

pub(super) fn list(call: &Call, target: &Object) -> Answer {
    let selection = Selection::read(target.entry, target.namespace.as_deref(), &call.query)?;
    let form = Form::read(call.request.headers(), &call.query)?;
    let limit = call.query.parse::<usize>("limit")?.filter(|limit| *limit > 0);
    let Snapshot { revision, mut items } = snapshot(call, target)?;
    if !selection.is_everything() {
        items.retain(|stored| selection.matches(stored));
    }
    let mut more = String::new();
    if let Some(limit) = limit.filter(|limit| *limit < items.len()) {
        let left = items.len() - limit;
        items.truncate(limit);
        if let Some(last) = items.last() {
            more = format!(",\"continue\":\"{}\"", Continue::write(revision, &last.key));
        }
        if selection.is_everything() {
            more.push_str(&format!(",\"remainingItemCount\":{left}"));
        }
    }
    let head = form.head(target.entry, &revision.to_string(), &more);
    Ok(super::raw(StatusCode::OK, join(head, items, (form, target.entry))))
}

/// The collection at the revision that the request asks for.
fn snapshot(call: &Call, target: &Object) -> Result<Snapshot, Failure> {
    let store = &call.context.store;
    let (resource, namespace) = (target.entry.resource, target.namespace.as_deref());
    if let Some(token) = call.query.text("continue") {
        let token = Continue::read(token)?;
        let after = target.entry.key(token.namespace.as_deref(), &token.name);
        return store.list_at(resource, namespace, Some(&after), token.revision).map_err(|_| {
            Failure::expired(
                "The provided continue parameter is too old to display a consistent list result. \
                 You must start a new list without the continue parameter.",
            )
        });
    }
    let asked = call.query.revision()?.unwrap_or_default();
    let current = store.revision();
    if asked > current {
        return Err(Failure::ahead(asked, current));
    }
    match call.query.text("resourceVersionMatch") {
        Some("Exact") => store.list_at(resource, namespace, None, asked).map_err(Failure::expired),
        // What is served is always the newest, which is not older than anything.
        None | Some("NotOlderThan") => Ok(store.list(resource, namespace)),
        Some(other) => Err(Failure::bad_request(format!("resourceVersionMatch: {other:?}"))),
    }
}

/// The head, the objects with commas between them, the tail; in chunks.
fn join(head: String, items: Vec<Arc<Stored>>, (form, entry): (Form, &'static Entry)) -> Body {
    let mut items = items.into_iter().enumerate();
    let mut begin = Some(head.into_bytes());
    let mut ended = false;
    let chunks = std::iter::from_fn(move || {
        if ended {
            return None;
        }
        let mut chunk = begin.take().unwrap_or_default();
        chunk.reserve(CHUNK / 4);
        while chunk.len() < CHUNK {
            let Some((index, stored)) = items.next() else {
                ended = true;
                chunk.extend_from_slice(form.tail().as_bytes());
                break;
            };
            if index > 0 {
                chunk.push(b',');
            }
            chunk.extend_from_slice(&form.item(entry, &stored));
        }
        Some(Ok::<_, std::convert::Infallible>(Bytes::from(chunk)))
    });
    Body::from_stream(stream::iter(chunks))
}
