//! A lease passes on only after the last process of its holder is gone.

use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::json;

fn driver(script: &str, grace: u32) -> serde_json::Value {
    json!({
        "resources": {"actuators": ["base:Drive"]},
        "run": {"process": {"command": ["sh", "-c", script]}},
        "gracePeriodSeconds": grace,
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn a_holder_that_ignores_sigterm_keeps_the_lease_until_it_is_killed() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    // The child in a session of its own ignores SIGTERM as well.
    let stubborn = "trap '' TERM; setsid sh -c 'trap \"\" TERM; while :; do sleep 1; done' & while :; do sleep 1; done";
    let holder = cluster.create("holder", driver(stubborn, 2)).await;
    cluster.phase("holder", TaskPhase::Running).await;
    let uid = holder.metadata.uid.expect("set by the server");
    wait::until("the task and its child", || {
        let run = kernel::with_env("MUSTER_UID", &uid);
        async move { if run.len() >= 2 { Ok(()) } else { Err(format!("{run:?}")) } }
    })
    .await;

    cluster.create("next", driver("sleep 1000", 0)).await;
    cluster
        .task("next", "waiting for the lease", |s| s.why.iter().any(|w| w.reason == "LeaseHeld"))
        .await;
    cluster.tasks().await.delete("holder", &Default::default()).await.expect("it is there");

    // Whenever the next one has the lease, nothing of the holder is left.
    let next = cluster.task("next", "bound", |s| s.phase != TaskPhase::Pending).await;
    assert_eq!(
        kernel::with_env("MUSTER_UID", &uid),
        [],
        "the lease passed while its old holder ran"
    );
    assert_eq!(next.status.and_then(|s| s.lease).map(|l| l.epoch.0), Some(2));
    cluster.phase("next", TaskPhase::Running).await;
}
