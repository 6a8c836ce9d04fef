//! Probes of topics: a task is Ready while a real topic is published often enough, and is ended when it should not be silent.

use muster_api::kind::task::TaskStatus;
use muster_tests::{AgentOptions, Cluster, Ros, wait};
use serde_json::{Value, json};

async fn one_robot() -> Cluster {
    let mut cluster = Cluster::start().await;
    let robot = AgentOptions::robot("robot", 0.0, 0.0).flag("--docker-socket", "none");
    cluster.join(robot.flag("--ros-host", "127.0.0.1")).await;
    cluster
}

fn sleeps(env: &[(&str, &str)], readiness: Value) -> Value {
    let env: Vec<Value> =
        env.iter().map(|(name, value)| json!({"name": name, "value": value})).collect();
    json!({
        "run": {"process": {"command": ["sleep", "1000"], "env": env}}, "gracePeriodSeconds": 0,
        "readiness": readiness,
    })
}

fn topic(name: &str, min_hz: f64, within: &str) -> Value {
    let topic = json!({"name": name, "minHz": min_hz, "within": within});
    json!({"topic": topic, "period": "200ms", "failureThreshold": 1})
}

fn publish(ros: &Ros, hz: &str) -> muster_tests::ros::Program {
    ros.spawn("rostopic", &["pub", "-r", hz, "/r1/chatter", "std_msgs/String", "data: x"])
}

/// Waits until a task runs and is not Ready, for a reason that has these words.
async fn not_ready(cluster: &Cluster, task: &str, words: &str) -> String {
    let is = |s: &TaskStatus| s.ready == Some(false) && s.message.contains(words);
    cluster.task(task, words, is).await.status.expect("it has one").message
}

/// Waits until a task is Ready.
async fn ready(cluster: &Cluster, task: &str) -> TaskStatus {
    let task = cluster.task(task, "ready", |s| s.ready == Some(true)).await;
    task.status.expect("it has one")
}

#[tokio::test(flavor = "multi_thread")]
async fn readiness_follows_a_topics_rate_and_two_probes_share_a_subscription() {
    let (ros, cluster) = (Ros::start().await, one_robot().await);
    let master = ros.master();
    let env = [("ROS_MASTER_URI", master.as_str()), ("ROS_NAMESPACE", "/r1")];
    cluster.create("watch", sleeps(&env, topic("chatter", 8.0, "1s"))).await;
    let mut explicit = topic("/r1/chatter", 0.4, "5s");
    explicit["topic"]["master"] = master.as_str().into();
    cluster.create("slow", sleeps(&[], explicit)).await;
    cluster.create("lost", sleeps(&[], topic("/r1/chatter", 1.0, "2s"))).await;
    not_ready(&cluster, "watch", "nobody publishes /r1/chatter").await;
    let why = not_ready(&cluster, "lost", "no ROS master is known").await;
    assert!(why.contains("topic.master") && why.contains("--ros-master"), "{why}");

    let mut fast = publish(&ros, "20");
    ready(&cluster, "watch").await;
    ready(&cluster, "slow").await;
    let info = ros.output("rosnode", &["info", "/muster_probes_robot"]).await;
    assert_eq!(info.matches(" * /r1/chatter [").count(), 1, "{info}");
    assert_eq!(info.matches("direction: inbound").count(), 1, "one connection: {info}");

    // Slower than one asks for, and fast enough for the other.
    let _slow = publish(&ros, "2");
    let info = async || ros.output("rosnode", &["info", "/muster_probes_robot"]).await;
    wait::until("two publishers are connected", || async {
        let text = info().await;
        if text.matches("direction: inbound").count() == 2 { Ok(()) } else { Err(text) }
    })
    .await;
    fast.kill().await;
    let why = not_ready(&cluster, "watch", "/r1/chatter comes at").await;
    assert!(why.contains("Hz over 1 s, at least 8 are asked for"), "{why}");
    ready(&cluster, "slow").await;
    let _fast = publish(&ros, "20");
    ready(&cluster, "watch").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_whose_own_topic_falls_silent_is_ended_and_started_again() {
    let (ros, cluster) = (Ros::start().await, one_robot().await);
    // As long as Python may take to start, and some seconds more.
    let script = "timeout 15 rostopic pub -r 20 /own std_msgs/String 'data: x'; exec sleep 1000";
    let (master, home) = (ros.master(), ros.dir().display().to_string());
    let env = [
        ("ROS_MASTER_URI", master.as_str()),
        ("ROS_IP", "127.0.0.1"),
        ("ROS_HOME", home.as_str()),
        ("PYTHONUNBUFFERED", "1"),
    ];
    let mut spec = sleeps(&env, topic("/own", 5.0, "1s"));
    spec["run"]["process"]["command"] = json!(["sh", "-c", script]);
    spec["restartPolicy"] = "Always".into();
    spec["startup"] = topic("/own", 5.0, "1s");
    spec["startup"]["failureThreshold"] = 100.into();
    spec["liveness"] = topic("/own", 5.0, "1s");
    spec["liveness"]["failureThreshold"] = 2.into();
    cluster.create("talker", spec).await;
    let first = ready(&cluster, "talker").await.attempt;
    cluster.task("talker", "started again", |s| s.attempt > first).await;
    wait::until("told", || async {
        let events = cluster.get("/api/v1/namespaces/default/events").await.to_string();
        let told = events.contains("its liveness probe failed 2 times in a row");
        if told { Ok(()) } else { Err(events) }
    })
    .await;
    ready(&cluster, "talker").await;
}
