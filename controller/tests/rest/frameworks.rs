//! Who may run a framework, and where; and what of it stands in the audit log.

use http::Request;
use http_body_util::BodyExt as _;
use kube::Client;
use serde_json::{Value, json};

use super::support::*;

/// Opens a session as JSON lines: the code, and its first event. The session lasts as long as the rest.
async fn subscribe(client: &Client, namespace: &str) -> (u16, Value, kube::client::Body) {
    let call = json!({"subscribe": {"name": "deliver", "namespace": namespace}});
    let body = kube::client::Body::from(format!("{call}\n").into_bytes());
    let request = Request::post("/framework/v1/session").body(body).unwrap();
    let response = client.send(request).await.unwrap();
    let code = response.status().as_u16();
    let mut body = response.into_body();
    let frame = tokio::time::timeout(DEADLINE, body.frame()).await.unwrap().unwrap().unwrap();
    let first = frame.into_data().unwrap();
    let line = first.split(|byte| *byte == b'\n').next().unwrap();
    (code, serde_json::from_slice(line).unwrap(), body)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_framework_is_run_where_its_role_is() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let namespace = json!({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": "lab"}});
    assert_eq!(send(&admin, "POST", "/api/v1/namespaces", namespace).await.0, 201);
    let give = async |role: &str, user: &str| {
        cluster.give(user, role, json!(["lab"])).await;
        cluster.user(user).await
    };
    let courier = give("framework", "courier").await;
    let viewer = give("viewer", "vera").await;
    let other = give("framework", "other").await;

    for refused in [&viewer, &cluster.agent("r1").await] {
        let (code, status, _) = subscribe(refused, "lab").await;
        assert_eq!(refusal(&(code, status)), (403, "Forbidden"));
    }
    let (code, status, _) = subscribe(&cluster.anonymous().await, "lab").await;
    assert_eq!(refusal(&(code, status)), (401, "Unauthorized"));
    let (code, event, _) = subscribe(&courier, "default").await;
    assert_eq!((code, &event["error"]["reason"]), (200, &"Forbidden".into()), "{event}");
    let message = event["error"]["message"].as_str().unwrap();
    assert!(message.contains("resource \"frameworks/session\""), "{message}");

    let (code, event, _lasts) = subscribe(&courier, "lab").await;
    assert_eq!(code, 200);
    let session = event["subscribed"]["sessionId"].as_str().unwrap().to_owned();
    let calls = format!("/framework/v1/session/{session}/calls");
    let revive = json!({"revive": {}});
    assert_eq!(send(&courier, "POST", &calls, revive.clone()).await.0, 202);
    let stolen = send(&other, "POST", &calls, revive).await;
    assert_eq!(refusal(&stolen), (404, "NotFound"), "a session is its opener's");

    let text = std::fs::read_to_string(cluster.dir.path().join("data/audit/audit.jsonl")).unwrap();
    let line = text.lines().find(|line| line.contains("\"frameworks\"")).unwrap();
    let line: Value = serde_json::from_str(line).unwrap();
    assert_eq!(
        (&line["user"], &line["verb"], &line["namespace"], &line["name"]),
        (&"courier".into(), &"create".into(), &"lab".into(), &"deliver".into())
    );
    cluster.running.shut_down().await.unwrap();
}

/// What a session says until `wanted`.
async fn until(body: &mut kube::client::Body, wanted: impl Fn(&Value) -> bool) -> Value {
    let mut rest = Vec::new();
    loop {
        let frame = tokio::time::timeout(DEADLINE, body.frame()).await.expect("it is said");
        let frame = frame.expect("the session goes on").unwrap();
        rest.extend_from_slice(&frame.into_data().unwrap_or_default());
        while let Some(end) = rest.iter().position(|byte| *byte == b'\n') {
            let line: Vec<u8> = rest.drain(..=end).collect();
            let event: Value = serde_json::from_slice(&line).unwrap();
            if wanted(&event) {
                return event;
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn somebody_else_says_where_a_framework_works() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let path = format!("{G}/namespaces/default/frameworks/deliver");
    let at = |x: f64| json!({"spec": {"position": {"x": x, "y": 2.0}, "radius": 5.0}});
    let set = async |body: Value| send(&admin, "POST", &format!("{path}/position"), body).await;
    assert_eq!(refusal(&set(at(1.0)).await), (404, "NotFound"));
    let (_, event, mut session) = subscribe(&admin, "default").await;
    assert!(event["subscribed"].is_object(), "{event}");

    let (code, framework) = set(at(1.0)).await;
    assert_eq!((code, &framework["spec"]["position"]["x"]), (200, &1.0.into()), "{framework}");
    let event = until(&mut session, |event| event["moved"].is_object()).await;
    let position =
        json!({"map": "map", "x": 1.0, "y": 2.0, "radius": 5.0, "cost": "COST_DISTANCE"});
    assert_eq!(event["moved"]["position"], position);
    assert!(!event["moved"]["by"].as_str().unwrap().is_empty());
    let (code, framework) = set(json!({"spec": {}})).await;
    assert_eq!((code, framework["spec"].get("position")), (200, None), "everywhere");
    let event = until(&mut session, |event| event["moved"].is_object()).await;
    assert_eq!(event["moved"].get("position"), None);

    let nowhere = set(json!({"spec": {"radius": 5.0}})).await;
    assert_eq!(refusal(&nowhere), (422, "Invalid"));
    assert_eq!(nowhere.1["details"]["causes"][0]["field"], "spec.position");
    assert_eq!(set(json!({"spec": {"filter": {}}})).await.0, 422, "that is the framework's own");
    let (_, unchanged) = send(&admin, "GET", &path, Value::Null).await;
    assert_eq!(unchanged["spec"].get("radius"), None);

    drop(session);
    // It is away as soon as its session knows.
    let refused = loop {
        match set(at(3.0)).await {
            (200, _) => tokio::task::yield_now().await,
            refused => break refused,
        }
    };
    assert_eq!(refusal(&refused), (409, "NotConnected"));
    cluster.running.shut_down().await.unwrap();
}

async fn ends(mut body: kube::client::Body) {
    until(&mut body, |event| event["error"]["reason"] == "Forbidden").await;
    let end = tokio::time::timeout(DEADLINE, body.frame()).await.expect("it ends");
    assert!(end.is_none_or(|end| end.is_err()), "nothing more is said");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_ends_with_the_token_or_the_right_that_opened_it() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    cluster.give("courier", "framework", json!(["default"])).await;
    let made = cluster.token("courier", 3600).await;
    let courier = cluster.bearer(made["status"]["token"].as_str().unwrap()).await;
    let (_, event, mut session) = subscribe(&courier, "default").await;
    let subscribed = &event["subscribed"];
    let id = subscribed["frameworkId"].as_str().unwrap().to_owned();
    let calls =
        format!("/framework/v1/session/{}/calls", subscribed["sessionId"].as_str().unwrap());

    // Another token of the same user: the session is theirs.
    let renewed = cluster.user("courier").await;
    let filter = json!({"id": "1", "setFilter": {"filter": {"most": 2}}});
    assert_eq!(send(&renewed, "POST", &calls, filter).await.0, 202);
    until(&mut session, |event| event["answer"]["id"] == "1").await;
    let text = std::fs::read_to_string(cluster.dir.path().join("data/audit/audit.jsonl")).unwrap();
    let line: Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
    assert_eq!(
        (&line["user"], &line["verb"], &line["resource"], &line["name"]),
        (&"courier".into(), &"update".into(), &"frameworks".into(), &"deliver".into())
    );

    // It calls nothing, and ends.
    let token = format!("{G}/usertokens/{}", made["metadata"]["name"].as_str().unwrap());
    assert_eq!(send(&admin, "DELETE", &token, Value::Null).await.0, 200);
    ends(session).await;

    let call = json!({"subscribe": {"name": "deliver", "namespace": "default", "frameworkId": id}});
    let body = kube::client::Body::from(format!("{call}\n").into_bytes());
    let request = Request::post("/framework/v1/session").body(body).unwrap();
    let mut session = renewed.send(request).await.unwrap().into_body();
    until(&mut session, |event| !event["subscribed"].is_null()).await;
    let gone = send(&admin, "DELETE", &format!("{G}/accesses/courier"), Value::Null).await;
    assert_eq!(gone.0, 200);
    ends(session).await;
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_framework_reaches_into_nodes_only_with_access_to_hosts() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    cluster.give("courier", "framework", json!(["default"])).await;
    let courier = cluster.user("courier").await;
    let (_, event, mut session) = subscribe(&courier, "default").await;
    let id = event["subscribed"]["sessionId"].as_str().unwrap();
    let calls = format!("/framework/v1/session/{id}/calls");
    let accept = |id: &str, run: Value| json!({"id": id, "accept": {"offers": ["0-3"], "launches": [{"spec": {"run": run}}]}});
    let mut said = async |call: Value| {
        assert_eq!(send(&courier, "POST", &calls, call.clone()).await.0, 202);
        let answer = until(&mut session, |event| event["answer"]["id"] == call["id"]).await;
        answer["answer"]["refusal"].clone()
    };

    let process = json!({"process": {"command": ["true"]}});
    let refused = said(accept("1", process.clone())).await;
    assert_eq!(refused["reason"], "REFUSAL_REASON_INVALID", "{refused}");
    assert_eq!(refused["causes"][0]["field"], "launches[0].spec.run.process", "{refused}");
    // The offer that is none comes after the spec that is wrong.
    let gone = "REFUSAL_REASON_OFFER_GONE";
    let container = json!({"container": {"image": "busybox", "network": "Bridge"}});
    assert_eq!(said(accept("2", container)).await["reason"], gone);
    // The session is older than the right.
    let path = format!("{G}/accesses/courier");
    let given = json!({"spec": {"hostAccess": true}});
    assert_eq!(send(&admin, "PATCH", &path, given).await.0, 200);
    assert_eq!(said(accept("3", process)).await["reason"], gone);
    cluster.running.shut_down().await.unwrap();
}

/// A reference, a finalizer and a label that a framework's own launches have.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_does_not_forge_what_a_framework_launched() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let forged = json!({
        "finalizers": ["muster.dev/framework-acknowledges"],
        "labels": {"muster.dev/framework": "deliver"},
        "ownerReferences": [{
            "apiVersion": "muster.dev/v1alpha1", "kind": "Framework", "name": "deliver", "uid": "u", "controller": true,
        }],
    });
    let fields = |answer: &(u16, Value)| {
        assert_eq!(refusal(answer), (422, "Invalid"));
        let causes = answer.1["details"]["causes"].as_array().unwrap().iter();
        causes.map(|cause| cause["field"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    let places = [
        "metadata.ownerReferences[0]",
        "metadata.finalizers[0]",
        "metadata.labels[\"muster.dev/framework\"]",
    ];
    let mut made = task("t");
    for (field, value) in forged.as_object().unwrap() {
        made["metadata"][field] = value.clone();
    }
    let (_, plan) = send(&admin, "POST", &format!("{G}/plan"), json!({"objects": []})).await;
    let transaction = json!({"revision": plan["revision"], "requests": [{"create": made.clone()}]});
    let whole = send(&admin, "POST", &format!("{G}/transaction"), transaction).await;
    assert_eq!(whole.1["refusals"][0]["status"]["code"], 422, "{whole:?}");
    assert_eq!(fields(&send(&admin, "POST", TASKS, made).await), places);
    assert_eq!(send(&admin, "POST", TASKS, task("t")).await.0, 201);
    let patch = json!({"metadata": forged});
    assert_eq!(fields(&send(&admin, "PATCH", &format!("{TASKS}/t"), patch).await), places);
    cluster.running.shut_down().await.unwrap();
}
