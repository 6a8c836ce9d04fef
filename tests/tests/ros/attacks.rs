//! Somebody who is not the holder tries to move a robot whose driver is a ROS node: a task with a network of its own, as another
//! user, that knows every address. Nothing of it arrives, and the holder drives on.

use muster_ros1::xmlrpc::Value as Said;
use muster_ros1::xmlrpc::http::{Uri, invoke};
use muster_tests::ros::Program;
use muster_tests::ros_robot::{self, GATE, address, attacks, drives};
use muster_tests::{Cluster, Ros, wait};
use serde_json::json;

use crate::gate::{fenced, told};

/// Tricks that are tried.
const TRIES: &str = "10000";

/// The same by a task that has a ROS master of its own.
const FEWER: &str = "1000";

/// Waits for what an attacker says in the end: how many of its tries were answered.
async fn reached(cluster: &Cluster, task: &str, tries: &str) -> u64 {
    let said = wait::until("its tries", async || {
        let log = cluster.try_task_log(task).await?;
        let prefix = format!("{tries} ");
        log.lines().find_map(|line| line.strip_prefix(&prefix)?.parse().ok()).ok_or(log)
    });
    said.await
}

/// The driver hears this speed so many times more, and nothing else but a stop, which the gate gives when the agent cannot speak
/// for seconds, as on a machine that is too busy.
async fn drives_on(driver: &mut Program, speed: &str, times: usize) {
    let (moves, stands) = (format!("{speed} {GATE}"), format!("0.0 {GATE}"));
    let mut heard = 0;
    while heard < times {
        let line = driver.line().await;
        assert!(line == moves || line == stands, "{line}");
        heard += usize::from(line == moves);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn who_does_not_hold_the_robot_gets_nothing_through() {
    let ros = Ros::start().await;
    let cluster = ros_robot::join(&ros, json!({})).await;
    let mut driver = ros.script("driver.py", &[]);
    fenced(&cluster, "True", "").await;
    cluster.create("holder", drives("0.25", "20")).await;
    told(&mut driver, "0.25").await;
    cluster.create("attacker", attacks(&ros, TRIES, "None").await).await;
    let mut viewer = attacks(&ros, FEWER, "Host").await;
    viewer["ros"] = json!({"master": "View"});
    cluster.create("viewer", viewer).await;
    drives_on(&mut driver, "0.25", 40).await;
    assert_eq!(reached(&cluster, "attacker", TRIES).await, 0);
    assert_eq!(reached(&cluster, "viewer", FEWER).await, 0);
    drives_on(&mut driver, "0.25", 10).await;
    fenced(&cluster, "True", "").await;
    // The holder too has no other way than the gate.
    cluster.delete("attacker").await;
    cluster.delete("holder").await;
    told(&mut driver, "0.0").await;
    let mut alone = drives("0.5", "20");
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
    let cluster = ros_robot::join(&ros, json!({})).await;
    let mut driver = ros.script("driver.py", &[]);
    fenced(&cluster, "True", "").await;
    let gate: Uri = address(&ros, GATE).await.parse().expect("an address");
    let lease = "/apis/muster.dev/v1alpha1/leases/robot.body";
    let mut heard = 0;
    for speed in ["0.25", "0.5", "0.75"] {
        let before = format!("holder-{heard}");
        cluster.create(&before, drives(speed, "200")).await;
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
