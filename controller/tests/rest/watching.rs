//! Watches: what is sent, from where, and how they end.

use std::pin::pin;

use futures::{AsyncBufReadExt as _, StreamExt as _, TryStreamExt as _};
use http::Request;
use kube::Client;
use kube::api::Api;
use kube::runtime::{WatchStreamExt as _, watcher};
use muster_api::kind::event::Event;
use serde_json::{Value, json};

use super::support::*;

struct Lines(futures::io::Lines<std::pin::Pin<Box<dyn futures::AsyncBufRead + Send>>>);

impl Lines {
    async fn open(client: &Client, path: &str) -> Self {
        let request = Request::get(path).body(Vec::new()).unwrap();
        let reader = client.request_stream(request).await.unwrap();
        Self((Box::pin(reader) as std::pin::Pin<Box<dyn futures::AsyncBufRead + Send>>).lines())
    }

    async fn next(&mut self) -> Option<Value> {
        let line = self.0.try_next().await.unwrap()?;
        Some(serde_json::from_str(&line).unwrap())
    }

    /// `TYPE name` of the next event.
    async fn event(&mut self) -> String {
        let event = self.next().await.expect("the watch goes on");
        let name = event["object"]["metadata"]["name"].as_str().unwrap_or_default();
        format!("{} {name}", event["type"].as_str().unwrap())
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watch_begins_where_it_is_told_to() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let (_, a) = send(&admin, "POST", EVENTS, event("a")).await;
    send(&admin, "POST", EVENTS, event("b")).await;
    let version = a["metadata"]["resourceVersion"].as_str().unwrap();
    let mut all = Lines::open(&admin, &format!("{EVENTS}?watch=true")).await;
    assert_eq!(all.event().await, "ADDED a");
    assert_eq!(all.event().await, "ADDED b");
    let mut since =
        Lines::open(&admin, &format!("{EVENTS}?watch=true&resourceVersion={version}")).await;
    assert_eq!(since.event().await, "ADDED b");
    let single = format!("{EVENTS}?watch=1&resourceVersion=0&fieldSelector=metadata.name=b");
    let mut single = Lines::open(&admin, &single).await;
    assert_eq!(single.event().await, "ADDED b");
    send(&admin, "DELETE", &format!("{EVENTS}/a"), Value::Null).await;
    send(&admin, "DELETE", &format!("{EVENTS}/b"), Value::Null).await;
    assert_eq!(all.event().await, "DELETED a");
    assert_eq!(since.event().await, "DELETED a");
    assert_eq!(single.event().await, "DELETED b");
    cluster.running.shut_down().await.unwrap();
    assert_eq!(all.event().await, "DELETED b");
    assert!(all.next().await.is_none(), "a shutdown ends watches");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn leaving_the_selection_is_a_deletion() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut watch =
        Lines::open(&admin, &format!("{EVENTS}?watch=true&labelSelector=app=blue")).await;
    send(&admin, "POST", EVENTS, event("x")).await;
    let path = format!("{EVENTS}/x");
    for (label, expected) in [("blue", "ADDED x"), ("red", "DELETED x"), ("blue", "ADDED x")] {
        send(&admin, "PATCH", &path, json!({"metadata": {"labels": {"app": label}}})).await;
        assert_eq!(watch.event().await, expected);
    }
    send(&admin, "PATCH", &path, json!({"metadata": {"labels": {"other": "y"}}})).await;
    assert_eq!(watch.event().await, "MODIFIED x");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_compacted_version_is_gone_and_a_time_limit_ends_with_a_bookmark() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", EVENTS, event("a")).await;
    let (_, b) = send(&admin, "POST", EVENTS, event("b")).await;
    let store = &cluster.running.context().store;
    store.compact(store.revision()).await.unwrap();
    let mut old = Lines::open(&admin, &format!("{EVENTS}?watch=true&resourceVersion=1")).await;
    let error = old.next().await.unwrap();
    assert_eq!(
        (error["type"].as_str(), error["object"]["code"].as_u64()),
        (Some("ERROR"), Some(410))
    );
    assert_eq!(error["object"]["reason"], "Expired");
    assert!(old.next().await.is_none());

    let version = b["metadata"]["resourceVersion"].as_str().unwrap();
    let query =
        format!("watch=true&resourceVersion={version}&timeoutSeconds=1&allowWatchBookmarks=true");
    let mut short = Lines::open(&admin, &format!("{EVENTS}?{query}")).await;
    let bookmark = short.next().await.unwrap();
    assert_eq!(bookmark["type"], "BOOKMARK");
    assert_eq!(bookmark["object"]["metadata"]["resourceVersion"], version);
    assert!(short.next().await.is_none());
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_kube_watcher_works_in_both_its_modes() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", EVENTS, event("before")).await;
    for config in [watcher::Config::default(), watcher::Config::default().streaming_lists()] {
        let events: Api<Event> = Api::default_namespaced(admin.clone());
        let mut seen = pin!(watcher(events, config).applied_objects());
        let first = seen.next().await.unwrap().unwrap();
        assert_eq!(first.metadata.name.as_deref(), Some("before"));
        send(&admin, "POST", EVENTS, event("later")).await;
        let second = seen.next().await.unwrap().unwrap();
        assert_eq!(second.metadata.name.as_deref(), Some("later"));
        send(&admin, "DELETE", &format!("{EVENTS}/later"), Value::Null).await;
    }
    cluster.running.shut_down().await.unwrap();
}
