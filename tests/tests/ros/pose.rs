//! A robot's pose from ROS at the controller: right to a millimetre, and honest when there is none.

use std::f64::consts::{PI, TAU};
use std::time::Duration;

use muster_api::condition::{ConditionStatus, LOCALIZED, POSE_FRESH};
use muster_api::kind::node::Node;
use muster_tests::ros::Program;
use muster_tests::{AgentOptions, Cluster, Ros, wait};
use serde_json::{Value, json};

/// A robot whose pose comes from a topic.
fn robot(ros: &Ros, topic: &str) -> AgentOptions {
    let mut options = AgentOptions::robot("rover-1", 0.0, 0.0);
    let position = options.flags.iter_mut().find(|f| f.starts_with("static:")).expect("a place");
    *position = format!("ros1:{topic}");
    options.flag("--ros-master", &ros.master()).flag("--ros-host", "127.0.0.1")
}

/// The live pose that `wanted` takes.
async fn live(cluster: &Cluster, what: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    wait::until(what, || async {
        let poses = cluster.get("/apis/muster.dev/v1alpha1/poses").await;
        let pose = poses["items"].get(0).cloned().unwrap_or_default();
        if wanted(&pose) { Ok(pose) } else { Err(format!("{pose} {}", cluster.log_of("rover-1"))) }
    })
    .await
}

fn number(pose: &Value, field: &str) -> f64 {
    pose[field].as_f64().unwrap_or_else(|| panic!("{field} in {pose}"))
}

/// The pose is where the driver was when it sent some message, seen from the map. What it sent can be told from the heading.
fn is_on_the_way(pose: &Value, (mx, my, myaw): (f64, f64, f64)) {
    let x = (number(pose, "yaw") - myaw).rem_euclid(TAU);
    let (sin, cos) = myaw.sin_cos();
    let y = -2.0 * x;
    let expected = (mx + cos * x - sin * y, my + sin * x + cos * y);
    let off = (number(pose, "x") - expected.0).hypot(number(pose, "y") - expected.1);
    assert!(off < 1e-3, "{off} m off: {pose}, not {expected:?}");
}

/// The robot has driven on.
async fn follows(cluster: &Cluster, place: (f64, f64, f64)) {
    let localized = |pose: &Value| pose["localized"] == true;
    let first = live(cluster, "localized", localized).await;
    is_on_the_way(&first, place);
    let later =
        live(cluster, "moving", |pose| localized(pose) && pose["yaw"] != first["yaw"]).await;
    is_on_the_way(&later, place);
}

/// Waits for a condition, and gives its message.
async fn condition(cluster: &Cluster, name: &str, status: ConditionStatus, reason: &str) -> String {
    let find = |node: &Node| node.status.as_ref()?.condition(name).cloned();
    let is = |node: Option<&Node>| {
        node.and_then(find).is_some_and(|c| c.status == status && c.reason == reason)
    };
    let node =
        wait::object(cluster.nodes().await, "rover-1", &format!("{name} {reason}"), is).await;
    node.as_ref().and_then(find).expect("it was found").message
}

/// Ends the agent's node in ROS, and every other one that comes after it.
async fn keep_ending_the_node(ros: &Ros) {
    let mut ticks = tokio::time::interval(Duration::from_secs(15));
    loop {
        ticks.tick().await;
        // When the node is not there yet, there is nothing to end.
        drop(ros.command("rosnode").args(["kill", "/muster_agent_rover_1"]).output().await);
    }
}

fn drive(ros: &Ros, arguments: &[&str], environment: &[(&str, &str)]) -> Program {
    ros.script_with("odometry.py", arguments, environment)
}

#[tokio::test(flavor = "multi_thread")]
async fn odometry_through_a_turned_frame_is_right_to_a_millimetre_and_its_loss_is_told() {
    let (ros, mut cluster) = (Ros::start().await, Cluster::start().await);
    let options =
        robot(&ros, "odom").flag("--ros-namespace", "/r1").flag("--map-to-odom", "12.5,-3.25,2.5");
    let place = (12.5, -3.25, 2.5);
    cluster.join(options.flag("--map", "lab")).await;
    let why = condition(&cluster, POSE_FRESH, ConditionStatus::False, "NoPublisher").await;
    assert_eq!(why, "nobody publishes /r1/odom");

    let mut driver = drive(&ros, &["odometry", "/r1/odom", "30", "0.04"], &[]);
    follows(&cluster, place).await;
    let pose = live(&cluster, "there", |pose| pose["localized"] == true).await;
    assert_eq!((&pose["source"], &pose["map"]), (&json!("ros1:odom"), &json!("lab")));
    assert!(
        (number(&pose["covariance"], "xx") - 0.04).abs() < 1e-9 && pose["stamp"].is_string(),
        "{pose}"
    );
    condition(&cluster, POSE_FRESH, ConditionStatus::True, "Fresh").await;
    condition(&cluster, LOCALIZED, ConditionStatus::True, "Localized").await;

    // The publisher dies without a word: the master goes on to name it.
    driver.kill().await;
    condition(&cluster, POSE_FRESH, ConditionStatus::False, "PublisherUnreachable").await;
    condition(&cluster, LOCALIZED, ConditionStatus::False, "PoseNotFresh").await;
    live(&cluster, "lost", |pose| pose["localized"] == false).await;
    let spec = json!({
        "placement": {"at": {"map": "lab", "x": 12.0, "y": -3.0}, "within": 1000.0, "on": "Robot"},
        "run": {"process": {"command": ["sleep", "1000"]}},
        "gracePeriodSeconds": 0,
    });
    cluster.create("look", spec).await;
    let lost =
        |s: &muster_api::kind::task::TaskStatus| s.why.iter().any(|w| w.reason == "NotLocalized");
    cluster.task("look", "waiting for a robot that knows where it is", lost).await;

    let _driver = drive(&ros, &["odometry", "/r1/odom", "30", "0.04"], &[]);
    cluster.task("look", "bound", |s| s.node.is_some()).await;
    follows(&cluster, place).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_master_that_is_started_anew_is_found_again() {
    let (ros, mut cluster) = (Ros::start().await, Cluster::start().await);
    cluster.join(robot(&ros, "/odom")).await;
    let mut driver = drive(&ros, &["odometry", "/odom", "30"], &[]);
    follows(&cluster, (0.0, 0.0, 0.0)).await;
    // Data does not pass the master: what is connected stays so, and the robot is localized.
    ros.kill_core();
    follows(&cluster, (0.0, 0.0, 0.0)).await;
    // rospy does not register again; the new master knows nothing of the driver, which drives on all the same.
    ros.start_core().await;
    let known = async || ros.output("rosnode", &["list"]).await.contains("/muster_agent_rover_1");
    wait::until("registered again", || async {
        known().await.then_some(()).ok_or_else(String::new)
    })
    .await;
    follows(&cluster, (0.0, 0.0, 0.0)).await;
    driver.kill().await;
    condition(&cluster, POSE_FRESH, ConditionStatus::False, "NoPublisher").await;
    ros.kill_core();
    let why = condition(&cluster, POSE_FRESH, ConditionStatus::False, "NoMaster").await;
    // It refused the connection, or reset it in the middle of a question.
    assert!(why.contains(&ros.master()), "{why}");
    ros.start_core().await;
    condition(&cluster, POSE_FRESH, ConditionStatus::False, "NoPublisher").await;
    let _driver = drive(&ros, &["odometry", "/odom", "30"], &[]);
    follows(&cluster, (0.0, 0.0, 0.0)).await;
    // Somebody ends the agent's node in ROS: it comes back. That it is gone is shown for some seconds: one that was missed
    // is made again.
    tokio::select! {
        _ = condition(&cluster, POSE_FRESH, ConditionStatus::False, "NotRunning") => {}
        () = keep_ending_the_node(&ros) => {}
    }
    follows(&cluster, (0.0, 0.0, 0.0)).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn transforms_are_composed_over_the_tree() {
    let (ros, mut cluster) = (Ros::start().await, Cluster::start().await);
    let place = (-4.0, 7.5, PI / 3.0);
    let _driver = drive(
        &ros,
        &["tf", "/tf", "40"],
        &[("MAP", &format!("{},{},{}", place.0, place.1, place.2))],
    );
    cluster.join(robot(&ros, "/tf")).await;
    follows(&cluster, place).await;
    condition(&cluster, LOCALIZED, ConditionStatus::True, "Localized").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn localisation_that_is_not_sure_takes_the_robot_out() {
    let (ros, mut cluster) = (Ros::start().await, Cluster::start().await);
    let mut driver = drive(&ros, &["amcl", "/amcl_pose", "10", "0.16"], &[]);
    cluster.join(robot(&ros, "/amcl_pose").flag("--pose-max-deviation", "0.5")).await;
    follows(&cluster, (0.0, 0.0, 0.0)).await;
    driver.kill().await;
    let _driver = drive(&ros, &["amcl", "/amcl_pose", "10", "0.36"], &[]);
    let why = condition(&cluster, LOCALIZED, ConditionStatus::False, "TooUncertain").await;
    assert_eq!(why, "the position's standard deviation is above 0.5 m");
    condition(&cluster, POSE_FRESH, ConditionStatus::True, "Fresh").await;
    // A topic that tells no place says what it is.
    cluster.kill_agent("rover-1");
    let _chatter =
        ros.spawn("rostopic", &["pub", "-r", "10", "/chatter", "std_msgs/String", "data: x"]);
    cluster.set_flag("rover-1", "ros1:/amcl_pose", "ros1:/chatter");
    cluster.restart_agent("rover-1").await;
    let why = condition(&cluster, POSE_FRESH, ConditionStatus::False, "UnknownType").await;
    assert!(why.contains("/chatter is of type std_msgs/String"), "{why}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_simulations_clock_is_followed() {
    let (ros, mut cluster) = (Ros::start().await, Cluster::start().await);
    drop(ros.output("rosparam", &["set", "/use_sim_time", "true"]).await);
    let _driver = drive(&ros, &["odometry", "/odom", "30"], &[("SIM", "1")]);
    cluster.join(robot(&ros, "/odom")).await;
    follows(&cluster, (0.0, 0.0, 0.0)).await;
    let pose = live(&cluster, "there", |pose| pose["localized"] == true).await;
    let stamp: jiff::Timestamp = pose["stamp"].as_str().expect("a stamp").parse().expect("a time");
    let off = jiff::Timestamp::now().duration_since(stamp).as_secs();
    assert!(off.abs() < 60, "by this machine's clock, not an hour after the epoch: {pose}");
}
