//! The SDKs' examples, as they are, against a controller and agents that are real.

use std::path::Path;
use std::process::{Output, Stdio};

use futures::StreamExt as _;
use kube::api::{ListParams, WatchEvent, WatchParams};
use muster_api::kind::task::{Task, TaskStatus};
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, cluster, kernel, puppet, wait};
use tokio::process::{Child, Command};

/// Robots by their places on the x axis, metres, and a cloud server.
async fn building(robots: &[(&str, f64)]) -> Cluster {
    let mut cluster = Cluster::start().await;
    // What is found after a node is ready makes its offer anew, and these examples need none of it.
    let without = |options: AgentOptions| options.flag("--docker-socket", "none");
    for (name, x) in robots {
        cluster.join(without(AgentOptions::robot(name, *x, 0.0))).await;
    }
    cluster.join(without(AgentOptions::cloud("cloud-1"))).await;
    cluster
}

fn rust(cluster: &Cluster, example: &str) -> Command {
    let mut command = Command::new(cluster::example(example));
    command.env("MUSTER_CONFIG", cluster.kubeconfig());
    command
}

fn python(cluster: &Cluster, example: &str) -> Command {
    let examples = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../api/python/examples"));
    let mut command = Command::new(puppet::python());
    command.arg(examples.join(example)).arg("--kubeconfig").arg(cluster.kubeconfig());
    command
}

fn spawn(mut command: Command) -> Child {
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).kill_on_drop(true);
    command.spawn().expect("the example runs")
}

/// What it had said when it ended.
async fn end(program: Child) -> (Output, String) {
    let output = tokio::time::timeout(wait::DEADLINE, program.wait_with_output()).await;
    let output = output.expect("it ends in time").expect("it is ours");
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    eprintln!("{said}{}", String::from_utf8_lossy(&output.stderr));
    (output, said)
}

async fn tasks(cluster: &Cluster) -> Vec<(Task, TaskStatus)> {
    let list = cluster.tasks().await.list(&ListParams::default()).await.expect("a list");
    let status = |task: Task| task.status.clone().map(|status| (task, status));
    list.items.into_iter().filter_map(status).collect()
}

/// Where tasks drove since `from`, in that order: by what was written, however short each was.
async fn drove(cluster: &Cluster, from: &str, robots: usize) -> Vec<String> {
    let (tasks, params) = (cluster.tasks().await, WatchParams::default().timeout(60));
    let mut events = tasks.watch(&params, from).await.expect("a watch").boxed();
    let mut seen = Vec::new();
    while seen.len() < robots
        && let Some(event) = events.next().await
    {
        if let Ok(WatchEvent::Added(task) | WatchEvent::Modified(task)) = event
            && let Some(status) = task.status
            && matches!(status.phase, TaskPhase::Running | TaskPhase::Succeeded)
            && status.lease.is_some()
            && let Some(node) = status.node
            && !seen.contains(&node)
        {
            seen.push(node);
        }
    }
    seen
}

/// Everything of the example is gone, and every robot is free to drive.
async fn nothing_left(cluster: &Cluster) {
    wait::until("empty", || async {
        let all = tasks(cluster).await;
        if all.is_empty() { Ok(()) } else { Err(format!("{all:#?}")) }
    })
    .await;
    for lease in cluster.leases().await.list(&ListParams::default()).await.expect("a list").items {
        assert_eq!(lease.status.and_then(|s| s.holder), None);
    }
}

/// Each goal has another robot beside it, and a third is nowhere near.
const DELIVERIES: [(&str, f64); 3] = [("tb-1", 3.0), ("tb-2", 20.0), ("tb-3", 40.0)];

async fn deliver(command: impl FnOnce(&Cluster) -> Command) -> String {
    let cluster = building(&DELIVERIES).await;
    let start = cluster.tasks().await.list(&ListParams::default()).await.expect("a list");
    let start = start.metadata.resource_version.expect("a list has one");
    let (output, said) = end(spawn(command(&cluster))).await;
    assert_eq!(output.status.code(), Some(0));
    nothing_left(&cluster).await;
    assert_eq!(drove(&cluster, &start, 2).await, ["tb-1", "tb-2"]);
    said
}

#[tokio::test(flavor = "multi_thread")]
async fn deliver_in_rust_drives_the_nearest_robot_to_each_goal() {
    let said = deliver(|cluster| {
        let mut command = rust(cluster, "deliver");
        command.args(["3,1", "20,2"]);
        command
    })
    .await;
    let lines: Vec<&str> = said.lines().collect();
    let expected =
        ["tb-1 drives, 1.00 m away", "next: 20,2", "tb-2 drives, 2.00 m away", "delivered"];
    assert_eq!(lines, expected);
}

#[tokio::test(flavor = "multi_thread")]
async fn deliver_in_python_drives_the_nearest_robot_to_each_goal() {
    let said = deliver(|cluster| {
        let mut command = python(cluster, "deliver.py");
        command.args(["--goal", "3,1", "--goal", "20,2", "--radius", "10"]);
        command
    })
    .await;
    for goal in ["goal 3.0,1.0: tb-1, 1.00 m away", "goal 20.0,2.0: tb-2, 2.00 m away"] {
        assert_eq!(said.matches(goal).count(), 1, "{goal}");
    }
    assert_eq!(said.matches("SUCCEEDED").count(), 2);
}

/// Uids of the tasks that run on two robots and the cloud server, in this order.
async fn patrolling(cluster: &Cluster, but: Option<&str>) -> Vec<String> {
    wait::until("patrolling", || async {
        let all = tasks(cluster).await;
        let mut running: Vec<_> = all
            .iter()
            .filter(|(_, s)| s.phase == TaskPhase::Running)
            .map(|(t, s)| (s.node.clone(), s.lease.is_some(), t.metadata.uid.clone()))
            .collect();
        running.sort();
        let uids: Vec<String> = running.iter().filter_map(|(.., uid)| uid.clone()).collect();
        let places: Vec<_> =
            running.iter().map(|(node, drives, _)| (node.as_deref(), *drives)).collect();
        let wanted = [(Some("cloud-1"), false), (Some("tb-1"), true), (Some("tb-2"), true)];
        if places == wanted && !but.is_some_and(|gone| uids.iter().any(|uid| uid == gone)) {
            return Ok(uids);
        }
        Err(format!("{all:#?}"))
    })
    .await
}

/// Two robots and the cloud server are taken; what ends is launched again; interrupted, it leaves nothing behind.
async fn patrol(command: impl FnOnce(&Cluster) -> Command) -> (Output, String) {
    let cluster = building(&[("tb-1", 0.0), ("tb-2", 4.0)]).await;
    let program = spawn(command(&cluster));
    let before = patrolling(&cluster, None).await;
    let all = tasks(&cluster).await;
    let one = all.iter().find(|(task, _)| task.metadata.uid.as_ref() == before.get(1));
    let name = one.and_then(|(task, _)| task.metadata.name.clone()).expect("it drives tb-1");
    let deleted = cluster.tasks().await.delete(&name, &Default::default()).await;
    deleted.expect("it is there");
    patrolling(&cluster, Some(&before[1])).await;
    kernel::interrupt(program.id().expect("it runs"));
    let ended = end(program).await;
    nothing_left(&cluster).await;
    ended
}

#[tokio::test(flavor = "multi_thread")]
async fn patrol_in_rust_takes_two_robots_and_recognises_in_the_cloud() {
    let (output, said) = patrol(|cluster| {
        let mut command = rust(cluster, "patrol");
        command.arg("0,0");
        command
    })
    .await;
    assert_eq!(output.status.code(), Some(0));
    assert_eq!(said.matches("recognition on cloud-1\n").count(), 1, "{said}");
    assert_eq!(said.matches("on tb-1\n").count(), 2, "{said}");
    assert_eq!(said.matches("on tb-2\n").count(), 1, "{said}");
}

#[tokio::test(flavor = "multi_thread")]
async fn patrol_in_python_takes_two_robots_and_recognises_in_the_cloud() {
    let (output, said) = patrol(|cluster| {
        let mut command = python(cluster, "patrol.py");
        command.args(["--at", "0,0", "--radius", "50"]);
        command
    })
    .await;
    assert_eq!(output.status.code(), Some(130), "interrupted");
    assert_eq!(said.matches("recognise: cloud-1\n").count(), 1, "{said}");
    assert_eq!(said.matches(": tb-1\n").count(), 2, "{said}");
    assert_eq!(said.matches(": tb-2\n").count(), 1, "{said}");
}
