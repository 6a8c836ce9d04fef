//! Mission locks that are set on the robot: by a task, and by a person there while the controller is gone.

use kube::Api;
use kube::api::{Patch, PatchParams, PostParams};
use muster_api::kind::node::Node;
use muster_api::kind::taskset::{TaskSet, TaskSetStatus};
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, wait};
use serde_json::{Value, json};

use crate::cli::muster;

async fn sets(cluster: &Cluster) -> Api<TaskSet> {
    Api::namespaced(cluster.client().await, "default")
}

async fn program(cluster: &Cluster, command: &str) {
    let run = json!({"process": {"command": ["sh", "-c", command]}});
    let patch = Patch::Merge(json!({"spec": {"template": {"spec": {"run": run}}}}));
    let changed = sets(cluster).await.patch("watch", &PatchParams::default(), &patch).await;
    changed.expect("the controller takes it");
}

async fn until(
    cluster: &Cluster,
    what: &str,
    is: impl Fn(&TaskSetStatus) -> bool,
) -> TaskSetStatus {
    let is = |set: Option<&TaskSet>| set.and_then(|set| set.status.as_ref()).is_some_and(&is);
    let set = wait::object(sets(cluster).await, "watch", what, is).await;
    set.and_then(|set| set.status).expect("it has one")
}

fn held(status: &TaskSetStatus) -> bool {
    !status.held.is_empty()
}

async fn locks(cluster: &Cluster, wanted: &[(&str, &str)]) {
    let is = |node: Option<&Node>| {
        let locks = node.and_then(|n| n.status.as_ref()).map(|s| s.mission_locks.clone());
        let locks = locks.unwrap_or_default();
        locks.iter().map(|l| (l.holder.as_str(), l.reason.as_str())).collect::<Vec<_>>() == wanted
    };
    wait::object(cluster.nodes().await, "robot", &format!("{wanted:?}"), is).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_on_a_mission_is_left_alone_whoever_says_so_there() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    let over = cluster.dir().join("over");
    let script = format!(
        "echo carries a tray > $MUSTER_RUN_DIR/mission-lock; until [ -e {} ]; do sleep 0.05; done; \
         rm $MUSTER_RUN_DIR/mission-lock; exec sleep 1000",
        over.display()
    );
    let run = json!({"process": {"command": ["sh", "-c", script]}});
    cluster.create("mission", json!({"run": run, "gracePeriodSeconds": 0})).await;
    locks(&cluster, &[("task default/mission", "carries a tray")]).await;
    let template = json!({"spec": {
        "placement": {"on": "Robot"}, "gracePeriodSeconds": 0,
        "run": {"process": {"command": ["sleep", "1001"]}},
    }});
    let set: Value = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "TaskSet", "metadata": {"name": "watch"},
        "spec": {"everyNode": true, "minReadySeconds": 0, "template": template},
    });
    let set = serde_json::from_value(set).expect("a set");
    sets(&cluster).await.create(&PostParams::default(), &set).await.expect("it is created");
    let serves = |s: &TaskSetStatus| s.updated_replicas == 1 && s.available_replicas == 1;
    until(&cluster, "serving", serves).await;

    program(&cluster, "exec sleep 1002").await;
    let status = until(&cluster, "held", held).await;
    assert_eq!((&*status.held[0].node, &*status.held[0].holder), ("robot", "task default/mission"));
    let (code, _, err) = muster(&cluster, &["node", "unlock", "robot"]);
    assert!(code != 0 && err.contains("on the robot itself"), "{err}");
    let (code, out, _) = muster(&cluster, &["drain", "robot", "--timeout=5s"]);
    assert!(code != 0 && out.contains("waiting for the mission of task default/mission"), "{out}");
    cluster.phase("mission", TaskPhase::Running).await;
    assert_eq!(muster(&cluster, &["uncordon", "robot"]).0, 0);
    std::fs::write(&over, "").expect("a file");
    locks(&cluster, &[]).await;
    until(&cluster, "updated", |s| serves(s) && !held(s)).await;

    // A person on the robot, and nobody to tell; a change that is asked for the moment the controller is back.
    cluster.kill_controller();
    let file = cluster.dir().join("robot").join("mission-lock");
    std::fs::write(&file, "ada: cleans the laser\n").expect("a file");
    cluster.start_controller().await;
    program(&cluster, "exec sleep 1003").await;
    let status = until(&cluster, "held", held).await;
    assert_eq!(&*status.held[0].holder, "ada");
    std::fs::remove_file(&file).expect("it is there");
    until(&cluster, "updated", |s| serves(s) && !held(s)).await;
}
