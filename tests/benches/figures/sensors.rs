//! A camera of 1 MB and 30 Hz, read by many tasks at once: through muster in shared memory, through muster as copies over each
//! socket, and by as many subscribers of a ROS topic.
//!
//! This program is also the camera, the topic's publisher and the readers, by its first argument. A reader looks at a byte of
//! each page, so that a frame that is not there would be seen; it prints a line each second of what it has got so far.

use std::io::Write as _;
use std::time::{Duration, Instant};

use muster_api::phase::TaskPhase;
use muster_ros1::node::{PublishOptions, SubscribeOptions};
use muster_ros1::sensor_msgs::Image;
use muster_ros1::{Node, NodeOptions};
use muster_sdk::sensor::{Mode, Sensor};
use muster_tests::{AgentOptions, Cluster, Ros, wait};
use serde_json::{Value, json};

use crate::footprint::cpu;

const FUNCTION: &str = "kinect:ImageGen";
const TOPIC: &str = "/image";
/// Bytes of a frame, and frames a second.
const SIZE: usize = 1_000_000;
const HZ: f64 = 30.0;

/// What is counted of.
const SPAN: Duration = Duration::from_secs(10);

/// A role of this program's; none: it is the benchmark.
pub(crate) fn role(arguments: &[String]) -> bool {
    match arguments {
        [role] if role == "sensor-camera" => camera(),
        [role, master] if role == "sensor-publish" => block(publish(master)),
        [role] if role == "sensor-read" => block(read(false)),
        [role] if role == "sensor-read-copies" => block(read(true)),
        [role, master] if role == "sensor-subscribe" => block(subscribe(master)),
        _ => return false,
    }
    true
}

fn block(work: impl Future<Output = ()>) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    runtime.expect("a runtime").block_on(work);
}

fn camera() {
    let (mut frame, mut out, mut due) = (vec![0_u8; SIZE], std::io::stdout(), Instant::now());
    loop {
        frame[0] = frame[0].wrapping_add(1);
        if out.write_all(&frame).is_err() {
            return;
        }
        due += Duration::from_secs_f64(HZ.recip());
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
}

async fn node(master: &str, name: &str) -> Node {
    let options = NodeOptions {
        name: format!("{name}_{}", std::process::id()),
        master: Some(master.to_owned()),
        host: Some("127.0.0.1".to_owned()),
        ..NodeOptions::default()
    };
    Node::start(options).await.expect("a node")
}

async fn publish(master: &str) {
    let node = node(master, "camera").await;
    let topic = node.advertise::<Image>(TOPIC, PublishOptions { queue: 1, ..Default::default() });
    let topic = topic.expect("a topic");
    let image = Image { data: vec![0; SIZE].into(), ..Image::default() };
    let mut ticks = tokio::time::interval(Duration::from_secs_f64(HZ.recip()));
    loop {
        ticks.tick().await;
        topic.publish(&image);
    }
}

/// What a reader has got so far.
struct Got {
    frames: u64,
    dropped: u64,
    ages: Vec<f64>,
    told: Instant,
}

impl Got {
    fn new() -> Got {
        Got { frames: 0, dropped: 0, ages: Vec::new(), told: Instant::now() }
    }

    fn frame(&mut self, data: &[u8], dropped: u64, age: Duration) {
        assert!(data.len() >= SIZE);
        std::hint::black_box(data.iter().step_by(4096).fold(0_u8, |all, byte| all ^ byte));
        self.frames += 1;
        self.dropped += dropped;
        self.ages.push(age.as_secs_f64() * 1e3);
        if self.told.elapsed() >= Duration::from_secs(1) {
            self.told = Instant::now();
            self.ages.sort_unstable_by(f64::total_cmp);
            let p99 = self.ages[self.ages.len() * 99 / 100];
            self.ages.clear();
            let used = cpu(std::process::id()).as_secs_f64();
            let said =
                json!({"frames": self.frames, "dropped": self.dropped, "cpu": used, "p99": p99});
            println!("{said}");
        }
    }
}

async fn read(copies: bool) {
    let mut sensor = Sensor::open(FUNCTION, Mode::Queue(4)).await.expect("a sensor");
    if copies {
        sensor = sensor.with_copies();
    }
    let mut got = Got::new();
    loop {
        let frame = sensor.next().await.expect("a frame");
        let age = frame.stamp.elapsed().unwrap_or_default();
        got.frame(frame.data, frame.dropped, age);
    }
}

async fn subscribe(master: &str) {
    let node = node(master, "reader").await;
    let options = SubscribeOptions { queue: 4, ..SubscribeOptions::default() };
    let mut topic = node.subscribe::<Image>(TOPIC, options).expect("a topic");
    let mut got = Got::new();
    loop {
        let (image, incoming) = topic.next().await.expect("an image");
        let dropped = topic.dropped().saturating_sub(got.dropped);
        got.frame(&image.data, dropped, incoming.received.elapsed());
    }
}

pub(crate) async fn all() {
    let program = std::env::current_exe().expect("it has a path").display().to_string();
    for readers in [1, 8, 64] {
        for (how, role) in [("lent", "sensor-read"), ("copied", "sensor-read-copies")] {
            let mut cluster = Cluster::start().await;
            let config = cluster.dir().join("agent.yaml");
            let source = json!({"function": FUNCTION, "exec": [program, "sensor-camera"],
                "framing": "Fixed", "size": SIZE.to_string(), "memory": "128Mi"});
            // JSON is YAML.
            let text = json!({"sensors": [source]}).to_string();
            std::fs::write(&config, text).expect("a directory");
            let robot = AgentOptions::robot("robot", 0.0, 0.0).flag("--docker-socket", "none");
            cluster.join(robot.flag("--config", &config.display().to_string())).await;
            start(&cluster, readers, &[&program, role], json!([FUNCTION])).await;
            measure(&cluster, readers, how, cluster.agent_pid("robot")).await;
        }
        let (ros, mut cluster) = (Ros::start().await, Cluster::start().await);
        let robot = AgentOptions::robot("robot", 0.0, 0.0).flag("--docker-socket", "none");
        cluster.join(robot).await;
        let publisher = ros.spawn(&program, &["sensor-publish", &ros.master()]);
        let command = [&program, "sensor-subscribe", &ros.master()];
        start(&cluster, readers, &command, json!([])).await;
        measure(&cluster, readers, "own ROS subscribers", publisher.pid()).await;
    }
}

async fn start(cluster: &Cluster, readers: usize, command: &[&str], sensors: Value) {
    for reader in 0..readers {
        let spec = json!({
            "resources": {"sensors": sensors},
            "run": {"process": {"command": command}},
            "gracePeriodSeconds": 0,
        });
        cluster.create(&format!("r{reader}"), spec).await;
    }
    for reader in 0..readers {
        cluster.task(&format!("r{reader}"), "running", |s| s.phase == TaskPhase::Running).await;
    }
}

/// The newest of what each has said; an error, until all have.
async fn said(cluster: &Cluster, readers: usize) -> Result<Vec<Value>, String> {
    let mut all = Vec::new();
    for reader in 0..readers {
        let log = cluster.try_task_log(&format!("r{reader}")).await?;
        let whole = log.rsplit_once('\n').map_or("", |(whole, _)| whole);
        let last = whole.lines().last().and_then(|line| serde_json::from_str(line).ok());
        all.push(last.ok_or_else(|| format!("r{reader}: {log}"))?);
    }
    Ok(all)
}

/// `server`: who every frame passes.
async fn measure(cluster: &Cluster, readers: usize, how: &str, server: u32) {
    let (began, before) = wait::until("all readers", async || {
        let all = said(cluster, readers).await?;
        Ok::<_, String>((Instant::now(), all))
    })
    .await;
    let used = cpu(server);
    wait::idle(SPAN).await;
    let used = cpu(server) - used;
    let after = said(cluster, readers).await.expect("they said something before");
    let took = began.elapsed().as_secs_f64();
    let sum =
        |of: &[Value], field: &str| of.iter().filter_map(|said| said[field].as_f64()).sum::<f64>();
    let grown = |field| sum(&after, field) - sum(&before, field);
    let worst = after.iter().filter_map(|said| said["p99"].as_f64()).fold(0.0, f64::max);
    let percent = |seconds: f64| seconds / took * 100.0;
    println!(
        "  {readers:2} readers, {how:20} {:5.1} frames/s each, {:4.1} % dropped, server {:5.1} % of a core, readers {:5.1} % together, worst p99 {worst:.1} ms",
        grown("frames") / took / readers as f64,
        grown("dropped") / (grown("frames") + grown("dropped")).max(1.0) * 100.0,
        percent(used.as_secs_f64()),
        percent(grown("cpu")),
    );
}
