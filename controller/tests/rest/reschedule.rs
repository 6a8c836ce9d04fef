//! Tasks that fail on their node and are tried on another one, and everything else that looks at the end of a task.

use muster_api::wire::agent::v1 as wire;
use serde_json::{Value, json};
use wire::TaskPhase::{Failed, Running};

use super::agent::{Session, join, report};
use super::support::*;

const QUOTAS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/quotas";
const MAPS: &str = "/api/v1/namespaces/default/configmaps";
const T: &str = "/apis/muster.dev/v1alpha1/namespaces/default/tasks/t";

fn retried(reschedule: Value) -> Value {
    let mut task = task("t");
    task["spec"]["reschedule"] = reschedule;
    task["metadata"]["annotations"] = json!({"note": "kept"});
    task["spec"]["priority"] = 7.into();
    task
}

/// Two robots, each with a session.
async fn robots(cluster: &Cluster) -> Vec<(String, Session)> {
    let mut all = Vec::new();
    for name in ["r1", "r2"] {
        let credential = join(cluster, name).await;
        let session = Session::open(cluster, &credential, Vec::new()).await.unwrap();
        all.push((name.to_owned(), session));
    }
    all
}

fn text<'a>(task: &'a Value, pointer: &str) -> &'a str {
    task.pointer(pointer).and_then(Value::as_str).unwrap_or_default()
}

/// Waits until it is placed under another uid than these.
async fn placed(cluster: &Cluster, before: &[String]) -> (String, String, Value) {
    let task = cluster
        .until(T, |task| {
            let uid = text(task, "/metadata/uid");
            text(task, "/status/phase") == "Bound" && !before.iter().any(|b| b == uid)
        })
        .await;
    (text(&task, "/metadata/uid").to_owned(), text(&task, "/status/node").to_owned(), task)
}

fn failed(uid: &str, failed_attempts: u32) -> wire::TaskReport {
    wire::TaskReport {
        reason: "Error".to_owned(),
        message: "exited with code 3".to_owned(),
        exit_code: Some(3),
        failed_attempts,
        ..report(uid, 5, Failed)
    }
}

async fn say(robots: &mut [(String, Session)], node: &str, report: wire::TaskReport) {
    let (_, session) = robots.iter_mut().find(|(name, _)| name == node).unwrap();
    session.say_of(report).await;
}

fn reasons(task: &Value) -> Vec<&str> {
    let why = task.pointer("/status/why").and_then(Value::as_array);
    why.into_iter().flatten().map(|w| w["reason"].as_str().unwrap()).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn it_goes_from_node_to_node_under_new_uids_and_ends_with_what_was_tried() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut robots = robots(&cluster).await;
    let block =
        json!({"maxAttempts": 4, "attemptsPerNode": 2, "backoff": "3s", "maxBackoff": "3s"});
    let mut task = retried(block);
    task["spec"]["restartPolicy"] = "OnFailure".into();
    let (code, answer) = send(&admin, "POST", TASKS, task).await;
    assert_eq!(code, 201, "{answer}");
    let (first, node, _) = placed(&cluster, &[]).await;
    let session = &mut robots.iter_mut().find(|(name, _)| *name == node).unwrap().1;
    assert_eq!(session.assigned(&first).await.attempts, 2, "so many may fail there");
    // What belongs to it.
    let owner =
        json!([{"apiVersion": "muster.dev/v1alpha1", "kind": "Task", "name": "t", "uid": first}]);
    let map = json!({"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "m", "ownerReferences": owner}});
    assert_eq!(send(&admin, "POST", MAPS, map).await.0, 201);

    say(&mut robots, &node, report(&first, 1, Running)).await;
    say(&mut robots, &node, failed(&first, 1)).await;
    let held = cluster.until(T, |task| reasons(task).contains(&"BackOff")).await;
    assert_eq!(reasons(&held), ["BackOff", "TriedBefore"]);
    assert_eq!(text(&held, "/status/why/1/node"), node);
    let message = text(&held, "/status/message");
    assert!(
        message.starts_with(&format!("failed on {node} (Error: exited with code 3)")),
        "{message}"
    );

    let (second, other, again) = placed(&cluster, std::slice::from_ref(&first)).await;
    assert_ne!(other, node, "another node comes first");
    assert_eq!(text(&again, "/metadata/annotations/note"), "kept");
    assert_eq!(text(&again, "/metadata/labels/app"), "t");
    assert_eq!(again["spec"]["priority"], 7);
    let earlier = &again["status"]["earlier"];
    assert_eq!(earlier[0]["uid"], first.as_str());
    assert_eq!((&earlier[0]["node"], &earlier[0]["exitCode"]), (&json!(node), &json!(3)));
    assert_eq!(again["status"]["attemptsUsed"], 1);
    let map = format!("{MAPS}/m");
    let map = cluster.until(&map, |m| text(m, "/metadata/ownerReferences/0/uid") == second).await;
    assert_eq!(text(&map, "/metadata/ownerReferences/0/kind"), "Task");

    say(&mut robots, &other, failed(&second, 2)).await;
    // Both have failed once, so either may take it; one attempt is left.
    let (third, last, _) = placed(&cluster, &[first.clone(), second.clone()]).await;
    let session = &mut robots.iter_mut().find(|(name, _)| *name == last).unwrap().1;
    assert_eq!(session.assigned(&third).await.attempts, 1);
    say(&mut robots, &last, failed(&third, 1)).await;
    let end = cluster.until(T, |task| text(task, "/status/reason") == "AttemptsExhausted").await;
    assert_eq!(text(&end, "/metadata/uid"), third);
    assert_eq!(text(&end, "/status/phase"), "Failed");
    let message = text(&end, "/status/message");
    assert!(message.starts_with("4 attempts have failed, as many as may fail: 1 on "), "{message}");
    assert!(message.contains(&format!("2 on {other} (Error: exited with code 3)")), "{message}");
    assert_eq!(get(&admin, &format!("{MAPS}/m")).await.0, 200, "it belongs to what is there");
    cluster.running.shut_down().await.unwrap();
}

/// Nobody is to see a name without an object, or a uid that came back.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watch_sees_one_go_and_the_next_come_in_the_next_revision() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut robots = robots(&cluster).await;
    send(&admin, "POST", TASKS, retried(json!({"backoff": "1h", "maxBackoff": "1h"}))).await;
    let (uid, node, _) = placed(&cluster, &[]).await;
    let store = &cluster.running.context().store;
    let mut changes = store.watch_all(store.revision()).unwrap();
    say(&mut robots, &node, failed(&uid, 1)).await;
    let mut seen: Vec<(u64, String, String)> = Vec::new();
    while !seen.iter().any(|(_, change, of)| change == "Put" && *of != uid) {
        for event in changes.next().await.unwrap() {
            if &*event.object.key.name == "t" && event.object.key.resource.to_string() == "tasks" {
                let change = format!("{:?}", event.change);
                seen.push((event.revision(), change, event.object.uid.to_string()));
            }
        }
    }
    let gone = seen.iter().position(|(_, change, _)| change == "Delete").unwrap();
    assert_eq!(seen[gone].2, uid);
    assert_eq!(seen[gone + 1].0, seen[gone].0 + 1);
    assert_ne!(seen[gone + 1].2, uid);
    // The node's agent may forget it, and the lease is free.
    let lease = cluster.until(&format!("{G}/leases/{node}.body"), |_| true).await;
    assert_eq!(lease["status"]["holder"], Value::Null);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn its_deadline_counts_over_all_nodes_and_its_ttl_from_the_last_end() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut robots = robots(&cluster).await;
    let mut task = retried(json!({"backoff": "1h", "maxBackoff": "1h"}));
    task["spec"]["activeDeadlineSeconds"] = 8.into();
    task["spec"]["ttlSecondsAfterFinished"] = 3600.into();
    send(&admin, "POST", TASKS, task).await;
    let (uid, node, _) = placed(&cluster, &[]).await;
    say(&mut robots, &node, failed(&uid, 1)).await;
    let end = cluster
        .until(T, |task| {
            text(task, "/status/phase") == "Failed" && text(task, "/metadata/uid") != uid
        })
        .await;
    assert_eq!(text(&end, "/status/reason"), "DeadlineExceeded");
    assert_eq!(text(&end, "/status/message"), "was under way for 8 s, its activeDeadlineSeconds");
    assert_eq!(end["status"]["earlier"][0]["node"], node.as_str());

    // One that is over at once when it ends is not taken away before it is tried elsewhere.
    send(&admin, "DELETE", T, Value::Null).await;
    let mut task = retried(json!({"maxAttempts": 2, "backoff": "0s"}));
    task["spec"]["ttlSecondsAfterFinished"] = 0.into();
    assert_eq!(send(&admin, "POST", TASKS, task).await.0, 201);
    let (first, node, _) = placed(&cluster, std::slice::from_ref(&uid)).await;
    say(&mut robots, &node, failed(&first, 1)).await;
    let (second, node, _) = placed(&cluster, &[uid, first]).await;
    say(&mut robots, &node, failed(&second, 1)).await;
    cluster.until(T, |answer| answer["reason"] == "NotFound").await;
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn its_place_in_the_quota_stays_its_own() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut robots = robots(&cluster).await;
    let quota = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Quota", "metadata": {"name": "default"},
        "spec": {"hard": {"tasks": 1}},
    });
    assert_eq!(send(&admin, "POST", QUOTAS, quota).await.0, 201);
    let block = json!({"maxAttempts": 2, "backoff": "100ms"});
    assert_eq!(send(&admin, "POST", TASKS, retried(block)).await.0, 201);
    let (first, node, _) = placed(&cluster, &[]).await;
    // Another one asks all the time, and may come only when this one has failed for good.
    let asking = {
        let admin = admin.clone();
        tokio::spawn(async move {
            loop {
                let (code, _) = send(&admin, "POST", TASKS, task("other")).await;
                if code == 201 {
                    return get(&admin, T).await.1;
                }
                assert_eq!(code, 422);
                tokio::task::yield_now().await;
            }
        })
    };
    say(&mut robots, &node, failed(&first, 1)).await;
    let (second, node, _) = placed(&cluster, &[first]).await;
    assert!(!asking.is_finished());
    say(&mut robots, &node, failed(&second, 1)).await;
    let then = tokio::time::timeout(DEADLINE, asking).await.unwrap().unwrap();
    assert_eq!(text(&then, "/metadata/uid"), second);
    assert_eq!(text(&then, "/status/phase"), "Failed");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_waits_for_it_goes_on_waiting_and_a_deleted_one_stays_away() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut robots = robots(&cluster).await;
    send(&admin, "POST", TASKS, retried(json!({"backoff": "1h", "maxBackoff": "1h"}))).await;
    let mut after = task("after");
    after["spec"]["dependsOn"] = json!([{"task": "t", "condition": "Succeeded"}]);
    send(&admin, "POST", TASKS, after).await;
    let (first, node, _) = placed(&cluster, &[]).await;
    say(&mut robots, &node, failed(&first, 1)).await;
    let path = format!("{TASKS}/after");
    let pending = "waits for task t, which is Pending, not yet Succeeded";
    cluster.until(&path, |task| text(task, "/status/why/0/message") == pending).await;
    // Somebody who deletes it means it.
    let waits = cluster.until(T, |task| text(task, "/metadata/uid") != first).await;
    assert_eq!(text(&waits, "/status/phase"), "Pending");
    assert_eq!(send(&admin, "DELETE", T, Value::Null).await.0, 200);
    let gone = "waits for task t, which is not there; waits until it is created";
    cluster.until(&path, |task| text(task, "/status/why/0/message") == gone).await;
    assert_eq!(get(&admin, T).await.0, 404);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_wait_outlives_the_controller() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut robots_before = robots(&cluster).await;
    send(&admin, "POST", TASKS, retried(json!({"backoff": "1s"}))).await;
    let (first, node, _) = placed(&cluster, &[]).await;
    say(&mut robots_before, &node, failed(&first, 1)).await;
    let waits = cluster.until(T, |task| text(task, "/metadata/uid") != first).await;
    let uid = text(&waits, "/metadata/uid").to_owned();
    drop(robots_before);
    let cluster = cluster.restart().await;
    let _robots = robots(&cluster).await;
    let bound = cluster.until(T, |task| text(task, "/status/phase") == "Bound").await;
    assert_eq!(text(&bound, "/metadata/uid"), uid);
    assert_ne!(text(&bound, "/status/node"), node);
    assert_eq!(bound["status"]["earlier"][0]["uid"], first.as_str());
    cluster.running.shut_down().await.unwrap();
}
