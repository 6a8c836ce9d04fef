//! A task with a ROS master of its own: its nodes find each other, its sensor is a topic, its commands pass the gate, and the graph
//! outlasts the agent.

use muster_tests::ros_robot::{self, drives};
use muster_tests::{Cluster, Ros, wait};
use serde_json::{Value, json};

use crate::gate::{fenced, told};

pub(crate) const SENSOR: &str = "wheels:Odometry";

async fn robot(ros: &Ros) -> Cluster {
    let sensors = json!([{"function": SENSOR, "ros1": "/odom"}]);
    ros_robot::join(ros, json!({"srRes": SENSOR, "sensors": sensors})).await
}

/// Two programs: one that says something, and `view.py`.
pub(crate) fn both(speed: &str) -> String {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/ros/view.py");
    // A tool of ROS's ends when there is no master yet.
    format!(
        "until rostopic pub -r 5 /chatter std_msgs/String 'data: one'; do :; done & \
         exec /usr/bin/python3 {script} {speed}"
    )
}

fn views(ros: &Ros, speed: &str) -> Value {
    let logs = ros.dir().join("tasks").display().to_string();
    json!({
        "ros": {"master": "View"},
        "resources": {"actuators": ["base:Drive"], "sensors": [SENSOR]},
        "run": {"process": {
            "command": ["sh", "-c", both(speed)],
            "env": [{"name": "ROS_LOG_DIR", "value": logs}],
        }},
        "gracePeriodSeconds": 0,
    })
}

fn count(log: &str, word: &str) -> usize {
    log.lines().filter(|line| line.starts_with(word)).count()
}

/// Waits until the task has said `word` so often.
pub(crate) async fn said(cluster: &Cluster, task: &str, word: &str, times: usize) {
    wait::until(word, async || {
        let log = cluster.try_task_log(task).await?;
        if count(&log, word) >= times { Ok(()) } else { Err(log) }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_has_a_graph_of_its_own_which_outlasts_the_agent() {
    let ros = Ros::start().await;
    let mut cluster = robot(&ros).await;
    let mut driver = ros.script("driver.py", &[]);
    let _odometry = ros.script("odometry.py", &["odometry", "/odom", "10"]);
    fenced(&cluster, "True", "").await;
    cluster.create("viewer", views(&ros, "0.25")).await;
    said(&cluster, "viewer", "chatter one", 1).await;
    said(&cluster, "viewer", "odom ", 1).await;
    told(&mut driver, "0.25").await;
    // Nothing of it is in the robot's graph.
    let nodes = ros.output("rosnode", &["list"]).await;
    assert!(!nodes.contains("/viewer") && nodes.contains("/base_driver"), "{nodes}");
    // The agent is killed: the robot stands, and drives on when the next one has the task's graph again. Its nodes do not register
    // anew: that the sensor comes again says that the master knows them.
    cluster.kill_agent("robot");
    told(&mut driver, "0.0").await;
    cluster.restart_agent("robot").await;
    told(&mut driver, "0.25").await;
    let heard = cluster.task_log("viewer").await;
    said(&cluster, "viewer", "odom ", count(&heard, "odom ") + 20).await;
    said(&cluster, "viewer", "chatter one", count(&heard, "chatter one") + 1).await;
    fenced(&cluster, "True", "").await;
    // It loses the robot to a person, and nothing of it passes, though it goes on.
    let take = "/apis/muster.dev/v1alpha1/leases/robot.body/take";
    cluster.post(take, &json!({"reason": "stuck in a door"})).await;
    told(&mut driver, "0.0").await;
    let heard = cluster.task_log("viewer").await;
    said(&cluster, "viewer", "odom ", count(&heard, "odom ") + 20).await;
    cluster.post(&take.replace("take", "return"), &json!({})).await;
    cluster.create("next", drives("0.5", "20")).await;
    loop {
        let line = driver.line().await;
        assert!(!line.starts_with("0.25 "), "{line}");
        if line.starts_with("0.5 ") {
            break;
        }
    }
}
