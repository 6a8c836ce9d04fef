//! How long a placement takes, and how many there are in a second.

use std::time::{Duration, Instant};

use futures::StreamExt as _;
use kube::api::{Api, PostParams, WatchEvent, WatchParams};
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_controller::config::Config;
use muster_controller::store::{Key, Op, Resource};
use muster_controller::{app, objects};
use muster_tests::{AgentOptions, Cluster};
use serde_json::{Value, json};

use crate::floor::{Rows, between_syncs};
use crate::stats::{Samples, figure, millis};

const ROUNDS: usize = 100;

fn task(name: &str) -> Value {
    json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Task",
        "metadata": { "name": name, "namespace": "default" },
        "spec": { "resources": { "cpu": "10m" }, "run": { "process": { "command": ["sleep", "1000"] } }, "gracePeriodSeconds": 0 },
    })
}

/// One task at a time: POST until a watch shows it bound, with a one-row commit beside each.
pub(crate) async fn one() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud").flag("--docker-socket", "none")).await;
    let dir = cluster.dir().to_owned();
    between_syncs(&dir, async {
        let mut rows = Rows::open(&dir).await;
        let (mut floor, mut bound) = (Samples::default(), Samples::default());
        let api: Api<Task> = cluster.tasks().await;
        for round in 0..ROUNDS {
            floor.push(rows.commit(1).await);
            let name = format!("p{round}");
            let watch = WatchParams::default().fields(&format!("metadata.name={name}"));
            let version = api
                .list_metadata(&kube::api::ListParams::default().limit(1))
                .await
                .expect("a list")
                .metadata
                .resource_version;
            let mut events =
                api.watch(&watch, &version.unwrap_or_default()).await.expect("a watch").boxed();
            let body: Task = serde_json::from_value(task(&name)).expect("a task");
            let begin = Instant::now();
            let params = PostParams::default();
            let created = api.create(&params, &body);
            let seen = async {
                while let Some(event) = events.next().await {
                    let (Ok(WatchEvent::Added(task)) | Ok(WatchEvent::Modified(task))) = event
                    else {
                        continue;
                    };
                    if task.status.is_some_and(|s| s.phase != TaskPhase::Pending) {
                        return begin.elapsed();
                    }
                }
                panic!("the watch ended");
            };
            let (created, seen) = tokio::join!(created, seen);
            created.expect("taken");
            bound.push(seen);
            cluster.delete(&name).await;
        }
        floor.line("floor: one-row FULL commit");
        bound.line("POST to Bound seen by a watch");
        let allowed = millis(floor.median()) * 2.0 + 1.0;
        figure("p50 against 2 commits + 1 ms", millis(bound.median()) / allowed, "x", "<= 1x");
    })
    .await;
}

const NODES: usize = 5_000;
const TASKS: usize = 2_000;

/// A node as its agent would have reported it.
fn hollow_node(i: usize) -> Op {
    let name = format!("hollow-{i:04}");
    let value = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Node",
        "metadata": { "name": name, "uid": name, "creationTimestamp": "2026-01-01T00:00:00Z", "generation": 1 },
        "spec": { "kind": if i.is_multiple_of(2) { "Robot" } else { "Cloud" } },
        "status": {
            "allocatable": { "cpu": "4", "memory": "8Gi" },
            "capacity": { "cpu": "4", "memory": "8Gi" },
            "pose": { "map": "map", "x": (i % 100) as f64, "y": (i / 100) as f64 },
            "conditions": [{ "type": "Ready", "status": "True" }],
            "runtimes": [{ "name": "process", "available": true }],
        },
    });
    Op::create(objects::node_key(&name), value)
}

/// Tasks half of which want the nearest robot to a place, and half any computer.
fn queued_task(i: usize) -> Op {
    let name = format!("queued-{i:04}");
    let mut value = task(&name);
    value["metadata"]["uid"] = name.clone().into();
    value["spec"]["resources"]["cpu"] = "1".into();
    if i.is_multiple_of(2) {
        value["spec"]["placement"] = json!({ "at": { "x": (i % 97) as f64, "y": (i % 47) as f64 }, "within": 30.0, "on": "Robot" });
    }
    Op::create(Key::namespaced(Resource::new("tasks"), "default", name.as_str()), value)
}

/// A queue that is there at once; until every task is bound and that is durable.
pub(crate) async fn queue() {
    let dir = tempfile::tempdir().expect("a directory");
    between_syncs(dir.path(), async {
        let config = Config {
            data_dir: dir.path().join("controller"),
            listen: "127.0.0.1:0".parse().expect("an address"),
            kubeconfig: dir.path().join("kubeconfig"),
            kubeconfig_asked: true,
            advertise: Vec::new(),
            encryption_key: None,
            certificate_ttl: muster_controller::pki::TTL,
            requests_per_second: muster_controller::config::REQUESTS_PER_SECOND,
        };
        let running = app::start(config).await.expect("a controller");
        let store = running.context().store.clone();
        store.apply((0..NODES).map(hollow_node).collect()).await.expect("durable");
        let mut watcher = store.watch(Resource::new("tasks"), store.revision()).expect("a watch");
        store.apply((0..TASKS).map(queued_task).collect()).await.expect("durable");
        let begin = Instant::now();
        let mut bound = std::collections::BTreeSet::new();
        let wait = async {
            while bound.len() < TASKS {
                for event in watcher.next().await.expect("the ring holds it") {
                    let bound_phase = b"\"phase\":\"Bound\"";
                    if event.object.bytes.windows(bound_phase.len()).any(|w| w == bound_phase) {
                        bound.insert(event.object.uid.clone());
                    }
                }
            }
        };
        tokio::time::timeout(Duration::from_secs(120), wait).await.expect("all are bound");
        let elapsed = begin.elapsed();
        println!("  {TASKS} tasks on {NODES} nodes bound and durable in {:.1} ms", millis(elapsed));
        figure("placements", TASKS as f64 / elapsed.as_secs_f64(), "/s", ">= 14 000/s");
        running.shut_down().await.expect("it ends well");
    })
    .await;
}
