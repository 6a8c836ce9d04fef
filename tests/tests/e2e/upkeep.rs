//! What takes a node out of service for a while: its battery, people's work on it, a full disk.

use std::path::{Path, PathBuf};
use std::process::Command;

use kube::api::{Patch, PatchParams};
use muster_api::condition::ConditionStatus;
use muster_api::kind::node::Node;
use muster_api::kind::task::TaskStatus;
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::{Value, json};

fn sleeper(placement: Value) -> Value {
    json!({
        "placement": placement, "gracePeriodSeconds": 1,
        "run": {"process": {"command": ["sleep", "1000"]}},
    })
}

fn waits_for(taint: &'static str) -> impl Fn(&TaskStatus) -> bool {
    move |status| {
        status.why.iter().any(|why| why.reason == "OutOfService" && why.message.contains(taint))
    }
}

async fn condition(cluster: &Cluster, node: &str, r#type: &str, wanted: ConditionStatus) {
    let is = |node: Option<&Node>| {
        let status = node.and_then(|node| node.status.as_ref());
        status.and_then(|s| s.condition(r#type)).is_some_and(|c| c.status == wanted)
    };
    wait::object(cluster.nodes().await, node, &format!("{type} {wanted:?}"), is).await;
}

async fn change(cluster: &Cluster, node: &str, spec: Value) {
    let patch = Patch::Merge(json!({ "spec": spec }));
    let changed = cluster.nodes().await.patch(node, &PatchParams::default(), &patch).await;
    changed.expect("the controller takes it");
}

fn robot_with_battery(
    cluster: &Cluster,
    name: &str,
    x: f64,
    charge: &str,
) -> (AgentOptions, PathBuf) {
    let file = cluster.dir().join(format!("{name}.battery"));
    std::fs::write(&file, charge).expect("a file");
    let source = format!("file:{}", file.display());
    (AgentOptions::robot(name, x, 0.0).flag("--battery", &source), file)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_low_battery_keeps_all_but_the_charging_away_and_the_fuller_one_is_preferred() {
    let mut cluster = Cluster::start().await;
    let (low, file) = robot_with_battery(&cluster, "low", 1.0, "8\n");
    cluster.join(low).await;
    condition(&cluster, "low", "Battery", ConditionStatus::False).await;

    cluster.create("patrol", sleeper(json!({"on": "Robot"}))).await;
    cluster.task("patrol", "kept away", waits_for("muster.dev/battery-low")).await;
    let tolerations = json!([{"key": "muster.dev/battery-low", "operator": "Exists"}]);
    cluster.create("dock", sleeper(json!({"on": "Robot", "tolerations": tolerations}))).await;
    cluster.phase("dock", TaskPhase::Running).await;
    std::fs::write(&file, "60 charging\n").expect("a file");
    cluster.phase("patrol", TaskPhase::Running).await;

    let (full, _) = robot_with_battery(&cluster, "full", 3.0, "90\n");
    cluster.join(full).await;
    condition(&cluster, "full", "Battery", ConditionStatus::True).await;
    let node = |name: &'static str, placement: Value| {
        let cluster = &cluster;
        async move {
            cluster.create(name, sleeper(placement)).await;
            cluster.phase(name, TaskPhase::Running).await.status.and_then(|s| s.node)
        }
    };
    let at = json!({"x": 0.0, "y": 0.0});
    assert_eq!(node("near", json!({"on": "Robot", "at": at})).await.as_deref(), Some("low"));
    // 30 % more are worth 3 m; the other robot is only 2 m farther.
    let cost = json!({"on": "Robot", "at": at, "batteryCost": 0.1});
    assert_eq!(node("fuller", cost).await.as_deref(), Some("full"));
    let least = json!({"on": "Robot", "at": at, "minBattery": 80});
    assert_eq!(node("demanding", least).await.as_deref(), Some("full"));
    assert_eq!(node("anywhere", json!({"on": "Robot"})).await.as_deref(), Some("full"));
}

#[tokio::test(flavor = "multi_thread")]
async fn maintenance_ends_what_is_there_and_lets_in_who_tolerates_it() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    let worker = cluster.create("worker", sleeper(json!({}))).await;
    let tolerations = json!([{"key": "muster.dev/maintenance", "operator": "Exists"}]);
    cluster.create("monitor", sleeper(json!({"tolerations": tolerations}))).await;
    cluster.phase("worker", TaskPhase::Running).await;
    cluster.phase("monitor", TaskPhase::Running).await;

    let start = k8s_openapi::jiff::Timestamp::now();
    let window = json!({"start": start, "lasts": "1h", "drain": true, "reason": "new wheels"});
    change(&cluster, "robot", json!({"maintenance": [window]})).await;
    let status = cluster.phase("worker", TaskPhase::Failed).await.status.expect("ended");
    assert_eq!(status.reason, "NodeMaintenance", "{status:?}");
    assert!(status.message.contains("new wheels"), "{status:?}");
    let uid = worker.metadata.uid.expect("set by the server");
    assert_eq!(kernel::with_env("MUSTER_UID", &uid), []);
    cluster.create("next", sleeper(json!({}))).await;
    cluster.task("next", "kept away", waits_for("muster.dev/maintenance")).await;
    cluster
        .task("monitor", "left alone", |s| s.phase == TaskPhase::Running && s.stop.is_none())
        .await;

    change(&cluster, "robot", json!({"maintenance": []})).await;
    cluster.phase("next", TaskPhase::Running).await;
}

/// A small disk of its own under an agent's data directory; it goes with this.
struct Disk(PathBuf);

impl Disk {
    fn mount(at: &Path) -> Disk {
        std::fs::create_dir_all(at).expect("a directory");
        let mounted =
            Command::new("mount").args(["-t", "tmpfs", "-o", "size=64m", "tmpfs"]).arg(at).status();
        assert!(mounted.expect("mount runs").success());
        Disk(at.to_owned())
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        // Lazily: the agent may still be on it. A failed test must not hide its own failure.
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_disk_keeps_new_tasks_away() {
    let mut cluster = Cluster::start().await;
    let dir = cluster.dir().join("small");
    let _disk = Disk::mount(&dir);
    cluster.join(AgentOptions::cloud("small")).await;
    condition(&cluster, "small", "DiskPressure", ConditionStatus::False).await;
    let ballast = dir.join("ballast");
    std::fs::write(&ballast, vec![0; 62 << 20]).expect("it still fits");
    condition(&cluster, "small", "DiskPressure", ConditionStatus::True).await;
    cluster.create("writer", sleeper(json!({}))).await;
    cluster.task("writer", "kept away", waits_for("muster.dev/disk-pressure")).await;
    std::fs::remove_file(&ballast).expect("it is there");
    cluster.phase("writer", TaskPhase::Running).await;
}
