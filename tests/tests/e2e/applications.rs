//! Applications with real processes on a robot and a cloud server: their parts run, move to where they are worth more, and
//! come home when they must.

use std::time::Duration;

use kube::Api;
use kube::api::PostParams;
use muster_api::kind::application::{
    APPLICATION_LABEL, Application, ApplicationPhase, ApplicationStatus, CutOff, MoveStage,
    PART_LABEL, PartStatus,
};
use muster_api::quantity::MilliCpu;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::{Value, json};

use crate::cli::muster;

async fn applications(cluster: &Cluster) -> Api<Application> {
    Api::namespaced(cluster.client().await, "default")
}

/// A robot and a server with twice its cores.
async fn robot_and_cloud() -> Cluster {
    let mut cluster = Cluster::start().await;
    let small =
        |options: AgentOptions, cpu| options.flag("--docker-socket", "none").flag("--cpu", cpu);
    cluster.join(small(AgentOptions::robot("robot", 0.0, 0.0), "1000m")).await;
    cluster.join(small(AgentOptions::cloud("cloud"), "2000m")).await;
    cluster
}

fn part(name: &str, script: &str, resources: Value) -> Value {
    json!({
        "name": name,
        "template": {"spec": {
            "gracePeriodSeconds": 0, "restartPolicy": "Always", "resources": resources,
            "run": {"process": {"command": ["sh", "-c", script]}},
        }},
    })
}

/// A camera that stays on the robot, and one that looks at its images, and may be anywhere.
fn corridor(look: &str) -> Value {
    let mut ar = part("ar", look, json!({"cpu": "200m"}));
    // What is measured of a program that sleeps is worth no move.
    ar["cpu"] = json!("200m");
    json!({
        "home": "robot", "cooldown": "3s",
        "parts": [
            part("camera", "exec sleep 1000", json!({"sensors": ["kinect:ImageGen"]})),
            ar,
        ],
        "connections": [
            {"topic": "/image", "from": "camera", "to": "ar", "minHz": 5.0, "tolerance": "4s", "bandwidth": "6M"},
        ],
    })
}

async fn create(cluster: &Cluster, spec: Value) {
    let object = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Application", "metadata": {"name": "corridor"}, "spec": spec,
    });
    let object: Application = serde_json::from_value(object).expect("an Application");
    let api = applications(cluster).await;
    api.create(&PostParams::default(), &object).await.expect("it is taken");
}

async fn status(
    cluster: &Cluster,
    what: &str,
    wanted: impl Fn(&ApplicationStatus) -> bool,
) -> ApplicationStatus {
    let holds =
        |app: Option<&Application>| app.and_then(|app| app.status.as_ref()).is_some_and(&wanted);
    let app = wait::object(applications(cluster).await, "corridor", what, holds).await;
    app.and_then(|app| app.status).expect("it has a status")
}

/// Waits until `ar` is served from a node, and nothing else of it is left.
async fn serves_on(cluster: &Cluster, node: &str) -> PartStatus {
    let there = |status: &ApplicationStatus| {
        status.phase == ApplicationPhase::Running
            && status.part("ar").is_some_and(|ar| {
                ar.scale.as_deref() == Some(node) && ar.stage == Some(MoveStage::Settled)
            })
    };
    let status = status(cluster, &format!("served from {node}"), there).await;
    status.part("ar").cloned().expect("a part")
}

fn processes(part: &PartStatus) -> Vec<kernel::Process> {
    kernel::with_env("MUSTER_UID", &part.task.as_ref().expect("it has a task").uid)
}

fn are_gone(processes: &[kernel::Process]) -> bool {
    processes.iter().all(|p| kernel::start_time(p.pid) != Some(p.start))
}

#[tokio::test(flavor = "multi_thread")]
async fn a_part_moves_to_the_cloud_comes_home_when_that_is_drained_and_nothing_is_left() {
    let cluster = robot_and_cloud().await;
    create(&cluster, corridor("exec sleep 1000")).await;
    let away = serves_on(&cluster, "cloud").await;
    let task = away.task.as_ref().expect("it has a task");
    let object = cluster.tasks().await.get(&task.name).await.expect("it is there");
    assert_eq!(object.metadata.uid.as_ref(), Some(&task.uid));
    let labels = object.metadata.labels.expect("labels");
    assert_eq!((&*labels[APPLICATION_LABEL], &*labels[PART_LABEL]), ("corridor", "ar"));
    let owner = &object.metadata.owner_references.expect("an owner")[0];
    assert_eq!((&*owner.kind, &*owner.name), ("Application", "corridor"));
    assert_eq!(object.status.and_then(|s| s.node).as_deref(), Some("cloud"));
    let there = processes(&away);
    assert_eq!(there.len(), 1);
    let all = cluster.tasks().await.list(&Default::default()).await.expect("a list").items;
    let names: Vec<_> = all.iter().filter_map(|task| task.metadata.name.as_deref()).collect();
    assert!(!names.contains(&"corridor-ar-1"), "the one before has ended: {names:?}");

    let (code, table, _) = muster(&cluster, &["get", "app"]);
    assert_eq!(code, 0);
    let row: Vec<&str> = table.lines().nth(1).expect("a row").split_whitespace().collect();
    assert_eq!(row[..7], ["corridor", "robot", "2", "ar", "1", "Optimal", "Running"], "{table}");
    let (_, why, _) = muster(&cluster, &["why", "app/corridor"]);
    assert!(why.contains("application/corridor is Running") && why.contains("at home"), "{why}");

    let (_, top, _) = muster(&cluster, &["top", "nodes", "-o", "json"]);
    let top: Value = serde_json::from_str(&top).expect("JSON");
    for node in top["nodes"].as_array().expect("a list") {
        let trip = node["link"]["roundTripUsec"].as_u64();
        assert!(trip.is_some_and(|usec| usec > 0), "heartbeats measure the link: {top}");
    }

    assert_eq!(muster(&cluster, &["drain", "cloud"]).0, 0);
    let home = serves_on(&cluster, "robot").await;
    wait::until("its process gone", || async {
        if are_gone(&there) { Ok(()) } else { Err(format!("{there:?}")) }
    })
    .await;
    let (_, why, _) = muster(&cluster, &["why", "app/corridor"]);
    assert!(why.contains("ScaleUnfit") && why.contains("it is cordoned"), "{why}");
    let (_, described, _) = muster(&cluster, &["describe", "app/corridor"]);
    for words in ["Mappings", "ar on cloud", "moves to cloud, for", "Phase"] {
        assert!(described.contains(words), "{words}: {described}");
    }
    wait::until("told in events", || async {
        let (_, events, _) = muster(&cluster, &["get", "events"]);
        let told = ["Moving", "Moved", "Begun", "Ended"].iter().all(|word| events.contains(word));
        if told { Ok(()) } else { Err(events) }
    })
    .await;

    let here = processes(&home);
    assert_eq!(here.len(), 1);
    assert_eq!(muster(&cluster, &["delete", "app", "corridor"]).0, 0);
    wait::until("gone with its tasks", || async {
        let (_, left, _) = muster(&cluster, &["get", "app,tasks", "-o", "name"]);
        if left.is_empty() { Ok(()) } else { Err(left) }
    })
    .await;
    assert!(are_gone(&here), "{here:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_part_on_a_server_that_is_lost_comes_home_and_what_it_left_there_ends_when_it_is_back() {
    let mut cluster = robot_and_cloud().await;
    let mut spec = corridor("exec sleep 1000");
    // Longer than the tolerance: what is silent for so long as both is unfit, which would be as good a reason.
    spec["cooldown"] = json!("15s");
    create(&cluster, spec).await;
    let there = processes(&serves_on(&cluster, "cloud").await);
    cluster.kill_agent("cloud");
    let lost = status(&cluster, "served at home", |status| {
        let ar = status.part("ar");
        ar.is_some_and(|ar| ar.scale.as_deref() == Some("robot") && ar.ready)
    })
    .await;
    let why = lost.timeline.last().expect("it has moved");
    assert_eq!((&*why.part, &*why.reason), ("ar", "Frequency"));
    assert!(why.message.contains("the link of cloud is down"), "{}", why.message);
    let said = status(&cluster, "said that it may run on", |status| {
        status.condition("Degraded").is_some_and(|c| c.reason == "TaskUnreachable")
    })
    .await;
    assert_eq!(said.phase, ApplicationPhase::Running);
    // Its agent is told, as soon as it is back.
    cluster.restart_agent("cloud").await;
    wait::until("the one before gone", || async {
        if are_gone(&there) { Ok(()) } else { Err(format!("{there:?}")) }
    })
    .await;
    // When it has cooled down it is worth more there again.
    assert_eq!(processes(&serves_on(&cluster, "cloud").await).len(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_topic_that_comes_too_slowly_to_a_part_that_is_away_brings_it_home() {
    let cluster = robot_and_cloud().await;
    let says = cluster.dir().join("observed");
    std::fs::write(&says, "/image 12.5\n").expect("the test's directory is writable");
    let look = format!(
        "while :; do cp {} $MUSTER_RUN_DIR/new && mv $MUSTER_RUN_DIR/new $MUSTER_RUN_DIR/observed; sleep 0.2; done",
        says.display()
    );
    create(&cluster, corridor(&look)).await;
    serves_on(&cluster, "cloud").await;
    let hz = |status: &ApplicationStatus| status.connections.first().and_then(|c| c.hz);
    status(&cluster, "told how often", |status| hz(status) == Some(12.5)).await;
    std::fs::write(&says, "/image 2\n").expect("the test's directory is writable");
    let home = serves_on(&cluster, "robot").await;
    let task = home.task.expect("it has a task");
    assert_eq!(task.reason, "Frequency");
    assert!(task.message.contains("/image is below its frequency since"), "{}", task.message);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_that_is_cut_off_begins_by_itself_what_is_away_when_nothing_of_it_runs_there() {
    cut_off(CutOff::Fenced).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_that_is_cut_off_begins_in_time_what_is_away() {
    cut_off(CutOff::InTime).await;
}

async fn cut_off(when: CutOff) {
    let mut cluster = robot_and_cloud().await;
    let mut spec = corridor("exec sleep 1000");
    spec["parts"][1]["whenCutOff"] = json!(when);
    create(&cluster, spec).await;
    let there = processes(&serves_on(&cluster, "cloud").await);
    let stands_by = |status: &ApplicationStatus| {
        let standby = status.part("ar").and_then(|ar| ar.standby.clone());
        standby.filter(|task| !task.uid.is_empty())
    };
    let standby = status(&cluster, "standing by", |status| stands_by(status).is_some()).await;
    let standby = stands_by(&standby).expect("it was waited for");
    let task = cluster.task(&standby.name, "standing by", |s| s.reason == "Standby").await;
    assert_eq!(task.status.and_then(|s| s.node).as_deref(), Some("robot"));
    let begins = task.spec.standby.map(|standby| standby.after.as_duration());
    let begins = begins.expect("it stands by");
    assert_eq!(begins < Duration::from_secs(6), when == CutOff::InTime, "{begins:?}");
    // A node's books are written a moment after what is in them.
    wait::object(cluster.nodes().await, "robot", "keeping what it needs", |node| {
        let status = node.and_then(|node| node.status.as_ref());
        status.is_some_and(|status| status.free.cpu == MilliCpu(800))
    })
    .await;
    assert_eq!(kernel::with_env("MUSTER_UID", &standby.uid), []);

    // Without the controller both are cut off from each other's word.
    cluster.kill_controller();
    let begun = wait::until("begun by the robot", || async {
        let begun = kernel::with_env("MUSTER_UID", &standby.uid);
        let gone = are_gone(&there);
        assert!(begun.is_empty() || gone || when == CutOff::InTime, "both run");
        if begun.is_empty() { Err(format!("gone there: {gone}")) } else { Ok(begun) }
    })
    .await;
    cluster.start_controller().await;
    let home = serves_on(&cluster, "robot").await;
    assert_eq!(home.task.as_ref().map(|task| &task.name), Some(&standby.name));
    assert_eq!(processes(&home), begun, "it was not started again");
}
