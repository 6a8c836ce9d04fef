//! A robot that is lost: what a person's word frees, and what holds when the person erred.

use muster_api::condition;
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::json;

use crate::cli::muster;

fn driver(script: &str, grace: u32) -> serde_json::Value {
    json!({
        "placement": {"node": "robot"},
        "resources": {"actuators": ["base:Drive"]},
        "run": {"process": {"command": ["sh", "-c", script]}},
        "gracePeriodSeconds": grace,
    })
}

/// A robot whose driver runs, and a second driver that waits for it; the first one's uid.
async fn driven(cluster: &mut Cluster, script: &str, grace: u32) -> String {
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    let first = cluster.create("first", driver(script, grace)).await;
    cluster.phase("first", TaskPhase::Running).await;
    cluster.create("second", driver("sleep 1000", 0)).await;
    cluster
        .task("second", "waiting for the lease", |s| s.why.iter().any(|w| w.reason == "LeaseHeld"))
        .await;
    first.metadata.uid.expect("set by the server")
}

/// Kills the agent and waits until the controller has given the node up.
async fn lose(cluster: &mut Cluster) {
    let (code, _, err) = muster(cluster, &["node", "fence", "robot", "--reason", "x", "--yes"]);
    assert_eq!(code, 4, "a node that is there is not fenced: {err}");
    assert!(err.contains("not off") && err.contains("muster drain robot"), "{err}");
    cluster.kill_agent("robot");
    cluster.phase("first", TaskPhase::Unknown).await;
}

async fn fence(cluster: &Cluster) {
    let (code, out, err) = muster(cluster, &["node", "fence", "robot", "--reason", "no power"]);
    assert_eq!((code, out.as_str()), (2, ""), "nobody confirmed it: {err}");
    assert!(err.contains("robot is powered off or its processes are gone"), "{err}");
    let line = ["node", "fence", "robot", "--reason", "no power", "--yes"];
    let (code, out, err) = muster(cluster, &line);
    assert_eq!((code, out.as_str()), (0, "node/robot fenced\n"), "{err}");
    let first = cluster.phase("first", TaskPhase::Failed).await.status.expect("ended");
    assert_eq!(first.reason, "NodeFenced");
    let lease = cluster.leases().await.get("robot.body").await.expect("a lease");
    let status = lease.status.expect("it was granted");
    assert_eq!((status.holder, status.epoch.0), (None, 1));
    let second = cluster.tasks().await.get("second").await.expect("it waits");
    assert_eq!(second.status.map(|s| s.phase), Some(TaskPhase::Pending), "the node is not there");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_that_is_off_is_fenced_and_goes_on_with_the_next_driver() {
    let mut cluster = Cluster::start().await;
    let first = driven(&mut cluster, "sleep 1000", 0).await;
    lose(&mut cluster).await;
    // Without power its shims and tasks are gone as well.
    let data = cluster.dir().join("robot").display().to_string();
    let tasks = kernel::with_env("MUSTER_UID", &first).into_iter().map(|process| process.pid);
    kernel::with_command(&data).into_iter().chain(tasks).for_each(kernel::kill);
    wait::until("without power", || {
        let left = kernel::with_env("MUSTER_UID", &first);
        async move { if left.is_empty() { Ok(()) } else { Err(format!("{left:?}")) } }
    })
    .await;

    fence(&cluster).await;
    cluster.restart_agent("robot").await;
    let second = cluster.phase("second", TaskPhase::Running).await.status.expect("it runs");
    assert_eq!(second.lease.map(|l| l.epoch.0), Some(2));
    let node = cluster.nodes().await.get("robot").await.expect("it is back").status.expect("set");
    let fenced = node.condition(condition::FENCED).expect("it was fenced");
    assert_eq!(fenced.status, condition::ConditionStatus::False);
    let first = cluster.phase("first", TaskPhase::Failed).await.status.expect("ended");
    assert_eq!(first.reason, "NodeFenced", "an end is not told twice");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_driver_that_lives_after_all_keeps_the_next_one_waiting() {
    let mut cluster = Cluster::start().await;
    // It does not end at SIGTERM, so that there is a time in which both could drive.
    let stubborn = "trap '' TERM; while :; do sleep 0.1; done";
    let first = driven(&mut cluster, stubborn, 10).await;
    lose(&mut cluster).await;
    fence(&cluster).await;
    assert_ne!(kernel::with_env("MUSTER_UID", &first), [], "only the agent was killed");

    cluster.spawn_agent("robot", None);
    let strays = |n: Option<&muster_api::kind::node::Node>| {
        let ready = n.and_then(|n| n.status.as_ref()?.condition(condition::READY));
        ready.is_some_and(|c| c.reason == "StrayTasks" && c.message.contains("default/first"))
    };
    wait::object(cluster.nodes().await, "robot", "held by a stray", strays).await;
    let second = cluster.task("second", "bound", |s| s.phase != TaskPhase::Pending).await;
    assert_eq!(kernel::with_env("MUSTER_UID", &first), [], "two drivers");
    assert_eq!(second.status.and_then(|s| s.lease).map(|l| l.epoch.0), Some(2));
    cluster.phase("second", TaskPhase::Running).await;
    cluster.node_ready("robot").await;
}
