//! What no request may do, whatever it brings: take the controller with it, or store what cannot be read again.

use kube::Client;
use serde_json::{Value, json};

use super::support::*;

const JSON_PATCH: &str = "application/json-patch+json";

fn nested(depth: usize) -> Value {
    (0..depth).fold(json!(1), |inner, _| json!({ "a": inner }))
}

async fn as_table(client: &Client, path: &str) -> (u16, Value) {
    let accept = "application/json;as=Table;v=v1;g=meta.k8s.io";
    let request = http::Request::get(path).header("accept", accept);
    let response = client.send(request.body(kube::client::Body::empty()).unwrap()).await.unwrap();
    let code = response.status().as_u16();
    let bytes = response.into_body().collect_bytes().await.unwrap();
    (code, serde_json::from_slice(&bytes).unwrap())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_patch_that_doubles_an_object_over_and_over_is_refused() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", EVENTS, event("p")).await;
    let copy =
        |i: usize| json!({"op": "copy", "from": "/metadata", "path": format!("/metadata/x{i}")});
    let doubled: Value = (0..30).map(copy).collect();
    for query in ["", "?dryRun=All"] {
        let path = format!("{EVENTS}/p{query}");
        let bomb = send_as(&admin, "PATCH", &path, JSON_PATCH, doubled.to_string()).await;
        assert_eq!(refusal(&bomb), (413, "RequestEntityTooLarge"), "{query}");
    }
    assert_eq!(get(&admin, &format!("{EVENTS}/p")).await.0, 200);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_stored_that_cannot_be_read_again() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", EVENTS, event("p")).await;
    let path = format!("{EVENTS}/p");
    let patch = async |ops: Value, query: &str| {
        send_as(&admin, "PATCH", &format!("{path}{query}"), JSON_PATCH, ops.to_string()).await
    };
    let unknown = patch(json!([{"op": "add", "path": "/foo", "value": nested(50)}]), "").await;
    assert_eq!(refusal(&unknown), (422, "Invalid"), "an Event has no such field");
    let dropped = json!([{"op": "add", "path": "/foo", "value": nested(50)}]);
    let (code, dropped) = patch(dropped, "?fieldValidation=Ignore").await;
    assert_eq!((code, &dropped["foo"]), (200, &Value::Null));
    let deep = json!([{"op": "add", "path": "/foo", "value": nested(110)}]);
    let refused = patch(deep, "?fieldValidation=Ignore").await;
    assert_eq!(refusal(&refused), (413, "RequestEntityTooLarge"));
    let mut deep = event("deep");
    deep["foo"] = nested(110);
    let refused = send(&admin, "POST", &format!("{EVENTS}?fieldValidation=Ignore"), deep).await;
    assert_eq!(refusal(&refused), (400, "BadRequest"));

    // A status is not held against every field; it has no more room.
    let quota = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Quota", "metadata": {"name": "default"},
        "spec": {"hard": {"cpu": "1"}},
    });
    let quotas = format!("{G}/namespaces/default/quotas");
    assert_eq!(send(&admin, "POST", &quotas, quota).await.0, 201);
    send(&admin, "POST", TASKS, task("t")).await;
    for path in [format!("{quotas}/default/status"), format!("{TASKS}/t/status")] {
        let first = json!({"status": {"foo": nested(90)}});
        send(&admin, "PATCH", &path, first).await;
        let under = format!("/status/foo{}", "/a".repeat(89));
        let deeper = json!([{"op": "add", "path": under, "value": nested(90)}]);
        let deeper = send_as(&admin, "PATCH", &path, JSON_PATCH, deeper.to_string()).await;
        assert!((400..500).contains(&deeper.0), "{}", deeper.1);
    }
    for path in [EVENTS, TASKS, &quotas] {
        assert_eq!(as_table(&admin, path).await.0, 200, "{path}");
    }
    let large = json!({"metadata": {"annotations": {"x": "x".repeat(2 << 20)}}});
    assert_eq!(send(&admin, "PATCH", &path, large).await.0, 200);
    let larger = json!({"metadata": {"annotations": {"y": "x".repeat(2 << 20)}}});
    for query in ["", "?dryRun=All"] {
        let larger = send(&admin, "PATCH", &format!("{path}{query}"), larger.clone()).await;
        assert_eq!(refusal(&larger), (400, "BadRequest"), "{query}");
    }
    assert_eq!(send(&admin, "DELETE", &path, Value::Null).await.0, 200);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_body_full_of_mistakes_has_a_short_answer() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut wrong = task("wrong");
    let spec = wrong["spec"].as_object_mut().unwrap();
    spec.extend((0..100_000).map(|i| (format!("unknown{i}"), json!(1))));
    spec.insert("a".repeat(100_000), json!(1));
    for mode in ["Strict", "Warn", "Ignore"] {
        let path = format!("{TASKS}?fieldValidation={mode}");
        let (code, status) = send(&admin, "POST", &path, wrong.clone()).await;
        assert_eq!((code, status["details"]["causes"].as_array().unwrap().len()), (422, 100));
        assert!(status.to_string().len() < 150_000, "{mode}: {}", status.to_string().len());
        assert!(status["message"].as_str().unwrap().ends_with("and more]"));
    }
    let mut wrong = task("wrong");
    for i in 0..90 {
        wrong["spec"][format!("{}{i}", "long".repeat(20))] = json!(1);
    }
    let request = http::Request::post(format!("{TASKS}?fieldValidation=Warn"))
        .header("content-type", "application/json")
        .body(kube::client::Body::from(wrong.to_string().into_bytes()));
    let response = admin.send(request.unwrap()).await.unwrap();
    assert_eq!(response.status(), 201);
    let warnings: Vec<&str> =
        response.headers().get_all("warning").iter().map(|w| w.to_str().unwrap()).collect();
    assert!(warnings[0].starts_with(r#"299 - "unknown field \"spec.longlong"#), "{}", warnings[0]);
    let length: usize = warnings.iter().map(|warning| warning.len()).sum();
    assert!(length <= 4 << 10 && warnings.len() > 10, "{length} bytes in {}", warnings.len());
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_judged_together_is_not_without_end() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let objects: Vec<Value> = (0..1001).map(|i| task(&format!("t{i}"))).collect();
    let create: Vec<Value> = objects.iter().map(|object| json!({ "create": object })).collect();
    for (path, body) in [
        ("plan", json!({ "objects": objects })),
        ("check", json!({ "objects": objects })),
        ("transaction", json!({"revision": "1", "requests": create})),
    ] {
        let refused = send(&admin, "POST", &format!("{G}/{path}"), body).await;
        assert_eq!(refusal(&refused), (413, "RequestEntityTooLarge"), "{path}");
    }
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn strangers_have_connections_of_their_own_number() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let live = async |client: &Client| {
        let request = http::Request::get("/livez").body(kube::client::Body::empty()).unwrap();
        let response = client.send(request).await.ok()?;
        response.into_body().collect_bytes().await.ok()
    };
    let mut held = Vec::new();
    while held.len() < 400 {
        let stranger = cluster.anonymous().await;
        if live(&stranger).await.is_none() {
            break;
        }
        held.push(stranger);
    }
    assert!((100..400).contains(&held.len()), "{} were let in", held.len());
    assert!(live(&admin).await.is_some(), "who has a certificate is let in");
    drop(held);
    let again = async {
        while live(&cluster.anonymous().await).await.is_none() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(DEADLINE, again).await.expect("places are given back");
    cluster.running.shut_down().await.unwrap();
}
