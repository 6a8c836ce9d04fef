//! Tasks and nodes as core Pods and Nodes: what is selected, watched and written through them.

use futures::{AsyncBufReadExt as _, TryStreamExt as _};
use http::Request;
use kube::Client;
use serde_json::{Value, json};

use super::support::*;

const PODS: &str = "/api/v1/namespaces/default/pods";
const STRATEGIC: &str = "application/strategic-merge-patch+json";
const APPLY: &str = "application/apply-patch+yaml";

/// Gives the task a status, as its node would.
async fn report(admin: &Client, name: &str, status: Value) -> String {
    let path = format!("{TASKS}/{name}/status");
    let (code, task) = send(admin, "PATCH", &path, json!({ "status": status })).await;
    assert_eq!(code, 200, "{task}");
    task["metadata"]["resourceVersion"].as_str().unwrap().to_owned()
}

/// The next event of the type, after others of the same object that say that it goes on.
async fn until(
    watch: &mut (impl futures::Stream<Item = std::io::Result<String>> + Unpin),
    wanted: &str,
) -> Value {
    loop {
        let line = tokio::time::timeout(DEADLINE, watch.try_next()).await;
        let line = line.expect("an event comes").unwrap().expect("the watch goes on");
        let event: Value = serde_json::from_str(&line).unwrap();
        if event["type"] == wanted {
            return event["object"].clone();
        }
        assert_eq!(event["type"], "MODIFIED", "{wanted} was to come: {event}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watch_of_a_node_sees_its_tasks_come_and_go() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    for node in ["n1", "n2"] {
        register(&admin, node).await;
    }
    send(&admin, "POST", TASKS, task("t")).await;
    let follow = |path: &str, selector: &str| {
        let uri = format!("{path}?watch=true&fieldSelector={selector}");
        let (admin, request) = (admin.clone(), Request::get(uri).body(Vec::new()).unwrap());
        async move { Box::pin(admin.request_stream(request).await.unwrap()).lines() }
    };
    let mut pods = follow(PODS, "spec.nodeName=n1").await;
    let mut tasks = follow(TASKS, "spec.node=n1").await;
    let mut running = follow(PODS, "status.phase=Running").await;
    let status = |phase: &str, node: &str| json!({"phase": phase, "node": node, "attempt": 1});

    report(&admin, "t", status("Bound", "n1")).await;
    assert_eq!(until(&mut pods, "ADDED").await["spec"]["nodeName"], "n1");
    assert_eq!(until(&mut tasks, "ADDED").await["status"]["node"], "n1");
    let list = |path: &str, selector: &str| {
        let (admin, path) = (admin.clone(), format!("{path}?fieldSelector={selector}"));
        async move { get(&admin, &path).await.1 }
    };
    assert_eq!(names(&list(PODS, "spec.nodeName=n1").await), ["t"]);
    assert_eq!(names(&list(TASKS, "spec.node=n1,status.phase!=Running").await), ["t"]);
    assert!(names(&list(TASKS, "spec.node!=n1").await).is_empty());
    assert!(names(&list("/api/v1/pods", "spec.nodeName=n2").await).is_empty());
    // The view of a node has labels of its own, and is selected by them and by others.
    let nodes = async |labels: &str| {
        names(&get(&admin, &format!("/api/v1/nodes?labelSelector={labels}")).await.1).len()
    };
    assert_eq!(nodes("kubernetes.io/hostname=n1").await, 1);
    assert_eq!(nodes("node-role.kubernetes.io/robot").await, 2);
    assert_eq!(nodes("node-role.kubernetes.io/cloud").await, 0);

    report(&admin, "t", status("Running", "n1")).await;
    assert_eq!(until(&mut running, "ADDED").await["status"]["phase"], "Running");

    let moved = report(&admin, "t", status("Running", "n2")).await;
    let gone = until(&mut pods, "DELETED").await;
    assert_eq!(gone["spec"]["nodeName"], "n1", "as it was when it was last selected");
    let at = |object: &Value| -> u64 {
        object["metadata"]["resourceVersion"].as_str().unwrap().parse().unwrap()
    };
    assert!(at(&gone) <= moved.parse().unwrap() && at(&gone) > 0);
    assert_eq!(until(&mut tasks, "DELETED").await["status"]["node"], "n1");
    assert_eq!(names(&list(PODS, "spec.nodeName=n2").await), ["t"]);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_written_to_a_pod_is_written_to_its_task() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", TASKS, task("t")).await;
    let path = format!("{PODS}/t");
    let label = json!({"metadata": {"labels": {"floor": "2"}, "annotations": {"note": "x"}}});
    for media in [STRATEGIC, "application/merge-patch+json"] {
        let (code, pod) = send_as(&admin, "PATCH", &path, media, label.to_string()).await;
        assert_eq!((code, &pod["kind"]), (200, &json!("Pod")), "{pod}");
        assert_eq!(pod["metadata"]["labels"], json!({"app": "t", "floor": "2"}));
    }
    let (_, stored) = get(&admin, &format!("{TASKS}/t")).await;
    assert_eq!(stored["metadata"]["labels"]["floor"], "2");
    assert_eq!(stored["metadata"]["annotations"], json!({"note": "x"}));
    assert_eq!(stored["metadata"]["generation"], 1, "labels are not the spec");

    let json_patch = json!([{"op": "remove", "path": "/metadata/labels/floor"}]).to_string();
    let (code, pod) =
        send_as(&admin, "PATCH", &path, "application/json-patch+json", json_patch).await;
    assert_eq!((code, &pod["metadata"]["labels"]), (200, &json!({"app": "t"})));

    // A whole pod as it was read, changed where it may be.
    let (_, mut pod) = get(&admin, &path).await;
    pod["spec"]["priority"] = 5.into();
    let (code, put) = send(&admin, "PUT", &format!("{path}?dryRun=All"), pod.clone()).await;
    assert_eq!((code, &put["spec"]["priority"]), (200, &json!(5)), "{put}");
    assert_eq!(get(&admin, &path).await.1["spec"]["priority"], 0, "it was only asked");
    pod["metadata"]["resourceVersion"] = "1".into();
    assert_eq!(refusal(&send(&admin, "PUT", &path, pod.clone()).await), (409, "Conflict"));
    pod["metadata"]["resourceVersion"] = Value::Null;
    pod["spec"]["containers"][0]["image"] = "other".into();
    let refused = send(&admin, "PUT", &path, pod).await;
    assert_eq!(refusal(&refused), (422, "Invalid"));
    assert_eq!(refused.1["details"]["causes"][0]["field"], "spec.containers");
    let none = send_as(&admin, "PATCH", &format!("{PODS}/none"), STRATEGIC, "{}".into()).await;
    assert_eq!(refusal(&none), (404, "NotFound"));
    let made = send(&admin, "POST", PODS, json!({})).await;
    assert_eq!(refusal(&made), (405, "MethodNotAllowed"));
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_applied_to_a_view_has_owners() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    register(&admin, "r1").await;
    send(&admin, "POST", TASKS, task("t")).await;
    let apply = |path: &str, manager: &str, config: Value| {
        let mark = if path.contains('?') { '&' } else { '?' };
        let (admin, path) = (admin.clone(), format!("{path}{mark}fieldManager={manager}"));
        async move { send_as(&admin, "PATCH", &path, APPLY, config.to_string()).await }
    };
    let node = |value: &str| {
        json!({"apiVersion": "v1", "kind": "Node", "metadata": {"name": "r1", "labels": {"zone": value}},
               "spec": {"taints": [{"key": "k", "effect": "NoSchedule"}]}})
    };
    let (code, shown) = apply("/api/v1/nodes/r1", "one", node("a")).await;
    assert_eq!((code, &shown["metadata"]["labels"]["zone"]), (200, &json!("a")), "{shown}");
    assert_eq!(get(&admin, &format!("{G}/nodes/r1")).await.1["spec"]["taints"][0]["key"], "k");
    let other = apply("/api/v1/nodes/r1", "two", node("b")).await;
    assert_eq!(refusal(&other), (409, "Conflict"), "{}", other.1);
    let cause = &other.1["details"]["causes"][0];
    assert_eq!(
        (&cause["reason"], &cause["field"]),
        (&json!("FieldManagerConflict"), &json!(".metadata.labels.zone"))
    );
    assert_eq!(cause["message"], "conflict with \"one\"");
    let (code, forced) = apply("/api/v1/nodes/r1?force=true", "two", node("b")).await;
    assert_eq!((code, &forced["metadata"]["labels"]["zone"]), (200, &json!("b")), "{forced}");
    let lost = apply("/api/v1/nodes/r1", "one", node("a")).await;
    assert_eq!(
        lost.1["details"]["causes"][0]["message"], "conflict with \"two\"",
        "it is theirs now"
    );
    let pod = json!({"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "t", "labels": {"zone": "a"}}});
    let (code, shown) = apply(&format!("{PODS}/t"), "one", pod.clone()).await;
    assert_eq!((code, &shown["metadata"]["labels"]["zone"]), (200, &json!("a")), "{shown}");
    let mut whole = pod.clone();
    whole["spec"] = json!({"containers": []});
    assert_eq!(refusal(&apply(&format!("{PODS}/t"), "one", whole).await), (422, "Invalid"));
    // What kubectl applies to the Node itself is not taken away by what it applies through the view.
    let ours = json!({"apiVersion": "muster.dev/v1alpha1", "kind": "Node", "metadata": {"name": "r1"},
        "spec": {"kind": "Robot", "speed": 0.5, "minBattery": 20, "estop": "Cut"}});
    let (code, shown) = apply(&format!("{G}/nodes/r1"), "kubectl", ours).await;
    assert_eq!((code, &shown["spec"]["estop"]), (200, &json!("Cut")), "{shown}");
    let label = json!({"apiVersion": "v1", "kind": "Node", "metadata": {"name": "r1", "labels": {"floor": "2"}}});
    let (code, shown) = apply("/api/v1/nodes/r1", "kubectl", label.clone()).await;
    assert_eq!((code, &shown["metadata"]["labels"]["floor"]), (200, &json!("2")), "{shown}");
    let (_, stored) = get(&admin, &format!("{G}/nodes/r1")).await;
    assert_eq!(stored["spec"]["estop"], "Cut", "a robot stays stopped");
    assert_eq!((&stored["spec"]["speed"], &stored["spec"]["kind"]), (&json!(0.5), &json!("Robot")));
    let managers = stored["metadata"]["managedFields"].as_array().unwrap();
    let of = |m: &Value| {
        (m["manager"].as_str().unwrap().to_owned(), m["apiVersion"].as_str().unwrap().to_owned())
    };
    let mut kubectls: Vec<_> =
        managers.iter().map(of).filter(|(name, _)| name == "kubectl").collect();
    kubectls.sort_unstable();
    assert_eq!(kubectls.len(), 2, "{kubectls:?}");
    assert_eq!((&*kubectls[0].1, &*kubectls[1].1), ("muster.dev/v1alpha1", "v1"));
    for field in ["estop", "estopRelease", "kind", "speed"] {
        let mut through = label.clone();
        through["spec"][field] = json!("None");
        let refused = apply("/api/v1/nodes/r1?force=true", "kubectl", through).await;
        assert_eq!(refusal(&refused), (422, "Invalid"), "{field}");
        assert_eq!(refused.1["details"]["causes"][0]["field"], format!("spec.{field}"));
    }
    let mut new = pod;
    new["metadata"]["name"] = "new".into();
    assert_eq!(refusal(&apply(&format!("{PODS}/new"), "one", new).await), (404, "NotFound"));
    cluster.running.shut_down().await.unwrap();
}
