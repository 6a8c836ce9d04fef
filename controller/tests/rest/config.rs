//! ConfigMaps and Secrets over REST: as every other kind, and what is theirs alone.

use serde_json::{Value, json};

use super::support::*;

const MAPS: &str = "/api/v1/namespaces/default/configmaps";
const SECRETS: &str = "/api/v1/namespaces/default/secrets";

fn secret(name: &str) -> Value {
    json!({
        "apiVersion": "v1", "kind": "Secret", "metadata": {"name": name, "labels": {"of": name}},
        "stringData": {"password": "hunter2"},
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn secrets_are_written_as_text_and_kept_as_base64() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let (code, stored) = send(&admin, "POST", SECRETS, secret("a")).await;
    assert_eq!(code, 201, "{stored}");
    assert_eq!(stored["data"], json!({"password": "aHVudGVyMg=="}));
    assert!(stored.get("stringData").is_none() && stored["type"] == "Opaque", "{stored}");

    let more = json!({"stringData": {"user": "ada"}});
    let (code, changed) = send(&admin, "PATCH", &format!("{SECRETS}/a"), more).await;
    assert_eq!((code, &changed["data"]["user"]), (200, &json!("YWRh")));
    assert_eq!(changed["data"]["password"], "aHVudGVyMg==");
    let other = json!({"type": "example.org/other"});
    let refused = send(&admin, "PATCH", &format!("{SECRETS}/a"), other).await;
    assert_eq!(refusal(&refused), (422, "Invalid"));

    send(&admin, "POST", SECRETS, secret("b")).await;
    let (_, list) =
        send(&admin, "GET", &format!("{SECRETS}?labelSelector=of%3Db"), Value::Null).await;
    assert_eq!(list["kind"], "SecretList");
    assert_eq!(list["items"].as_array().map(Vec::len), Some(1), "{list}");
    let (code, _) = send(&admin, "DELETE", &format!("{SECRETS}/b"), Value::Null).await;
    assert_eq!(code, 200);
    let (code, _) = send(&admin, "DELETE", SECRETS, Value::Null).await;
    assert_eq!(code, 200);
    let (_, list) = send(&admin, "GET", SECRETS, Value::Null).await;
    assert_eq!(list["items"], json!([]));
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_immutable_object_keeps_its_values() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let map = json!({"metadata": {"name": "m"}, "data": {"a": "1"}, "immutable": true});
    let (code, stored) = send(&admin, "POST", MAPS, map).await;
    assert_eq!(code, 201, "{stored}");
    let path = format!("{MAPS}/m");
    for (change, field) in
        [(json!({"data": {"a": "2"}}), "data"), (json!({"immutable": false}), "immutable")]
    {
        let answer = send(&admin, "PATCH", &path, change).await;
        assert_eq!(refusal(&answer), (422, "Invalid"));
        assert_eq!(answer.1["details"]["causes"][0]["field"], field);
    }
    let (code, _) = send(&admin, "PATCH", &path, json!({"metadata": {"labels": {"x": "y"}}})).await;
    assert_eq!(code, 200, "metadata may change");

    let bad = json!({"metadata": {"name": "n"}, "data": {"a b": "x"}, "spec": {}});
    assert_eq!(refusal(&send(&admin, "POST", MAPS, bad).await), (422, "Invalid"));
    let (_, resources) = send(&admin, "GET", "/api/v1", Value::Null).await;
    assert!(resources.to_string().contains("\"cm\""), "{resources}");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_plan_knows_what_is_applied_with_the_task() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut waits = task("waits");
    waits["spec"]["run"]["process"]["envFrom"] = json!([{"configMapRef": {"name": "m"}}]);
    let plan = "/apis/muster.dev/v1alpha1/plan";
    let (code, alone) = send(&admin, "POST", plan, json!({"objects": [waits]})).await;
    assert_eq!(code, 200, "{alone}");
    assert_eq!(alone["waits"][0]["why"][0]["reason"], "ConfigMapNotFound", "{alone}");
    let map = json!({"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "m"}});
    let (_, both) = send(&admin, "POST", plan, json!({"objects": [map, waits]})).await;
    assert!(!both.to_string().contains("ConfigMapNotFound"), "{both}");
    cluster.running.shut_down().await.unwrap();
}
