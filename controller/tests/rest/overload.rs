//! More than can be answered: refused, ended or cut, and never kept without end.

use futures::{AsyncBufReadExt as _, TryStreamExt as _};
use http::Request;
use muster_controller::store::{Key, Op, Resource};
use serde_json::{Value, json};

use super::support::*;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_finds_no_place_is_told_to_come_back() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let places = &cluster.running.context().places;
    let taken = places.acquire_many(u32::try_from(places.available_permits()).unwrap());
    let taken = taken.await.unwrap();
    let get = || async {
        let request = Request::get(EVENTS).body(kube::client::Body::empty()).unwrap();
        admin.send(request).await.unwrap()
    };
    let busy = get().await;
    assert_eq!(busy.status(), 429);
    assert_eq!(busy.headers()["retry-after"], "1");
    let status = busy.into_body().collect_bytes().await.unwrap();
    let status: Value = serde_json::from_slice(&status).unwrap();
    assert_eq!(
        (status["kind"].as_str(), status["reason"].as_str()),
        (Some("Status"), Some("TooManyRequests"))
    );
    assert_eq!(status["details"]["retryAfterSeconds"], 1);
    let live = Request::get("/livez").body(Vec::new()).unwrap();
    assert_eq!(admin.request_text(live).await.unwrap(), "ok", "that it is busy is no illness");
    // What lasts takes no place.
    let request = Request::get(format!("{EVENTS}?watch=true")).body(Vec::new()).unwrap();
    drop(admin.request_stream(request).await.unwrap());
    drop(taken);
    assert_eq!(get().await.status(), 200);
    cluster.running.shut_down().await.unwrap();
}

/// A watcher that does not read is sent no more than fits on the way, and then that it is too late.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watcher_that_is_too_slow_is_cut_off() {
    /// More than the history that is kept, with what fits on the way.
    const EVENTS_SENT: usize = 2_400;
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let request = Request::get(format!("{EVENTS}?watch=true")).body(Vec::new()).unwrap();
    let slow = admin.request_stream(request).await.unwrap();
    let store = &cluster.running.context().store;
    let text = "x".repeat(20_000);
    let put = |i: usize| {
        let name = format!("e{i:05}");
        let mut object = event(&name);
        object["metadata"]["uid"] = name.as_str().into();
        object["message"] = text.as_str().into();
        Op::create(Key::namespaced(Resource::new("events"), "default", &*name), object)
    };
    let gone = |i: usize| {
        let key = Key::namespaced(Resource::new("events"), "default", &*format!("e{i:05}"));
        Op::Delete { key, precondition: Default::default() }
    };
    for first in (0..EVENTS_SENT).step_by(100) {
        // Those before are gone again, but for their place in the history; in the same transaction, which takes half
        // as long: who has not read for half a minute is cut off without a word.
        let before = first.saturating_sub(100)..first;
        let ops = before.map(gone).chain((first..first + 100).map(put));
        store.apply(ops.collect()).await.unwrap();
    }
    let mut lines = Box::pin(slow).lines();
    let (mut seen, mut last) = (0, Value::Null);
    while let Some(line) = lines.try_next().await.unwrap() {
        last = serde_json::from_str(&line).unwrap();
        seen += 1;
    }
    assert_eq!((&last["type"], &last["object"]["code"]), (&json!("ERROR"), &json!(410)));
    assert!(seen < EVENTS_SENT, "{seen} events were kept for it");
    cluster.running.shut_down().await.unwrap();
}
