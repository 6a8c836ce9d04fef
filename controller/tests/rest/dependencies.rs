//! Tasks that wait for others, as far as the controller goes: who is held and why, rings, plans.

use serde_json::{Value, json};

use super::support::*;

fn after(name: &str, others: Value) -> Value {
    let mut task = task(name);
    task["spec"]["dependsOn"] = others;
    task
}

fn reasons(task: &Value) -> Vec<(String, String)> {
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let why = task["status"]["why"].as_array().cloned().unwrap_or_default();
    why.iter().map(|one| (text(&one["reason"]), text(&one["message"]))).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_task_waits_for_others_and_says_for_which() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let both = json!([{"task": "camera", "condition": "Ready"}, {"task": "map", "condition": "Succeeded"}]);
    let (code, answer) = send(&admin, "POST", TASKS, after("detector", both)).await;
    assert_eq!(code, 201, "{answer}");
    let path = format!("{TASKS}/detector");
    let held = |wanted: &[(&str, &str)]| {
        let wanted: Vec<(String, String)> =
            wanted.iter().map(|(r, m)| ((*r).to_owned(), (*m).to_owned())).collect();
        let (cluster, path) = (&cluster, &path);
        async move { cluster.until(path, |task| reasons(task) == wanted).await }
    };
    let not_there = |task: &str| {
        format!("waits for task {task}, which is not there; waits until it is created")
    };
    let (camera, map) = (not_there("camera"), not_there("map"));
    held(&[("DependencyNotFound", &camera), ("DependencyNotFound", &map)]).await;

    send(&admin, "POST", TASKS, task("camera")).await;
    let pending = "waits for task camera, which is Pending, not yet Ready";
    held(&[("DependencyNotMet", pending), ("DependencyNotFound", &map)]).await;
    let status = |phase: &str, ready: Value| json!({"status": {"phase": phase, "node": "n", "ready": ready}});
    let set = async |name: &str, status: Value| {
        let (code, answer) = send(&admin, "PATCH", &format!("{TASKS}/{name}/status"), status).await;
        assert_eq!(code, 200, "{answer}");
    };
    set("camera", status("Running", json!(false))).await;
    let unready = "waits for task camera, which is not ready yet";
    held(&[("DependencyNotMet", unready), ("DependencyNotFound", &map)]).await;
    set("camera", status("Running", json!(true))).await;
    held(&[("DependencyNotFound", &map)]).await;
    send(&admin, "POST", TASKS, task("map")).await;
    set("map", status("Failed", Value::Null)).await;
    let ended = "waits for task map, which has ended (Failed) and will not become Succeeded";
    held(&[("DependencyNotMet", ended)]).await;
    // One that is made anew may still come so far.
    send(&admin, "DELETE", &format!("{TASKS}/map"), Value::Null).await;
    send(&admin, "POST", TASKS, task("map")).await;
    set("map", status("Succeeded", Value::Null)).await;
    cluster.until(&path, |task| reasons(task).iter().any(|(reason, _)| reason == "NoNodes")).await;
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn rings_are_refused_with_their_names() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let on = |task: &str| json!([{"task": "free"}, {"task": task}]);
    assert_eq!(send(&admin, "POST", TASKS, after("a", on("b"))).await.0, 201);
    assert_eq!(send(&admin, "POST", TASKS, after("b", on("c"))).await.0, 201);
    let answer = send(&admin, "POST", TASKS, after("c", on("a"))).await;
    assert_eq!(refusal(&answer), (422, "Invalid"));
    let cause = &answer.1["details"]["causes"][0];
    assert_eq!(cause["field"], "spec.dependsOn[1].task");
    let message = cause["message"].as_str().unwrap();
    assert!(message.contains("waits for itself: c → a → b → c"), "{message}");
    let own = send(&admin, "POST", TASKS, after("d", on("d"))).await;
    assert_eq!(refusal(&own), (422, "Invalid"));
    // The same names elsewhere are other tasks.
    let (code, _) = send(
        &admin,
        "POST",
        "/api/v1/namespaces",
        json!({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": "lab"}}),
    )
    .await;
    assert_eq!(code, 201);
    let elsewhere = TASKS.replace("/default/", "/lab/");
    let mut other = after("c", on("a"));
    other["metadata"]["namespace"] = "lab".into();
    assert_eq!(send(&admin, "POST", &elsewhere, other).await.0, 201);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_plan_knows_what_is_applied_together() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let objects =
        [task("camera"), after("detector", json!([{"task": "camera"}, {"task": "other"}]))];
    let (code, plan) =
        send(&admin, "POST", &format!("{G}/plan"), json!({"objects": objects})).await;
    assert_eq!(code, 200, "{plan}");
    let waits = plan["waits"].as_array().unwrap();
    let detector = waits.iter().find(|wait| wait["name"] == "detector").unwrap();
    let messages: Vec<&str> = detector["why"]
        .as_array()
        .unwrap()
        .iter()
        .map(|why| why["message"].as_str().unwrap())
        .collect();
    assert_eq!(
        messages,
        [
            "waits for task camera, which is created with it",
            "waits for task other, which is not there; waits until it is created"
        ]
    );
    cluster.running.shut_down().await.unwrap();
}
