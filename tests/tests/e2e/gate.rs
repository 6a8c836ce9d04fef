//! A robot's driver behind the gate: the holder alone drives, a person stops the robot whoever holds it, and what is lost leaves a
//! robot that stands.

use std::path::PathBuf;

use muster_api::kind::node::Node;
use muster_api::phase::TaskPhase;
use muster_tests::puppet::python;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::json;

use crate::cli::muster;

/// A robot whose driver writes down what it hears.
pub(crate) struct Robot {
    heard: PathBuf,
}

impl Robot {
    pub(crate) async fn join(cluster: &mut Cluster) -> Robot {
        let (heard, config) = (cluster.dir().join("heard"), cluster.dir().join("agent.yaml"));
        let gate = json!({"gate": {"drivers": [{
            "actuators": ["base:Drive", "arm:Grasp"],
            "exec": ["sh", "-c", format!("exec cat >> {}", heard.display())],
            "stop": "stop",
        }]}});
        // JSON is YAML.
        std::fs::write(&config, gate.to_string()).expect("the directory is there");
        let options = AgentOptions::robot("robot", 0.0, 0.0);
        cluster.join(options.flag("--config", &config.display().to_string())).await;
        Robot { heard }
    }

    pub(crate) fn heard(&self) -> Vec<String> {
        let text = std::fs::read_to_string(&self.heard).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }

    /// Waits until the newest word of the driver's is this.
    pub(crate) async fn wait(&self, word: &str) {
        let last = async || match self.heard().pop() {
            Some(last) if last == word => Ok(()),
            last => Err(format!("{last:?}")),
        };
        wait::until(word, last).await;
    }
}

pub(crate) fn drive() -> serde_json::Value {
    let program = concat!(env!("CARGO_MANIFEST_DIR"), "/frameworks/drive.py");
    json!({
        "resources": {"actuators": ["base:Drive"]},
        "run": {"process": {"command": [python(), program]}},
        "gracePeriodSeconds": 0,
    })
}

pub(crate) async fn condition(cluster: &Cluster, name: &str, status: &str) -> String {
    let found = |node: Option<&Node>| {
        let conditions = &node?.status.as_ref()?.conditions;
        let found = conditions.iter().find(|c| c.r#type == name)?;
        (format!("{:?}", found.status) == status).then(|| found.message.clone())
    };
    let what = format!("{name}={status}");
    let node = wait::object(cluster.nodes().await, "robot", &what, |n| found(n).is_some()).await;
    found(node.as_ref()).expect("it was seen")
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_is_driven_by_its_holder_and_stopped_by_a_person() {
    let mut cluster = Cluster::start().await;
    let robot = Robot::join(&mut cluster).await;
    condition(&cluster, "ActuatorsFenced", "True").await;
    let first = cluster.create("first", drive()).await;
    cluster.phase("first", TaskPhase::Running).await;
    robot.wait("go first").await;

    // A person stops it. The holder stays the holder, and nothing of it passes.
    let said = muster(&cluster, &["estop", "robot", "--timeout", "60s"]);
    assert_eq!((said.0, said.1.as_str()), (0, "node/robot stopped (Settle)\n"), "{}", said.2);
    // The driver has it by now, and writes it down a moment later.
    robot.wait("stop").await;
    let heard = robot.heard();
    assert_eq!(heard.last().map(String::as_str), Some("stop"));
    let message = condition(&cluster, "EmergencyStop", "True").await;
    assert!(message.contains("Settle by the controller"), "{message}");
    // The controller's end changes nothing.
    cluster.kill_controller();
    cluster.start_controller().await;
    condition(&cluster, "EmergencyStop", "True").await;
    // It may be told to stop again.
    let since = robot.heard().split_off(heard.len());
    assert!(since.iter().all(|word| word == "stop"), "it stood all the time: {since:?}");
    let said = muster(&cluster, &["estop", "--all", "--release", "--timeout", "60s"]);
    assert_eq!((said.0, said.1.as_str()), (0, "node/robot released\n"), "{}", said.2);
    robot.wait("go first").await;

    // The holder is killed while it drives: the robot stands, and the next one drives when it is gone.
    cluster.create("second", drive()).await;
    let uid = first.metadata.uid.expect("set by the server");
    for process in kernel::with_env("MUSTER_UID", &uid) {
        kernel::kill(process.pid);
    }
    cluster.phase("first", TaskPhase::Failed).await;
    robot.wait("go second").await;
    let heard = robot.heard();
    let last = heard.iter().rposition(|word| word == "go first").expect("it drove");
    assert_eq!(heard[last + 1], "stop");
    assert!(!heard[last + 1..].contains(&"go first".to_owned()));
}
