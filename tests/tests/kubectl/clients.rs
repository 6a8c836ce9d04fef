//! The stock Rust client: typed objects, a watcher and its reflector, a controller of kube-runtime; and many watchers.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use futures::{StreamExt as _, TryStreamExt as _};
use k8s_openapi::api::core::v1::{ConfigMap, Pod};
use kube::api::{
    AttachParams, DeleteParams, ListParams, LogParams, Patch, PatchParams, PostParams, WatchEvent,
    WatchParams,
};
use kube::runtime::controller::Action;
use kube::runtime::{Controller, WatchStreamExt as _, reflector, watcher};
use kube::{Api, ResourceExt as _};
use muster_api::kind::task::Task;
use muster_tests::{AgentOptions, Cluster};
use serde_json::{Value, json};
use tokio::io::AsyncReadExt as _;

/// No wait in these tests should take this long; a machine under load may need a good part of it.
const DEADLINE: Duration = Duration::from_secs(120);

async fn in_time<T>(what: &str, work: impl Future<Output = T>) -> T {
    tokio::time::timeout(DEADLINE, work).await.unwrap_or_else(|_| panic!("{what}: too late"))
}

fn map(name: &str, label: &str, value: usize) -> ConfigMap {
    let object = json!({
        "apiVersion": "v1", "kind": "ConfigMap",
        "metadata": {"name": name, "labels": {"group": label}}, "data": {"value": value.to_string()},
    });
    serde_json::from_value(object).expect("a ConfigMap")
}

fn value(map: &ConfigMap) -> usize {
    map.data.as_ref().and_then(|data| data["value"].parse().ok()).expect("a number")
}

#[tokio::test(flavor = "multi_thread")]
async fn the_rust_client_applies_watches_and_reconciles() {
    let cluster = Cluster::start().await;
    let api: Api<ConfigMap> = Api::namespaced(cluster.client().await, "default");
    let apply = PatchParams::apply("test");
    let applied = api.patch("a", &apply, &Patch::Apply(map("a", "x", 1))).await.expect("created");
    assert_eq!(applied.managed_fields()[0].manager.as_deref(), Some("test"));
    let other = PatchParams::apply("other");
    let refused = api.patch("a", &other, &Patch::Apply(map("a", "x", 2))).await;
    assert!(matches!(refused, Err(kube::Error::Api(status)) if status.code == 409));

    // A controller that writes down what it saw, until the object is as it wants it.
    let seen = Arc::new(AtomicUsize::new(0));
    let reconciled = Arc::new(tokio::sync::Notify::new());
    let context = Arc::new((api.clone(), Arc::clone(&seen), Arc::clone(&reconciled)));
    let controller = Controller::new(api.clone(), watcher::Config::default().labels("group=x"))
        .run(
            |map: Arc<ConfigMap>, context: Arc<(Api<ConfigMap>, Arc<AtomicUsize>, Arc<tokio::sync::Notify>)>| async move {
                let (api, seen, reconciled) = &*context;
                seen.fetch_add(1, Ordering::SeqCst);
                if value(&map) < 5 {
                    let more = json!({"data": {"value": (value(&map) + 1).to_string()}});
                    api.patch(&map.name_any(), &PatchParams::default(), &Patch::Merge(more)).await?;
                } else {
                    reconciled.notify_one();
                }
                Ok::<_, kube::Error>(Action::await_change())
            },
            |_, _, _| Action::requeue(Duration::from_secs(1)),
            context,
        )
        .for_each(|_| futures::future::ready(()));
    let controller = tokio::spawn(controller);
    in_time("the controller reaches its aim", reconciled.notified()).await;
    assert!(seen.load(Ordering::SeqCst) >= 2);
    controller.abort();
    assert_eq!(value(&api.get("a").await.expect("it is there")), 5);

    // A reflector's store holds what there is, across a page of its list.
    for i in 0..7 {
        api.create(&PostParams::default(), &map(&format!("p{i}"), "y", i)).await.expect("created");
    }
    let (reader, writer) = reflector::store();
    let config = watcher::Config::default().labels("group=y").page_size(3);
    let stream = watcher(api.clone(), config).reflect(writer).applied_objects();
    let stream = tokio::spawn(stream.try_for_each(|_| futures::future::ready(Ok(()))));
    in_time("the reflector is ready", reader.wait_until_ready()).await.expect("it lives");
    assert_eq!(reader.state().len(), 7);
    stream.abort();

    // The streaming form of a list.
    let config = watcher::Config::default().labels("group=y").streaming_lists();
    let names: Vec<String> = in_time("a streamed list", async {
        let mut names = Vec::new();
        let mut events = watcher(api.clone(), config).boxed();
        while let Some(event) = events.try_next().await.expect("no error") {
            match event {
                watcher::Event::InitApply(map) => names.push(map.name_any()),
                watcher::Event::InitDone => break,
                _ => {}
            }
        }
        names
    })
    .await;
    assert_eq!(names.len(), 7);
    let group = ListParams::default().labels("group=y");
    let deleted = api.delete_collection(&DeleteParams::default(), &group).await;
    deleted.expect("deleted");
    assert!(api.list(&group).await.expect("a list").items.is_empty());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_is_a_pod_for_the_rust_client() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud-1")).await;
    let command = json!(["sh", "-c", "echo from a task; exec sleep 1000"]);
    cluster.create("t", json!({"run": {"process": {"command": command}}})).await;
    cluster.phase("t", muster_api::phase::TaskPhase::Running).await;
    let pods: Api<Pod> = Api::namespaced(cluster.client().await, "default");
    let pod = pods.get("t").await.expect("the view of a task");
    assert_eq!(pod.spec.and_then(|spec| spec.node_name).as_deref(), Some("cloud-1"));
    let text = in_time("a log", async {
        loop {
            let text = pods.logs("t", &LogParams::default()).await.expect("a log");
            if !text.is_empty() {
                return text;
            }
            tokio::task::yield_now().await;
        }
    });
    assert_eq!(text.await, "from a task\n");
    let piped = AttachParams::interactive_tty().tty(false);
    let mut shell = pods.exec("t", ["sh", "-c", "cat; exit 3"], &piped).await.expect("it begins");
    let status = shell.take_status().expect("asked for");
    let mut stdin = shell.stdin().expect("asked for");
    tokio::io::AsyncWriteExt::write_all(&mut stdin, b"to and fro").await.expect("it is taken");
    tokio::io::AsyncWriteExt::shutdown(&mut stdin).await.expect("it is taken");
    let mut text = String::new();
    let mut stdout = shell.stdout().expect("asked for");
    in_time("its output", stdout.read_to_string(&mut text)).await.expect("text");
    let status = in_time("its end", status).await.expect("it is told");
    let code = status.details.and_then(|details| details.causes?.pop()?.message);
    assert_eq!((text.as_str(), code.as_deref()), ("to and fro", Some("3")));
    let task = cluster.tasks().await.get("t").await.expect("it is there");
    let ready = |task: &Task| task.status.as_ref().map(|s| s.conditions()).unwrap_or_default();
    assert!(ready(&task).iter().any(|c| c.r#type == "Ready" && c.status == true.into()));
    let metadata = pods.list_metadata(&ListParams::default()).await.expect("partial objects");
    assert_eq!(metadata.items[0].name_any(), "t");
}

/// Every watcher sees each event of its objects once and in order, while many others watch and somebody writes.
#[tokio::test(flavor = "multi_thread")]
async fn every_watcher_sees_each_of_its_events_once_and_in_order() {
    const GROUPS: usize = 20;
    const WATCHERS: usize = 100;
    const ALL: usize = 4;
    const ROUNDS: usize = 10;
    let cluster = Cluster::start().await;
    let client = cluster.client().await;
    let api: Api<ConfigMap> = Api::namespaced(client, "default");
    for i in 0..GROUPS {
        let name = format!("m{i}");
        api.create(&PostParams::default(), &map(&name, &name, 0)).await.expect("created");
    }
    let since = api.list(&ListParams::default()).await.expect("a list");
    let since = since.metadata.resource_version.expect("a list has a revision");
    let mut watchers = tokio::task::JoinSet::new();
    for w in 0..WATCHERS + ALL {
        let mine = (w < WATCHERS).then(|| format!("group=m{}", w % GROUPS));
        // Only changes are counted.
        let params = WatchParams::default().disable_bookmarks();
        let params = mine.iter().fold(params, |params, labels| params.labels(labels));
        // One after another: the handshakes of all at once take longer than a connection is waited for.
        let mut events = api.watch(&params, &since).await.expect("a watch").boxed();
        watchers.spawn(async move {
            let wanted = if mine.is_some() { ROUNDS } else { ROUNDS * GROUPS };
            let mut last: BTreeMap<String, usize> = BTreeMap::new();
            for _ in 0..wanted {
                match events.try_next().await.expect("no error") {
                    Some(WatchEvent::Modified(map)) => {
                        let before = last.insert(map.name_any(), value(&map)).unwrap_or(0);
                        assert_eq!(value(&map), before + 1, "{} of {mine:?}", map.name_any());
                    }
                    other => panic!("{other:?}"),
                }
            }
        });
    }
    for round in 1..=ROUNDS {
        for i in 0..GROUPS {
            let change: Value = json!({"data": {"value": round.to_string()}});
            let name = format!("m{i}");
            api.patch(&name, &PatchParams::default(), &Patch::Merge(change))
                .await
                .expect("changed");
        }
    }
    in_time("all watchers", async {
        while let Some(ended) = watchers.join_next().await {
            ended.expect("a watcher saw what it should");
        }
    })
    .await;
}
