//! A driver that is a topic of ROS 1, behind the gate: a real rospy subscriber that tells who commands it.

use muster_api::kind::node::Node;
use muster_api::phase::TaskPhase;
use muster_tests::ros::Program;
use muster_tests::ros_robot::{self, GATE, gate_pid};
use muster_tests::{Cluster, Ros, kernel, wait};
use serde_json::{Value, json};

/// Waits until the node says this of its actuators.
pub(crate) async fn fenced(cluster: &Cluster, status: &str, words: &str) {
    let told = |node: Option<&Node>| {
        let conditions = node.and_then(|node| node.status.as_ref()).map(|s| &s.conditions);
        conditions.into_iter().flatten().any(|condition| {
            condition.r#type == "ActuatorsFenced"
                && format!("{:?}", condition.status) == status
                && condition.message.contains(words)
        })
    };
    wait::object(cluster.nodes().await, "robot", words, told).await;
}

fn drives(speed: &str) -> Value {
    ros_robot::drives(speed, "20")
}

/// Reads on until the driver is told `speed`; all of it is the gate's word.
pub(crate) async fn told(driver: &mut Program, speed: &str) {
    let wanted = format!("{speed} {GATE}");
    loop {
        let line = driver.line().await;
        assert!(line.ends_with(GATE), "{line}");
        if line == wanted {
            return;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_topic_is_driven_by_the_holder_and_begins_with_a_stop() {
    let ros = Ros::start().await;
    let cluster = ros_robot::join(&ros, json!({})).await;
    fenced(&cluster, "False", "/base_driver does not subscribe /cmd_vel").await;
    let mut driver = ros.script("driver.py", &[]);
    assert_eq!(driver.line().await, format!("0.0 {GATE}"));
    fenced(&cluster, "True", "").await;
    let first = cluster.create("first", drives("0.25")).await;
    told(&mut driver, "0.25").await;
    // Somebody who watches does not disturb, and a driver that begins anew is told to stand first.
    drop(ros.output("rostopic", &["echo", "-n", "2", "/cmd_vel"]).await);
    driver.kill().await;
    let mut driver = ros.script("driver.py", &[]);
    assert_eq!(driver.line().await, format!("0.0 {GATE}"));
    told(&mut driver, "0.25").await;
    // The holder is killed: the robot stands, and is the next one's.
    cluster.create("second", drives("0.5")).await;
    let uid = first.metadata.uid.expect("set by the server");
    for process in kernel::with_env("MUSTER_UID", &uid) {
        kernel::kill(process.pid);
    }
    cluster.phase("first", TaskPhase::Failed).await;
    told(&mut driver, "0.0").await;
    told(&mut driver, "0.5").await;
    // The gate is killed: the next one's first word is a stop.
    kernel::kill(gate_pid(&cluster));
    let next = loop {
        let line = driver.line().await;
        if line != format!("0.5 {GATE}") {
            break line;
        }
    };
    assert_eq!(next, format!("0.0 {GATE}"));
    told(&mut driver, "0.5").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_gate_is_not_ended_and_tells_of_others_who_command() {
    let ros = Ros::start().await;
    let cluster = ros_robot::join(&ros, json!({})).await;
    // Somebody reads in the name of the driver, which is there and does not.
    let mut asleep = ros.script("driver.py", &["/elsewhere"]);
    let mut lend = ros.script("intrude.py", &["lend", "/base_driver", "/cmd_vel"]);
    assert_eq!(lend.line().await, "1");
    fenced(&cluster, "False", "it does not read from /muster_gate").await;
    lend.kill().await;
    asleep.kill().await;
    let mut driver = ros.script("driver.py", &[]);
    cluster.create("first", drives("0.25")).await;
    told(&mut driver, "0.25").await;
    fenced(&cluster, "True", "").await;
    let pid = gate_pid(&cluster);
    let mut end = ros.script("intrude.py", &["end", GATE]);
    assert_eq!(end.line().await, "-1", "it does not end for others");
    told(&mut driver, "0.25").await;
    // Its name is taken, and it takes it back.
    let mut evict = ros.script("intrude.py", &["evict", GATE]);
    assert_eq!(evict.line().await, "1");
    let published = async || {
        let info = ros.output("rostopic", &["info", "/cmd_vel"]).await;
        if info.contains(&format!("Publishers: \n * {GATE} (http")) { Ok(()) } else { Err(info) }
    };
    wait::until("registered again", published).await;
    evict.kill().await;
    told(&mut driver, "0.25").await;
    // The driver is told to read from somebody whom the master does not know.
    let mut push = ros.script("intrude.py", &["push", "/base_driver", "/cmd_vel"]);
    assert_eq!(push.line().await, "1");
    fenced(&cluster, "False", "/base_driver reads /cmd_vel from http://").await;
    push.kill().await;
    fenced(&cluster, "True", "").await;
    let data = "{linear: {x: 9.0}}";
    let args = ["pub", "-r", "5", "/cmd_vel", "geometry_msgs/Twist", data];
    let other = ros.spawn("rostopic", &args);
    fenced(&cluster, "False", "/cmd_vel is published by /rostopic_").await;
    kernel::interrupt(other.pid());
    // It may have been heard, and its word is not the holder's.
    while driver.line().await != format!("0.25 {GATE}") {}
    fenced(&cluster, "True", "").await;
    assert_eq!(gate_pid(&cluster), pid);
}
