//! A driver that is a node of ROS, behind the gate: how soon a gate that was killed is back with its stop, and whether a task that
//! attacks disturbs the holder's stream.
//!
//! The driver is rospy, whose lines this process reads; the floor of the stream is the same stream beside a task that is as busy and
//! attacks nobody.

use std::time::{Duration, Instant};

use muster_tests::ros::Program;
use muster_tests::ros_robot::{self, GATE, attacks, drives, gate_pid};
use muster_tests::{Ros, kernel};
use serde_json::json;

use crate::stats::{Samples, figure, millis};

const ROUNDS: usize = 20;

/// Commands of the holder's, fifty a second.
const STREAM: usize = 1_000;

/// More than there is time for.
const TRIES: &str = "1000000";

pub(crate) async fn all() {
    let ros = Ros::start().await;
    let cluster = ros_robot::join(&ros, json!({})).await;
    let mut driver = ros.script("driver.py", &[]);
    until(&mut driver, "0.0").await;
    cluster.create("holder", drives("0.25", "50")).await;
    let mut stops = Samples::default();
    for _ in 0..ROUNDS {
        until(&mut driver, "0.25").await;
        let begun = Instant::now();
        kernel::kill(gate_pid(&cluster));
        until(&mut driver, "0.0").await;
        stops.push(begun.elapsed());
    }
    stops.line("gate killed until rospy reads the stop");
    figure("p99 to the driver's stop", millis(stops.quantile(0.99)), " ms", "<= 250 ms");
    let command = ["sh", "-c", "while :; do :; done"];
    cluster.create("busy", json!({"run": {"process": {"command": command}}})).await;
    let floor = jitter(&mut driver).await;
    floor.line("floor: jitter of the holder's stream beside a busy task");
    cluster.delete("busy").await;
    cluster.create("attacker", attacks(&ros, TRIES, "None").await).await;
    let attacked = jitter(&mut driver).await;
    attacked.line("the same under attack");
    let ratio = attacked.quantile(0.5).as_secs_f64() / floor.quantile(0.5).as_secs_f64();
    figure("median under attack / floor", ratio, "x", "<= 1.1x");
}

/// Reads on until the driver is told so.
async fn until(driver: &mut Program, speed: &str) {
    let wanted = format!("{speed} {GATE}");
    while driver.line().await != wanted {}
}

/// How far apart commands arrive, against how far apart they are given.
async fn jitter(driver: &mut Program) -> Samples {
    let mut samples = Samples::default();
    until(driver, "0.25").await;
    let mut last = Instant::now();
    for _ in 0..STREAM {
        until(driver, "0.25").await;
        samples.push((last.elapsed()).abs_diff(Duration::from_millis(20)));
        last = Instant::now();
    }
    samples
}
