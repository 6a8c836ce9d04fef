//! Tasks that wait for others, with real processes on one robot and on two nodes.

use muster_api::kind::task::TaskStatus;
use muster_api::phase::TaskPhase;
use muster_tests::kernel::{self, Process};
use muster_tests::{AgentOptions, Cluster, wait};
use serde_json::{Value, json};

fn sleeper(more: Value) -> Value {
    let mut spec = json!({
        "run": {"process": {"command": ["sleep", "1000"]}}, "gracePeriodSeconds": 0,
    });
    spec.as_object_mut().expect("an object").extend(more.as_object().expect("an object").clone());
    spec
}

fn uid(task: &muster_api::kind::task::Task) -> String {
    task.metadata.uid.clone().expect("set by the server")
}

/// Kills the program of a task as a crash would end it.
fn crash(uid: &str) {
    let program = kernel::with_env("MUSTER_UID", uid).into_iter().next().expect("it runs");
    kernel::kill(program.pid);
}

fn again(attempt: u32) -> impl Fn(&TaskStatus) -> bool {
    move |status| status.phase == TaskPhase::Running && status.attempt == attempt
}

#[tokio::test(flavor = "multi_thread")]
async fn tasks_begin_in_order_and_follow_each_other_across_nodes() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    cluster.join(AgentOptions::cloud("cloud")).await;
    let ready = cluster.dir().join("ready");
    // Created in the wrong order.
    let follows = |other: &str| json!([{"task": other, "condition": "Ready", "restart": true}]);
    let viewer = json!({"placement": {"on": "Cloud"}, "dependsOn": follows("detector")});
    let viewer = cluster.create("viewer", sleeper(viewer)).await;
    let detector = json!({"placement": {"on": "Robot"}, "dependsOn": follows("camera")});
    let detector = cluster.create("detector", sleeper(detector)).await;
    let held = |s: &TaskStatus| s.why.iter().any(|why| why.reason.starts_with("Dependency"));
    cluster.task("detector", "held", held).await;
    let probe =
        json!({"exec": {"command": ["test", "-e", ready]}, "period": "100ms", "timeout": "20s"});
    let camera = json!({
        "placement": {"on": "Robot"}, "readiness": probe, "restartPolicy": "Always",
    });
    let camera = cluster.create("camera", sleeper(camera)).await;
    cluster.phase("camera", TaskPhase::Running).await;
    cluster.task("viewer", "held", held).await;
    assert_eq!(kernel::with_env("MUSTER_UID", &uid(&detector)), []);
    std::fs::write(&ready, "").expect("a file");
    cluster.phase("viewer", TaskPhase::Running).await;
    let first = cluster.phase("detector", TaskPhase::Running).await;
    assert_eq!(first.status.map(|s| s.attempt), Some(1));

    // The camera crashes: the detector beside it begins anew, then the viewer on the other node, whatever their policies.
    crash(&uid(&camera));
    cluster.task("camera", "up again", again(2)).await;
    cluster.task("detector", "begun anew", again(2)).await;
    let last = cluster.task("viewer", "begun anew", again(2)).await;
    assert_eq!(uid(&last), uid(&viewer), "the same task");
    assert_eq!(kernel::with_env("MUSTER_UID", &uid(&viewer)).len(), 1);
}

/// A node that lost everything, as after a power cut, and no controller: what it had begins again in order.
#[tokio::test(flavor = "multi_thread")]
async fn the_order_holds_without_a_controller() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    let ready = cluster.dir().join("ready");
    std::fs::write(&ready, "").expect("a file");
    let always = |more: Value| {
        let mut spec = sleeper(more);
        spec["restartPolicy"] = "Always".into();
        spec
    };
    let probe =
        json!({"exec": {"command": ["test", "-e", ready]}, "period": "100ms", "timeout": "20s"});
    let camera = cluster.create("camera", always(json!({"readiness": probe}))).await;
    let on = json!({"dependsOn": [{"task": "camera", "condition": "Ready"}]});
    let detector = cluster.create("detector", always(on)).await;
    cluster.phase("detector", TaskPhase::Running).await;

    cluster.kill_controller();
    cluster.kill_agent("robot");
    std::fs::remove_file(&ready).expect("it is there");
    let of = |task: &str| kernel::with_env("MUSTER_UID", task);
    let (camera, detector) = (uid(&camera), uid(&detector));
    let mut old = Vec::new();
    let mut kill = |process: Process| {
        kernel::kill(process.pid);
        old.push(process);
    };
    for task in [&camera, &detector] {
        // The shims, whose arguments name the task's directory, and then what they ran.
        let shims = kernel::with_command(task).into_iter();
        let shims = shims.filter_map(|pid| Some(Process { pid, start: kernel::start_time(pid)? }));
        shims.for_each(&mut kill);
        of(task).into_iter().for_each(&mut kill);
    }
    // What was killed is there until the kernel comes to it, and would be taken for what begins now.
    wait::until("all of it dead", || async {
        let lives = |p: &&Process| kernel::start_time(p.pid) == Some(p.start);
        let left: Vec<_> = old.iter().filter(lives).collect();
        if left.is_empty() { Ok(()) } else { Err(format!("{left:?}")) }
    })
    .await;
    cluster.spawn_agent("robot", None);
    let runs = |task: String| async move {
        let found = kernel::with_env("MUSTER_UID", &task);
        if found.len() == 1 { Ok(()) } else { Err(format!("{found:?}")) }
    };
    wait::until("the camera runs again", || runs(camera.clone())).await;
    assert_eq!(of(&detector), [], "the camera is not ready");
    std::fs::write(&ready, "").expect("a file");
    wait::until("the detector runs again", || runs(detector.clone())).await;
    cluster.start_controller().await;
    cluster.node_ready("robot").await;
    cluster.phase("detector", TaskPhase::Running).await;
}
