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
    assert_eq!(all.event().await, "DELETED b");
    cluster.running.shut_down().await.unwrap();
    assert!(all.next().await.is_none(), "a shutdown ends watches");
}

/// Python's client writes `True`; and a time that no clock can count is no fault.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watch_is_asked_for_in_many_ways() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", EVENTS, event("a")).await;
    for query in ["watch=True", "watch=yes", "watch=true&timeoutSeconds=18446744073709551615"] {
        let mut watch = Lines::open(&admin, &format!("{EVENTS}?{query}")).await;
        assert_eq!(watch.event().await, "ADDED a", "{query}");
        let poses = format!("/apis/muster.dev/v1alpha1/poses?{query}");
        let end = Lines::open(&admin, &poses).await.next().await.unwrap();
        assert_eq!(end["type"], "BOOKMARK", "{query}");
    }
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watch_of_tables_is_of_tables() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", EVENTS, event("a")).await;
    let query = "watch=true&allowWatchBookmarks=true&sendInitialEvents=true&resourceVersionMatch=NotOlderThan";
    let accept = "application/json;as=Table;v=v1;g=meta.k8s.io";
    let request = Request::get(format!("{EVENTS}?{query}")).header("accept", accept);
    let reader = admin.request_stream(request.body(Vec::new()).unwrap()).await.unwrap();
    let reader = Box::pin(reader) as std::pin::Pin<Box<dyn futures::AsyncBufRead + Send>>;
    let mut watch = Lines(reader.lines());
    let first = watch.next().await.unwrap();
    assert_eq!((&first["type"], &first["object"]["kind"]), (&json!("ADDED"), &json!("Table")));
    assert_eq!(first["object"]["rows"][0]["object"]["metadata"]["name"], "a");
    let end = watch.next().await.unwrap();
    assert_eq!((&end["type"], &end["object"]["kind"]), (&json!("BOOKMARK"), &json!("Table")));
    assert!(end["object"]["metadata"]["resourceVersion"].is_string());
    let marked = &end["object"]["rows"][0]["object"]["metadata"]["annotations"];
    assert_eq!(marked["k8s.io/initial-events-end"], "true");
    send(&admin, "POST", EVENTS, event("b")).await;
    let later = watch.next().await.unwrap();
    assert_eq!(later["object"]["rows"][0]["object"]["metadata"]["name"], "b");
    cluster.running.shut_down().await.unwrap();
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
    let (_, red) =
        send(&admin, "PATCH", &path, json!({"metadata": {"labels": {"app": "red"}}})).await;
    let left = watch.next().await.unwrap();
    assert_eq!(left["object"]["metadata"]["labels"]["app"], "blue", "as it was last selected");
    assert_eq!(left["object"]["metadata"]["resourceVersion"], red["metadata"]["resourceVersion"]);
    cluster.running.shut_down().await.unwrap();
}

/// As client-go's reflector asks for it: what there is as events, then the word that this was all, then what changes.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_list_that_is_streamed_says_where_it_ends() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let (_, a) = send(&admin, "POST", EVENTS, event("a")).await;
    send(&admin, "POST", EVENTS, event("b")).await;
    let at = a["metadata"]["resourceVersion"].as_str().unwrap();
    let asked = "allowWatchBookmarks=true&resourceVersionMatch=NotOlderThan&sendInitialEvents=true";
    for revision in ["", "0", at] {
        let query = format!("watch=true&resourceVersion={revision}&timeoutSeconds=60&{asked}");
        let mut list = Lines::open(&admin, &format!("{EVENTS}?{query}")).await;
        assert_eq!((&*list.event().await, &*list.event().await), ("ADDED a", "ADDED b"));
        let end = list.next().await.unwrap();
        assert_eq!(end["type"], "BOOKMARK");
        assert_eq!(end["object"]["metadata"]["annotations"]["k8s.io/initial-events-end"], "true");
        send(&admin, "POST", EVENTS, event("c")).await;
        assert_eq!(list.event().await, "ADDED c");
        send(&admin, "DELETE", &format!("{EVENTS}/c"), Value::Null).await;
    }
    let refused = |query: &'static str| {
        let (admin, path) = (admin.clone(), format!("{EVENTS}?{query}"));
        async move { get(&admin, &path).await }
    };
    for query in [
        "watch=true&sendInitialEvents=true",
        "watch=true&resourceVersionMatch=NotOlderThan&resourceVersion=1",
        "sendInitialEvents=true&resourceVersionMatch=NotOlderThan",
        "resourceVersionMatch=Exact",
        "resourceVersionMatch=Exact&resourceVersion=0",
        "resourceVersionMatch=Nearly&resourceVersion=1",
    ] {
        assert_eq!(refusal(&refused(query).await), (422, "Invalid"), "{query}");
    }
    let ahead = format!("watch=true&resourceVersion=99999&{asked}");
    let ahead = get(&admin, &format!("{EVENTS}?{ahead}")).await;
    assert_eq!(refusal(&ahead), (504, "Timeout"));
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

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watch_ends_with_the_token_or_the_right_that_opened_it() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    cluster.give("ada", "viewer", Value::Null).await;
    send(&admin, "POST", EVENTS, event("a")).await;
    let made = cluster.token("ada", 3600).await;
    let client =
        async |made: &Value| cluster.bearer(made["status"]["token"].as_str().unwrap()).await;
    let watch = async |client: &Client| {
        let mut watch = Lines::open(client, &format!("{EVENTS}?watch=true")).await;
        assert_eq!(watch.event().await, "ADDED a");
        watch
    };
    let deleted = watch(&client(&made).await).await;
    let denied = watch(&cluster.user("ada").await).await;
    let mut goes_on = watch(&admin).await;
    // Made last: its watch has to begin while it holds.
    let short = cluster.token("ada", 15).await;
    let expires = watch(&client(&short).await).await;
    let ends = async |mut watch: Lines| {
        let next = tokio::time::timeout(DEADLINE, watch.next()).await.expect("the watch ends");
        assert_eq!(next, None);
    };
    ends(expires).await;
    let token = format!("{G}/usertokens/{}", made["metadata"]["name"].as_str().unwrap());
    assert_eq!(send(&admin, "DELETE", &token, Value::Null).await.0, 200);
    ends(deleted).await;
    let gone = send(&admin, "DELETE", &format!("{G}/accesses/ada"), Value::Null).await;
    assert_eq!(gone.0, 200);
    ends(denied).await;
    send(&admin, "POST", EVENTS, event("b")).await;
    assert_eq!(goes_on.event().await, "ADDED b");
    cluster.running.shut_down().await.unwrap();
}
