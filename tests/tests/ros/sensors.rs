//! A topic as a sensor: one subscription for every task, what is published as it is serialised, and masters that come and go.

use std::time::Duration;

use muster_api::kind::node::Node;
use muster_tests::puppet::python;
use muster_tests::{AgentOptions, Cluster, Ros, wait};
use serde_json::{Value, json};

async fn robot(ros: &Ros) -> Cluster {
    let mut cluster = Cluster::start().await;
    let config = cluster.dir().join("agent.yaml");
    let sensors = json!({"sensors": [{"function": "kinect:ImageGen", "ros1": "/chatter"}]});
    // JSON is YAML.
    std::fs::write(&config, sensors.to_string()).expect("a directory");
    let robot = AgentOptions::robot("robot", 0.0, 0.0).flag("--docker-socket", "none");
    let robot = robot.flag("--ros-host", "127.0.0.1").flag("--ros-master", &ros.master());
    cluster.join(robot.flag("--config", &config.display().to_string())).await;
    cluster
}

fn reads() -> Value {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/sensors/read.py");
    json!({
        "resources": {"sensors": ["kinect:ImageGen"]},
        "run": {"process": {"command": [python(), script, "kinect:ImageGen", "4"]}},
        "gracePeriodSeconds": 0,
    })
}

fn publish(ros: &Ros, text: &str) -> muster_tests::ros::Program {
    let data = format!("data: {text}");
    ros.spawn("rostopic", &["pub", "-r", "10", "/chatter", "std_msgs/String", &data])
}

/// Waits until a reader has got a frame that ends so; that frame.
async fn hears(cluster: &Cluster, task: &str, text: &str) -> Value {
    wait::until(&format!("{task} hears {text}"), async || {
        let log = cluster.try_task_log(task).await?;
        let mut frames = log.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
        let heard = |frame: &Value| frame["text"].as_str().is_some_and(|said| said.ends_with(text));
        frames.rfind(heard).ok_or(log)
    })
    .await
}

/// Waits until the node says this of its sensors.
async fn told(cluster: &Cluster, status: &str, words: &str) {
    let told = |node: Option<&Node>| {
        let conditions = node.and_then(|node| node.status.as_ref()).map(|s| &s.conditions);
        conditions.into_iter().flatten().any(|condition| {
            condition.r#type == "SensorsReady"
                && format!("{:?}", condition.status) == status
                && condition.message.contains(words)
        })
    };
    wait::object(cluster.nodes().await, "robot", words, told).await;
}

/// Waits until the master does not know the node any more.
async fn unlisted(ros: &Ros, node: &str) {
    wait::until("the subscription's end", async || {
        let nodes = ros.output("rosnode", &["list"]).await;
        if nodes.contains(node) { Err(nodes) } else { Ok(()) }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_topic_is_a_sensor_of_every_task_that_asked() {
    let ros = Ros::start().await;
    let cluster = robot(&ros).await;
    for task in ["a", "b"] {
        cluster.create(task, reads()).await;
    }
    told(&cluster, "False", "nobody publishes /chatter").await;
    let mut talker = publish(&ros, "one");
    for task in ["a", "b"] {
        let frame = hears(&cluster, task, "one").await;
        // A String is its length and its bytes.
        assert_eq!(
            (&frame["length"], &frame["format"]),
            (&json!(7), &json!("ros1:std_msgs/String"))
        );
    }
    told(&cluster, "True", "").await;
    let node = "/muster_sensor_robot_kinect_ImageGen";
    let info = ros.output("rosnode", &["info", node]).await;
    assert_eq!(info.matches("direction: inbound").count(), 1, "one connection for both: {info}");

    // Another publisher, then another master.
    talker.kill().await;
    let mut talker = publish(&ros, "two");
    hears(&cluster, "a", "two").await;
    talker.kill().await;
    ros.kill_core();
    told(&cluster, "False", "the ROS master does not answer").await;
    ros.start_core().await;
    let _talker = publish(&ros, "three");
    for task in ["a", "b"] {
        hears(&cluster, task, "three").await;
    }

    cluster.delete("a").await;
    cluster.delete("b").await;
    // A master on a busy machine may not have answered when the node took its leave: once more.
    for _ in 0..2 {
        if tokio::time::timeout(Duration::from_secs(10), unlisted(&ros, node)).await.is_ok() {
            return;
        }
        cluster.create("a", reads()).await;
        hears(&cluster, "a", "three").await;
        cluster.delete("a").await;
    }
    unlisted(&ros, node).await;
}
