//! Tasks that are placed anew when their robot leaves the radius, as far as the controller goes.

use std::time::Duration;

use muster_api::wire::agent::v1 as wire;
use serde_json::{Value, json};
use wire::TaskPhase::{Failed, Running};

use super::agent::{Session, join, report};
use super::support::*;

const T: &str = "/apis/muster.dev/v1alpha1/namespaces/default/tasks/t";

/// Between two poses of a robot.
const RATE: Duration = Duration::from_millis(200);

fn pose(x: f64) -> wire::Pose {
    wire::Pose { map: "map".to_owned(), x, localized: true, ..wire::Pose::default() }
}

/// Does `work` while the robots say where they are.
async fn at<T>(robots: &[(&Session, f64)], work: impl Future<Output = T>) -> T {
    let say = async {
        let mut ticks = tokio::time::interval(RATE);
        loop {
            ticks.tick().await;
            for (session, x) in robots {
                session.say_pose(pose(*x)).await;
            }
        }
    };
    tokio::select! {
        done = work => done,
        () = say => unreachable!("it goes on"),
    }
}

fn text<'a>(object: &'a Value, pointer: &str) -> &'a str {
    object.pointer(pointer).and_then(Value::as_str).unwrap_or_default()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_leaves_loses_its_task_when_its_mission_is_over_and_another_gets_it() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut sessions = Vec::new();
    for name in ["r1", "r2"] {
        let credential = join(&cluster, name).await;
        sessions.push(Session::open(&cluster, &credential, Vec::new()).await.unwrap());
    }
    let [mut one, two] = <[Session; 2]>::try_from(sessions).ok().unwrap();
    let mut task = task("t");
    task["spec"]["placement"] = json!({
        "on": "Robot", "at": {"x": 0, "y": 0}, "within": 5, "onOutOfRange": "Reschedule",
    });
    let near = [(&one, 0.5), (&two, 4.0)];
    // Before it is known that the second is further away, either may get the task.
    let far_one = format!("{G}/nodes/r2");
    at(&near, cluster.until(&far_one, |node| node["status"]["pose"]["x"] == 4.0)).await;
    assert_eq!(send(&admin, "POST", TASKS, task).await.0, 201);
    let placed = at(&near, cluster.until(T, |task| text(task, "/status/phase") == "Bound")).await;
    assert_eq!(text(&placed, "/status/node"), "r1");
    let uid = text(&placed, "/metadata/uid").to_owned();
    one.say_of(report(&uid, 1, Running)).await;

    // It is on a mission when it leaves.
    let lock = |value: Value| {
        let patch = json!({"metadata": {"annotations": {"muster.dev/mission-lock": value}}});
        let admin = admin.clone();
        async move {
            let (code, answer) = send(&admin, "PATCH", &format!("{G}/nodes/r1"), patch).await;
            assert_eq!(code, 200, "{answer}");
        }
    };
    lock(json!("ada: carries a tray")).await;
    let far = [(&one, 9.0), (&two, 4.0)];
    let said = |list: &Value| {
        let items = list["items"].as_array().cloned().unwrap_or_default();
        items.iter().any(|event| event["reason"] == "OutOfRange")
    };
    let events = at(&far, cluster.until(EVENTS, said)).await;
    let events = events["items"].as_array().unwrap();
    let event = events.iter().find(|event| event["reason"] == "OutOfRange").unwrap();
    assert_eq!(
        text(event, "/message"),
        "r1 is 9.0 m from the operation position and was outside of its radius of 5 m for 5 s; \
         the task stays while ada has the robot's mission lock"
    );
    let kept = get(&admin, T).await.1;
    assert_eq!((&kept["status"]["stop"], text(&kept, "/status/phase")), (&Value::Null, "Running"));

    lock(Value::Null).await;
    let ordered = |task: &Value| text(task, "/status/stop/reason") == "OutOfRange";
    at(&far, cluster.until(T, ordered)).await;
    let stop = loop {
        if let Some(stop) = one.assigned(&uid).await.stop {
            break stop;
        }
    };
    assert!(stop.reason.starts_with("OutOfRange: r1 is 9.0 m from"), "{}", stop.reason);
    one.say(wire::TaskReport { reason: "Stopped".to_owned(), ..report(&uid, 2, Failed) }).await;
    let again =
        |task: &Value| text(task, "/metadata/uid") != uid && text(task, "/status/phase") == "Bound";
    let far = [(&one, 9.0), (&two, 4.0)];
    let moved = at(&far, cluster.until(T, again)).await;
    assert_eq!(text(&moved, "/status/node"), "r2");
    assert_eq!(text(&moved, "/status/earlier/0/reason"), "OutOfRange");
    assert_eq!(moved["status"]["earlier"][0]["attempts"], 0);
    cluster.running.shut_down().await.unwrap();
}
