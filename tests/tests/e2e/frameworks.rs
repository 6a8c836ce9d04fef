//! Frameworks through the Python SDK, with real agents: Figure 4 of Avalon, and what happens when a framework dies.

use std::collections::BTreeMap;

use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, Puppet, kernel, puppet, wait};
use serde_json::{Value, json};

fn spec(cpu: Option<&str>, sensors: &[&str], actuators: &[&str]) -> Value {
    let mut resources = json!({"memory": "16Mi", "sensors": sensors, "actuators": actuators});
    if let Some(cpu) = cpu {
        resources["cpu"] = cpu.into();
    }
    json!({
        "resources": resources,
        "run": {"process": {"command": ["sh", "-c", "while :; do sleep 1; done"]}},
        "gracePeriodSeconds": 0,
    })
}

async fn two_robots() -> Cluster {
    let mut cluster = Cluster::start().await;
    for (name, x) in [("slave-1", 0.0), ("slave-2", 10.0)] {
        let options = AgentOptions::robot(name, x, 0.0).flag("--cpu", "1").flag("--memory", "1Gi");
        // A node may find Docker after it is ready: then what it offers is offered anew.
        cluster.join(options.flag("--docker-socket", "none")).await;
    }
    cluster
}

fn cpu(offers: &BTreeMap<String, Value>, node: &str) -> Option<u64> {
    offers.get(node)?["cpu"].as_u64()
}

fn list(offers: &BTreeMap<String, Value>, node: &str, what: &str) -> usize {
    offers.get(node).and_then(|o| o[what].as_array()).map_or(0, Vec::len)
}

/// Metres from the frameworks' position.
fn one_score(node: &str) -> Option<f64> {
    Some(if node == "slave-1" { 0.0 } else { 10.0 })
}

/// Steps 1 to 7 of Avalon, III-D: what is offered after each.
#[tokio::test(flavor = "multi_thread")]
async fn figure_4_of_avalon_with_frameworks() {
    // 1: two robots report what they have and where they are.
    let cluster = two_robots().await;

    // 2 and 3: framework 1 says where it works, and is offered both, the nearest first.
    let mut one =
        Puppet::start(&cluster, json!({"name": "one", "position": [0.0, 0.0], "radius": 10.0}))
            .await;
    one.holds("both robots, whole", |o| {
        cpu(o, "slave-1") == Some(1000) && cpu(o, "slave-2") == Some(1000)
    })
    .await;
    assert_eq!(one.holding["slave-1"]["score"], 0.0);
    assert_eq!(one.holding["slave-2"]["score"], 10.0, "the rim is inside");
    assert_eq!(list(&one.holding, "slave-1", "actuators"), 2);

    // 4 and 5: it launches task 1 and task 2 at once; each takes CR and all AR of its robot.
    let launched = one
        .launch(&[
            ("slave-1", "task-1", spec(Some("600m"), &["kinect:LaserGen"], &["base:Drive"])),
            ("slave-2", "task-2", spec(Some("1"), &["kinect:LaserGen"], &["arm:Grasp"])),
        ])
        .await;
    assert_eq!(launched["event"], "launched", "{launched}");
    for (task, node) in [("task-1", "slave-1"), ("task-2", "slave-2")] {
        one.hears(task, "RUNNING").await;
        let status = cluster.phase(task, TaskPhase::Running).await.status.expect("running");
        assert_eq!(status.node.as_deref(), Some(node));
        assert_eq!(status.score, one_score(node), "the offer's");
        assert_eq!(status.lease.map(|l| (l.name, l.epoch.0)), Some((format!("{node}.body"), 1)));
    }

    // 6: framework 2, at the same position, is offered the remaining CR and all SR of slave 1, and all SR of slave 2.
    let two = json!({"name": "two", "position": [0.0, 0.0], "radius": 10.0});
    let mut two = Puppet::start(&cluster, two).await;
    two.holds("what is left", |o| cpu(o, "slave-1") == Some(400) && cpu(o, "slave-2") == Some(0))
        .await;
    for node in ["slave-1", "slave-2"] {
        assert_eq!(list(&two.holding, node, "sensors"), 2, "sensors are shared");
        assert_eq!(list(&two.holding, node, "actuators"), 0, "actuators are held");
    }
    let refused =
        two.launch(&[("slave-1", "second-driver", spec(None, &[], &["arm:Grasp"]))]).await;
    assert_eq!(refused["reason"], "CONFLICT", "{refused}");

    // A framework decides itself where a task is tried again.
    let mut again = spec(None, &[], &[]);
    again["reschedule"] = json!({});
    let refused = two.launch(&[("slave-1", "again", again)]).await;
    assert_eq!(refused["reason"], "INVALID", "{refused}");

    // 7: its two tasks, which need SR, are deployed beside the first ones.
    two.holds("both again", |o| o.len() == 2).await;
    let launched = two
        .launch(&[
            ("slave-1", "sr-1", spec(Some("300m"), &["kinect:ImageGen"], &[])),
            ("slave-2", "sr-2", spec(None, &["kinect:ImageGen"], &[])),
        ])
        .await;
    assert_eq!(launched["event"], "launched", "{launched}");
    two.hears("sr-1", "RUNNING").await;
    two.hears("sr-2", "RUNNING").await;

    // A third that joins later gets the remaining CR and all SR of both robots.
    let mut three = Puppet::start(&cluster, json!({"name": "three", "position": [5.0, 0.0]})).await;
    three
        .holds("the rest", |o| cpu(o, "slave-1") == Some(100) && cpu(o, "slave-2") == Some(0))
        .await;
    for node in ["slave-1", "slave-2"] {
        assert_eq!(list(&three.holding, node, "sensors"), 2, "all SR of {node}");
        assert_eq!(list(&three.holding, node, "actuators"), 0, "and no AR");
    }
    // A declared task takes from the same books, and the third sees it at once.
    cluster
        .create(
            "declared",
            json!({"placement": {"node": "slave-1"}, "resources": {"cpu": "60m"},
            "run": {"process": {"command": ["sleep", "1000"]}}}),
        )
        .await;
    three.holds("less", |o| cpu(o, "slave-1") == Some(40)).await;

    // Ended by its framework, a driver's robot is offered with its actuators again.
    let task = launched_id(&cluster, "task-1").await;
    one.order(json!({"do": "kill", "task": task, "grace": 0})).await;
    one.hears("task-1", "FAILED").await;
    three.holds("actuators", |o| list(o, "slave-1", "actuators") == 2).await;
    one.order(json!({"do": "stop"})).await;
    one.event("the end", |e| e["event"] == "ended").await;
    three.holds("all but two's", |o| cpu(o, "slave-2") == Some(1000)).await;
}

async fn launched_id(cluster: &Cluster, task: &str) -> String {
    let task = cluster.task(task, "there", |_| true).await;
    task.metadata.uid.expect("a uid")
}

/// A framework that dies and comes back with its id finds its tasks as they were; one that stays away loses them.
#[tokio::test(flavor = "multi_thread")]
async fn a_framework_fails_over_or_its_tasks_end() {
    let cluster = two_robots().await;
    let info =
        |id: &str, timeout: f64| json!({"name": "fragile", "id": id, "failover_timeout": timeout});
    let mut first = Puppet::start(&cluster, info("", 600.0)).await;
    first.holds("offers", |o| o.len() == 2).await;
    let drive = spec(Some("100m"), &[], &["base:Drive"]);
    let launched = first.launch(&[("slave-1", "driver", drive)]).await;
    assert_eq!(launched["event"], "launched", "{launched}");
    first.hears("driver", "RUNNING").await;
    let before = cluster.phase("driver", TaskPhase::Running).await.status.expect("running");
    first.kill().await;

    let id = first.id.clone();
    // Its timeout is short now: the next death is the last.
    let mut again = Puppet::start(&cluster, info(&id, 0.2)).await;
    again.hears("driver", "RUNNING").await;
    let after = cluster.phase("driver", TaskPhase::Running).await.status.expect("running");
    assert_eq!(before.started_at, after.started_at, "it was not started again");
    again.kill().await;

    let gone = wait::object(cluster.tasks().await, "driver", "gone", |t| t.is_none());
    gone.await;
    let mut late = Puppet::start(&cluster, json!({"name": "other"})).await;
    late.holds("the robot's actuators", |o| list(o, "slave-1", "actuators") == 2).await;
}

/// The controller's own absence is no framework's: however long it lasts, they find their tasks as they were.
#[tokio::test(flavor = "multi_thread")]
async fn a_stop_of_the_controller_longer_than_the_failover_timeout_ends_nothing() {
    let mut cluster = two_robots().await;
    let info = json!({"name": "patient", "failover_timeout": 0.1});
    let mut framework = Puppet::start(&cluster, info).await;
    framework.holds("offers", |o| o.len() == 2).await;
    let drive = spec(Some("100m"), &[], &["base:Drive"]);
    let launched = framework.launch(&[("slave-1", "driver", drive)]).await;
    assert_eq!(launched["event"], "launched", "{launched}");
    framework.hears("driver", "RUNNING").await;
    let before = cluster.phase("driver", TaskPhase::Running).await;

    // Sessions end, each with a word in its object, before the process does; the next life takes longer than 0.1 s.
    kernel::interrupt(cluster.controller_pid());
    cluster.await_controller();
    framework.event("the end of the session", |e| e["event"] == "disconnected").await;
    cluster.start_controller().await;
    framework.event("it is back", |e| e["event"] == "reregistered").await;
    framework.holds("offers of the new life", |o| o.len() == 2).await;
    let after = cluster.phase("driver", TaskPhase::Running).await;
    assert_eq!(before.metadata.uid, after.metadata.uid);
    let started = |task: &Task| task.status.as_ref().and_then(|s| s.started_at.clone());
    assert_eq!(started(&before), started(&after), "it was not started again");
}

/// An executor stays alive and runs several tasks; what it holds for them ends with it.
#[tokio::test(flavor = "multi_thread")]
async fn an_executor_runs_tasks_and_talks_to_its_framework() {
    let cluster = two_robots().await;
    let mut framework = Puppet::start(&cluster, json!({"name": "crew"})).await;
    framework.holds("offers", |o| o.len() == 2).await;
    let worker = concat!(env!("CARGO_MANIFEST_DIR"), "/frameworks/worker.py");
    let executor = json!({
        "resources": {"cpu": "200m", "memory": "256Mi"},
        "run": {"process": {"command": [puppet::python(), worker]}},
    });
    let launched = framework.launch(&[("slave-1", "worker", executor)]).await;
    assert_eq!(launched["event"], "launched", "{launched}");
    let word = format!("ready crew {}", framework.id);
    let ready = framework.event("ready", |e| e["event"] == "message" && e["data"] == *word).await;
    assert_eq!(ready["executor"], launched["tasks"]["worker"]);
    assert_eq!(ready["node"], "slave-1");

    let work = json!({
        "resources": {"cpu": "100m", "actuators": ["base:Drive"]},
        "run": {"executor": {"task": "worker", "data": {"goal": [1, 2]}}},
    });
    let elsewhere = framework.launch(&[("slave-2", "lost", work.clone())]).await;
    assert_eq!(elsewhere["reason"], "CONFLICT", "its executor is not there: {elsewhere}");
    let known = |o: &BTreeMap<String, Value>| o.get("slave-1").map(|o| o["executors"].clone());
    let there = json!({"worker": ready["executor"]});
    framework
        .holds("what is left", |o| {
            cpu(o, "slave-1") == Some(800) && known(o).as_ref() == Some(&there)
        })
        .await;
    let mut stranger = Puppet::start(&cluster, json!({"name": "stranger"})).await;
    stranger.holds("offers", |o| o.len() == 2).await;
    assert_eq!(known(&stranger.holding), Some(json!({})), "it is not the stranger's");
    let refused = stranger.launch(&[("slave-1", "intruder", work.clone())]).await;
    let why = (refused["reason"].as_str(), refused["message"].to_string());
    assert!(why.0 == Some("CONFLICT") && why.1.contains("worker"), "nor is its work: {refused}");
    drop(stranger);
    let launched = framework.launch(&[("slave-1", "work-1", work.clone())]).await;
    assert_eq!(launched["event"], "launched", "{launched}");
    framework.hears("work-1", "RUNNING").await;
    let status = cluster.phase("work-1", TaskPhase::Running).await.status.expect("running");
    assert_eq!(status.lease.map(|l| l.epoch.0), Some(1), "work may drive");

    let to = |data: &str| json!({"do": "message", "executor": ready["executor"], "data": data});
    framework.order(to("grüße")).await;
    framework.event("an echo", |e| e["event"] == "message" && e["data"] == "grüße").await;
    framework.order(to("finish work-1")).await;
    framework.hears("work-1", "SUCCEEDED").await;
    framework.holds("the actuators again", |o| list(o, "slave-1", "actuators") == 2).await;

    // With its executor gone, nobody does the work any more.
    let launched = framework.launch(&[("slave-1", "work-2", work)]).await;
    assert_eq!(launched["event"], "launched", "{launched}");
    framework.hears("work-2", "RUNNING").await;
    framework.order(json!({"do": "kill", "task": ready["executor"], "grace": 0})).await;
    let end = framework
        .event("the end of work-2", |e| e["name"] == "work-2" && e["state"] == "FAILED")
        .await;
    assert_eq!(end["reason"], "ExecutorLost");
    framework.holds("no executor", |o| known(o) == Some(json!({}))).await;
    framework.holds("the actuators at last", |o| list(o, "slave-1", "actuators") == 2).await;
}

/// A framework that does not answer (SIGSTOP) and has less than the others holds offers of everything, and holds up neither
/// another framework nor declared tasks; when it goes on, it is told what is so now.
#[tokio::test(flavor = "multi_thread")]
async fn a_frozen_framework_delays_nobody() {
    let cluster = two_robots().await;
    let namespace = json!({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": "poor"}});
    cluster.post("/api/v1/namespaces", &namespace).await;
    let info = json!({"name": "frozen", "namespace": "poor"});
    let mut frozen = Puppet::start(&cluster, info).await;
    frozen.holds("both robots", |o| o.len() == 2).await;
    // The other namespace has something already, so it is the one that waits for who has less.
    let queued = |cpu: &str| {
        json!({"placement": {"node": "slave-2"}, "resources": {"cpu": cpu, "actuators": ["base:Drive"]},
            "run": {"process": {"command": ["sleep", "1000"]}}, "gracePeriodSeconds": 0})
    };
    cluster.create("first", queued("200m")).await;
    cluster.phase("first", TaskPhase::Running).await;
    frozen.holds("what is left of it", |o| cpu(o, "slave-2") == Some(800)).await;
    kernel::freeze(frozen.pid(), true);

    let mut lively =
        Puppet::start(&cluster, json!({"name": "lively", "namespace": "default"})).await;
    for round in 1..=5 {
        lively.holds("a robot to drive", |o| list(o, "slave-1", "actuators") == 2).await;
        let name = format!("drive-{round}");
        let drive = spec(Some("700m"), &[], &["base:Drive"]);
        let launched = lively.launch(&[("slave-1", &name, drive)]).await;
        assert_eq!(launched["event"], "launched", "{launched}");
        lively.hears(&name, "RUNNING").await;
        lively.holds("what is left", |o| cpu(o, "slave-1") == Some(300)).await;
        if round < 5 {
            lively.order(json!({"do": "kill", "task": launched["tasks"][&name], "grace": 0})).await;
            lively.hears(&name, "FAILED").await;
        }
    }
    // Declared tasks take the other robot after one another, though the frozen one is offered it each time.
    for (before, next) in [("first", "second"), ("second", "third")] {
        cluster.create(next, queued("200m")).await;
        cluster.delete(before).await;
        cluster.phase(next, TaskPhase::Running).await;
    }

    kernel::freeze(frozen.pid(), false);
    let rest = |o: &BTreeMap<String, Value>| {
        cpu(o, "slave-1") == Some(300) && list(o, "slave-1", "actuators") == 0
    };
    frozen.holds("what the other left", rest).await;
}

/// A robot that declared tasks of one namespace queue for is left to the framework of another that has less, when it comes free.
#[tokio::test(flavor = "multi_thread")]
async fn declared_tasks_do_not_starve_a_framework() {
    let cluster = two_robots().await;
    let namespace = json!({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": "lab"}});
    cluster.post("/api/v1/namespaces", &namespace).await;
    let queued = |node: &str| {
        json!({"placement": {"node": node}, "resources": {"actuators": ["base:Drive"]},
            "run": {"process": {"command": ["sleep", "1000"]}}, "gracePeriodSeconds": 0})
    };
    // One robot is the other namespace's for good, and it queues for the second one.
    cluster.create("other", queued("slave-2")).await;
    cluster.create("first", queued("slave-1")).await;
    for name in ["other", "first"] {
        cluster.phase(name, TaskPhase::Running).await;
    }
    cluster.create("second", queued("slave-1")).await;
    cluster.task("second", "waiting", |s| !s.why.is_empty()).await;
    let wish = json!({"name": "lab", "namespace": "lab", "filter": {"anyActuator": true}});
    let mut lab = super::lines::Session::open(&cluster, wish).await;
    cluster.delete("first").await;
    // With free actuators: nobody has taken them before it could hear of it.
    let offer = lab.offer_of("slave-1").await;
    lab.say(json!({"decline": {"offers": [offer], "refuseSeconds": 3600}})).await;
    cluster.phase("second", TaskPhase::Running).await;
}
