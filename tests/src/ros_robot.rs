//! A robot whose driver is a node of ROS (`tests/ros/driver.py`), behind the gate; who drives it, and who attacks it.

use serde_json::{Value, json};

use crate::puppet::python;
use crate::{AgentOptions, Cluster, Ros};

/// The gate's node.
pub const GATE: &str = "/muster_gate_robot_cmd_vel";

const ATTACK: &str = include_str!("../ros/attack.py");

/// The robot, with more in its `agent.yaml`. Silence stops it only after minutes: what it is told does not hang on how busy the
/// machine is.
pub async fn join(ros: &Ros, more: Value) -> Cluster {
    begin(ros, more, &[("--docker-socket", "none")]).await
}

/// The same, with this machine's Docker Engine.
pub async fn join_with_docker(ros: &Ros, more: Value) -> Cluster {
    begin(ros, more, &[]).await
}

async fn begin(ros: &Ros, more: Value, flags: &[(&str, &str)]) -> Cluster {
    let mut cluster = Cluster::start().await;
    let config = cluster.dir().join("agent.yaml");
    let mut settings = json!({"arRes": "base:Drive", "gate": {"drivers": [{
        "actuators": ["base:Drive"],
        "ros1": {"topic": "/cmd_vel", "type": "geometry_msgs/Twist", "node": "/base_driver"},
    }], "ladder": [{"after": "5m", "action": "Stop"}]}});
    for (field, value) in more.as_object().into_iter().flatten() {
        settings[field] = value.clone();
    }
    // JSON is YAML.
    std::fs::write(&config, settings.to_string()).expect("a directory");
    let robot = AgentOptions::bare("robot").flag("--kind", "robot");
    let robot = robot.flag("--ros-host", "127.0.0.1").flag("--ros-master", &ros.master());
    let robot = flags.iter().fold(robot, |robot, (flag, value)| robot.flag(flag, value));
    cluster.join(robot.flag("--config", &config.display().to_string())).await;
    cluster
}

/// A task that drives it so fast, so many times a second.
#[must_use]
pub fn drives(speed: &str, hertz: &str) -> Value {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/ros/drive.py");
    json!({
        "resources": {"actuators": ["base:Drive"]},
        "run": {"process": {"command": [python(), script, speed, hertz]}},
        "gracePeriodSeconds": 0,
    })
}

/// The gate's process.
///
/// # Panics
///
/// When none runs.
#[must_use]
pub fn gate_pid(cluster: &Cluster) -> u32 {
    let lock = cluster.dir().join("robot/gate/lock");
    let pid = std::fs::read_to_string(lock).expect("a gate runs");
    pid.trim().parse().expect("its pid")
}

/// Where a node is, from a line of `rosnode info`, as `contacting node http://127.0.0.1:4711/ ...`.
///
/// # Panics
///
/// When nobody knows it.
pub async fn address(ros: &Ros, node: &str) -> String {
    let info = ros.output("rosnode", &["info", node]).await;
    let line = info.lines().find_map(|line| line.strip_prefix("contacting node "));
    let address = line.and_then(|line| line.split_whitespace().next());
    address.unwrap_or_else(|| panic!("{info}")).to_owned()
}

/// A task of another user that tries so many tricks on master, driver and gate, by their addresses.
pub async fn attacks(ros: &Ros, tries: &str, network: &str) -> Value {
    let (driver, gate) = (address(ros, "/base_driver").await, address(ros, GATE).await);
    // As text: another user may not see this tree.
    let command = json!(["/usr/bin/python3", "-c", ATTACK, ros.master(), driver, gate, tries]);
    json!({
        "run": {"process": {
            "command": command, "user": "65534", "network": network, "workingDir": "/",
        }},
        "gracePeriodSeconds": 0,
    })
}
