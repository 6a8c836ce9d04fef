//! Nodes that are lost: a person's word, what comes back after all, and what a deletion takes along.

use muster_api::wire::agent::v1::TaskPhase::{Failed, Running};
use muster_api::wire::agent::v1::TaskReport;
use serde_json::{Value, json};

use super::agent::{Credential, Session, ask_to_join, join, report, token};
use super::support::*;

const NODE: &str = "/apis/muster.dev/v1alpha1/nodes/r1";

fn driver(name: &str) -> Value {
    let mut task = task(name);
    task["spec"]["resources"] = json!({"actuators": ["base:Drive"]});
    task
}

fn condition(node: &Value, r#type: &str) -> (String, String) {
    let conditions = node["status"]["conditions"].as_array();
    let found = conditions.into_iter().flatten().find(|c| c["type"] == r#type);
    let text = |field: &str| found.and_then(|c| c[field].as_str()).unwrap_or_default().to_owned();
    (text("status"), text("reason"))
}

/// A robot that runs a driver, which is then heard no more; the driver's uid.
async fn lost_robot(cluster: &Cluster) -> (Credential, String) {
    let admin = cluster.admin().await;
    let credential = join(cluster, "r1").await;
    let mut session = Session::open(cluster, &credential, Vec::new()).await.unwrap();
    cluster.until(NODE, |node| condition(node, "Ready").0 == "True").await;
    let (_, made) = send(&admin, "POST", TASKS, driver("first")).await;
    let uid = made["metadata"]["uid"].as_str().unwrap().to_owned();
    assert_eq!(session.assigned(&uid).await.lease.unwrap().epoch, 1);
    session.say(TaskReport { ready: Some(true), ..report(&uid, 2, Running) }).await;
    let runs = |t: &Value| t["status"]["phase"] == "Running" && t["status"]["ready"] == true;
    cluster.until(&format!("{TASKS}/first"), runs).await;
    let early = send(&admin, "POST", &format!("{NODE}/fence"), json!({"reason": "I think"})).await;
    assert_eq!(refusal(&early), (409, "NodeAlive"));
    drop(session);
    cluster.until(NODE, |node| condition(node, "Ready").0 == "Unknown").await;
    let lost = |t: &Value| t["status"]["phase"] == "Unknown" && t["status"]["ready"] == false;
    cluster.until(&format!("{TASKS}/first"), lost).await;
    (credential, uid)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fence_ends_what_was_there_and_a_stray_keeps_the_node_until_it_ended() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let (credential, first) = lost_robot(&cluster).await;
    let (_, made) = send(&admin, "POST", TASKS, driver("second")).await;
    let second = made["metadata"]["uid"].as_str().unwrap().to_owned();

    let fence = format!("{NODE}/fence");
    let (code, fenced) =
        send(&admin, "POST", &fence, json!({"reason": "plug pulled", "by": "ada"})).await;
    assert_eq!(code, 200, "{fenced}");
    assert_eq!(condition(&fenced, "Fenced"), ("True".to_owned(), "ConfirmedOff".to_owned()));
    let (_, ended) = get(&admin, &format!("{TASKS}/first")).await;
    assert_eq!(
        (&ended["status"]["phase"], &ended["status"]["reason"]),
        (&"Failed".into(), &"NodeFenced".into())
    );
    assert_eq!(ended["status"]["ready"], false);
    let message = ended["status"]["message"].as_str().unwrap();
    assert!(message.contains("ada") && message.contains("plug pulled"), "{message}");
    let (_, lease) = get(&admin, &format!("{G}/leases/r1.body")).await;
    assert_eq!((&lease["status"]["holder"], &lease["status"]["epoch"]), (&Value::Null, &1.into()));
    // The books follow.
    cluster.until(NODE, |node| node["status"]["leases"][0]["holder"].is_null()).await;

    // The person erred: the robot is back, and the first driver still drives.
    let mut session =
        Session::open(&cluster, &credential, vec![report(&first, 9, Running)]).await.unwrap();
    let page = session.assignments().await.unwrap();
    assert!(page.complete && page.upserts.iter().all(|a| a.uid == first && a.ended), "{page:?}");
    let node = cluster.until(NODE, |node| condition(node, "Ready").1 == "StrayTasks").await;
    assert!(node["status"]["conditions"].to_string().contains("default/first"), "{node}");
    assert_eq!(condition(&node, "Fenced").0, "True");
    let waits = |task: &Value| task["status"]["why"].to_string().contains("default/first");
    cluster.until(&format!("{TASKS}/second"), waits).await;
    let take = format!("{G}/leases/r1.body/take");
    let refused = send(&admin, "POST", &take, json!({"reason": "to look"})).await;
    assert_eq!(refusal(&refused), (409, "NotFenced"), "what drives there would drive on");

    session.say(report(&first, 10, Failed)).await;
    let given = session.assigned(&second).await;
    assert_eq!(given.lease.unwrap().epoch, 2);
    let (_, node) = get(&admin, NODE).await;
    assert_eq!(condition(&node, "Ready").0, "True");
    assert_eq!(condition(&node, "Fenced"), ("False".to_owned(), "NothingLeft".to_owned()));
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stray_without_an_object_is_released_after_its_end() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let (credential, first) = lost_robot(&cluster).await;
    send(&admin, "POST", &format!("{NODE}/fence"), json!({"reason": "gone"})).await;
    let (code, _) = send(&admin, "DELETE", &format!("{TASKS}/first"), Value::Null).await;
    assert_eq!((code, get(&admin, &format!("{TASKS}/first")).await.0), (200, 404));
    let said = vec![report(&first, 9, Running), report("older", 3, Failed)];
    let mut session = Session::open(&cluster, &credential, said).await.unwrap();
    let page = session.assignments().await.unwrap();
    assert!(page.complete && page.upserts.is_empty(), "{page:?}");
    assert_eq!(page.released, ["older"], "what lives is stopped and heard before it is forgotten");
    cluster.until(NODE, |node| condition(node, "Ready").1 == "StrayTasks").await;
    session.say(report(&first, 10, Failed)).await;
    assert_eq!(session.assignments().await.unwrap().released, [first]);
    cluster.until(NODE, |node| condition(node, "Ready").0 == "True").await;
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fence_needs_a_reason_and_an_admin() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    register(&admin, "r1").await;
    let fence = format!("{NODE}/fence");
    for (body, path) in [
        (json!({"reason": " "}), "reason"),
        (json!({}), "reason"),
        (json!({"reason": "x", "why": "y"}), "why"),
    ] {
        let refused = send(&admin, "POST", &fence, body).await;
        assert_eq!(refusal(&refused), (422, "Invalid"));
        assert!(refused.1["message"].as_str().unwrap().contains(path), "{refused:?}");
    }
    let good = json!({"reason": "never switched on"});
    let anonymous = cluster.anonymous().await;
    assert_eq!(send(&anonymous, "POST", &fence, good.clone()).await.0, 401);
    let unknown = send(&admin, "POST", &format!("{G}/nodes/r9/fence"), good.clone()).await;
    assert_eq!(refusal(&unknown), (404, "NotFound"));
    assert_eq!(send(&admin, "POST", &fence, good).await.0, 200);
    assert_eq!(refusal(&get(&admin, &fence).await).0, 405);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_a_person_has_stopped_is_not_deleted() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    join(&cluster, "r1").await;
    let estop = |tier: Value| json!({"spec": {"estop": tier}});
    assert_eq!(send(&admin, "PATCH", NODE, estop(json!("Cut"))).await.0, 200);
    let refused = send(&admin, "DELETE", NODE, Value::Null).await;
    assert_eq!(refusal(&refused), (409, "NodeStopped"));
    assert!(refused.1["message"].as_str().unwrap().contains("muster estop r1 --release"));
    assert_eq!(send(&admin, "PATCH", NODE, estop(Value::Null)).await.0, 200);
    assert_eq!(send(&admin, "DELETE", NODE, Value::Null).await.0, 200);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_node_in_use_is_not_deleted_and_a_deleted_one_takes_its_credential_along() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let credential = join(&cluster, "r1").await;
    let mut session = Session::open(&cluster, &credential, Vec::new()).await.unwrap();
    session.assignments().await.unwrap();
    let (_, made) = send(&admin, "POST", TASKS, driver("first")).await;
    let uid = made["metadata"]["uid"].as_str().unwrap();
    session.assigned(uid).await;
    let refused = send(&admin, "DELETE", NODE, Value::Null).await;
    assert_eq!(refusal(&refused), (409, "NodeInUse"));
    let message = refused.1["message"].as_str().unwrap();
    assert!(
        message.contains("default/first")
            && message.contains("muster drain r1")
            && message.contains("muster node fence r1"),
        "{message}"
    );
    session.say(report(uid, 2, Failed)).await;
    cluster.until(&format!("{TASKS}/first"), |t| t["status"]["phase"] == "Failed").await;
    assert_eq!(send(&admin, "DELETE", NODE, Value::Null).await.0, 200);

    let end = loop {
        if let Err(end) = session.assignments().await {
            break end;
        }
    };
    assert!(end.message().contains("it was deleted"), "{end}");
    for registered in [false, true] {
        if registered {
            register(&admin, "r1").await;
        }
        let mut again = Session::open(&cluster, &credential, Vec::new()).await.unwrap();
        let refused = again.assignments().await.unwrap_err();
        assert_eq!(refused.code(), tonic::Code::PermissionDenied);
        assert!(refused.message().contains("muster token create --node r1"), "{refused}");
        assert_eq!(get(&admin, NODE).await.0, if registered { 200 } else { 404 });
    }
    let credential = join(&cluster, "r1").await;
    let mut session = Session::open(&cluster, &credential, Vec::new()).await.unwrap();
    session.assignments().await.unwrap();
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_name_that_has_joined_is_given_away_only_by_a_token_for_it() {
    let cluster = Cluster::start().await;
    let any = token(&cluster, None).await;
    assert_eq!(ask_to_join(&cluster, "r1", &any).await.0, 200);
    let (code, refused, _) = ask_to_join(&cluster, "r1", &any).await;
    assert_eq!(code, 409);
    assert_eq!(
        refused["message"],
        "r1 has joined already; a replacement needs a token made for it: muster token create --node r1"
    );
    assert_eq!(ask_to_join(&cluster, "r2", &any).await.0, 200, "it is no worse for that");
    register(&cluster.admin().await, "r3").await;
    assert_eq!(ask_to_join(&cluster, "r3", &any).await.0, 200, "registered is not joined");

    // The replacement locks the one before it out.
    let old = join(&cluster, "r1").await;
    let mut session = Session::open(&cluster, &old, Vec::new()).await.unwrap();
    session.assignments().await.unwrap();
    let new = join(&cluster, "r1").await;
    let mut replacement = Session::open(&cluster, &new, Vec::new()).await.unwrap();
    replacement.assignments().await.unwrap();
    let mut again = Session::open(&cluster, &old, Vec::new()).await.unwrap();
    let refused = again.assignments().await.unwrap_err();
    assert!(refused.message().contains("another agent has joined in its place"), "{refused}");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_with_a_field_that_does_not_exist_is_refused() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    for (body, path) in [
        (json!({"spec": {"ttl": "1h"}}), "spec.ttl"),
        (json!({"nodeName": "r1"}), "nodeName"),
        (json!({"spec": {"uses": "many"}}), "spec.uses"),
    ] {
        let refused = send(&admin, "POST", &format!("{G}/jointokens"), body).await;
        assert_eq!(refusal(&refused), (422, "Invalid"));
        assert_eq!(refused.1["details"]["causes"][0]["field"], path, "{refused:?}");
    }
    cluster.running.shut_down().await.unwrap();
}
