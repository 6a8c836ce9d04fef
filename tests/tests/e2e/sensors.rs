//! Sensors: one reader of a source for every task that asked for it, and nobody else; what is slow, dies or is away costs nobody
//! else anything.

use std::path::{Path, PathBuf};

use muster_api::kind::node::Node;
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_tests::cluster::example;
use muster_tests::puppet::python;
use muster_tests::{AgentOptions, Cluster, docker, kernel, wait};
use serde_json::{Value, json};

const IMAGE: &str = "kinect:ImageGen";
const LASER: &str = "kinect:LaserGen";

/// Bytes of a frame of the camera: more than is sent inline, and than a pipe holds.
const SIZE: usize = 300_000;

fn script(name: &str) -> String {
    format!("{}/sensors/{name}", env!("CARGO_MANIFEST_DIR"))
}

/// A robot whose camera is a program that says in a file when it was started.
struct Robot {
    starts: PathBuf,
}

impl Robot {
    async fn join(cluster: &mut Cluster, hz: u32) -> Robot {
        let starts = cluster.dir().join("starts");
        let camera = ["python3", &script("camera.py"), &SIZE.to_string(), &hz.to_string()];
        let mut exec = camera.map(str::to_owned).to_vec();
        exec.push(starts.display().to_string());
        join(cluster, json!([{"function": IMAGE, "exec": exec, "framing": "Fixed", "size": SIZE.to_string()}])).await;
        Robot { starts }
    }

    /// The processes of the camera so far.
    fn pids(&self) -> Vec<u32> {
        let text = std::fs::read_to_string(&self.starts).unwrap_or_default();
        text.lines().map(|pid| pid.parse().expect("a pid")).collect()
    }
}

async fn join(cluster: &mut Cluster, sensors: Value) {
    let config = cluster.dir().join("agent.yaml");
    // JSON is YAML.
    std::fs::write(&config, json!({"sensors": sensors}).to_string()).expect("a directory");
    let robot = AgentOptions::robot("robot", 0.0, 0.0);
    cluster.join(robot.flag("--config", &config.display().to_string())).await;
}

fn reads(function: &str, args: &[&str]) -> Value {
    let script = script("read.py");
    let mut command = vec![python().display().to_string(), script, function.to_owned()];
    command.extend(args.iter().map(|arg| (*arg).to_owned()));
    json!({
        "resources": {"sensors": [function]},
        "run": {"process": {"command": command}},
        "gracePeriodSeconds": 0,
    })
}

/// Creates a task, and waits until its agent can be asked for what it says.
async fn create(cluster: &Cluster, name: &str, spec: Value) -> Task {
    let task = cluster.create(name, spec).await;
    cluster.task(name, "begun", |s| s.phase == TaskPhase::Running || s.phase.is_terminal()).await;
    task
}

/// What a reader has said so far.
async fn said(cluster: &Cluster, task: &str) -> Vec<Value> {
    words(&cluster.task_log(task).await)
}

fn words(log: &str) -> Vec<Value> {
    let whole = log.rsplit_once('\n').map_or("", |(whole, _)| whole);
    whole.lines().map(|line| serde_json::from_str(line).expect(line)).collect()
}

/// Waits until what a reader has said is as wanted.
async fn until(
    cluster: &Cluster,
    task: &str,
    what: &str,
    wanted: impl Fn(&[Value]) -> bool,
) -> Vec<Value> {
    wait::until(&format!("{task}: {what}"), async || {
        let said = words(&cluster.try_task_log(task).await?);
        if wanted(&said) { Ok(said) } else { Err(format!("{:?}", said.last())) }
    })
    .await
}

/// Frames are whole, in order, and what is between two of them is told.
fn check(frames: &[Value]) {
    for frame in frames {
        assert_eq!((&frame["whole"], &frame["length"]), (&json!(true), &json!(SIZE)), "{frame}");
    }
    for pair in frames.windows(2).filter(|pair| pair[0]["life"] == pair[1]["life"]) {
        let [before, after] =
            [&pair[0], &pair[1]].map(|f| f["sequence"].as_u64().expect("a number"));
        assert_eq!(pair[1]["dropped"].as_u64(), Some(after - before - 1), "{pair:?}");
    }
}

fn is_gone(pid: u32) -> bool {
    kernel::start_time(pid).is_none()
}

#[tokio::test(flavor = "multi_thread")]
async fn two_tasks_read_one_source_which_is_there_as_long_as_they_are() {
    let mut cluster = Cluster::start().await;
    let robot = Robot::join(&mut cluster, 20).await;
    let two = |said: &[Value]| said.len() >= 2;
    let ready =
        |n: Option<&Node>| condition(n, "SensorsReady").is_some_and(|(status, _)| status == "True");
    wait::object(cluster.nodes().await, "robot", "idle", ready).await;
    assert!(robot.pids().is_empty(), "nobody wants it");

    let a = create(&cluster, "a", reads(IMAGE, &[])).await;
    until(&cluster, "a", "frames", two).await;
    create(&cluster, "b", reads(IMAGE, &["16"])).await;
    until(&cluster, "b", "frames", two).await;
    assert_eq!(robot.pids().len(), 1, "one reader for both");

    // A task that did not ask has no sockets; with those and the token of one that did, it is refused.
    let dir = task_dir(&cluster, &a).join("sensors");
    let mut spec = reads(IMAGE, &[]);
    spec["resources"] = json!({});
    create(&cluster, "none", spec.clone()).await;
    let why = until(&cluster, "none", "an error", |said| !said.is_empty()).await.remove(0);
    assert!(
        why["why"].as_str().is_some_and(|why| why.contains("MUSTER_SENSORS_DIR is not set")),
        "{why}"
    );
    let record = std::fs::read(task_dir(&cluster, &a).join("task.json")).expect("its record");
    let record: Value = serde_json::from_slice(&record).expect("JSON");
    spec["run"]["process"]["env"] = json!([
        {"name": "MUSTER_SENSORS_DIR", "value": dir},
        {"name": "MUSTER_SENSORS_TOKEN", "value": record["token"]},
    ]);
    create(&cluster, "thief", spec.clone()).await;
    let why = until(&cluster, "thief", "an error", |said| !said.is_empty()).await.remove(0);
    assert!(why["why"].as_str().is_some_and(|why| why.contains("no process of the task")), "{why}");

    // The source dies: the same readers go on with the next one.
    let life = said(&cluster, "a").await[0]["life"].clone();
    kernel::kill(robot.pids()[0]);
    wait::until("another camera", async || {
        if robot.pids().len() == 2 { Ok(()) } else { Err(format!("{:?}", robot.pids())) }
    })
    .await;
    let count = said(&cluster, "a").await.len();
    let frames = until(&cluster, "a", "more frames", |said| said.len() > count + 2).await;
    assert_eq!(frames.last().map(|f| &f["life"]), Some(&life));
    check(&frames);

    // The agent dies, and the camera with it; the readers come again.
    cluster.kill_agent("robot");
    let camera = robot.pids()[1];
    wait::until(
        "the camera's end",
        async || if is_gone(camera) { Ok(()) } else { Err(String::new()) },
    )
    .await;
    cluster.restart_agent("robot").await;
    for task in ["a", "b"] {
        let frames = until(&cluster, task, "another life", |said| {
            said.last().is_some_and(|f| f["life"] != life)
        })
        .await;
        check(&frames);
    }
    assert_eq!(robot.pids().len(), 3);

    cluster.delete("a").await;
    assert!(!is_gone(robot.pids()[2]), "b still wants it");
    cluster.delete("b").await;
    let camera = robot.pids()[2];
    wait::until("its end", async || if is_gone(camera) { Ok(()) } else { Err(String::new()) })
        .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_slow_reader_loses_frames_of_its_own() {
    let mut cluster = Cluster::start().await;
    let _robot = Robot::join(&mut cluster, 20).await;
    create(&cluster, "slow", reads(IMAGE, &["1", "0.7"])).await;
    create(&cluster, "fast", reads(IMAGE, &["16"])).await;
    let dropped =
        |frames: &[Value]| frames.iter().filter_map(|f| f["dropped"].as_u64()).sum::<u64>();
    // 20 a second, of which it takes fewer than two.
    let is_behind = |said: &[Value]| said.len() >= 6 && dropped(said) > 20;
    let slow = until(&cluster, "slow", "behind", is_behind).await;
    // A busy machine may hold it up at first, and not for good.
    let keeps_up = |said: &[Value]| said.len() >= 20 && dropped(said) <= said.len() as u64 / 4;
    let fast = until(&cluster, "fast", "keeping up", keeps_up).await;
    check(&slow);
    check(&fast);
}

#[tokio::test(flavor = "multi_thread")]
async fn why_nothing_comes_is_told_where_people_look() {
    let mut cluster = Cluster::start().await;
    let program = cluster.dir().join("laser");
    let write = |text: &str| {
        let next = program.with_extension("next");
        std::fs::write(&next, format!("#!/bin/sh\n{text}\n")).expect("a file");
        std::fs::set_permissions(&next, std::os::unix::fs::PermissionsExt::from_mode(0o755))
            .expect("its mode");
        std::fs::rename(&next, &program).expect("the same directory");
    };
    write("echo the laser is not plugged in >&2; exit 3");
    let fifo = cluster.dir().join("gps");
    rustix::fs::mknodat(rustix::fs::CWD, &fifo, rustix::fs::FileType::Fifo, 0o600.into(), 0)
        .expect("a FIFO");
    join(
        &mut cluster,
        json!([
            {"function": LASER, "exec": [program], "framing": "Lines"},
            {"function": IMAGE, "device": fifo, "framing": "Lines"},
        ]),
    )
    .await;
    let task = create(&cluster, "laser", reads(LASER, &["4"])).await;
    let fails = |n: Option<&Node>| {
        condition(n, "SensorsReady").is_some_and(|(status, message)| {
            status == "False"
                && message.contains("kinect:LaserGen")
                && message.contains("not plugged in")
        })
    };
    wait::object(cluster.nodes().await, "robot", "failing", fails).await;
    let path = task_dir(&cluster, &task).join("sensors/status.json");
    told(&path, &["Failing", "not plugged in"]).await;

    write("n=0; while :; do n=$((n+1)); echo \"scan $n\"; sleep 0.05; done");
    let frames = until(&cluster, "laser", "scans", |said| said.len() >= 3).await;
    assert!(frames[0]["text"].as_str().is_some_and(|text| text.starts_with("scan ")), "{frames:?}");
    let ready =
        |n: Option<&Node>| condition(n, "SensorsReady").is_some_and(|(status, _)| status == "True");
    wait::object(cluster.nodes().await, "robot", "ready", ready).await;
    told(&path, &["Delivering"]).await;

    // A FIFO that has no writer yet is waited for.
    create(&cluster, "gps", reads(IMAGE, &["4"])).await;
    let says = format!("while :; do echo '$GPGGA,1'; sleep 0.1; done > {}", fifo.display());
    let mut writer = tokio::process::Command::new("sh");
    let _writer = writer.args(["-c", &says]).kill_on_drop(true).spawn().expect("a shell");
    let frames = until(&cluster, "gps", "a line", |said| !said.is_empty()).await;
    assert_eq!(frames[0]["text"], "$GPGGA,1");
}

#[tokio::test(flavor = "multi_thread")]
async fn containers_and_other_users_read_too() {
    let mut cluster = Cluster::start().await;
    let _robot = Robot::join(&mut cluster, 10).await;
    docker::image();
    // Whoever is nobody must be able to run it.
    let open = |path: &Path| {
        let mode = std::os::unix::fs::PermissionsExt::from_mode(0o755);
        std::fs::set_permissions(path, mode).expect("its mode");
    };
    let bin = cluster.dir().join("bin");
    std::fs::create_dir(&bin).expect("a new directory");
    std::fs::copy(example("watch"), bin.join("watch")).expect("a copy");
    [cluster.dir(), &bin, &bin.join("watch")].into_iter().for_each(open);

    // The host's libraries: the image has none.
    let mount =
        |host: &str, path: &str| json!({"hostPath": host, "mountPath": path, "readOnly": true});
    let mounts = [
        mount(&bin.display().to_string(), "/opt"),
        mount("/usr/lib", "/lib"),
        mount("/usr/lib64", "/lib64"),
    ];
    let mut spec = reads(IMAGE, &[]);
    spec["run"] = json!({"container": {"image": docker::IMAGE, "command": ["/opt/watch", IMAGE, "4"],
        "network": "None", "mounts": mounts}});
    create(&cluster, "box", spec).await;
    let mut spec = reads(IMAGE, &[]);
    spec["run"]["process"] = json!({"command": [bin.join("watch"), IMAGE, "4"], "user": "nobody"});
    create(&cluster, "other", spec).await;
    for task in ["box", "other"] {
        watched(&cluster, task, "three frames", |lives| lives.len() >= 3).await;
    }
    // The agent of the next life is found by both.
    cluster.kill_agent("robot");
    cluster.restart_agent("robot").await;
    for task in ["box", "other"] {
        let anew = |lives: &[&str]| lives.windows(2).any(|pair| pair[0] != pair[1]);
        watched(&cluster, task, "another life", anew).await;
    }
    cluster.delete("box").await;
}

/// Waits until the file in a task's directory says all of these words of its sensors.
async fn told(path: &Path, words: &[&str]) {
    wait::until(&format!("{words:?} in the task's directory"), async || {
        match std::fs::read_to_string(path) {
            Ok(status) if words.iter().all(|word| status.contains(word)) => Ok(()),
            other => Err(format!("{other:?}")),
        }
    })
    .await;
}

/// Waits until the frames that `watch` has said are as wanted, each by the agent's life in which it came.
async fn watched(cluster: &Cluster, task: &str, what: &str, wanted: impl Fn(&[&str]) -> bool) {
    wait::until(&format!("{task}: {what}"), async || {
        let log = cluster.try_task_log(task).await?;
        let size = format!("{SIZE} bytes,");
        let whole = log.rsplit_once('\n').map_or("", |(whole, _)| whole);
        let frames = whole.lines().filter_map(|line| line.split_once(' '));
        let frames = frames.filter(|(number, _)| number.parse::<u64>().is_ok());
        let frames = frames.filter_map(|(_, rest)| rest.strip_prefix(&size));
        let lives: Vec<&str> =
            frames.filter_map(|rest| rest.split_once(", life ")).map(|(_, life)| life).collect();
        if wanted(&lives) { Ok(()) } else { Err(log) }
    })
    .await;
}

fn condition(node: Option<&Node>, name: &str) -> Option<(String, String)> {
    let conditions = &node?.status.as_ref()?.conditions;
    let found = conditions.iter().find(|condition| condition.r#type == name)?;
    Some((format!("{:?}", found.status), found.message.clone()))
}

fn task_dir(cluster: &Cluster, task: &Task) -> PathBuf {
    let uid = task.metadata.uid.as_deref().expect("set by the server");
    Path::new(cluster.dir()).join("robot/tasks").join(uid)
}
