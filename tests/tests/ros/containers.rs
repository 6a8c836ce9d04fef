//! Containers with ROS in them: what roslaunch starts there is in the robot's graph and leaves it when it is told to end; and a
//! container has a graph of its own as a process has.

use muster_tests::docker::{BARE_IMAGE, bare_image, containers_of};
use muster_tests::ros_robot;
use muster_tests::{Ros, wait};
use serde_json::{Value, json};

use crate::gate::{fenced, told};
use crate::view::said;

/// A container with the node's own ROS, and with more of the node's directories.
fn container(command: &Value, network: &str, more: &[&str]) -> Value {
    bare_image();
    let system = ["/usr", "/etc/alternatives", "/etc/passwd", "/etc/ros"].into_iter();
    let there =
        system.chain(more.iter().copied()).filter(|path| std::path::Path::new(path).exists());
    let mount = |path: &str| json!({"hostPath": path, "mountPath": path, "readOnly": true});
    let mounts: Vec<Value> = there.map(mount).collect();
    json!({"container": {
        "image": BARE_IMAGE, "pullPolicy": "Never", "command": command, "network": network, "mounts": mounts,
        "env": [
            {"name": "PATH", "value": "/usr/local/bin:/usr/bin:/bin"}, {"name": "ROS_HOME", "value": "/tmp/ros"},
            {"name": "PYTHONUNBUFFERED", "value": "1"},
        ],
    }})
}

#[tokio::test(flavor = "multi_thread")]
async fn roslaunch_in_a_container_is_in_the_robots_graph_and_leaves_it() {
    let ros = Ros::start().await;
    let cluster = ros_robot::join_with_docker(&ros, json!({})).await;
    let file = ros.dir().join("test.launch");
    std::fs::write(&file, crate::tasks::LAUNCH).expect("a directory");
    let command = json!(["roslaunch", file]);
    let dir = ros.dir().display().to_string();
    let patrol = json!({
        "ros": {"namespace": "/patrol"},
        "run": container(&command, "Host", &[&dir]),
        "gracePeriodSeconds": 30,
    });
    let patrol = cluster.create("patrol", patrol).await;
    crate::tasks::there(&ros, "/patrol").await;
    cluster.delete("patrol").await;
    wait::until("its node has left", async || {
        let nodes = ros.output("rosnode", &["list"]).await;
        if nodes.contains("/patrol/") { Err(nodes) } else { Ok(()) }
    })
    .await;
    let uid = patrol.metadata.uid.expect("set by the server");
    wait::until("the container's end", async || {
        let left = containers_of(&uid);
        if left.is_empty() { Ok(()) } else { Err(format!("{left:?}")) }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_container_has_a_graph_of_its_own() {
    let ros = Ros::start().await;
    let sensors = json!([{"function": crate::view::SENSOR, "ros1": "/odom"}]);
    let more = json!({"srRes": crate::view::SENSOR, "sensors": sensors});
    let cluster = ros_robot::join_with_docker(&ros, more).await;
    let mut driver = ros.script("driver.py", &[]);
    let _odometry = ros.script("odometry.py", &["odometry", "/odom", "10"]);
    fenced(&cluster, "True", "").await;
    let command = json!(["sh", "-c", crate::view::both("0.25")]);
    let scripts = concat!(env!("CARGO_MANIFEST_DIR"), "/ros");
    let viewer = json!({
        "ros": {"master": "View"},
        "resources": {"actuators": ["base:Drive"], "sensors": [crate::view::SENSOR]},
        "run": container(&command, "None", &[scripts]),
        "gracePeriodSeconds": 0,
    });
    cluster.create("viewer", viewer).await;
    said(&cluster, "viewer", "chatter one", 1).await;
    said(&cluster, "viewer", "odom ", 1).await;
    told(&mut driver, "0.25").await;
    let nodes = ros.output("rosnode", &["list"]).await;
    assert!(!nodes.contains("/viewer") && nodes.contains("/base_driver"), "{nodes}");
    cluster.delete("viewer").await;
    told(&mut driver, "0.0").await;
}
