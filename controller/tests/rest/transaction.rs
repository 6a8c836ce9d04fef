//! Several objects in one commit, and only while what was planned still holds.

use serde_json::{Value, json};
use tokio::task::JoinSet;

use super::support::*;

const PLAN: &str = "/apis/muster.dev/v1alpha1/plan";
const TRANSACTION: &str = "/apis/muster.dev/v1alpha1/transaction";

fn task(name: &str) -> Value {
    json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Task", "metadata": {"name": name, "namespace": "default"},
        "spec": {"run": {"process": {"command": ["true"]}}},
    })
}

fn create(object: Value) -> Value {
    json!({ "create": object })
}

/// The revision as of which a plan is made.
async fn planned(client: &kube::Client, objects: &[Value]) -> String {
    let (code, plan) = send(client, "POST", PLAN, json!({ "objects": objects })).await;
    assert_eq!(code, 200, "{plan}");
    plan["revision"].as_str().unwrap().to_owned()
}

async fn apply(client: &kube::Client, revision: &str, requests: Value) -> (u16, Value) {
    send(client, "POST", TRANSACTION, json!({"revision": revision, "requests": requests})).await
}

/// The same, planned anew until nothing comes between.
async fn apply_now(client: &kube::Client, requests: Value) -> Value {
    let applied = async {
        loop {
            let revision = planned(client, &[]).await;
            let (code, answer) = apply(client, &revision, requests.clone()).await;
            if code != 409 {
                assert_eq!(code, 200, "{answer}");
                return answer;
            }
        }
    };
    tokio::time::timeout(DEADLINE, applied).await.unwrap()
}

fn revision(object: &Value) -> u64 {
    object["metadata"]["resourceVersion"].as_str().unwrap().parse().unwrap()
}

#[tokio::test]
async fn a_plan_that_somebody_overtook_stores_nothing() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let done = apply_now(&admin, json!([create(task("first"))])).await;
    let version = done["objects"][0]["metadata"]["resourceVersion"].clone();
    // The scheduler says of new tasks why they wait; then they are as they are.
    let waits = |task: &Value| !task["status"]["why"].is_null();
    cluster.until(&format!("{TASKS}/first"), waits).await;

    let old = planned(&admin, &[task("a"), task("b")]).await;
    let (code, _) = send(&admin, "POST", TASKS, task("between")).await;
    assert_eq!(code, 201);
    let both = json!([create(task("a")), create(task("b"))]);
    let (code, refused) = apply(&admin, &old, both.clone()).await;
    assert_eq!((code, &refused["reason"]), (409, &json!("Conflict")), "{refused}");
    let message = refused["message"].as_str().unwrap();
    assert!(message.contains("tasks/default/between has changed"), "{message}");
    assert_eq!(get(&admin, &format!("{TASKS}/a")).await.0, 404);

    let done = apply_now(&admin, both).await;
    let objects = done["objects"].as_array().unwrap();
    assert_eq!(revision(&objects[1]), revision(&objects[0]) + 1, "one commit");

    // Of what is changed and what stays the client says which version it has seen.
    let of = |name: &str| json!({"apiVersion": "muster.dev/v1alpha1", "kind": "Task", "namespace": "default", "name": name});
    let stale = json!([
        {"patch": {"of": of("a"), "patch": {"metadata": {"resourceVersion": version}, "spec": {"priority": 2}}}},
        {"check": {"of": of("b"), "resourceVersion": version}},
    ]);
    let answer = apply_now(&admin, stale).await;
    let codes: Vec<&Value> =
        answer["refusals"].as_array().unwrap().iter().map(|r| &r["status"]["code"]).collect();
    assert_eq!(codes, [&json!(409), &json!(409)], "{answer}");
    let a = cluster.until(&format!("{TASKS}/a"), waits).await;
    let b = cluster.until(&format!("{TASKS}/b"), waits).await;
    let now = json!([
        {"patch": {"of": of("a"), "patch": {"metadata": {"resourceVersion": a["metadata"]["resourceVersion"]}, "spec": {"priority": 2}}}},
        {"check": {"of": of("b"), "resourceVersion": b["metadata"]["resourceVersion"]}},
    ]);
    let answer = apply_now(&admin, now).await;
    assert_eq!(answer["objects"][0]["spec"]["priority"], 2, "{answer}");
    assert_eq!(answer["objects"][0]["metadata"]["generation"], 2, "{answer}");
    assert_eq!(revision(&answer["objects"][1]), revision(&b), "{answer}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_many_who_apply_at_once_each_is_stored_whole_and_none_is_lost() {
    let cluster = Cluster::start().await;
    let mut all = JoinSet::new();
    for n in 0..8 {
        let admin = cluster.admin().await;
        all.spawn(async move {
            let two = json!([create(task(&format!("t{n}-a"))), create(task(&format!("t{n}-b")))]);
            let done = apply_now(&admin, two).await;
            [revision(&done["objects"][0]), revision(&done["objects"][1])]
        });
    }
    let mut pairs = all.join_all().await;
    pairs.sort_unstable();
    assert!(pairs.iter().all(|[a, b]| *b == a + 1), "{pairs:?}");
    assert!(pairs.windows(2).all(|two| two[0][1] < two[1][0]), "{pairs:?}");
    let (_, list) = get(&cluster.admin().await, TASKS).await;
    assert_eq!(list["items"].as_array().unwrap().len(), 16);
}

#[tokio::test]
async fn what_is_wrong_with_one_keeps_all_out_and_is_said_of_it() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let refusals = async |requests: Value| {
        let answer = apply_now(&admin, requests).await;
        let refusals = answer["refusals"].as_array().cloned().unwrap_or_default();
        let (_, list) = get(&admin, TASKS).await;
        assert_eq!(list["items"], json!([]), "nothing is stored: {answer}");
        let row = |r: &Value| {
            let status = r["status"]["message"].as_str().unwrap().to_owned();
            (r["index"].as_u64().unwrap(), status)
        };
        refusals.iter().map(row).collect::<Vec<_>>()
    };
    let mut wrong = task("wrong");
    wrong["spec"]["resources"] = json!({"cpu": "2core"});
    let framework = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Framework",
        "metadata": {"name": "f", "namespace": "default"}, "spec": {},
    });
    let said = refusals(json!([create(task("good")), create(wrong), create(framework)])).await;
    assert_eq!((said.len(), said[0].0, said[1].0), (2, 1, 2), "{said:?}");
    assert!(said[0].1.contains("spec.resources.cpu"), "{said:?}");
    assert!(said[1].1.contains("create is not supported"), "{said:?}");

    // Each alone waits for one that is not there; both together wait for each other.
    let waits = |name: &str, other: &str| {
        let mut task = task(name);
        task["spec"]["dependsOn"] = json!([{"task": other, "condition": "Running"}]);
        create(task)
    };
    let said = refusals(json!([waits("a", "b"), waits("b", "a")])).await;
    assert!(
        !said.is_empty() && said.iter().all(|(_, text)| text.contains("dependsOn")),
        "{said:?}"
    );

    // The quota that comes with them is the one that counts.
    let asking = |name: &str| {
        let mut task = task(name);
        task["spec"]["resources"] = json!({"cpu": "600m"});
        create(task)
    };
    let quota = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Quota",
        "metadata": {"name": "default", "namespace": "default"}, "spec": {"hard": {"cpu": "1"}},
    });
    let said = refusals(json!([create(quota.clone()), asking("x"), asking("y")])).await;
    assert_eq!((said.len(), said[0].0), (1, 2), "{said:?}");
    assert!(said[0].1.contains("asks for 600m cpu"), "{said:?}");

    // A namespace may come with what is in it.
    let lab = json!({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": "lab"}});
    let mut inside = task("inside");
    inside["metadata"]["namespace"] = "lab".into();
    let done = apply_now(&admin, json!([create(lab), create(inside)])).await;
    assert_eq!(done["objects"][1]["metadata"]["namespace"], "lab", "{done}");
}
