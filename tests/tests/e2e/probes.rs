//! Probes with real robots: when a task is Ready and who waits for that, and what becomes of one that is not alive.

use std::path::Path;

use futures::StreamExt as _;
use kube::Api;
use kube::api::{ListParams, Patch, PatchParams, PostParams, WatchEvent, WatchParams};
use muster_api::kind::task::{Task, TaskStatus};
use muster_api::kind::taskset::{TaskSet, TaskSetStatus};
use muster_api::phase::TaskPhase;
use muster_tests::kernel::{self, Process};
use muster_tests::{AgentOptions, Cluster, wait};
use serde_json::{Value, json};

use crate::cli::muster;

/// A probe that looks for a file.
fn looks_for(file: &Path) -> Value {
    let command = json!(["test", "-e", file]);
    json!({"exec": {"command": command}, "period": "200ms", "timeout": "20s", "failureThreshold": 1})
}

async fn one_robot() -> Cluster {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0).flag("--docker-socket", "none")).await;
    cluster
}

async fn events(cluster: &Cluster, task: &str) -> Vec<String> {
    let list = cluster.get("/api/v1/namespaces/default/events").await;
    let about = |e: &&Value| e["involvedObject"]["name"] == task;
    let reason = |e: &Value| e["reason"].as_str().map(str::to_owned);
    list["items"].as_array().into_iter().flatten().filter(about).filter_map(reason).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_is_ready_when_its_probe_says_so_also_after_the_agent_was_killed() {
    let mut cluster = one_robot().await;
    let file = cluster.dir().join("ready");
    let spec = json!({
        "run": {"process": {"command": ["sleep", "1000"]}}, "gracePeriodSeconds": 0,
        "readiness": looks_for(&file),
    });
    cluster.create("probed", spec).await;
    cluster.create("plain", json!({"run": {"process": {"command": ["sleep", "1000"]}}})).await;
    let (code, out, err) = muster(&cluster, &["wait", "task/plain", "--for=condition=Ready"]);
    assert_eq!((code, out.as_str()), (0, "task/plain is Ready=True\n"), "{err}");

    let said = |s: &TaskStatus| s.reason == "NotReady" && s.message.contains("exited with code 1");
    let task = cluster.task("probed", "not ready", said).await;
    let status = task.status.expect("it has one");
    assert_eq!((status.phase, status.ready), (TaskPhase::Running, Some(false)));
    let wait_for_it = ["wait", "task/probed", "--for=condition=Ready", "--timeout=300ms"];
    let (code, _, err) = muster(&cluster, &wait_for_it);
    assert_ne!(code, 0, "{err}");
    let (_, text, _) = muster(&cluster, &["describe", "task/probed"]);
    let line = "now: its readiness probe failed: exited with code 1";
    assert!(text.contains("Ready:           False") && text.contains(line), "{text}");

    std::fs::write(&file, "").expect("a file");
    let (code, out, err) = muster(&cluster, &["wait", "task/probed", "--for=condition=Ready"]);
    assert_eq!((code, out.as_str()), (0, "task/probed is Ready=True\n"), "{err}");
    let (_, table, _) = muster(&cluster, &["get", "tasks", "-o", "wide"]);
    let column = |row: &str, name: &str| {
        let header = table.lines().next().expect("a header");
        let at = header.split_whitespace().position(|h| h == name).expect("the column");
        let row = table.lines().find(|l| l.starts_with(row)).expect("the row");
        row.split_whitespace().nth(at).expect("its cell").to_owned()
    };
    assert_eq!(
        (column("probed", "READY"), column("plain", "READY")),
        ("True".into(), "True".into())
    );

    let uid = task.metadata.uid.expect("a uid");
    // Its first process; those of checks come and go beside it.
    let before = kernel::with_env("MUSTER_UID", &uid).into_iter().min_by_key(|p| (p.start, p.pid));
    cluster.kill_agent("robot");
    cluster.restart_agent("robot").await;
    cluster.task("probed", "ready", TaskStatus::is_ready).await;
    std::fs::remove_file(&file).expect("it is there");
    let task = cluster.task("probed", "not ready", |s| s.ready == Some(false)).await;
    assert_eq!(task.status.expect("it has one").attempt, 1);
    assert!(
        before.is_some_and(|p| kernel::start_time(p.pid) == Some(p.start)),
        "the same process as {before:?}"
    );
    wait::until("told", || async {
        let told = events(&cluster, "probed").await;
        let both = ["Ready", "NotReady"].iter().all(|r| told.iter().any(|t| t == r));
        if both { Ok(()) } else { Err(format!("{told:?}")) }
    })
    .await;
    cluster.delete("probed").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_that_is_not_alive_is_started_again_or_has_failed() {
    let cluster = one_robot().await;
    let file = cluster.dir().join("alive");
    std::fs::write(&file, "").expect("a file");
    let spec = |policy: &str| {
        json!({
            "run": {"process": {"command": ["sleep", "1000"]}}, "restartPolicy": policy,
            "liveness": looks_for(&file),
        })
    };
    for (name, policy) in [("once", "Never"), ("again", "OnFailure")] {
        cluster.create(name, spec(policy)).await;
        cluster.phase(name, TaskPhase::Running).await;
    }
    std::fs::remove_file(&file).expect("it is there");
    let task = cluster.phase("once", TaskPhase::Failed).await;
    let status = task.status.expect("it has one");
    assert_eq!(
        (status.reason.as_str(), status.message.as_str()),
        ("LivenessFailed", "its liveness probe failed: exited with code 1")
    );
    cluster
        .task("again", "backing off", |s| s.reason == "BackOff" && s.message.contains("liveness"))
        .await;
    std::fs::write(&file, "").expect("a file");
    let runs = |s: &TaskStatus| s.phase == TaskPhase::Running && s.attempt > 1;
    cluster.task("again", "running again", runs).await;
    let (code, _, err) = muster(&cluster, &["wait", "task/once", "--for=condition=Ready"]);
    assert_ne!(code, 0);
    assert!(err.contains("ended as Failed LivenessFailed"), "{err}");
}

async fn sets(cluster: &Cluster) -> Api<TaskSet> {
    Api::namespaced(cluster.client().await, "default")
}

/// Waits until a set's status, of its present spec, is as wanted.
async fn status(
    cluster: &Cluster,
    what: &str,
    wanted: impl Fn(&TaskSetStatus) -> bool,
) -> TaskSetStatus {
    let holds = |set: Option<&TaskSet>| {
        set.is_some_and(|set| {
            let status = set.status.clone().unwrap_or_default();
            Some(status.observed_generation) == set.metadata.generation && wanted(&status)
        })
    };
    let set = wait::object(sets(cluster).await, "serve", what, holds).await;
    set.and_then(|set| set.status).expect("it has a status")
}

fn says(status: &TaskSetStatus, reason: &str) -> bool {
    status.condition("Progressing").is_some_and(|c| c.reason == reason)
}

/// Changes what the set's tasks are, and how long one has to become Ready, seconds.
async fn change(cluster: &Cluster, template: Value, deadline: u32) {
    let rollout = json!({"progressDeadlineSeconds": deadline});
    let patch = json!({"spec": {"template": {"spec": template}, "rollout": rollout}});
    let patch = Patch::Merge(patch);
    let api = sets(cluster).await;
    api.patch("serve", &PatchParams::default(), &patch).await.expect("it is taken");
}

/// The set's tasks by whether their template is this one.
async fn split(cluster: &Cluster, script: &str) -> (Vec<Task>, Vec<Task>) {
    let tasks = cluster.tasks().await.list(&ListParams::default()).await.expect("a list").items;
    let is_new = |task: &Task| {
        task.spec
            .run
            .process
            .as_ref()
            .is_some_and(|p| p.command.last().is_some_and(|c| c == script))
    };
    tasks.into_iter().partition(is_new)
}

/// Waits until a task has said this of itself since `from`. What was written is looked at, however short it stood there.
async fn was_said(cluster: &Cluster, from: &str, words: &str) {
    let (tasks, params) = (cluster.tasks().await, WatchParams::default().timeout(60));
    let mut events = tasks.watch(&params, from).await.expect("a watch").boxed();
    while let Some(event) = events.next().await {
        if let Ok(WatchEvent::Added(task) | WatchEvent::Modified(task)) = event
            && task.status.is_some_and(|status| status.message.contains(words))
        {
            return;
        }
    }
    panic!("no task said {words:?}");
}

fn processes(tasks: &[Task]) -> Vec<Process> {
    let uids = tasks.iter().filter_map(|task| task.metadata.uid.as_deref());
    uids.flat_map(|uid| kernel::with_env("MUSTER_UID", uid)).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_rollout_waits_for_ready_and_goes_back_when_a_probe_fails() {
    let mut cluster = Cluster::start().await;
    for (name, x) in [("near", 0.0), ("middle", 10.0), ("far", 20.0)] {
        cluster.join(AgentOptions::robot(name, x, 0.0).flag("--docker-socket", "none")).await;
    }
    // Each task looks for a file that is named after its program and its robot.
    let dir = cluster.dir().to_owned();
    let probe = |script: &str| {
        let test = format!("test -e {}/{}-$MUSTER_NODE", dir.display(), script.replace(' ', "-"));
        json!({"exec": {"command": ["sh", "-c", test]}, "period": "200ms", "timeout": "20s"})
    };
    let run = |script: &str| json!({"process": {"command": ["sh", "-c", script]}});
    let good = |script: &str, node: &str| {
        let file = dir.join(format!("{}-{node}", script.replace(' ', "-")));
        std::fs::write(file, "").expect("a file");
    };
    let (first, second) = ("exec sleep 1001", "exec sleep 1002");
    for node in ["near", "middle", "far"] {
        good(first, node);
    }
    let set = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "TaskSet", "metadata": {"name": "serve"},
        "spec": {
            "replicas": 3, "minReadySeconds": 0, "rollout": {"progressDeadlineSeconds": 600},
            "template": {"spec": {
                "gracePeriodSeconds": 0, "placement": {"at": {"x": 0.0, "y": 0.0}},
                "resources": {"sensors": ["kinect:LaserGen"]},
                "run": run(first), "readiness": probe(first),
            }},
        },
    });
    let set: TaskSet = serde_json::from_value(set).expect("a set");
    sets(&cluster).await.create(&PostParams::default(), &set).await.expect("the set is taken");
    let complete = |s: &TaskSetStatus| says(s, "Complete") && s.available_replicas == 3;
    status(&cluster, "complete", complete).await;

    // Each new task runs and is not ready: the next is changed when it is.
    change(&cluster, json!({"run": run(second), "readiness": probe(second)}), 600).await;
    for changed in 1..=3 {
        let tried = wait::until("a new task that is not ready", || async {
            let (new, old) = split(&cluster, second).await;
            let not_ready = |task: &&Task| {
                task.status
                    .as_ref()
                    .is_some_and(|s| s.phase == TaskPhase::Running && s.ready == Some(false))
            };
            match new.iter().find(not_ready) {
                Some(task) if new.len() == changed => {
                    assert_eq!(old.len(), 3 - changed, "one at a time");
                    Ok(task.clone())
                }
                _ => Err(format!("{new:#?}")),
            }
        })
        .await;
        good(second, &tried.status.and_then(|s| s.node).expect("it is placed"));
    }
    status(&cluster, "complete", complete).await;
    let before = processes(&split(&cluster, second).await.0);

    // Never ready in time.
    let fails = json!({"exec": {"command": ["sh", "-c", "echo no map; exit 7"]},
        "period": "200ms", "timeout": "20s", "failureThreshold": 1});
    change(&cluster, json!({"readiness": fails}), 20).await;
    let back = |s: &TaskSetStatus| {
        says(s, "RolledBack") && s.available_replicas == 3 && s.replacing.is_empty()
    };
    let why = status(&cluster, "rolled back", back).await.rolled_back_from.expect("given up");
    assert_eq!(why.reason, "ProbeFailed", "{}", why.message);
    let said = "was not ready within 20 s: its readiness probe failed: exited with code 7: no map";
    assert!(why.message.ends_with(said), "{}", why.message);

    // Not alive, before it could be ready.
    let from = cluster.tasks().await.list(&ListParams::default()).await.expect("a list");
    let from = from.metadata.resource_version.expect("a list has one");
    change(&cluster, json!({"readiness": fails, "liveness": fails}), 600).await;
    let not_alive = |s: &TaskSetStatus| {
        back(s) && s.rolled_back_from.as_ref().is_some_and(|r| r.reason == "Crashed")
    };
    let why = status(&cluster, "rolled back", not_alive).await.rolled_back_from.expect("given up");
    let said = "its liveness probe failed: exited with code 7: no map";
    // When the next attempt begins before the set is looked at, only how the one before ended is known: by SIGKILL or SIGTERM.
    let ends = [said, "ended by signal", "exited with code 137", "exited with code 143"];
    assert!(ends.iter().any(|words| why.message.contains(words)), "{}", why.message);
    was_said(&cluster, &from, said).await;
    let after = processes(&split(&cluster, second).await.0);
    let same = before.iter().filter(|process| after.contains(process)).count();
    assert_eq!(same, 2, "only the canary was touched: {before:?} {after:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_check_sees_what_its_task_is_given() {
    let mut cluster = one_robot().await;
    let secret = json!({
        "apiVersion": "v1", "kind": "Secret", "metadata": {"name": "camera"},
        "stringData": {"password": "change-me"},
    });
    cluster.post("/api/v1/namespaces/default/secrets", &secret).await;
    let test = "[ \"$CAMERA_password\" = change-me ] && grep -q change-me keys/password";
    let spec = json!({
        "run": {"process": {
            "command": ["sleep", "1000"],
            "envFrom": [{"prefix": "CAMERA_", "secretRef": {"name": "camera"}}],
            "files": [{"secret": "camera", "mountPath": "keys"}],
        }},
        "gracePeriodSeconds": 0,
        "readiness": {"exec": {"command": ["sh", "-c", test]}, "period": "200ms", "timeout": "20s"},
    });
    cluster.create("given", spec).await;
    cluster.task("given", "ready", TaskStatus::is_ready).await;
    let log = cluster.log_of("robot");
    cluster.kill_agent("robot");
    cluster.restart_agent("robot").await;
    cluster.task("given", "ready again", TaskStatus::is_ready).await;
    assert!(!log.contains("change-me"), "{log}");
    cluster.delete("given").await;
}
