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
    let old = json!({"preconditions": {"resourceVersion": "1", "uid": null}});
    assert_eq!(refusal(&delete(&admin, &path, old).await), (409, "Conflict"));
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
    // As in Kubernetes, of one namespace at a time.
    let all = delete(&admin, "/api/v1/events", Value::Null).await;
    assert_eq!(refusal(&all), (405, "MethodNotAllowed"));
    assert_eq!(names(&get(&admin, EVENTS).await.1), ["b"]);
    let dry = json!({"kind": "DeleteOptions", "dryRun": ["All"], "preconditions": null});
    for path in [EVENTS.to_owned(), format!("{EVENTS}/b")] {
        assert_eq!(delete(&admin, &path, dry.clone()).await.0, 200);
        assert_eq!(delete(&admin, &format!("{path}?dryRun=All"), Value::Null).await.0, 200);
    }
    assert_eq!(names(&get(&admin, EVENTS).await.1), ["b"], "it was only asked");
    for i in 0..300 {
        send(&admin, "POST", EVENTS, event(&format!("many-{i}"))).await;
    }
    let (code, list) = delete(&admin, EVENTS, json!({"dryRun": null})).await;
    assert_eq!((code, names(&list).len()), (200, 301));
    assert!(names(&get(&admin, EVENTS).await.1).is_empty());
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

/// Whoever takes a finalizer off a namespace that ends: what is in it goes first.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_namespace_without_finalizers_still_goes_after_what_is_in_it() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let namespace = json!({
        "apiVersion": "v1", "kind": "Namespace",
        "metadata": {"name": "lab", "finalizers": ["example.dev/cleanup"]},
    });
    assert_eq!(send(&admin, "POST", "/api/v1/namespaces", namespace).await.0, 201);
    register(&admin, "n1").await;
    let tasks = format!("{G}/namespaces/lab/tasks");
    send(&admin, "POST", &tasks, task("bound")).await;
    let status = json!({"status": {"phase": "Running", "node": "n1"}});
    assert_eq!(send(&admin, "PATCH", &format!("{tasks}/bound/status"), status).await.0, 200);
    delete(&admin, "/api/v1/namespaces/lab", Value::Null).await;
    let bare = json!({"metadata": {"finalizers": null}});
    let (code, left) = send(&admin, "PATCH", "/api/v1/namespaces/lab", bare).await;
    assert_eq!((code, &left["status"]["phase"]), (200, &json!("Terminating")));
    let still = get(&admin, "/api/v1/namespaces/lab").await;
    assert_eq!(still.0, 200, "a task runs in it");
    let key = Key::namespaced(Resource::new("tasks"), "lab", "bound");
    let store = &cluster.running.context().store;
    store.delete(key, Precondition::Any).await.unwrap();
    gone(&cluster, &admin, "/api/v1/namespaces/lab").await;
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_owner_that_goes_in_the_foreground_goes_last() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let (_, owner) = send(&admin, "POST", EVENTS, event("owner")).await;
    let mut owned = event("owned");
    owned["metadata"]["ownerReferences"] = json!([{
        "apiVersion": "v1", "kind": "Event", "name": "owner", "uid": owner["metadata"]["uid"],
    }]);
    owned["metadata"]["finalizers"] = json!(["example.dev/cleanup"]);
    assert_eq!(send(&admin, "POST", EVENTS, owned).await.0, 201);
    let path = format!("{EVENTS}/owner");
    let (code, ending) = delete(&admin, &path, json!({"propagationPolicy": "Foreground"})).await;
    assert_eq!((code, &ending["metadata"]["finalizers"]), (200, &json!(["foregroundDeletion"])));
    let ends = |object: &Value| object["metadata"]["deletionTimestamp"].is_string();
    cluster.until(&format!("{EVENTS}/owned"), ends).await;
    assert_eq!(get(&admin, &path).await.0, 200, "it waits for what it owns");
    let bare = json!({"metadata": {"finalizers": null}});
    assert_eq!(send(&admin, "PATCH", &format!("{EVENTS}/owned"), bare).await.0, 200);
    gone(&cluster, &admin, &path).await;
    cluster.running.shut_down().await.unwrap();
}

/// However an eviction and the lock of a mission come together, none passes a lock that was set before it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_eviction_passes_a_mission_lock() {
    let cluster = Cluster::start().await;
    let (admin, other) = (cluster.admin().await, cluster.admin().await);
    register(&admin, "n1").await;
    let store = &cluster.running.context().store;
    let node = format!("{G}/nodes/n1");
    let lock =
        |value: Value| json!({"metadata": {"annotations": {"muster.dev/mission-lock": value}}});
    for round in 0..40 {
        let name = format!("t{round}");
        send(&admin, "POST", TASKS, task(&name)).await;
        let status = json!({"status": {"phase": "Running", "node": "n1"}});
        let bound = send(&admin, "PATCH", &format!("{TASKS}/{name}/status"), status).await;
        assert_eq!(bound.0, 200, "{}", bound.1);
        assert_eq!(send(&admin, "PATCH", &node, lock(Value::Null)).await.0, 200);
        let mut changes = store.watch_all(store.revision()).unwrap();
        let locks = async {
            // Some are locked before the eviction comes, some meanwhile.
            for _ in 0..round % 4 {
                tokio::task::yield_now().await;
            }
            send(&other, "PATCH", &node, lock("ada:carries a tray".into())).await
        };
        let path = format!("/api/v1/namespaces/default/pods/{name}/eviction");
        let eviction =
            json!({"apiVersion": "policy/v1", "kind": "Eviction", "metadata": {"name": name}});
        let (locked, answer) = tokio::join!(locks, send(&admin, "POST", &path, eviction));
        assert_eq!(locked.0, 200, "{}", locked.1);
        if answer.0 == 429 {
            assert!(
                answer.1["message"].as_str().unwrap().contains("a mission of ada"),
                "{}",
                answer.1
            );
            continue;
        }
        assert_eq!(answer.0, 201, "{}", answer.1);
        let mut first = None;
        while first.is_none() {
            first = changes.next().await.unwrap().iter().find_map(|event| {
                let (key, object) = (&event.object.key, event.object.value());
                let metadata = &object["metadata"];
                let is_lock = &*key.name == "n1"
                    && metadata["annotations"]["muster.dev/mission-lock"].is_string();
                let is_end = *key.name == *name && metadata["deletionTimestamp"].is_string();
                (is_lock || is_end).then_some(is_end)
            });
        }
        assert_eq!(first, Some(true), "round {round}: the lock was there before the end");
    }
    // With the lock, for certain not.
    let body = json!({"apiVersion": "policy/v1", "kind": "Eviction", "metadata": {"name": "t0"}});
    send(&admin, "POST", TASKS, task("last")).await;
    let status = json!({"status": {"phase": "Running", "node": "n1"}});
    send(&admin, "PATCH", &format!("{TASKS}/last/status"), status).await;
    let path = "/api/v1/namespaces/default/pods/last/eviction";
    assert_eq!(refusal(&send(&admin, "POST", path, body).await), (429, "TooManyRequests"));
    cluster.running.shut_down().await.unwrap();
}
