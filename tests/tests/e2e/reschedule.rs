//! A task that fails on one robot and does its work on the next, followed by the commands that people follow it with.

use std::path::Path;
use std::process::Stdio;

use muster_api::kind::task::TaskStatus;
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, cluster::binary, wait};
use serde_json::json;
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::Command;

use crate::cli::muster;

/// It breaks on the robot `near`, and works elsewhere; either when the test has made a file for it.
fn script(broken: &Path, works: &Path) -> String {
    let until = |file: &Path| format!("until [ -e {} ]; do sleep 0.05; done", file.display());
    format!(
        "if [ $MUSTER_NODE = near ]; then echo broken here; {}; exit 3; fi; echo works here; {}",
        until(broken),
        until(works)
    )
}

fn manifest(command: &str, backoff: &str) -> String {
    format!(
        "apiVersion: muster.dev/v1alpha1\nkind: Task\nmetadata: {{name: work}}\nspec:\n  \
         placement: {{at: {{x: 0, y: 0}}, within: 10}}\n  \
         reschedule: {{maxAttempts: 2, backoff: {backoff}}}\n  gracePeriodSeconds: 0\n  \
         resources: {{cpu: 100m, actuators: ['base:Drive']}}\n  \
         run: {{process: {{command: [sh, -c, '{command}']}}}}\n"
    )
}

async fn two_robots() -> Cluster {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("near", 1.0, 0.0)).await;
    cluster.join(AgentOptions::robot("far", 5.0, 0.0)).await;
    cluster
}

fn apply(cluster: &Cluster, text: &str) {
    let file = cluster.dir().join("work.yaml");
    std::fs::write(&file, text).expect("writable");
    let (code, out, err) = muster(cluster, &["apply", "-f", file.to_str().expect("text")]);
    assert_eq!((code, out.as_str()), (0, "task/work created\n"), "{err}");
}

#[tokio::test(flavor = "multi_thread")]
async fn commands_follow_a_task_from_robot_to_robot() {
    let cluster = two_robots().await;
    let (broken, works) = (cluster.dir().join("broken"), cluster.dir().join("works"));
    apply(&cluster, &manifest(&script(&broken, &works), "500ms"));
    let running = cluster.phase("work", TaskPhase::Running).await;
    let first = running.metadata.uid.clone().expect("it has one");
    let mut logs = Command::new(binary("muster"))
        .args(["logs", "-f", "work"])
        .env("MUSTER_CONFIG", cluster.kubeconfig())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .kill_on_drop(true)
        .spawn()
        .expect("it starts");
    let mut lines = BufReader::new(logs.stdout.take().expect("it is piped")).lines();
    for (line, file) in [("broken here", &broken), ("works here", &works)] {
        let said = tokio::time::timeout(wait::DEADLINE, lines.next_line()).await;
        let said = said.unwrap_or_else(|_| panic!("no {line:?} in time"));
        assert_eq!(said.expect("it can be read").as_deref(), Some(line));
        std::fs::write(file, "").expect("a file");
    }
    let (code, out, err) =
        muster(&cluster, &["wait", "task/work", "--for=phase=Succeeded", "--timeout=60s"]);
    assert_eq!((code, out.as_str()), (0, "task/work is Succeeded\n"), "{err}");
    assert_eq!(lines.next_line().await.expect("it can be read"), None);
    let logs = logs.wait_with_output().await.expect("it is ours");
    let said = String::from_utf8_lossy(&logs.stderr);
    assert!(said.contains("task/work goes on on far"), "{said}");

    let task = cluster.phase("work", TaskPhase::Succeeded).await;
    assert_ne!(task.metadata.uid.as_ref(), Some(&first));
    let status = task.status.expect("it has one");
    assert_eq!(status.node.as_deref(), Some("far"));
    let one = &status.earlier[0];
    assert_eq!((&*one.uid, &*one.node, one.exit_code), (&*first, "near", Some(3)));
    let (_, described, _) = muster(&cluster, &["describe", "task", "work"]);
    for part in ["Tried before", "near", "exited with code 3", "up to 2 attempts, after 500ms"] {
        assert!(described.contains(part), "{part:?} is not in\n{described}");
    }
    let (_, table, _) = muster(&cluster, &["get", "tasks"]);
    let row = table.lines().find(|line| line.starts_with("work")).expect("a row");
    assert!(row.contains(" 2/2 "), "{table}");
    // Both leases are free, and the first one's was held once.
    for lease in ["near.body", "far.body"] {
        let object = cluster.leases().await.get(lease).await.expect("it is there");
        assert!(object.status.is_none_or(|s| s.holder.is_none()), "{lease}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn why_tells_what_it_waits_for_and_a_start_that_cannot_be_made_counts() {
    let cluster = two_robots().await;
    // There is no such program anywhere.
    apply(
        &cluster,
        &manifest("exec /nowhere/at/all", "1h")
            .replace("backoff: 1h", "backoff: 1h, maxBackoff: 1h"),
    );
    cluster.task("work", "held", |s| s.why.iter().any(|w| w.reason == "BackOff")).await;
    let (code, why, err) = muster(&cluster, &["why", "task/work"]);
    assert_eq!(code, 0, "{err}");
    assert!(why.starts_with("task/work waits: it failed on near ("), "{why}");
    for part in [
        "attempt 2 of 2",
        "TriedBefore",
        "nodes that were not tried come first",
        "It was tried before:",
    ] {
        assert!(why.contains(part), "{part:?} is not in\n{why}");
    }
    cluster.delete("work").await;
    // A program that fails everywhere: it ends with what was tried where.
    cluster
        .create(
            "hopeless",
            json!({
                "reschedule": {"maxAttempts": 2, "backoff": "100ms"}, "gracePeriodSeconds": 0,
                "placement": {"on": "Robot", "at": {"x": 0, "y": 0}},
                "run": {"process": {"command": ["/nowhere/at/all"]}},
            }),
        )
        .await;
    let is_over = |s: &TaskStatus| s.reason == "AttemptsExhausted";
    let status = cluster.task("hopeless", "given up", is_over).await.status.expect("it has one");
    assert_eq!(status.phase, TaskPhase::Failed);
    assert!(status.message.contains("1 on near (StartError"), "{}", status.message);
    assert!(status.message.contains("1 on far (StartError"), "{}", status.message);
    let args = ["wait", "task/hopeless", "--for=phase=Running", "--timeout=30s"];
    let (code, _, err) = muster(&cluster, &args);
    assert!(code != 0 && err.contains("ended as Failed AttemptsExhausted"), "{err}");
}
