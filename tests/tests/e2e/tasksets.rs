//! Sets of tasks with real robots: where they go, how they are changed, and what is left alone.

use std::collections::BTreeMap;

use kube::Api;
use kube::api::{Patch, PatchParams, PostParams};
use muster_api::kind::node::MISSION_LOCK;
use muster_api::kind::task::Task;
use muster_api::kind::taskset::{TaskSet, TaskSetStatus};
use muster_api::phase::TaskPhase;
use muster_tests::kernel::{self, Process};
use muster_tests::{AgentOptions, Cluster, wait};
use serde_json::{Value, json};

use crate::cli::muster;

async fn sets(cluster: &Cluster) -> Api<TaskSet> {
    Api::namespaced(cluster.client().await, "default")
}

pub(crate) async fn create(cluster: &Cluster, name: &str, spec: Value) {
    let set = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "TaskSet", "metadata": {"name": name}, "spec": spec,
    });
    let set: TaskSet = serde_json::from_value(set).expect("a set");
    sets(cluster).await.create(&PostParams::default(), &set).await.expect("the set is taken");
}

/// Waits until a set's status, of its present spec, is as wanted.
pub(crate) async fn status(
    cluster: &Cluster,
    name: &str,
    what: &str,
    wanted: impl Fn(&TaskSetStatus) -> bool,
) -> TaskSetStatus {
    let holds = |set: Option<&TaskSet>| {
        set.is_some_and(|set| {
            let status = set.status.clone().unwrap_or_default();
            Some(status.observed_generation) == set.metadata.generation && wanted(&status)
        })
    };
    let set = wait::object(sets(cluster).await, name, what, holds).await;
    set.and_then(|set| set.status).expect("it has a status")
}

pub(crate) fn says(status: &TaskSetStatus, reason: &str) -> bool {
    status.condition("Progressing").is_some_and(|c| c.reason == reason)
}

pub(crate) async fn complete(cluster: &Cluster, name: &str, tasks: u32) -> TaskSetStatus {
    status(cluster, name, "complete", |s| says(s, "Complete") && s.available_replicas == tasks)
        .await
}

/// The processes of a set's tasks, by node.
async fn processes(cluster: &Cluster) -> BTreeMap<String, Vec<Process>> {
    let tasks = cluster.tasks().await.list(&Default::default()).await.expect("a list");
    let row = |task: &Task| {
        let node = task.status.as_ref()?.node.clone()?;
        Some((node, kernel::with_env("MUSTER_UID", task.metadata.uid.as_deref()?)))
    };
    tasks.items.iter().filter_map(row).collect()
}

pub(crate) async fn patch(cluster: &Cluster, name: &str, change: Value) {
    let params = PatchParams::default();
    sets(cluster).await.patch(name, &params, &Patch::Merge(change)).await.expect("it is taken");
}

fn program(script: &str) -> Value {
    json!({"spec": {"template": {"spec": {"run": {"process": {"command": ["sh", "-c", script]}}}}}})
}

/// Three robots at 0, 10 and 20 m.
async fn robots(cluster: &mut Cluster) {
    for (name, x) in [("near", 0.0), ("middle", 10.0), ("far", 20.0)] {
        cluster.join(AgentOptions::robot(name, x, 0.0).flag("--docker-socket", "none")).await;
    }
}

fn nearest(replicas: u32) -> Value {
    json!({
        "replicas": replicas, "minReadySeconds": 1,
        "template": {"spec": {
            "gracePeriodSeconds": 0,
            "placement": {"at": {"x": 0.0, "y": 0.0}},
            "resources": {"sensors": ["kinect:LaserGen"]},
            "run": {"process": {"command": ["sh", "-c", "sleep 1000"]}},
        }},
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn the_nearest_robots_have_one_each_and_a_set_takes_its_tasks_with_it() {
    let mut cluster = Cluster::start().await;
    robots(&mut cluster).await;
    create(&cluster, "watch", nearest(2)).await;
    complete(&cluster, "watch", 2).await;
    let two: Vec<String> = processes(&cluster).await.into_keys().collect();
    assert_eq!(two, ["middle", "near"]);

    let (code, out, err) = muster(&cluster, &["scale", "taskset/watch", "--replicas=3"]);
    assert_eq!((code, out.as_str()), (0, "taskset/watch scaled\n"), "{err}");
    complete(&cluster, "watch", 3).await;
    let before = processes(&cluster).await;
    let (code, _, err) = muster(&cluster, &["scale", "ts/watch", "--replicas=1"]);
    assert_eq!(code, 0, "{err}");
    complete(&cluster, "watch", 1).await;
    let tasks = cluster.tasks().await;
    let left = || async {
        let left = tasks.list(&Default::default()).await.expect("a list").items.len();
        if left == 1 { Ok(()) } else { Err(format!("{left} tasks")) }
    };
    wait::until("scaled down", left).await;
    let after = processes(&cluster).await;
    assert_eq!(after, BTreeMap::from([("near".to_owned(), before["near"].clone())]));

    let (code, table, _) = muster(&cluster, &["get", "tasksets"]);
    assert_eq!(code, 0);
    let row: Vec<&str> = table.lines().nth(1).expect("a row").split_whitespace().collect();
    assert_eq!(row[..6], ["watch", "1", "1", "1", "1", "Complete"], "{table}");
    let (_, described, _) = muster(&cluster, &["describe", "taskset/watch"]);
    assert!(
        described.contains("each on a node of its own") && described.contains("near"),
        "{described}"
    );

    assert_eq!(muster(&cluster, &["delete", "taskset", "watch"]).0, 0);
    wait::until("gone with its tasks", || async {
        let (_, left, _) = muster(&cluster, &["get", "ts,tasks,tsr", "-o", "name"]);
        if left.is_empty() { Ok(()) } else { Err(left) }
    })
    .await;
    for process in after.values().flatten() {
        assert_ne!(kernel::start_time(process.pid), Some(process.start), "it runs on");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_robot_has_one_as_it_joins() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("first", 0.0, 0.0).flag("--docker-socket", "none")).await;
    cluster.join(AgentOptions::cloud("cloud").flag("--docker-socket", "none")).await;
    let spec = json!({
        "everyNode": true, "minReadySeconds": 1,
        "template": {"spec": {
            "gracePeriodSeconds": 0, "placement": {"on": "Robot"},
            "run": {"process": {"command": ["sleep", "1000"]}},
        }},
    });
    create(&cluster, "report", spec).await;
    complete(&cluster, "report", 1).await;
    cluster.phase("report-first", TaskPhase::Running).await;
    cluster.join(AgentOptions::robot("second", 5.0, 0.0).flag("--docker-socket", "none")).await;
    complete(&cluster, "report", 2).await;
    cluster.phase("report-second", TaskPhase::Running).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_rollout_that_crashes_goes_back_a_mission_is_waited_for_and_undo_undoes() {
    let mut cluster = Cluster::start().await;
    robots(&mut cluster).await;
    create(&cluster, "watch", nearest(3)).await;
    let first = complete(&cluster, "watch", 3).await;
    let before = processes(&cluster).await;

    patch(&cluster, "watch", program("echo broken; exit 7")).await;
    let back = status(&cluster, "watch", "rolled back", |s| {
        says(s, "RolledBack") && s.available_replicas == 3 && s.replacing.is_empty()
    })
    .await;
    let why = back.rolled_back_from.expect("it was given up");
    assert_eq!(
        (why.reason.as_str(), why.to.as_str()),
        ("Crashed", first.current_revision.as_str())
    );
    assert!(why.message.contains("exited with code 7"), "{}", why.message);
    let after = processes(&cluster).await;
    let same = before.iter().filter(|(node, pids)| after[*node] == **pids).count();
    assert_eq!(same, 2, "only the canary was touched: {before:?} {after:?}");
    let (code, _, err) = muster(&cluster, &["rollout", "status", "ts/watch"]);
    assert_eq!(code, 1, "{err}");
    assert!(err.contains("RolledBack") && err.contains("exited with code 7"), "{err}");

    let lock = ["node", "lock", "far", "--holder", "ada", "--reason", "carries a tray"];
    assert_eq!(muster(&cluster, &lock).1, "node/far locked by ada\n");
    let node = cluster.nodes().await.get("far").await.expect("a node");
    assert_eq!(node.metadata.annotations.expect("set")[MISSION_LOCK], "ada: carries a tray");
    patch(&cluster, "watch", program("exec sleep 2000")).await;
    let held = status(&cluster, "watch", "held", |s| {
        says(s, "MissionLock") && s.updated_replicas == 2 && s.available_replicas == 3
    })
    .await;
    assert_eq!((held.held[0].node.as_str(), held.held[0].holder.as_str()), ("far", "ada"));
    let during = processes(&cluster).await;
    assert_eq!(during["far"], after["far"], "it is in the middle of a mission");
    assert_ne!(during["near"], after["near"]);
    assert_eq!(muster(&cluster, &["node", "unlock", "far"]).1, "node/far unlocked\n");
    let (code, out, err) = muster(&cluster, &["rollout", "status", "ts/watch", "--timeout", "60s"]);
    assert_eq!(code, 0, "{err}");
    assert!(out.ends_with("taskset \"watch\" successfully rolled out\n"), "{out}");
    assert_ne!(processes(&cluster).await["far"], after["far"]);

    assert_eq!(
        muster(&cluster, &["rollout", "undo", "ts/watch", "--to-revision=1"]).1,
        "taskset/watch rolled back\n"
    );
    let undone = complete(&cluster, "watch", 3).await;
    assert_eq!(undone.current_revision, first.current_revision);
    for task in cluster.tasks().await.list(&Default::default()).await.expect("a list") {
        let command = task.spec.run.process.expect("a process").command;
        assert_eq!(command, ["sh", "-c", "sleep 1000"]);
    }
    let (_, history, _) = muster(&cluster, &["rollout", "history", "ts/watch"]);
    assert_eq!(history.lines().count(), 5, "three templates: {history}");
}
