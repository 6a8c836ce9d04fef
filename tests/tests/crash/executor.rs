//! A work that an executor does.

use muster_api::phase::TaskPhase;
use muster_failpoint::Failpoint;
use muster_tests::cluster::binary;
use muster_tests::{AgentOptions, Cluster, wait};
use serde_json::json;

use crate::crash::{Crash, moments};

pub(crate) async fn works(points: &[Failpoint]) {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud").flag("--docker-socket", "none")).await;
    let executor = json!({
        "resources": {"memory": "256Mi"},
        "run": {"process": {"command": [binary("echo-executor")]}},
        "gracePeriodSeconds": 0,
    });
    let executor = cluster.create("executor", executor).await;
    cluster.phase("executor", TaskPhase::Running).await;
    // A work is written down when it is handed over, when it runs, and when it has ended.
    let each = moments(points).into_iter().flat_map(|moment| (1..=3).map(move |nth| (moment, nth)));
    for (number, (moment, nth)) in each.enumerate() {
        let crash = Crash::at(&mut cluster, "cloud", moment, nth);
        cluster.kill_agent("cloud");
        cluster.spawn_agent("cloud", None);
        let (name, tasks) = (format!("work-{number}"), cluster.tasks().await);
        let spec = json!({"run": {"executor": {"task": "executor", "data": {}}}, "gracePeriodSeconds": 20});
        let uid = cluster.create(&name, spec).await.metadata.uid.expect("set by the server");
        let life = async {
            let runs = |task: Option<&muster_api::kind::task::Task>| {
                let status = task.and_then(|task| task.status.as_ref());
                status.is_some_and(|status| status.phase == TaskPhase::Running)
            };
            wait::object(tasks.clone(), &name, "running", runs).await;
            tasks.delete(&name, &Default::default()).await.expect("it is there");
            wait::object(tasks.clone(), &name, "gone", |task| task.is_none()).await;
        };
        tokio::join!(life, crash.nurse(&mut cluster));
        let dir = cluster.dir().join("cloud/tasks").join(uid);
        wait::until("nothing left of the work", async || {
            if dir.exists() { Err(dir.display().to_string()) } else { Ok(()) }
        })
        .await;
    }
    // It was alive all the time, and did what it was told.
    let after = cluster.phase("executor", TaskPhase::Running).await;
    assert_eq!(after.metadata.uid, executor.metadata.uid);
    assert_eq!(after.status.expect("it runs").attempt, 1);
}
