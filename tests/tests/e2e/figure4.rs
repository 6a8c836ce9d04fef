//! Figure 4 of Avalon, step by step, with declared tasks of two users: what is *used* and what is
//! *allocatable* (`status.free` here) after each step.

use muster_api::kind::node::NodeStatus;
use muster_api::phase::TaskPhase;
use muster_api::quantity::MilliCpu;
use muster_tests::{AgentOptions, Cluster, wait};
use serde_json::{Value, json};

const RUN: &str = "while :; do sleep 1; done";

fn task(x: f64, cpu: &str, sensors: &[&str], actuators: &[&str]) -> Value {
    json!({
        "placement": {"at": {"x": x, "y": 0.0}, "within": 5.0, "on": "Robot"},
        "resources": {"cpu": cpu, "memory": "16Mi", "sensors": sensors, "actuators": actuators},
        "run": {"process": {"command": ["sh", "-c", RUN]}},
        "gracePeriodSeconds": 0,
    })
}

async fn books(
    cluster: &Cluster,
    node: &str,
    what: &str,
    holds: impl Fn(&NodeStatus) -> bool,
) -> NodeStatus {
    let node = wait::object(cluster.nodes().await, node, what, |n| {
        n.and_then(|n| n.status.as_ref()).is_some_and(&holds)
    });
    node.await.and_then(|n| n.status).expect("it has a status")
}

fn holder(status: &NodeStatus) -> Option<&str> {
    status.leases.iter().find_map(|l| l.holder.as_ref()).map(|h| h.name.as_str())
}

#[tokio::test(flavor = "multi_thread")]
async fn figure_4_of_avalon() {
    let mut cluster = Cluster::start().await;

    // 1: two robots report what they have and where they are.
    for (name, x) in [("slave-1", 0.0), ("slave-2", 10.0)] {
        cluster
            .join(AgentOptions::robot(name, x, 0.0).flag("--cpu", "1").flag("--memory", "1Gi"))
            .await;
        let status = books(&cluster, name, "all free", |s| s.free.cpu == MilliCpu(1000)).await;
        assert_eq!(status.used.cpu, MilliCpu(0));
        assert_eq!((status.sensors.len(), status.actuators.len()), (2, 2));
        assert_eq!(status.pose.map(|p| p.x), Some(x));
    }

    // 2–5: the first user's two tasks go to the nearest robots at the same time; each takes CR and
    // all AR of its robot.
    cluster.create("task-1", task(0.0, "600m", &["kinect:LaserGen"], &["base:Drive"])).await;
    cluster.create("task-2", task(10.0, "1", &["kinect:LaserGen"], &["arm:Grasp"])).await;
    for (name, node, score) in [("task-1", "slave-1", 0.0), ("task-2", "slave-2", 0.0)] {
        let status = cluster.phase(name, TaskPhase::Running).await.status.expect("running");
        assert_eq!(status.node.as_deref(), Some(node));
        assert_eq!(status.score, Some(score));
        assert_eq!(status.lease.map(|l| (l.name, l.epoch.0)), Some((format!("{node}.body"), 1)));
    }
    let one =
        books(&cluster, "slave-1", "task-1 in the books", |s| s.used.cpu == MilliCpu(600)).await;
    assert_eq!((one.free.cpu, holder(&one)), (MilliCpu(400), Some("task-1")));
    let two =
        books(&cluster, "slave-2", "task-2 in the books", |s| s.used.cpu == MilliCpu(1000)).await;
    assert_eq!((two.free.cpu, holder(&two)), (MilliCpu(0), Some("task-2")));

    // 6: what is left for a second user at the same positions is the remaining CR and all SR of
    // slave 1, and all SR of slave 2; no AR of either.
    cluster.create("wants-ar", task(0.0, "100m", &[], &["arm:Grasp"])).await;
    let waiting = cluster
        .task("wants-ar", "refused by both", |s| s.why.len() == 2)
        .await
        .status
        .expect("set");
    let mut why: Vec<(&str, &str)> =
        waiting.why.iter().map(|w| (w.node.as_str(), w.reason.as_str())).collect();
    why.sort_unstable();
    assert_eq!(why, [("slave-1", "LeaseHeld"), ("slave-2", "OutOfRange")]);
    cluster.create("wants-cr", task(10.0, "100m", &[], &[])).await;
    let waiting = cluster
        .task("wants-cr", "refused by both", |s| s.why.len() == 2)
        .await
        .status
        .expect("set");
    assert_eq!(
        waiting.why.iter().find(|w| w.node == "slave-2").map(|w| w.reason.as_str()),
        Some("Exhausted")
    );

    // 7: the second user's two SR tasks are deployed beside the first user's.
    for (name, x, cpu) in [("sr-1", 0.0, Some("300m")), ("sr-2", 10.0, None)] {
        let mut spec = task(x, "300m", &["kinect:ImageGen", "kinect:LaserGen"], &[]);
        if cpu.is_none() {
            spec["resources"].as_object_mut().expect("a map").remove("cpu");
        }
        cluster.create(name, spec).await;
        cluster.phase(name, TaskPhase::Running).await;
    }
    let one =
        books(&cluster, "slave-1", "sr-1 in the books", |s| s.used.cpu == MilliCpu(900)).await;
    assert_eq!((one.free.cpu, holder(&one)), (MilliCpu(100), Some("task-1")));

    // The AR comes free only when its holder ends, and then at once.
    cluster.delete("task-1").await;
    let status = cluster.phase("wants-ar", TaskPhase::Running).await.status.expect("running");
    assert_eq!(status.lease.map(|l| l.epoch.0), Some(2));
    let one =
        books(&cluster, "slave-1", "wants-ar in the books", |s| holder(s) == Some("wants-ar"))
            .await;
    assert_eq!(one.free.cpu, MilliCpu(600));
}
