//! Somebody who is not the holder tries to move a robot whose driver is a ROS node: a task with a network of its own, as another
//! user, that knows every address. Nothing of it arrives, and the holder drives on.

use muster_ros1::xmlrpc::Value as Said;
use muster_ros1::xmlrpc::http::{Uri, invoke};
use muster_tests::ros::Program;
use muster_tests::{Cluster, Ros, wait};
use serde_json::{Value, json};

use crate::gate::{GATE, drives, drives_at, fenced, robot, told};

const SCRIPT: &str = include_str!("../../ros/attack.py");

/// Tricks that are tried.
const TRIES: &str = "10000";

/// An address from a line of `rosnode info`, as `contacting node http://127.0.0.1:4711/ ...`.
async fn address(ros: &Ros, node: &str) -> String {
    let info = ros.output("rosnode", &["info", node]).await;
    let line = info.lines().find_map(|line| line.strip_prefix("contacting node "));
    let address = line.and_then(|line| line.split_whitespace().next());
    address.unwrap_or_else(|| panic!("{info}")).to_owned()
}

async fn attacks(ros: &Ros, tries: &str, network: &str) -> Value {
    let (driver, gate) = (address(ros, "/base_driver").await, address(ros, GATE).await);
    // As text: another user may not see this tree.
    let command = json!(["/usr/bin/python3", "-c", SCRIPT, ros.master(), driver, gate, tries]);
    json!({
        "run": {"process": {
            "command": command, "user": "65534", "network": network, "workingDir": "/",
        }},
        "gracePeriodSeconds": 0,
    })
}

/// Waits for what an attacker says in the end: how many of its tries were answered.
async fn reached(cluster: &Cluster, task: &str, tries: &str) -> u64 {
    let said = wait::until("its tries", async || {
        let log = cluster.try_task_log(task).await?;
        let prefix = format!("{tries} ");
        log.lines().find_map(|line| line.strip_prefix(&prefix)?.parse().ok()).ok_or(log)
    });
    said.await
}

/// The next so many words of the driver's are this speed, and the gate's.
async fn drives_on(driver: &mut Program, speed: &str, times: usize) {
    for _ in 0..times {
        let line = driver.line().await;
        assert_eq!(line, format!("{speed} {GATE}"));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn who_does_not_hold_the_robot_gets_nothing_through() {
    let ros = Ros::start().await;
    let cluster = robot(&ros).await;
    let mut driver = ros.script("driver.py", &[]);
    fenced(&cluster, "True", "").await;
    cluster.create("holder", drives("0.25")).await;
    told(&mut driver, "0.25").await;
    cluster.create("attacker", attacks(&ros, TRIES, "None").await).await;
    // Every word of these is the holder's, and none is a stop.
    drives_on(&mut driver, "0.25", 40).await;
    assert_eq!(reached(&cluster, "attacker", TRIES).await, 0);
    drives_on(&mut driver, "0.25", 10).await;
    fenced(&cluster, "True", "").await;
    // The holder too has no other way than the gate.
    cluster.delete("attacker").await;
    cluster.delete("holder").await;
    told(&mut driver, "0.0").await;
    let mut alone = drives("0.5");
    alone["run"]["process"]["network"] = "None".into();
    cluster.create("alone", alone).await;
    told(&mut driver, "0.5").await;
    // That there is something to reach: the same tricks in the node's own network are answered.
    cluster.create("neighbour", attacks(&ros, "3", "Host").await).await;
    assert_eq!(reached(&cluster, "neighbour", "3").await, 3);
}

/// How many messages the gate has given to its only subscriber.
async fn given(gate: &Uri) -> usize {
    let stats =
        invoke(gate, "getBusStats", &["/test".into()]).await.expect("the gate's node answers");
    let at = |value: &Said, index: usize| value.as_array().expect("a list")[index].clone();
    let topic = at(&at(&at(&stats, 2), 0), 0);
    let connections = at(&topic, 2);
    assert_eq!(connections.as_array().map(<[Said]>::len), Some(1), "{stats:?}");
    let Said::Int(messages) = at(&at(&connections, 0), 2) else { panic!("{stats:?}") };
    usize::try_from(messages).expect("a number of messages")
}

/// What the driver is told after the reply to whoever took the robot: counted, for the driver may read late what was sent before.
#[tokio::test(flavor = "multi_thread")]
async fn whoever_lost_the_robot_gets_nothing_through_from_the_reply_on() {
    let ros = Ros::start().await;
    let cluster = robot(&ros).await;
    let mut driver = ros.script("driver.py", &[]);
    fenced(&cluster, "True", "").await;
    let gate: Uri = address(&ros, GATE).await.parse().expect("an address");
    let lease = "/apis/muster.dev/v1alpha1/leases/robot.body";
    let mut heard = 0;
    for speed in ["0.25", "0.5", "0.75"] {
        let before = format!("holder-{heard}");
        cluster.create(&before, drives_at(speed, "200")).await;
        let (moves, stands) = (format!("{speed} {GATE}"), format!("0.0 {GATE}"));
        let mut line = driver.line().await;
        heard += 1;
        while line != moves {
            assert_eq!(line, stands, "the former holder's");
            line = driver.line().await;
            heard += 1;
        }
        cluster.post(&format!("{lease}/take"), &json!({"reason": "stuck in a door"})).await;
        let by_the_reply = given(&gate).await;
        // It goes on commanding.
        wait::until("its commands are refused", async || {
            let log = cluster.try_task_log(&before).await?;
            if log.contains("REVOKED") { Ok(()) } else { Err(log) }
        })
        .await;
        let all = given(&gate).await;
        assert!(all >= by_the_reply && by_the_reply >= heard, "{all} {by_the_reply} {heard}");
        while heard < all {
            let line = driver.line().await;
            heard += 1;
            assert!(line == stands || line == moves && heard <= by_the_reply, "{heard}: {line}");
        }
        cluster.delete(&before).await;
        cluster.post(&format!("{lease}/return"), &json!({})).await;
    }
}
