//! Tasks whose environment says where ROS is: nodes that roslaunch starts are in the robot's graph.

use muster_tests::{AgentOptions, Cluster, Ros, kernel, wait};
use serde_json::{Value, json};

/// Starts a node and sets a parameter, both with relative names.
pub(crate) const LAUNCH: &str = r#"<launch>
  <param name="speed" value="0.5"/>
  <node pkg="rosout" type="rosout" name="logger"/>
</launch>
"#;

async fn one_robot(ros: &Ros) -> Cluster {
    let mut cluster = Cluster::start().await;
    let robot = AgentOptions::robot("robot", 0.0, 0.0).flag("--docker-socket", "none");
    let robot = robot.flag("--ros-host", "127.0.0.1").flag("--ros-master", &ros.master());
    cluster.join(robot.flag("--ros-namespace", "/robot")).await;
    cluster
}

fn launches(ros: &Ros, of: Value) -> Value {
    let file = ros.dir().join("test.launch");
    std::fs::write(&file, LAUNCH).expect("a directory");
    let home = ros.dir().display().to_string();
    json!({
        "ros": of,
        "run": {"process": {
            "command": ["roslaunch", file],
            "env": [{"name": "ROS_HOME", "value": home}],
        }},
        "gracePeriodSeconds": 30,
    })
}

/// Waits until a node answers at the robot's address, and has set its parameter.
pub(crate) async fn there(ros: &Ros, namespace: &str) {
    let node = format!("{namespace}/logger");
    wait::until(&node, async || {
        let nodes = ros.output("rosnode", &["list"]).await;
        if nodes.lines().any(|line| line == node) { Ok(()) } else { Err(nodes) }
    })
    .await;
    let info = ros.output("rosnode", &["info", &node]).await;
    assert!(info.contains("contacting node http://127.0.0.1:"), "{info}");
    let speed = ros.output("rosparam", &["get", &format!("{namespace}/speed")]).await;
    assert_eq!(speed.trim(), "0.5");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_roslaunch_starts_is_in_the_robots_graph() {
    let ros = Ros::start().await;
    let cluster = one_robot(&ros).await;
    let mut patrol = launches(&ros, json!({"namespace": "/patrol"}));
    patrol["stopSignal"] = json!("SIGINT");
    let patrol = cluster.create("patrol", patrol).await;
    there(&ros, "/patrol").await;
    // Where nothing is said of a namespace it is the agent's; and a master may be named.
    cluster.create("other", launches(&ros, json!({"master": ros.master()}))).await;
    there(&ros, "/robot").await;
    // All of it ends, in order, and nothing of the other.
    cluster.delete("patrol").await;
    let uid = patrol.metadata.uid.expect("set by the server");
    wait::until("its nodes' end", async || {
        let left = kernel::with_env("MUSTER_UID", &uid);
        if left.is_empty() { Ok(()) } else { Err(format!("{left:?}")) }
    })
    .await;
    let nodes = ros.output("rosnode", &["list"]).await;
    assert!(!nodes.contains("/patrol/"), "{nodes}");
    there(&ros, "/robot").await;
}
