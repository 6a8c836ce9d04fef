//! Deletion: at once, after a wait, with all that belongs to it.

use kube::Client;
use muster_controller::store::{Key, Precondition, Resource};
use serde_json::{Value, json};

use super::support::*;

async fn delete(client: &Client, path: &str, options: Value) -> (u16, Value) {
    send(client, "DELETE", path, options).await
}

/// Waits until `path` answers 404, woken by the store's changes.
async fn gone(cluster: &Cluster, client: &Client, path: &str) {
    let store = &cluster.running.context().store;
    loop {
        let mut changes = store.watch_all(store.revision()).unwrap();
        if get(client, path).await.0 == 404 {
            return;
        }
        changes.next().await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_task_without_a_node_goes_at_once_and_another_waits() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let (_, made) = send(&admin, "POST", TASKS, task("free")).await;
    let path = format!("{TASKS}/free");
    let wrong = delete(&admin, &path, json!({"preconditions": {"uid": "other"}})).await;
    assert_eq!(refusal(&wrong), (409, "Conflict"));
    let (code, status) = delete(&admin, &path, Value::Null).await;
    assert_eq!((code, status["status"].as_str()), (200, Some("Success")));
    assert_eq!(status["details"]["uid"], made["metadata"]["uid"]);
    assert_eq!(refusal(&delete(&admin, &path, Value::Null).await), (404, "NotFound"));

    register(&admin, "n1").await;
    send(&admin, "POST", TASKS, task("bound")).await;
    let path = format!("{TASKS}/bound");
    let status = json!({"status": {"phase": "Running", "node": "n1"}});
    let (code, answer) = send(&admin, "PATCH", &format!("{path}/status"), status).await;
    assert_eq!(code, 200, "{answer}");
    // Kubernetes takes a negative one for a second.
    let negative = delete(&admin, &path, json!({"gracePeriodSeconds": -1})).await;
    assert_eq!(refusal(&negative), (400, "BadRequest"));
    let (code, ending) = delete(&admin, &path, Value::Null).await;
    assert_eq!((code, ending["kind"].as_str()), (200, Some("Task")));
    assert_eq!(ending["metadata"]["deletionGracePeriodSeconds"], 10);
    assert!(ending["metadata"]["deletionTimestamp"].is_string());
    let (_, sooner) = delete(&admin, &path, json!({"gracePeriodSeconds": 0})).await;
    assert_eq!(sooner["metadata"]["deletionGracePeriodSeconds"], 0);
    let (_, later) = delete(&admin, &path, json!({"gracePeriodSeconds": 60})).await;
    let end = |task: &Value| task["metadata"]["deletionTimestamp"].clone();
    assert_eq!(end(&later), end(&sooner), "an end does not come later for asking again");
    assert_eq!(get(&admin, &path).await.0, 200, "until somebody confirms that it is over");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn finalizers_hold_an_object() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut body = event("held");
    body["metadata"]["finalizers"] = json!(["example.dev/cleanup"]);
    send(&admin, "POST", EVENTS, body).await;
    let path = format!("{EVENTS}/held");
    let (_, ending) = delete(&admin, &path, Value::Null).await;
    assert!(ending["metadata"]["deletionTimestamp"].is_string());
    let more = json!({"metadata": {"finalizers": ["example.dev/cleanup", "example.dev/more"]}});
    assert_eq!(refusal(&send(&admin, "PATCH", &path, more).await), (422, "Invalid"));
    let (code, _) = send(&admin, "PATCH", &path, json!({"metadata": {"finalizers": null}})).await;
    assert_eq!(code, 200);
    assert_eq!(get(&admin, &path).await.0, 404);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_collection_goes_by_selector() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    for name in ["a", "b", "c"] {
        send(&admin, "POST", EVENTS, event(name)).await;
    }
    let path = format!("{EVENTS}?labelSelector=app!=b");
    let (code, list) = delete(&admin, &path, Value::Null).await;
    assert_eq!((code, names(&list)), (200, vec!["a", "c"]));
    assert_eq!(names(&get(&admin, EVENTS).await.1), ["b"]);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_namespace_ends_with_what_is_in_it() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let namespace = json!({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": "lab"}});
    let (code, made) = send(&admin, "POST", "/api/v1/namespaces", namespace).await;
    assert_eq!((code, &made["status"]["phase"]), (201, &"Active".into()));
    register(&admin, "n1").await;
    let tasks = format!("{G}/namespaces/lab/tasks");
    send(&admin, "POST", &tasks, task("free")).await;
    send(&admin, "POST", &tasks, task("bound")).await;
    let status = json!({"status": {"phase": "Running", "node": "n1"}});
    send(&admin, "PATCH", &format!("{tasks}/bound/status"), status).await;
    let (_, ending) = delete(&admin, "/api/v1/namespaces/lab", Value::Null).await;
    assert_eq!(ending["status"]["phase"], "Terminating");
    gone(&cluster, &admin, &format!("{tasks}/free")).await;
    let late = send(&admin, "POST", &tasks, task("late")).await;
    assert_eq!(refusal(&late), (403, "Forbidden"));
    assert_eq!(get(&admin, "/api/v1/namespaces/lab").await.0, 200, "a task still runs there");
    // What the reconciler does when the agent has confirmed that the processes are gone.
    let key = Key::namespaced(Resource::new("tasks"), "lab", "bound");
    let store = &cluster.running.context().store;
    store.delete(key, Precondition::Any).await.unwrap();
    gone(&cluster, &admin, "/api/v1/namespaces/lab").await;
    let default = delete(&admin, "/api/v1/namespaces/default", Value::Null).await;
    assert_eq!(refusal(&default), (403, "Forbidden"));
    cluster.running.shut_down().await.unwrap();
}
