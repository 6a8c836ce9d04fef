//! A container, and the guard of one that may not run without contact.

use muster_api::kind::node::Node;
use muster_api::phase::TaskPhase;
use muster_failpoint::{Failpoint, Moment, Step};
use muster_tests::{AgentOptions, Cluster, docker, kernel, wait};
use serde_json::{Value, json};

use crate::crash::{Crash, moments};

async fn join() -> Cluster {
    docker::image();
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    engine(&cluster).await;
    cluster
}

/// Waits until the node has found its engine.
async fn engine(cluster: &Cluster) {
    let has = |node: Option<&Node>| {
        let status = node.and_then(|node| node.status.as_ref());
        status.is_some_and(|s| s.runtimes.iter().any(|r| r.name == "docker" && r.available))
    };
    wait::object(cluster.nodes().await, "robot", "able to run containers", has).await;
}

/// Writes down each of its attempts, and ends when a file is there.
fn spec() -> Value {
    let script = "echo $MUSTER_ATTEMPT >> $MUSTER_RUN_DIR/runs
        until [ -e $MUSTER_RUN_DIR/end ]; do sleep 0.1; done";
    json!({
        "resources": {"actuators": ["base:Drive"]},
        "run": {"container": {"image": docker::IMAGE, "command": ["sh", "-c", script],
            "network": "None", "pullPolicy": "Never"}},
        "onDisconnect": {"policy": "Keep"},
        "gracePeriodSeconds": 0,
    })
}

async fn nothing_left(cluster: &Cluster, uid: &str) {
    let dir = cluster.dir().join("robot/tasks").join(uid);
    wait::until("nothing left of the container", async || {
        let left = docker::containers_of(uid);
        if left.is_empty() && !dir.exists() { Ok(()) } else { Err(format!("{left:?}")) }
    })
    .await;
    let lease = cluster.leases().await.get("robot.body").await.expect("it is there");
    assert!(lease.status.is_some_and(|status| status.holder.is_none()));
}

pub(crate) async fn to_its_end(points: &[Failpoint]) {
    let mut cluster = join().await;
    for (number, moment) in moments(points).into_iter().enumerate() {
        let crash = Crash::at(&mut cluster, "robot", moment, 1);
        cluster.kill_agent("robot");
        cluster.spawn_agent("robot", None);
        let name = format!("t{number}");
        let task = cluster.create(&name, spec()).await;
        let uid = task.metadata.uid.expect("set by the server");
        let (tasks, run) =
            (cluster.tasks().await, cluster.dir().join("robot/tasks").join(&uid).join("run"));
        let life = async {
            let runs = wait::until("a line of its program's", async || {
                std::fs::read_to_string(run.join("runs")).map_err(|error| error.to_string())
            });
            assert_eq!(runs.await, "1\n", "{moment}");
            assert_eq!(docker::containers_of(&uid).len(), 1, "{moment}");
            std::fs::write(run.join("end"), "").expect("its directory is there");
            let ended = |task: Option<&muster_api::kind::task::Task>| {
                let status = task.and_then(|task| task.status.as_ref());
                status.is_some_and(|status| status.phase.is_terminal())
            };
            let task = wait::object(tasks.clone(), &name, "ended", ended).await;
            let told = task.and_then(|task| task.status).expect("it has ended");
            assert_eq!((told.phase, told.attempt), (TaskPhase::Succeeded, 1), "{told:?}");
            tasks.delete(&name, &Default::default()).await.expect("it is there");
            wait::object(tasks.clone(), &name, "gone", |task| task.is_none()).await;
        };
        tokio::join!(life, crash.nurse(&mut cluster));
        nothing_left(&cluster, &uid).await;
    }
}

/// The agent stands still, and so there is no contact: its guard is to end the container.
pub(crate) async fn guarded(points: &[Failpoint]) {
    let mut cluster = join().await;
    for (number, moment) in moments(points).into_iter().enumerate() {
        let crash = Crash::at(&mut cluster, "robot", moment, 1);
        cluster.kill_agent("robot");
        cluster.spawn_agent("robot", None);
        let name = format!("t{number}");
        let mut wanted = spec();
        wanted["onDisconnect"] = json!({"policy": "Stop", "after": "2s"});
        let task = cluster.create(&name, wanted).await;
        let uid = task.metadata.uid.expect("set by the server");
        let Moment(point, step) = moment;
        if point == Failpoint::GuardOrder {
            crash.nurse(&mut cluster).await;
        } else {
            cluster.phase(&name, TaskPhase::Running).await;
            kernel::freeze(cluster.agent_pid("robot"), true);
            crash.happened().await;
            kernel::freeze(cluster.agent_pid("robot"), false);
            // The guard has said that it ends the container, and died before it did.
            let said = cluster.dir().join(format!("robot/tasks/{uid}/attempts/1/disconnected"));
            assert_eq!(said.exists(), step == Step::After, "{moment}");
        }
        cluster.phase(&name, TaskPhase::Running).await;
        cluster.delete(&name).await;
        nothing_left(&cluster, &uid).await;
    }
}
