//! Robots that move: offers, tasks and checkpoints follow them, whoever says where they are.

use std::path::Path;
use std::process::Stdio;

use muster_sdk::poses::{NodePose, PoseBatch, Publisher, Replies};
use muster_tests::cluster::binary;
use muster_tests::wait::{self, DEADLINE};
use muster_tests::{AgentOptions, Cluster, Puppet};
use serde_json::json;
use tokio::io::{AsyncBufReadExt as _, BufReader};

/// A robot whose own software keeps its pose in `file`.
fn robot(name: &str, file: &Path) -> AgentOptions {
    let mut options = AgentOptions::robot(name, 0.0, 0.0);
    let position = options.flags.iter_mut().find(|f| f.starts_with("static:")).expect("a place");
    *position = format!("file:{}", file.display());
    options
}

/// As a robot's software should: a whole file takes the place of the one before.
fn stand(file: &Path, x: f64, y: f64) {
    let new = file.with_extension("new");
    std::fs::write(&new, format!("{x} {y} 0.5\n")).expect("writable");
    std::fs::rename(&new, file).expect("writable");
}

async fn publish((publisher, replies): &mut (Publisher, Replies), node: &str, x: f64) {
    let poses = vec![NodePose { node: node.to_owned(), x, ..NodePose::default() }];
    let batch =
        PoseBatch { source: "mocap".to_owned(), poses, acknowledge: true, ..Default::default() };
    publisher.publish(batch).await.expect("the stream is open");
    let reply = tokio::time::timeout(DEADLINE, replies.next()).await.expect("in time");
    let reply = reply.expect("the stream is open").expect("it goes on");
    assert!(reply.refused.is_empty(), "{reply:?}");
}

async fn checkpoint(cluster: &Cluster, node: &str, x: f64) {
    let pose = |n: &muster_api::kind::node::Node| n.status.as_ref()?.pose.clone();
    let there =
        |n: Option<&muster_api::kind::node::Node>| n.and_then(pose).is_some_and(|pose| pose.x == x);
    wait::object(cluster.nodes().await, node, "written down", there).await;
}

/// A robot that moves by its own word and by the building's, into a framework's range and out of it.
#[tokio::test(flavor = "multi_thread")]
async fn offers_and_checkpoints_follow_a_robot() {
    let mut cluster = Cluster::start().await;
    let file = cluster.dir().join("pose");
    stand(&file, 50.0, 0.0);
    cluster.join(robot("rover", &file)).await;
    checkpoint(&cluster, "rover", 50.0).await;
    let info = json!({"name": "near", "position": [0.0, 0.0], "radius": 10.0});
    let mut framework = Puppet::start(&cluster, info).await;
    assert!(framework.holding.is_empty(), "it is 50 m away");

    stand(&file, 6.0, 8.0);
    framework.holds("the robot at the rim", |o| o.contains_key("rover")).await;
    assert_eq!(framework.holding["rover"]["score"], 10.0);
    checkpoint(&cluster, "rover", 6.0).await;
    stand(&file, 30.0, 0.0);
    framework.holds("nothing", |o| o.is_empty()).await;

    // The building sees it better than it does itself.
    let kubeconfig = cluster.kubeconfig();
    let mut mocap = Publisher::connect(Some(&kubeconfig)).await.expect("an administrator");
    publish(&mut mocap, "rover", 4.0).await;
    framework.holds("the robot", |o| o.contains_key("rover")).await;
    assert_eq!(framework.holding["rover"]["score"], 4.0);
    checkpoint(&cluster, "rover", 4.0).await;
    let live = cluster.get("/apis/muster.dev/v1alpha1/nodes/rover/pose").await;
    assert_eq!((&live["source"], &live["x"]), (&json!("mocap"), &json!(4.0)));
    publish(&mut mocap, "rover", 40.0).await;
    framework.holds("nothing again", |o| o.is_empty()).await;
}

/// A task waits for a robot to come by; the command shows it coming.
#[tokio::test(flavor = "multi_thread")]
async fn a_waiting_task_takes_the_robot_that_comes_by() {
    let mut cluster = Cluster::start().await;
    let file = cluster.dir().join("pose");
    stand(&file, 50.0, 0.0);
    cluster.join(robot("rover", &file)).await;
    let spec = json!({
        "placement": {"at": {"x": 0.0, "y": 0.0}, "within": 5.0, "on": "Robot"},
        "run": {"process": {"command": ["sleep", "1000"]}},
        "gracePeriodSeconds": 0,
    });
    cluster.create("look", spec).await;
    let far = |s: &muster_api::kind::task::TaskStatus| {
        s.why.iter().any(|w| w.node == "rover" && w.reason == "OutOfRange")
    };
    cluster.task("look", "out of range", far).await;

    let mut watch = tokio::process::Command::new(binary("muster"))
        .args(["get", "poses", "rover", "--watch", "--no-headers"])
        .env("MUSTER_CONFIG", cluster.kubeconfig())
        .env("NO_COLOR", "1")
        .stdout(Stdio::piped())
        .kill_on_drop(true)
        .spawn()
        .expect("muster starts");
    let mut rows = BufReader::new(watch.stdout.take().expect("it is piped")).lines();
    let mut row = async || {
        let line = tokio::time::timeout(DEADLINE, rows.next_line()).await.expect("a row in time");
        line.expect("it can be read").expect("the watch goes on")
    };
    let first = row().await;
    assert!(first.starts_with("rover   50.00,0.00"), "{first}");
    stand(&file, 3.0, 4.0);
    let status = cluster.task("look", "bound", |s| s.node.is_some()).await.status;
    let status = status.expect("it is bound");
    assert_eq!((status.node.as_deref(), status.score), (Some("rover"), Some(5.0)));
    let second = row().await;
    assert!(second.starts_with("rover   3.00,4.00 "), "{second}");
}
