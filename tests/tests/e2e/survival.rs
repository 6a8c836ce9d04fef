//! Work outlives its managers: killing agent and controller restarts nothing and loses no exit code.

use std::collections::BTreeMap;

use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::json;

const TASKS: usize = 20;

#[tokio::test(flavor = "multi_thread")]
async fn twenty_tasks_outlive_kill_9_of_agent_and_controller() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    let mut before = BTreeMap::new();
    for i in 0..TASKS {
        let name = format!("t{i:02}");
        let task = cluster.create(&name, json!({"run": {"process": {"command": ["sleep", "1000"]}}, "gracePeriodSeconds": 0})).await;
        before.insert(name, task.metadata.uid.expect("set by the server"));
    }
    // One that ends with its own code once it is told to, by a file.
    let gate = cluster.dir().join("end-now");
    let script = format!("until [ -e {} ]; do sleep 0.05; done; exit 42", gate.display());
    let ends = cluster
        .create("ends", json!({"run": {"process": {"command": ["sh", "-c", script]}}}))
        .await;
    let ends = ends.metadata.uid.expect("set by the server");
    let mut pids = BTreeMap::new();
    for (name, uid) in &before {
        cluster.phase(name, TaskPhase::Running).await;
        pids.insert(uid.clone(), kernel::with_env("MUSTER_UID", uid));
    }
    cluster.phase("ends", TaskPhase::Running).await;
    assert!(pids.values().all(|p| p.len() == 1), "{pids:?}");

    cluster.kill_agent("robot");
    std::fs::write(&gate, "").expect("the test's directory is writable");
    wait::until("ended while nobody watched", || {
        let left = kernel::with_env("MUSTER_UID", &ends);
        async move { if left.is_empty() { Ok(()) } else { Err(format!("{left:?}")) } }
    })
    .await;
    cluster.kill_controller();
    cluster.start_controller().await;
    cluster.restart_agent("robot").await;

    let status =
        cluster.task("ends", "told its end", |s| s.phase.is_terminal()).await.status.expect("set");
    assert_eq!((status.phase, status.exit_code), (TaskPhase::Failed, Some(42)), "{status:?}");
    for (name, uid) in &before {
        let status = cluster.phase(name, TaskPhase::Running).await.status.expect("running");
        assert_eq!(status.attempt, 1, "{name} was started again");
        assert_eq!(kernel::with_env("MUSTER_UID", uid), pids[uid], "{name} was touched");
    }
}
