//! From submit to Running, against doing the same without an orchestrator.

use std::process::Command;
use std::time::{Duration, Instant};

use bollard::Docker;
use bollard::models::{ContainerCreateBody, HostConfig};
use bollard::query_parameters::RemoveContainerOptionsBuilder;
use futures::StreamExt as _;
use kube::api::{Api, PostParams, WatchEvent, WatchParams};
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, docker};
use serde_json::{Value, json};

use crate::floor::between_syncs;
use crate::stats::{Samples, figure, millis};

const PAIRS: usize = 30;

async fn cluster() -> Cluster {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud")).await;
    cluster
}

/// POST until a watch shows the task Running; the task is deleted and gone afterwards.
async fn submit(cluster: &Cluster, name: &str, run: &Value) -> Duration {
    let api: Api<Task> = cluster.tasks().await;
    let object = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Task", "metadata": { "name": name },
        "spec": { "run": run, "gracePeriodSeconds": 0 },
    });
    let body: Task = serde_json::from_value(object).expect("a task");
    let watch = WatchParams::default().fields(&format!("metadata.name={name}"));
    let list = api.list_metadata(&kube::api::ListParams::default().limit(1)).await.expect("a list");
    let version = list.metadata.resource_version.unwrap_or_default();
    let mut events = api.watch(&watch, &version).await.expect("a watch").boxed();
    let begin = Instant::now();
    api.create(&PostParams::default(), &body).await.expect("taken");
    let running = loop {
        let event = events.next().await.expect("the watch stays");
        let Ok(WatchEvent::Added(task) | WatchEvent::Modified(task)) = event else { continue };
        let status = task.status.unwrap_or_default();
        assert!(!status.phase.is_terminal(), "{status:?}");
        if status.phase == TaskPhase::Running {
            break begin.elapsed();
        }
    };
    cluster.delete(name).await;
    running
}

pub(crate) async fn process() {
    let cluster = cluster().await;
    let dir = cluster.dir().to_owned();
    between_syncs(&dir, async {
        let (mut floor, mut ours) = (Samples::default(), Samples::default());
        let run = json!({ "process": { "command": ["sleep", "1000"] } });
        for pair in 0..PAIRS {
            let begin = Instant::now();
            let mut child = Command::new("sleep").arg("1000").spawn().expect("sleep");
            floor.push(begin.elapsed());
            child.kill().expect("ours");
            child.wait().expect("ours");
            ours.push(submit(&cluster, &format!("b{pair}"), &run).await);
        }
        floor.line("floor: fork + exec");
        ours.line("submit to Running seen by a watch");
        figure(
            "p50 over the floor",
            millis(ours.median()) - millis(floor.median()),
            " ms",
            "<= +15 ms",
        );
    })
    .await;
}

pub(crate) async fn container() {
    docker::image();
    let engine = Docker::connect_with_unix_defaults().expect("an engine");
    let cluster = cluster().await;
    let dir = cluster.dir().to_owned();
    for (network, mode) in [("Host", "host"), ("None", "none")] {
        between_syncs(&dir, async {
            let (mut floor, mut ours) = (Samples::default(), Samples::default());
            let run = json!({ "container": {
                "image": docker::IMAGE, "command": ["sleep", "1000"], "network": network, "pullPolicy": "Never",
            } });
            for pair in 0..PAIRS {
                floor.push(raw(&engine, mode).await);
                ours.push(submit(&cluster, &format!("c{}-{pair}", mode), &run).await);
            }
            floor.line(&format!("floor: raw create + start, {mode}"));
            ours.line("submit to Running seen by a watch");
            let ratio = ours.median().as_secs_f64() / floor.median().as_secs_f64();
            figure(&format!("p50 ratio, network {mode}"), ratio, "x", "<= 1.10x");
        })
        .await;
    }
}

/// Create and start through the engine's own API; the container is removed afterwards.
async fn raw(engine: &Docker, network: &str) -> Duration {
    let body = ContainerCreateBody {
        image: Some(docker::IMAGE.to_owned()),
        cmd: Some(vec!["sleep".to_owned(), "1000".to_owned()]),
        host_config: Some(HostConfig {
            network_mode: Some(network.to_owned()),
            ..HostConfig::default()
        }),
        ..ContainerCreateBody::default()
    };
    let begin = Instant::now();
    let created = engine.create_container(None, body).await.expect("created");
    engine.start_container(&created.id, None).await.expect("started");
    let elapsed = begin.elapsed();
    let force = RemoveContainerOptionsBuilder::default().force(true).build();
    engine.remove_container(&created.id, Some(force)).await.expect("removed");
    elapsed
}
