//! Many watchers: each event once and in order, and what it costs the controller.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use futures::{StreamExt as _, TryStreamExt as _};
use k8s_openapi::api::core::v1::ConfigMap;
use kube::api::{Patch, PatchParams, PostParams, WatchEvent, WatchParams};
use kube::{Api, ResourceExt as _};
use muster_tests::Cluster;
use serde_json::json;
use tokio::task::JoinSet;

use crate::footprint::{cpu, rss};
use crate::stats::{Samples, figure};

const OBJECTS: usize = 1_000;
const SHELVES: usize = 100;
const WATCHERS: usize = 1_000;
const ALL: usize = 20;
/// Each object is written so many times, one after the other.
const ROUNDS: usize = 5;
/// A little more than the bar of 500, which is to be reached with the last write's answer counted in.
const PER_SECOND: f64 = 520.0;

fn object(i: usize) -> ConfigMap {
    serde_json::from_value(json!({
        "apiVersion": "v1", "kind": "ConfigMap",
        "metadata": {"name": format!("m{i}"), "labels": {"shelf": format!("s{}", i % SHELVES)}},
        "data": {"n": "0", "text": "x".repeat(500)},
    }))
    .expect("a ConfigMap")
}

/// Reads until everything has come that should; the object's counter must go up by one each time.
async fn follow(api: Api<ConfigMap>, labels: Option<String>, since: String) -> usize {
    let params = WatchParams::default();
    let params = labels.iter().fold(params.clone(), |params, labels| params.labels(labels));
    let mut events = api.watch(&params, &since).await.expect("a watch").boxed();
    let wanted = ROUNDS * if labels.is_some() { OBJECTS / SHELVES } else { OBJECTS };
    let mut last: BTreeMap<String, usize> = BTreeMap::new();
    let mut seen = 0;
    while seen < wanted {
        match events.try_next().await.expect("no error") {
            Some(WatchEvent::Modified(map)) => {
                let n: usize = map.data.as_ref().expect("data")["n"].parse().expect("a number");
                let before = last.insert(map.name_any(), n).unwrap_or(0);
                assert_eq!(n, before + 1, "{} came twice, late or not at all", map.name_any());
                seen += 1;
            }
            Some(WatchEvent::Bookmark(_)) => {}
            other => panic!("{other:?}"),
        }
    }
    wanted
}

pub(crate) async fn all() {
    let cluster = Cluster::start().await;
    let controller = cluster.controller_pid();
    let api: Api<ConfigMap> = Api::namespaced(cluster.client().await, "default");
    for i in 0..OBJECTS {
        api.create(&PostParams::default(), &object(i)).await.expect("created");
    }
    let since = api.list_metadata(&Default::default()).await.expect("a list").metadata;
    let since = since.resource_version.expect("a list has a revision");
    let before = rss(controller);
    let mut watchers = JoinSet::new();
    for w in 0..WATCHERS + ALL {
        // A client each: what shares a connection shares its flow control.
        let api = Api::namespaced(cluster.client().await, "default");
        let labels = (w < WATCHERS).then(|| format!("shelf=s{}", w % SHELVES));
        watchers.spawn(follow(api, labels, since.clone()));
    }
    let (mut writes, begin, used) = (Samples::default(), Instant::now(), cpu(controller));
    let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / PER_SECOND));
    // A write begins at its time, whether those before it are answered or not; those of an object are a round apart.
    let mut under_way = JoinSet::new();
    for round in 1..=ROUNDS {
        for i in 0..OBJECTS {
            ticks.tick().await;
            let api = api.clone();
            under_way.spawn(async move {
                let change = Patch::Merge(json!({"data": {"n": round.to_string()}}));
                let sent = Instant::now();
                let name = format!("m{i}");
                api.patch(&name, &PatchParams::default(), &change).await.expect("written");
                sent.elapsed()
            });
            while let Some(took) = under_way.try_join_next() {
                writes.push(took.expect("a write was answered"));
            }
        }
        while let Some(took) = under_way.join_next().await {
            writes.push(took.expect("a write was answered"));
        }
    }
    let rate = (ROUNDS * OBJECTS) as f64 / begin.elapsed().as_secs_f64();
    let mut delivered = 0;
    while let Some(count) = watchers.join_next().await {
        delivered += count.expect("a watcher saw what it should");
    }
    let took = begin.elapsed().as_secs_f64();
    writes.line("PATCH while all watch");
    figure("writes", rate, "/s", ">= 500/s");
    figure("events, each once and in order", delivered as f64 / took, "/s", "all");
    let used = (cpu(controller) - used).as_secs_f64() / took;
    println!("  load of the machine, 1 min: {}", crate::list::load());
    figure("controller: CPU", used * 100.0, " % of a core", "report");
    let now = rss(controller);
    figure(
        "controller: RSS, all watching",
        now,
        " MB",
        "bounded: what it holds, and 100 kB a watcher",
    );
    figure(
        "controller: RSS a watcher",
        (now - before) * 1e3 / (WATCHERS + ALL) as f64,
        " kB",
        "<= 100 kB",
    );
}
