//! A more important task takes the place of others, gracefully; and what has run long enough ends.

use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::{Value, json};

fn driver(script: &str, priority: i32) -> Value {
    json!({
        "priority": priority,
        "resources": {"actuators": ["base:Drive"], "cpu": "100m"},
        "run": {"process": {"command": ["sh", "-c", script]}},
        // So long, in which it is seen that the place is being made.
        "gracePeriodSeconds": 20,
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lease_is_taken_only_after_its_old_holder_is_gone() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    let stubborn = "trap '' TERM; setsid sh -c 'trap \"\" TERM; while :; do sleep 1; done' & while :; do sleep 1; done";
    let holder = cluster.create("holder", driver(stubborn, 0)).await;
    cluster.phase("holder", TaskPhase::Running).await;
    let uid = holder.metadata.uid.expect("set by the server");
    wait::until("the task and its child", || {
        let run = kernel::with_env("MUSTER_UID", &uid);
        async move { if run.len() >= 2 { Ok(()) } else { Err(format!("{run:?}")) } }
    })
    .await;

    cluster.create("urgent", driver("sleep 1000", 10)).await;
    let nominated = |s: &muster_api::kind::task::TaskStatus| {
        s.reason == "Preempting" && s.nominated_node.as_deref() == Some("robot")
    };
    cluster.task("urgent", "nominated", nominated).await;
    // One that came later does not get what is being freed.
    cluster.create("later", driver("sleep 1000", 10)).await;

    let urgent = cluster.task("urgent", "bound", |s| s.phase != TaskPhase::Pending).await;
    let left = kernel::with_env("MUSTER_UID", &uid);
    assert_eq!(left, [], "the lease passed while its old holder ran");
    let status = urgent.status.expect("bound");
    assert_eq!((status.lease.map(|l| l.epoch.0), status.nominated_node), (Some(2), None));
    let ended = cluster.phase("holder", TaskPhase::Failed).await.status.expect("ended");
    assert_eq!(ended.reason, "Preempted");
    assert!(ended.message.contains("default/urgent"), "{ended:?}");
    cluster.phase("urgent", TaskPhase::Running).await;
    let waits =
        |s: &muster_api::kind::task::TaskStatus| s.why.iter().any(|w| w.reason == "LeaseHeld");
    cluster.task("later", "waiting for an equal", waits).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deadline_ends_a_task_and_its_object_goes_when_it_should() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud")).await;
    let run = |command: &str| json!({"process": {"command": ["sh", "-c", command]}});
    let long = json!({"run": run("sleep 1000"), "activeDeadlineSeconds": 1});
    let long = cluster.create("long", long).await.metadata.uid.expect("set by the server");
    let status = cluster.phase("long", TaskPhase::Failed).await.status.expect("ended");
    assert_eq!(status.reason, "DeadlineExceeded", "{status:?}");
    assert_eq!(kernel::with_env("MUSTER_UID", &long), []);

    let brief = json!({"run": run("true"), "ttlSecondsAfterFinished": 1});
    cluster.create("brief", brief).await;
    let tasks = cluster.tasks().await;
    wait::object(tasks, "brief", "removed", |task: Option<&muster_api::kind::task::Task>| {
        task.is_none()
    })
    .await;
    cluster.phase("long", TaskPhase::Failed).await;
}
