//! A simulated robot: driven through its gate and no other way, seen by its pose, its laser and its camera, stopped by walls and by
//! the loss of who drives; and there all the time, whatever becomes of its agent.

use std::path::PathBuf;
use std::time::Duration;

use muster_api::kind::node::Node;
use muster_api::phase::TaskPhase;
use muster_tests::cluster::binary;
use muster_tests::puppet::python;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::{Value, json};

/// A room of 6 m × 4 m.
const WORLD: &str = "
walls:
  - {line: [[0, 0], [6, 0], [6, 4], [0, 4], [0, 0]]}
robot: {start: [1, 2, 0], radius: 0.2, speed: 1.0, braking: 2.0}
laser: {from: -0.5, to: 0.5, rays: 11, nearest: 0.05, farthest: 10, deviation: 0, hz: 20}
camera: {width: 40, height: 30, hz: 10}
battery: {capacity: 40, charge: 80}
";

const AGENT: &str = "
position: sim:world.yaml
sensors:
  - {function: 'kinect:LaserGen', sim: Laser}
  - {function: 'kinect:ImageGen', sim: Camera}
gate:
  drivers: [{actuators: ['base:Drive', 'arm:Grasp'], sim: Base}]
";

async fn join(cluster: &mut Cluster) {
    let file = |name: &str, text: &str| -> PathBuf {
        let path = cluster.dir().join(name);
        std::fs::write(&path, text).expect("the directory is there");
        path
    };
    file("world.yaml", WORLD);
    let config = file("agent.yaml", AGENT);
    let mut robot = AgentOptions::robot("robot", 0.0, 0.0);
    // It is where its world says.
    robot.flags.truncate(robot.flags.len() - 2);
    cluster.join(robot.flag("--config", &config.display().to_string())).await;
}

fn script(name: &str, args: &[&str]) -> Value {
    let script = format!("{}/sim/{name}.py", env!("CARGO_MANIFEST_DIR"));
    let mut command = vec![python().display().to_string(), script];
    command.extend(args.iter().map(|arg| (*arg).to_owned()));
    json!({"process": {"command": command}})
}

fn drives(linear: &str) -> Value {
    json!({
        "resources": {"actuators": ["base:Drive"]},
        "run": script("drive", &[linear, "0"]),
        "gracePeriodSeconds": 0,
    })
}

fn looks(function: &str) -> Value {
    json!({"resources": {"sensors": [function]}, "run": script("look", &[function]), "gracePeriodSeconds": 0})
}

/// Where the robot is; one that has just joined may not have said it yet.
async fn pose(cluster: &Cluster) -> Value {
    let client = cluster.client().await;
    wait::until("known where it is", async || {
        let request = http::Request::get("/apis/muster.dev/v1alpha1/nodes/robot/pose");
        let request = request.body(Vec::new()).expect("a request");
        client.request::<Value>(request).await.map_err(|error| error.to_string())
    })
    .await
}

/// Waits until the robot is so far in the room; where it is.
async fn until_at(cluster: &Cluster, what: &str, is: impl Fn(f64) -> bool) -> f64 {
    wait::until(what, async || {
        let pose = pose(cluster).await;
        pose["x"].as_f64().filter(|x| is(*x)).ok_or_else(|| pose.to_string())
    })
    .await
}

/// Waits until the robot does not move any more; where.
async fn until_it_stands(cluster: &Cluster) -> f64 {
    wait::until("standing", async || {
        let before = pose(cluster).await;
        // Longer than a pose takes to come on a busy machine: one that is late looks like standing.
        wait::idle(Duration::from_secs(2)).await;
        let now = pose(cluster).await;
        let stands = (&before["x"], &before["yaw"]) == (&now["x"], &now["yaw"]);
        now["x"].as_f64().filter(|_| stands).ok_or_else(|| now.to_string())
    })
    .await
}

/// Waits until a reader's newest word is as wanted.
async fn until_seen(cluster: &Cluster, task: &str, is: impl Fn(&Value) -> bool) -> Value {
    cluster.phase(task, TaskPhase::Running).await;
    wait::until("seen", async || {
        let said = newest(cluster, task).await;
        said.and_then(|said| if is(&said) { Ok(said) } else { Err(said.to_string()) })
    })
    .await
}

/// A reader's newest word; when that is none, what it has said, or why nobody knows.
async fn newest(cluster: &Cluster, task: &str) -> Result<Value, String> {
    let log = cluster.try_task_log(task).await?;
    let whole = log.rsplit_once('\n').map_or("", |(whole, _)| whole);
    let last = whole.lines().last().and_then(|line| serde_json::from_str(line).ok());
    last.ok_or(log)
}

async fn condition(cluster: &Cluster, name: &str) {
    let holds = |node: Option<&Node>| {
        let status = node.and_then(|node| node.status.as_ref());
        let found = status.and_then(|s| s.conditions.iter().find(|c| c.r#type == name));
        found.is_some_and(|c| format!("{:?}", c.status) == "True")
    };
    wait::object(cluster.nodes().await, "robot", name, holds).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_simulated_robot_is_driven_seen_and_stopped() {
    let mut cluster = Cluster::start().await;
    join(&mut cluster).await;
    condition(&cluster, "ActuatorsFenced").await;
    condition(&cluster, "Localized").await;
    let there = pose(&cluster).await;
    assert_eq!(
        (&there["source"], &there["x"], &there["y"]),
        (&json!("sim"), &json!(1.0), &json!(2.0))
    );
    let node = cluster.nodes().await.get("robot").await.expect("it has joined");
    let percent = node.status.and_then(|s| s.battery).map(|b| b.percent);
    assert!(matches!(percent, Some(79 | 80)), "{percent:?}");
    assert_eq!(cluster.get("/apis/muster.dev/v1alpha1/nodes/robot").await["spec"]["speed"], 1.0);

    // Two tasks look, one drives: to the wall and not through it.
    cluster.create("scan", looks("kinect:LaserGen")).await;
    cluster.create("film", looks("kinect:ImageGen")).await;
    let far = until_seen(&cluster, "scan", |said| said["rays"] == 11).await;
    assert_eq!(far["format"], "protobuf:muster.ros.v1.sensor_msgs.LaserScan");
    assert!((far["ahead"].as_f64().expect("a range") - 5.0).abs() < 0.01, "{far}");
    let picture = until_seen(&cluster, "film", |said| said["width"] == 40).await;
    assert!(
        picture["height"] == 30 && picture["colors"].as_u64().is_some_and(|n| n > 8),
        "{picture}"
    );
    cluster.create("east", drives("1.0")).await;
    cluster.phase("east", TaskPhase::Running).await;
    until_at(&cluster, "on its way", |x| x > 2.0).await;
    let end = until_at(&cluster, "at the wall", |x| x > 5.79).await;
    assert!(end < 5.801, "{end}");
    until_seen(&cluster, "scan", |said| {
        said["ahead"].as_f64().is_some_and(|m| (m - 0.2).abs() < 0.01)
    })
    .await;

    // The other way; who drives is killed in the middle, and the robot stands within half a metre.
    cluster.delete("east").await;
    let west = cluster.create("west", drives("-0.4")).await;
    until_at(&cluster, "going back", |x| x < 5.0).await;
    let uid = west.metadata.uid.expect("set by the server");
    for process in kernel::with_env("MUSTER_UID", &uid) {
        kernel::kill(process.pid);
    }
    cluster.phase("west", TaskPhase::Failed).await;
    let stands = until_it_stands(&cluster).await;
    assert!(stands > 3.0, "{stands}");
    wait::idle(Duration::from_secs(1)).await;
    assert_eq!(pose(&cluster).await["x"].as_f64(), Some(stands));

    // The robot is there without its agent, and where it was.
    cluster.kill_agent("robot");
    cluster.restart_agent("robot").await;
    condition(&cluster, "ActuatorsFenced").await;
    condition(&cluster, "Localized").await;
    assert_eq!(until_at(&cluster, "where it was", |x| (x - stands).abs() < 1e-6).await, stands);
    cluster.create("again", drives("0.5")).await;
    until_at(&cluster, "driven again", |x| x > stands + 0.3).await;
}

/// gmapping as it is in the lab's manifests: it drives by the laser, and knows by it where the robot is.
#[tokio::test(flavor = "multi_thread")]
async fn a_task_maps_the_lab_by_the_simulated_laser() {
    let mut cluster = Cluster::start().await;
    let lab = concat!(env!("CARGO_MANIFEST_DIR"), "/../manifests/lab");
    let options = AgentOptions::bare("robot");
    let config = std::fs::read_to_string(format!("{lab}/agent.yaml")).expect("of the tree");
    let config = config
        .replace("name: sim-1", "name: robot")
        .replace("sim:world", &format!("sim:{lab}/world"));
    let path = cluster.dir().join("agent.yaml");
    std::fs::write(&path, config).expect("the directory is there");
    cluster.join(options.flag("--config", &path.display().to_string())).await;
    let start = pose(&cluster).await;

    let manifest = std::fs::read_to_string(format!("{lab}/explore.yaml")).expect("of the tree");
    let documents = muster_api::manifest::parse("explore.yaml", &manifest).expect("a manifest");
    let mut spec = documents[0].object["spec"].clone();
    spec["run"]["process"]["command"][0] = binary("muster").display().to_string().into();
    // The path of the test's own build has not the room that a machine at peace has.
    spec["resources"]["cpu"] = "900m".into();
    cluster.create("explore", spec).await;
    let mapped = |said: &Value| {
        let number = |field: &str| said[field].as_f64().unwrap_or_default();
        number("mapped_m2") > 20.0 && number("driven_m") > 2.0
    };
    until_seen(&cluster, "explore", mapped).await;
    let at = |pose: &Value| (pose["x"].as_f64().expect("x"), pose["y"].as_f64().expect("y"));
    // It drives on between its word and the look at it, on a busy machine farther than it may err.
    let now = wait::until("where it believes to be", async || {
        let (said, now) = (newest(&cluster, "explore").await, pose(&cluster).await);
        said.and_then(|said| {
            let ((x0, y0), (x, y), (dx, dy)) = (at(&start), at(&now), at(&said));
            // The map's frame is where it began, heading east.
            let error = (x0 + dx - x).hypot(y0 + dy - y);
            if error < 0.5 { Ok(now) } else { Err(format!("{error} m off: {said} {now}")) }
        })
    })
    .await;
    let (x, y) = at(&now);
    let range = (0.0..12.0).contains(&x) && (0.0..8.0).contains(&y);
    assert!(range && now["localized"] == true, "{now}");
}
