//! A person's hold on a robot is answered when its gate has said that it counts.

use muster_api::wire::agent::v1::TaskPhase::Running;
use muster_api::wire::agent::v1::{Condition, NodeState};
use serde_json::{Value, json};

use super::agent::{Session, join, report, robot};
use super::support::*;

const NODE: &str = "/apis/muster.dev/v1alpha1/nodes/r1";

fn state(fenced: bool, person_epoch: u64) -> NodeState {
    let condition = Condition {
        r#type: "ActuatorsFenced".to_owned(),
        status: fenced,
        reason: "Test".to_owned(),
        message: "the test says so".to_owned(),
    };
    NodeState { conditions: vec![condition], person_epoch, ..robot() }
}

async fn fenced(cluster: &Cluster, status: &str) {
    let says = |node: &Value| {
        let conditions = node["status"]["conditions"].as_array();
        let mut conditions = conditions.into_iter().flatten();
        conditions.any(|c| c["type"] == "ActuatorsFenced" && c["status"] == status)
    };
    cluster.until(NODE, says).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nobody_is_told_that_they_have_a_robot_while_a_task_may_drive_it() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    cluster.give("bob", "operator", Value::Null).await;
    let bob = cluster.user("bob").await;
    let credential = join(&cluster, "r1").await;
    let mut session = Session::open(&cluster, &credential, Vec::new()).await.unwrap();
    session.say_state(state(true, 0)).await;
    fenced(&cluster, "True").await;
    let mut driver = task("driver");
    driver["spec"]["resources"] = json!({"actuators": ["base:Drive"]});
    let (_, made) = send(&admin, "POST", TASKS, driver).await;
    let uid = made["metadata"]["uid"].as_str().unwrap().to_owned();
    assert_eq!(session.assigned(&uid).await.lease.unwrap().epoch, 1);
    session.say(report(&uid, 2, Running)).await;
    cluster.until(&format!("{TASKS}/driver"), |t| t["status"]["phase"] == "Running").await;

    let lease = format!("{G}/leases/r1.body");
    let ask = async |client, step: &str| {
        send(client, "POST", &format!("{lease}/{step}"), json!({})).await
    };
    // Its gate says nothing: neither the first nor the next person is told that the robot is theirs.
    assert_eq!(refusal(&ask(&admin, "take").await), (504, "Timeout"));
    assert_eq!(refusal(&ask(&bob, "take").await), (504, "Timeout"));
    session.say_state(state(true, 3)).await;
    let (code, taken) = ask(&bob, "take").await;
    assert_eq!((code, &taken["status"]["epoch"]), (200, &3.into()), "{taken}");
    // Without its gate the task would drive again; so it would against who acquires it next.
    session.say_state(state(false, 0)).await;
    fenced(&cluster, "False").await;
    assert_eq!(refusal(&ask(&bob, "take").await), (409, "NotFenced"));
    assert_eq!(ask(&bob, "return").await.0, 200);
    assert_eq!(refusal(&ask(&admin, "acquire").await), (409, "NotFenced"));
    let (_, present) = get(&admin, &lease).await;
    assert_eq!(present["status"]["epoch"], 3, "{present}");
    cluster.running.shut_down().await.unwrap();
}
