//! The door of a namespace with a Quota.

use futures::future::join_all;
use serde_json::{Value, json};

use super::support::*;

const QUOTAS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/quotas";
const SETS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/tasksets";

fn quota(spec: Value) -> Value {
    json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Quota", "metadata": {"name": "default"}, "spec": spec
    })
}

fn asking(name: &str, resources: Value) -> Value {
    let mut task = task(name);
    task["spec"]["resources"] = resources;
    task
}

async fn end(client: &kube::Client, name: &str) {
    let status = json!({"status": {"phase": "Succeeded"}});
    let path = format!("{TASKS}/{name}/status");
    let (code, answer) = send(client, "PATCH", &path, status).await;
    assert_eq!(code, 200, "{answer}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_not_left_is_refused_with_everything_that_is_short() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let hard = json!({"cpu": "1", "memory": "1Gi", "leases": 1});
    send(&admin, "POST", QUOTAS, quota(json!({"hard": hard}))).await;
    let first = json!({"cpu": "600m", "actuators": ["base:Drive"]});
    assert_eq!(send(&admin, "POST", TASKS, asking("first", first)).await.0, 201);

    let second = json!({"cpu": "600m", "memory": "2Gi", "actuators": ["base:Drive"]});
    let answer = send(&admin, "POST", TASKS, asking("second", second)).await;
    assert_eq!(refusal(&answer), (422, "Invalid"));
    let causes = answer.1["details"]["causes"].as_array().unwrap();
    let fields: Vec<&str> = causes.iter().map(|cause| cause["field"].as_str().unwrap()).collect();
    assert_eq!(fields, ["spec.resources.cpu", "spec.resources.memory", "spec.resources.actuators"]);
    let message = causes[0]["message"].as_str().unwrap();
    for part in ["600m cpu", "quota is 1", "600m are used", "400m are left"] {
        assert!(message.contains(part), "{message}");
    }
    // Asked without being meant, it is refused the same way.
    let dry = format!("{TASKS}?dryRun=All");
    let answer = send(&admin, "POST", &dry, asking("second", json!({"cpu": "600m"}))).await;
    assert_eq!(refusal(&answer), (422, "Invalid"));

    // Exactly what is left passes; more when the first has ended; what a deleted one had is left again.
    assert_eq!(send(&admin, "POST", TASKS, asking("rest", json!({"cpu": "400m"}))).await.0, 201);
    assert_eq!(send(&admin, "POST", TASKS, asking("more", json!({"cpu": "1m"}))).await.0, 422);
    end(&admin, "first").await;
    assert_eq!(send(&admin, "POST", TASKS, asking("more", json!({"cpu": "600m"}))).await.0, 201);
    assert_eq!(send(&admin, "POST", TASKS, asking("last", json!({"cpu": "1m"}))).await.0, 422);
    send(&admin, "DELETE", &format!("{TASKS}/rest"), Value::Null).await;
    assert_eq!(send(&admin, "POST", TASKS, asking("last", json!({"cpu": "400m"}))).await.0, 201);
    // Who asks for nothing that is limited is not asked.
    assert_eq!(send(&admin, "POST", TASKS, task("small")).await.0, 201);
    cluster.running.shut_down().await.unwrap();
}

/// However many come at once.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_crowd_gets_in_as_far_as_there_is_room() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", QUOTAS, quota(json!({"hard": {"cpu": "1", "tasks": 12}}))).await;
    let crowd =
        (0..40).map(|i| {
            let admin = &admin;
            let cpu = if i % 2 == 0 { "100m" } else { "1m" };
            async move {
                send(admin, "POST", TASKS, asking(&format!("t{i}"), json!({"cpu": cpu}))).await.0
            }
        });
    let codes = join_all(crowd).await;
    let entered = codes.iter().filter(|code| **code == 201).count();
    assert!(codes.iter().all(|code| matches!(code, 201 | 422)), "{codes:?}");
    let (_, list) = get(&admin, TASKS).await;
    let tasks = list["items"].as_array().unwrap();
    assert_eq!(tasks.len(), entered);
    let large = tasks.iter().filter(|t| t["spec"]["resources"]["cpu"] == "100m").count();
    let cpu = large * 100 + (entered - large);
    assert!(entered <= 12 && cpu <= 1_000, "{entered} entered with {cpu}m");
    // Nobody was kept out while there was room for the smallest.
    assert!(entered == 12 || cpu == 1_000, "{entered} entered with {cpu}m");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tasks_may_wait_instead_and_have_defaults() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let spec = json!({
        "hard": {"cpu": "1", "tasks": 3}, "excess": "Wait",
        "defaults": {"cpu": "700m", "memory": "64Mi", "pids": 50},
    });
    send(&admin, "POST", QUOTAS, quota(spec)).await;
    for name in ["a", "b"] {
        let (code, made) = send(&admin, "POST", TASKS, task(name)).await;
        assert_eq!(code, 201, "{made}");
        let resources = &made["spec"]["resources"];
        assert_eq!(*resources, json!({"cpu": "700m", "memory": "64Mi", "pids": 50}));
    }
    let (code, own) = send(&admin, "POST", TASKS, asking("own", json!({"cpu": "2"}))).await;
    assert_eq!((code, own["spec"]["resources"]["cpu"].as_str()), (201, Some("2")));
    let answer = send(&admin, "POST", TASKS, task("fourth")).await;
    assert_eq!(refusal(&answer), (422, "Invalid"));
    let message = answer.1["message"].as_str().unwrap();
    assert!(message.contains("asks for 1 tasks; the namespace's quota is 3"), "{message}");
    let asked = cluster
        .until(&format!("{QUOTAS}/default"), |quota| {
            quota["status"]["requested"]["tasks"] == 3
                && quota["status"]["requested"]["cpu"] == "3400m"
        })
        .await;
    assert_eq!(asked["status"]["used"]["cpu"], "0");
    cluster.running.shut_down().await.unwrap();
}

/// A set makes what there is room for, says what keeps the rest out, and makes it when there is room.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_set_makes_as_many_as_there_is_room_for() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", QUOTAS, quota(json!({"hard": {"cpu": "1"}}))).await;
    let set = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "TaskSet", "metadata": {"name": "crowd"},
        "spec": {"replicas": 4, "template": {"spec": {
            "resources": {"cpu": "400m"}, "run": {"process": {"command": ["true"]}},
        }}},
    });
    let (code, answer) = send(&admin, "POST", SETS, set).await;
    assert_eq!(code, 201, "{answer}");
    let count = |list: &Value| list["items"].as_array().map(Vec::len);
    cluster.until(TASKS, |list| count(list) == Some(2)).await;
    cluster
        .until(EVENTS, |list| {
            let said = list["items"].as_array().into_iter().flatten();
            let mut refused = said.filter(|event| event["reason"] == "FailedCreate");
            refused.any(|e| e["message"].as_str().is_some_and(|m| m.contains("200m are left")))
        })
        .await;
    cluster
        .until(&format!("{SETS}/crowd"), |set| {
            let all = set["status"]["conditions"].as_array().into_iter().flatten();
            all.into_iter().any(|c| c["type"] == "ReplicaFailure" && c["status"] == "True")
        })
        .await;
    let raised = json!({"spec": {"hard": {"cpu": "2"}}});
    assert_eq!(send(&admin, "PATCH", &format!("{QUOTAS}/default"), raised).await.0, 200);
    cluster.until(TASKS, |list| count(list) == Some(4)).await;
    cluster
        .until(&format!("{SETS}/crowd"), |set| {
            let all = set["status"]["conditions"].as_array().into_iter().flatten();
            all.into_iter().all(|c| c["type"] != "ReplicaFailure")
        })
        .await;
    cluster.running.shut_down().await.unwrap();
}

/// What one by one would pass and not together is said before anything is stored, in the order of storing.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tasks_are_checked_together_and_nobody_is_let_in_by_asking() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", QUOTAS, quota(json!({"hard": {"cpu": "1"}}))).await;
    let asking = |name: &str, cpu: &str| asking(name, json!({"cpu": cpu}));
    assert_eq!(send(&admin, "POST", TASKS, asking("old", "300m")).await.0, 201);
    let check = |objects: Value| {
        let admin = admin.clone();
        async move {
            let path = format!("{G}/check");
            let (code, answer) = send(&admin, "POST", &path, json!({"objects": objects})).await;
            assert_eq!(code, 200, "{answer}");
            let row = |refusal: &Value| {
                let status = &refusal["status"];
                let message = status["details"]["causes"][0]["message"].as_str().unwrap();
                (refusal["index"].as_u64().unwrap(), message.to_owned())
            };
            answer["refusals"].as_array().unwrap().iter().map(row).collect::<Vec<_>>()
        }
    };
    // The one that is there asks for nothing more, the third does not fit, and the last one does again.
    let set = json!([
        asking("old", "900m"),
        asking("a", "400m"),
        asking("b", "400m"),
        asking("c", "300m"),
        asking("d", "900m"),
    ]);
    let refusals = check(set).await;
    assert_eq!(refusals.iter().map(|(index, _)| *index).collect::<Vec<_>>(), [2, 4]);
    let (together, alone) = (&refusals[0].1, &refusals[1].1);
    assert!(together.contains("700m are used and 300m are left"), "{together}");
    assert!(together.contains("alone it would pass"), "{together}");
    assert!(alone.contains("asks for 900m cpu") && !alone.contains("alone it"), "{alone}");
    // A quota among them is stored before them; other namespaces have none.
    let mut elsewhere = asking("e", "9");
    elsewhere["metadata"]["namespace"] = "lab".into();
    let raised = json!([
        quota(json!({"hard": {"cpu": "2"}})),
        asking("a", "800m"),
        asking("b", "800m"),
        elsewhere
    ]);
    assert_eq!(check(raised).await, []);

    // A crowd that only asks takes nothing from one that means it.
    let dry = format!("{TASKS}?dryRun=All");
    let crowd = join_all((0..40).map(|i| {
        let (admin, dry) = (&admin, &dry);
        async move { send(admin, "POST", dry, asking(&format!("dry-{i}"), "700m")).await.0 }
    }));
    let meant = async {
        for i in 0..20 {
            let name = format!("meant-{i}");
            assert_eq!(send(&admin, "POST", TASKS, asking(&name, "700m")).await.0, 201);
            send(&admin, "DELETE", &format!("{TASKS}/{name}"), Value::Null).await;
        }
    };
    let (codes, ()) = futures::future::join(crowd, meant).await;
    assert!(codes.iter().all(|code| [201, 422].contains(code)), "{codes:?}");
    cluster.running.shut_down().await.unwrap();
}
