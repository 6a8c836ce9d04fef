//! GET: one object, or a collection in pages.
//!
//! A list is sent as it is joined from stored bytes, in chunks, so that ten thousand objects are never rendered or
//! held twice. A page names its revision and its last key in `continue`; the rest is taken from that revision, or, where
//! that is forgotten, from the newest one by those who say that they know.

use std::sync::Arc;

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use bytes::Bytes;
use futures::{StreamExt as _, stream};
use http::StatusCode;
use muster_api::validate::Violations;
use serde::{Deserialize, Serialize};

use super::failure::Failure;
use super::form::Form;
use super::path::Object;
use super::query::Query;
use super::registry::Entry;
use super::selector::Selection;
use super::{Answer, Call};
use crate::context::Context;
use crate::store::{Key, Snapshot, Stored};

/// Objects are joined up to this size: large enough for full TLS records, small enough to be nothing.
const CHUNK: usize = 64 << 10;
/// So many objects are looked at between two turns of others: to read one takes some microseconds.
const TURN: usize = 64;
/// As Kubernetes says it; clients show it to people.
const TOO_OLD: &str = "The provided continue parameter is too old to display a consistent list result. You can start a new \
     list without the continue parameter, or use the continue token in this response to retrieve the remainder of the results. \
     Continuing with the provided token results in an inconsistent list - objects that were created, modified, or deleted \
     between the time the first chunk was returned and now may show up in the list.";

pub(super) fn get(call: &Call, target: &Object) -> Answer {
    let key = target.key()?;
    let form = Form::read(call.request.headers(), &call.query)?;
    not_ahead(call, call.query.revision()?.unwrap_or_default())?;
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
    /// Instead of a revision: whatever is there when the list goes on.
    const NEWEST: u64 = 0;

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

/// Refuses what `resourceVersionMatch` and `sendInitialEvents` do not mean together, in a list or in a watch.
pub(super) fn check_match(query: &Query, follows: bool) -> Result<(), Failure> {
    let has = |name: &str| query.text(name).is_some();
    let (matching, streams) = (query.text("resourceVersionMatch"), has("sendInitialEvents"));
    let wrong = match (follows, streams, matching) {
        (false, false, None) | (true, false, None) | (true, true, Some("NotOlderThan")) => None,
        (_, _, Some(other)) if !matches!(other, "Exact" | "NotOlderThan") => {
            Some("may only be Exact or NotOlderThan")
        }
        (true, true, _) => Some("must be NotOlderThan where sendInitialEvents is set"),
        (true, false, Some(_)) => Some("is for a watch only where sendInitialEvents is set"),
        (false, true, _) => {
            let mut violations = Violations::new();
            violations.forbidden("sendInitialEvents", "is for a watch");
            return Err(refused(&violations));
        }
        (false, false, Some(_)) if has("continue") => Some("is not for a list that goes on"),
        (false, false, Some(_)) if !has("resourceVersion") => {
            Some("is of no use without resourceVersion")
        }
        (false, false, Some("Exact")) if query.text("resourceVersion") == Some("0") => {
            Some("may not be Exact of resourceVersion 0, which is any")
        }
        (false, false, Some(_)) => None,
    };
    let Some(wrong) = wrong else { return Ok(()) };
    let mut violations = Violations::new();
    violations.forbidden("resourceVersionMatch", wrong);
    Err(refused(&violations))
}

fn refused(violations: &Violations) -> Failure {
    Failure::invalid_body("ListOptions.meta.k8s.io \"\"", violations)
}

pub(super) async fn list(call: Call, target: Object) -> Answer {
    check_match(&call.query, false)?;
    let selection = Selection::read(target.entry, target.namespace.as_deref(), &call.query)?;
    let form = Form::read(call.request.headers(), &call.query)?;
    let limit = call.query.parse::<usize>("limit")?.filter(|limit| *limit > 0);
    let Snapshot { revision, items } = snapshot(&call, &target)?;
    let context = Arc::clone(&call.context);
    drop(call);
    let all = items.len();
    let (items, cut) = select(&selection, items, limit).await;
    let mut more = String::new();
    if let Some(last) = items.last().filter(|_| cut) {
        more = format!(",\"continue\":\"{}\"", Continue::write(revision, &last.key));
        if selection.is_everything() {
            more.push_str(&format!(",\"remainingItemCount\":{}", all - items.len()));
        }
    }
    answer(&context, (&revision.to_string(), &more), items, (form, target.entry)).await
}

/// The first `limit` objects that are asked for, and whether there are more. Others get their turn meanwhile.
pub(super) async fn select(
    selection: &Selection,
    mut items: Vec<Arc<Stored>>,
    limit: Option<usize>,
) -> (Vec<Arc<Stored>>, bool) {
    let limit = limit.unwrap_or(usize::MAX);
    if selection.is_everything() {
        let cut = items.len() > limit;
        items.truncate(limit);
        return (items, cut);
    }
    let mut selected = Vec::new();
    for (n, stored) in items.into_iter().enumerate() {
        if n % TURN == TURN - 1 {
            tokio::task::yield_now().await;
        }
        if !selection.matches(&stored) {
            continue;
        }
        if selected.len() == limit {
            return (selected, true);
        }
        selected.push(stored);
    }
    (selected, false)
}

/// The collection at the revision that the request asks for.
fn snapshot(call: &Call, target: &Object) -> Result<Snapshot, Failure> {
    let store = &call.context.store;
    let (resource, namespace) = (target.entry.resource, target.namespace.as_deref());
    if let Some(token) = call.query.text("continue") {
        let token = Continue::read(token)?;
        if call.query.text("resourceVersion").is_some_and(|version| version != "0") {
            let why = "specifying resource version is not allowed when using continue";
            return Err(Failure::bad_request(why));
        }
        not_ahead(call, token.revision)?;
        let after = target.entry.key(token.namespace.as_deref(), &token.name);
        let revision = match token.revision {
            Continue::NEWEST => store.revision(),
            revision => revision,
        };
        return store.list_at(resource, namespace, Some(&after), revision).map_err(|_| {
            Failure::expired(TOO_OLD).resumed_by(Continue::write(Continue::NEWEST, &after))
        });
    }
    let asked = call.query.revision()?.unwrap_or_default();
    not_ahead(call, asked)?;
    let paged = call.query.parse::<usize>("limit")?.is_some_and(|limit| limit > 0);
    match call.query.text("resourceVersionMatch") {
        // As Kubernetes means it: the first page of a revision is of that revision.
        None if paged && asked > 0 => {
            store.list_at(resource, namespace, None, asked).map_err(Failure::expired)
        }
        Some("Exact") => store.list_at(resource, namespace, None, asked).map_err(Failure::expired),
        // What is served is always the newest, which is not older than anything.
        _ => Ok(store.list(resource, namespace)),
    }
}

/// Refuses to answer from before a revision that the client has seen elsewhere.
pub(super) fn not_ahead(call: &Call, asked: u64) -> Result<(), Failure> {
    let current = call.context.store.revision();
    if asked > current { Err(Failure::ahead(asked, current)) } else { Ok(()) }
}

/// A list on its way.
struct Joining {
    form: Form,
    entry: &'static Entry,
    /// What comes before the first object; none: it was sent.
    head: Option<String>,
    items: std::vec::IntoIter<Arc<Stored>>,
    ended: bool,
}

impl Joining {
    fn chunk(&mut self) -> Bytes {
        let mut first = self.head.is_some();
        let mut chunk = self.head.take().map(String::into_bytes).unwrap_or_default();
        chunk.reserve(CHUNK + CHUNK / 4);
        while chunk.len() < CHUNK {
            let Some(stored) = self.items.next() else {
                self.ended = true;
                chunk.extend_from_slice(self.form.tail().as_bytes());
                break;
            };
            if !std::mem::take(&mut first) {
                chunk.push(b',');
            }
            chunk.extend_from_slice(&self.form.item(self.entry, &stored));
        }
        Bytes::from(chunk)
    }
}

/// The head, the objects with commas between them, the tail; `revision` and `more` stand in the list's metadata. What is longer
/// than a chunk is sent as it is joined, and between two chunks others get their turn: to encrypt and send ten thousand objects
/// takes a thread for longer than a get may take.
pub(super) async fn answer(
    context: &Context,
    (revision, more): (&str, &str),
    items: Vec<Arc<Stored>>,
    (form, entry): (Form, &'static Entry),
) -> Answer {
    let head = Some(form.head(entry, revision, more));
    let mut joining = Joining { form, entry, head, items: items.into_iter(), ended: false };
    let first = joining.chunk();
    if joining.ended {
        return Ok(super::raw(StatusCode::OK, first));
    }
    let rest = stream::unfold(joining, |mut joining| async move {
        if joining.ended {
            return None;
        }
        tokio::task::yield_now().await;
        Some((joining.chunk(), joining))
    });
    let chunks = stream::once(std::future::ready(first)).chain(rest);
    Ok(super::raw(StatusCode::OK, context.streams.follow(chunks)?))
}
