//! A simulated robot: its gate, its simulator, and a task that drives it, reads a sensor and has a graph of ROS.

use muster_api::phase::TaskPhase;
use muster_failpoint::Failpoint;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::{Value, json};

use crate::crash::{Crash, moments, nothing_half};

const WORLD: &str = "
walls:
  - {line: [[0, 0], [6, 0], [6, 4], [0, 4], [0, 0]]}
robot: {start: [1, 2, 0], radius: 0.2, speed: 1.0}
laser: {from: -0.5, to: 0.5, rays: 11, nearest: 0.05, farthest: 10, deviation: 0, hz: 20}
battery: {capacity: 40, charge: 80}
";

const AGENT: &str = "
kind: robot
srRes: kinect:LaserGen
arRes: base:Drive
position: sim:world.yaml
sensors:
  - {function: 'kinect:LaserGen', sim: Laser}
gate:
  drivers: [{actuators: ['base:Drive'], sim: Base}]
";

pub(crate) async fn robot(points: &[Failpoint]) {
    let mut cluster = Cluster::start().await;
    let file = |name: &str, text: &str| {
        let path = cluster.dir().join(name);
        std::fs::write(&path, text).expect("the directory is there");
        path
    };
    file("world.yaml", WORLD);
    let config = file("agent.yaml", AGENT).display().to_string();
    let flags = vec!["--config".to_owned(), config];
    let options = AgentOptions { flags, ..AgentOptions::bare("robot") };
    cluster.join(options.flag("--docker-socket", "none")).await;
    for (number, moment) in moments(points).into_iter().enumerate() {
        let crash = Crash::at(&mut cluster, "robot", moment, 1);
        // What stays when the agent goes is started by the next one then, and dies where it is to.
        cluster.kill_agent("robot");
        for beside in ["gate", "sim"] {
            let dir = cluster.dir().join("robot").join(beside).display().to_string();
            kernel::with_command(&dir).into_iter().for_each(kernel::kill);
        }
        cluster.spawn_agent("robot", None);
        let name = format!("t{number}");
        let spec = json!({
            "ros": {"master": "View"},
            "resources": {"actuators": ["base:Drive"], "sensors": ["kinect:LaserGen"]},
            "run": {"process": {"command": ["sleep", "1000"]}},
            "gracePeriodSeconds": 0,
        });
        let task = cluster.create(&name, spec).await;
        crash.nurse(&mut cluster).await;
        let status = cluster.phase(&name, TaskPhase::Running).await.status.expect("it runs");
        let lease = status.lease.expect("it drives");
        drives(&cluster, lease.epoch.0).await;
        let uid = task.metadata.uid.expect("set by the server");
        assert_eq!(status.attempt, 1, "{moment}");
        assert_eq!(kernel::with_env("MUSTER_UID", &uid).len(), 1, "{moment}");
        reads(&cluster, &uid).await;
        cluster.delete(&name).await;
    }
    nothing_half(&cluster.dir().join("robot")).await;
}

/// Waits until the gate has written down that this grant counts.
async fn drives(cluster: &Cluster, epoch: u64) {
    let kept = cluster.dir().join("robot/gate/kept.json");
    wait::until("counted by the gate", async || {
        let text = std::fs::read(&kept).map_err(|error| error.to_string())?;
        let kept: Value = serde_json::from_slice(&text).map_err(|error| error.to_string())?;
        let newest = kept.pointer("/newest/epoch").and_then(Value::as_u64);
        if newest == Some(epoch) { Ok(()) } else { Err(kept.to_string()) }
    })
    .await;
}

/// Waits until the task is told that its sensor delivers.
async fn reads(cluster: &Cluster, uid: &str) {
    let status = cluster.dir().join("robot/tasks").join(uid).join("sensors/status.json");
    wait::until("told how its sensor stands", async || {
        let text = std::fs::read_to_string(&status).map_err(|error| error.to_string())?;
        if text.contains("Delivering") { Ok(()) } else { Err(text) }
    })
    .await;
}
