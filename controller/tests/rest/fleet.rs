//! Thirty robots in one process, each a session of its own that runs nothing and says what it would: a rollout over a
//! fleet, with one robot that fails, and one on a mission.

use std::collections::{BTreeMap, BTreeSet};

use muster_api::wire::agent::v1 as wire;
use serde_json::{Value, json};
use tokio::task::JoinHandle;

use super::agent::{Session, join, report};
use super::support::*;

const ROBOTS: usize = 30;
const SETS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/tasksets";
/// The robot on which the program `fragile` crashes and the readiness probe of `deaf` fails; its name is the first, so a
/// canary is tried on it.
const WEAK: &str = "robot-00";

/// A robot that says of each of its tasks that it runs, until it is to end.
fn robot(cluster_session: Session, name: String) -> JoinHandle<()> {
    tokio::spawn(async move {
        let mut session = cluster_session;
        let mut said: BTreeMap<String, u64> = BTreeMap::new();
        while let Ok(page) = session.assignments().await {
            for assignment in page.upserts {
                let sequence = said.entry(assignment.uid.clone()).or_default();
                let ending = assignment.stop.is_some();
                // Once that it runs, and once that it ended.
                if assignment.ended || (*sequence > 0 && !ending) || *sequence > 9 {
                    continue;
                }
                let spec: Value = serde_json::from_slice(&assignment.spec).unwrap();
                let runs = |program: &str| {
                    spec["run"]["process"]["command"] == json!([program]) && name == WEAK
                };
                let next = if ending { 10 } else { 1 };
                *sequence = next;
                let mut said = state(&assignment.uid, next, ending, runs("fragile"));
                if runs("deaf") && !ending {
                    said.ready = Some(false);
                    said.message = "its readiness probe failed: HTTP status 503".to_owned();
                }
                session.say(said).await;
            }
        }
    })
}

fn state(uid: &str, sequence: u64, ending: bool, crashes: bool) -> wire::TaskReport {
    let phase = match (ending, crashes) {
        (true, _) => wire::TaskPhase::Succeeded,
        (false, true) => wire::TaskPhase::Starting,
        (false, false) => wire::TaskPhase::Running,
    };
    let mut report = report(uid, sequence, phase);
    if crashes && !ending {
        report.reason = "BackOff".to_owned();
        report.message = "exited with code 3; starts again in 1 s".to_owned();
        report.exit_code = Some(3);
    }
    report
}

async fn fleet(cluster: &Cluster) -> Vec<JoinHandle<()>> {
    let mut robots = Vec::new();
    for i in 0..ROBOTS {
        let name = format!("robot-{i:02}");
        let credential = join(cluster, &name).await;
        let session = Session::open(cluster, &credential, Vec::new()).await.unwrap();
        robots.push(robot(session, name));
    }
    robots
}

fn set(command: &str) -> Value {
    json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "TaskSet", "metadata": {"name": "patrol"},
        "spec": {
            "everyNode": true, "minReadySeconds": 0, "rollout": {"maxUnavailable": 10},
            "template": {"spec": {"placement": {"on": "Robot"}, "run": {"process": {"command": [command]}}}},
        },
    })
}

/// Waits until the rollout is where it should be, and gives the set.
async fn rollout(cluster: &Cluster, reason: &str, updated: usize) -> Value {
    cluster
        .until(&format!("{SETS}/patrol"), |set| {
            let conditions = set["status"]["conditions"].as_array();
            let said = conditions.into_iter().flatten().find(|c| c["type"] == "Progressing");
            said.is_some_and(|c| c["reason"] == reason)
                && set["status"]["observedGeneration"] == set["metadata"]["generation"]
                && set["status"]["updatedReplicas"] == updated
                && set["status"]["availableReplicas"] == ROBOTS
        })
        .await
}

/// The uids of the tasks by the node that they run on.
async fn tasks(client: &kube::Client) -> BTreeMap<String, (String, Value)> {
    let (_, list) = get(client, TASKS).await;
    let items = list["items"].as_array().unwrap();
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    let row = |task: &Value| {
        let command = task["spec"]["run"]["process"]["command"][0].clone();
        (text(&task["status"]["node"]), (text(&task["metadata"]["uid"]), command))
    };
    items.iter().map(row).collect()
}

async fn command(client: &kube::Client, command: &str) {
    let template = json!({"spec": {"run": {"process": {"command": [command]}}}});
    let patch = json!({"spec": {"template": template}});
    let (code, answer) = send(client, "PATCH", &format!("{SETS}/patrol"), patch).await;
    assert_eq!(code, 200, "{answer}");
}

/// How long a changed task gets.
async fn deadline(client: &kube::Client, seconds: u32) {
    let patch = json!({"spec": {"rollout": {"progressDeadlineSeconds": seconds}}});
    let (code, answer) = send(client, "PATCH", &format!("{SETS}/patrol"), patch).await;
    assert_eq!(code, 200, "{answer}");
}

async fn lock(client: &kube::Client, node: &str, lock: Value) {
    let patch = json!({"metadata": {"annotations": {"muster.dev/mission-lock": lock}}});
    let (code, answer) = send(client, "PATCH", &format!("{G}/nodes/{node}"), patch).await;
    assert_eq!(code, 200, "{answer}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn thirty_robots_are_changed_one_fails_and_one_is_on_a_mission() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let robots = fleet(&cluster).await;
    let (code, answer) = send(&admin, "POST", SETS, set("steady")).await;
    assert_eq!(code, 201, "{answer}");
    rollout(&cluster, "Complete", ROBOTS).await;
    let before = tasks(&admin).await;
    assert_eq!(before.len(), ROBOTS, "one on each");

    command(&admin, "fragile").await;
    let given_up = rollout(&cluster, "RolledBack", 0).await;
    let why = &given_up["status"]["rolledBackFrom"];
    assert_eq!(why["reason"], "Crashed", "{why}");
    assert!(why["message"].as_str().unwrap().contains("exited with code 3"), "{why}");
    let mut after = tasks(&admin).await;
    let touched: BTreeSet<&String> =
        after.iter().filter(|(node, task)| before[*node] != **task).map(|(node, _)| node).collect();
    assert_eq!(touched, BTreeSet::from([&WEAK.to_owned()]), "the others are untouched");
    assert!(after.values().all(|(_, command)| command == "steady"), "{after:?}");

    deadline(&admin, 20).await;
    command(&admin, "deaf").await;
    let given_up = rollout(&cluster, "RolledBack", 0).await;
    let why = &given_up["status"]["rolledBackFrom"];
    assert_eq!(why["reason"], "ProbeFailed", "{why}");
    assert!(why["message"].as_str().unwrap().ends_with("HTTP status 503"), "{why}");
    deadline(&admin, 600).await;
    let before = std::mem::replace(&mut after, tasks(&admin).await);
    let others = |all: &BTreeMap<String, (String, Value)>| {
        all.iter()
            .filter(|(node, _)| *node != WEAK)
            .map(|(_, task)| task.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(others(&before), others(&after), "the others are untouched");

    lock(&admin, "robot-07", json!("ada: carries a tray")).await;
    let plan = async |object: Value| {
        let objects = json!({ "objects": [object] });
        let (code, plan) = send(&admin, "POST", &format!("{G}/plan"), objects).await;
        assert_eq!(code, 200, "{plan}");
        plan
    };
    let planned = plan(set("better")).await;
    let of_set = &planned["sets"][0];
    let many = |field: &str| of_set[field].as_array().unwrap().len();
    assert_eq!((many("begins"), many("changes"), many("ends")), (0, ROBOTS - 1, 0), "{planned}");
    assert_eq!(of_set["held"][0]["node"], "robot-07", "{planned}");
    let mut other = set("steady");
    other["metadata"]["name"] = "other".into();
    let planned = plan(other).await;
    let begins = planned["sets"][0]["begins"].as_array().unwrap();
    let placed = planned["placements"].as_array().unwrap();
    assert_eq!((begins.len(), placed.len()), (ROBOTS, ROBOTS), "{planned}");
    let first = placed.iter().find(|p| p["name"] == "other-robot-00").unwrap();
    assert_eq!(first["node"], "robot-00", "{planned}");

    command(&admin, "better").await;
    let held = rollout(&cluster, "MissionLock", ROBOTS - 1).await;
    assert_eq!(
        held["status"]["held"],
        json!([{"node": "robot-07", "task": "patrol-robot-07", "holder": "ada", "reason": "carries a tray"}])
    );
    let during = tasks(&admin).await;
    assert_eq!(during["robot-07"], after["robot-07"], "it is in the middle of a mission");
    lock(&admin, "robot-07", Value::Null).await;
    rollout(&cluster, "Complete", ROBOTS).await;
    let done = tasks(&admin).await;
    assert!(done.values().all(|(_, command)| command == "better"), "{done:?}");
    for robot in robots {
        robot.abort();
    }
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_set_is_scaled_as_kubectl_does_it() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut body = set("x");
    body["metadata"]["name"] = "some".into();
    body["spec"] = json!({"replicas": 2, "template": body["spec"]["template"]});
    let (code, answer) = send(&admin, "POST", SETS, body).await;
    assert_eq!(code, 201, "{answer}");
    let path = format!("{SETS}/some/scale");
    cluster.until(&path, |scale| scale["status"]["replicas"] == 2).await;
    let (code, scale) = get(&admin, &path).await;
    assert_eq!(
        (code, &scale["kind"], &scale["apiVersion"]),
        (200, &"Scale".into(), &"autoscaling/v1".into())
    );
    assert_eq!(scale["status"]["selector"], "muster.dev/taskset=some");

    let (code, patched) = send(&admin, "PATCH", &path, json!({"spec": {"replicas": 3}})).await;
    assert_eq!((code, &patched["spec"]["replicas"]), (200, &3.into()), "{patched}");
    cluster.until(&path, |scale| scale["status"]["replicas"] == 3).await;
    let mut stale = scale.clone();
    stale["spec"]["replicas"] = 7.into();
    assert_eq!(refusal(&send(&admin, "PUT", &path, stale).await), (409, "Conflict"));
    // As a client in Go writes a 0.
    let (code, put) = send(&admin, "PUT", &path, json!({"spec": {}})).await;
    assert_eq!((code, &put["spec"]["replicas"]), (200, &0.into()), "{put}");
    cluster.until(&path, |scale| scale["status"]["replicas"] == 0).await;
    let bad = send(&admin, "PATCH", &path, json!({"spec": {"replicas": -1}})).await;
    assert_eq!(refusal(&bad), (422, "Invalid"));

    let (code, answer) = send(&admin, "POST", SETS, set("x")).await;
    assert_eq!(code, 201, "{answer}");
    let every = format!("{SETS}/patrol/scale");
    let refused = send(&admin, "PATCH", &every, json!({"spec": {"replicas": 1}})).await;
    assert_eq!(refusal(&refused), (422, "Invalid"));
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tasks_are_taken_in_by_their_labels_and_let_go_with_them() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut loose = task("loose");
    loose["metadata"]["labels"] = json!({"app": "watch"});
    loose["spec"]["restartPolicy"] = "Always".into();
    send(&admin, "POST", TASKS, loose).await;
    let mut body = set("x");
    body["spec"] = json!({
        "replicas": 2, "selector": {"matchLabels": {"app": "watch"}}, "rollout": {"strategy": "OnDelete"},
        "template": {"metadata": {"labels": {"app": "watch"}}, "spec": {"run": {"process": {"command": ["x"]}}}},
    });
    let (code, made) = send(&admin, "POST", SETS, body).await;
    assert_eq!(code, 201, "{made}");
    let path = format!("{TASKS}/loose");
    let owned = cluster.until(&path, |t| t["metadata"]["ownerReferences"].is_array()).await;
    let owner = &owned["metadata"]["ownerReferences"][0];
    assert_eq!((&owner["uid"], &owner["controller"]), (&made["metadata"]["uid"], &true.into()));
    cluster.until(&format!("{SETS}/patrol"), |s| s["status"]["replicas"] == 2).await;
    assert_eq!(names(&get(&admin, TASKS).await.1), ["loose", "patrol-0"]);

    let patch = json!({"metadata": {"labels": {"app": "other"}}});
    send(&admin, "PATCH", &path, patch).await;
    let free = |t: &Value| t["metadata"]["ownerReferences"].as_array().is_none_or(Vec::is_empty);
    cluster.until(&path, free).await;
    cluster.until(&format!("{TASKS}/patrol-1"), |t| t["kind"] == "Task").await;

    let orphan = json!({"propagationPolicy": "Orphan"});
    send(&admin, "DELETE", &format!("{SETS}/patrol"), orphan).await;
    cluster.until(&format!("{SETS}/patrol"), |s| s["code"] == 404).await;
    let (_, left) = get(&admin, TASKS).await;
    assert_eq!(names(&left), ["loose", "patrol-0", "patrol-1"], "what it had stays");
    cluster.running.shut_down().await.unwrap();
}
