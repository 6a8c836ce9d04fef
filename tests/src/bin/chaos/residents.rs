//! Tasks that are there all the time.
//!
//! | resident | where | without contact | shows |
//! |---|---|---|---|
//! | `keep-NODE` | its node | goes on | what no fault touches is never started anew |
//! | `driver` | robot-1 | goes on | it keeps the robot; `rival` waits for it all the time |
//! | `pilots`, two of a set | robot-2 | stop after 2 s | who may not drive any more has stopped before another begins |
//! | `roam`, one of a set | a robot | stops after 2 s, is replaced | it runs elsewhere in time, never in two places |
//! | `box`, one of a set, a container | cloud-1 first | stops after 2 s, is replaced | the same |

use std::time::Instant;

use kube::Api;
use kube::api::{DeleteParams, ListParams};
use muster_api::kind::lease::Lease;
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_tests::{docker, kernel, wait};
use serde_json::{Value, json};

use crate::house::{DEADLINE, House, PATIENCE};
use crate::report::Report;
use crate::witness;

/// A task without contact that stops does so after this, seconds.
pub(crate) const STOPS_AFTER: u64 = 2;
/// Sets, with how many of their tasks run.
const SETS: [(&str, usize); 3] = [("pilots", 1), ("roam", 1), ("box", 1)];

/// The name of the resident of a node that is never to be touched.
pub(crate) fn keeps(node: &str) -> String {
    format!("keep-{node}")
}

fn stops() -> Value {
    json!({"policy": "Stop", "after": format!("{STOPS_AFTER}s")})
}

/// Begins them, and waits until they run.
pub(crate) async fn move_in(house: &mut House) {
    for node in ["robot-1", "robot-2", "cloud-1"] {
        let name = keeps(node);
        let run = witness::process(&witness::program(house, &name, &name));
        house.cluster.create(&name, keep(node, run, &json!({"cpu": "10m"}))).await;
    }
    for name in ["driver", "rival"] {
        // Whoever drives robot-1 holds the same right.
        let run = witness::process(&witness::program(house, "robot-1", name));
        let resources = json!({"cpu": "10m", "actuators": ["base:Drive"]});
        house.cluster.create(name, keep("robot-1", run, &resources)).await;
        if name == "driver" {
            house.cluster.phase(name, TaskPhase::Running).await;
        }
    }
    let pilot = witness::process(&witness::program(house, "robot-2", "pilots"));
    let pilots = json!({
        "placement": {"node": "robot-2"},
        "resources": {"cpu": "10m", "actuators": ["base:Drive"]},
        "onDisconnect": stops(), "gracePeriodSeconds": 0, "run": pilot,
    });
    set(house, "pilots", 2, &pilots).await;
    let roam = witness::process(&witness::program(house, "roam", "roam"));
    let roam = json!({
        "placement": {"on": "Robot"}, "resources": {"cpu": "10m"},
        "onDisconnect": stops(), "gracePeriodSeconds": 0, "run": roam,
    });
    set(house, "roam", 1, &roam).await;
    let boxed = witness::container(house, &witness::program(house, "box", "box"));
    let boxed = json!({
        // What starts a container is held to its quota as well.
        "resources": {"cpu": "500m"},
        "onDisconnect": stops(), "gracePeriodSeconds": 0, "run": boxed,
    });
    set(house, "box", 1, &boxed).await;
    let running = async || unsettled(house).await.map_or(Ok(()), Err);
    wait::until("moved in", running).await;
}

/// A task that may be hit, when it runs: its uid.
pub(crate) async fn victim(house: &House, node: &str) -> Option<String> {
    let run = witness::process(&witness::program(house, "victim", "victim"));
    let task = house.cluster.create("victim", keep(node, run, &json!({"cpu": "10m"}))).await;
    let uid = task.metadata.uid?;
    let begun = Instant::now();
    let first = (uid.clone(), 1);
    while witness::starts(house, "victim").last() != Some(&first) {
        if begun.elapsed() > DEADLINE {
            return None;
        }
        wait::idle(std::time::Duration::from_millis(10)).await;
    }
    house.cluster.phase("victim", TaskPhase::Running).await;
    Some(uid)
}

fn keep(node: &str, run: Value, resources: &Value) -> Value {
    json!({
        "placement": {"node": node}, "resources": resources, "run": run,
        "restartPolicy": "Always", "onDisconnect": {"policy": "Keep"}, "gracePeriodSeconds": 0,
    })
}

async fn set(house: &House, name: &str, replicas: u32, spec: &Value) {
    let body = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "TaskSet", "metadata": {"name": name},
        "spec": {
            "replicas": replicas, "spread": false, "minReadySeconds": 0,
            "onUnreachable": {"policy": "Replace", "after": "1s"},
            "template": {"metadata": {"labels": {"resident": name}}, "spec": spec},
        },
    });
    house.cluster.post("/apis/muster.dev/v1alpha1/namespaces/default/tasksets", &body).await;
}

/// The tasks of a resident set that run.
pub(crate) async fn of_set(house: &House, name: &str) -> Vec<Task> {
    let tasks: Api<Task> = Api::namespaced(house.client.clone(), "default");
    let wanted = ListParams::default().labels(&format!("resident={name}"));
    let list = tokio::time::timeout(PATIENCE, tasks.list(&wanted)).await;
    let list = list.ok().and_then(Result::ok).map(|list| list.items).unwrap_or_default();
    list.into_iter().filter(runs).collect()
}

fn runs(task: &Task) -> bool {
    task.metadata.deletion_timestamp.is_none()
        && task.status.as_ref().is_some_and(|s| s.phase == TaskPhase::Running)
}

/// Somebody who does not run though they should.
async fn unsettled(house: &House) -> Option<String> {
    let tasks: Api<Task> = Api::namespaced(house.client.clone(), "default");
    let alone = house.machines.iter().map(|m| keeps(m.name)).chain(["driver".to_owned()]);
    for name in alone {
        let task = tokio::time::timeout(PATIENCE, tasks.get(&name)).await;
        match task.ok().and_then(Result::ok) {
            Some(task) if runs(&task) => {}
            other => {
                return Some(format!("{name} does not run: {:?}", other.and_then(|t| t.status)));
            }
        }
    }
    for (name, wanted) in SETS {
        let running = of_set(house, name).await.len();
        if running != wanted {
            return Some(format!("{running} of {name} run, not {wanted}"));
        }
    }
    None
}

/// After a fault: everybody runs again, and whoever was not touched was not started anew.
pub(crate) async fn check(house: &House, report: &mut Report) {
    let begun = Instant::now();
    while let Some(who) = unsettled(house).await {
        if begun.elapsed() > DEADLINE {
            report.broken(format!("{DEADLINE:?} after the fault: {who}"));
            return;
        }
        wait::idle(std::time::Duration::from_millis(20)).await;
    }
    let alone = house.machines.iter().map(|m| keeps(m.name)).chain(["driver".to_owned()]);
    for name in alone {
        let starts = witness::starts(house, &name).len();
        if starts != 1 {
            report.broken(format!("{name} was started {starts} times, though nothing touched it"));
        }
    }
    let rival = witness::starts(house, "rival").len();
    if rival > 0 {
        report.broken(format!("rival was started {rival} times while driver holds the robot"));
    }
}

/// Ends them all: nothing of them is left.
pub(crate) async fn move_out(house: &House, report: &mut Report) {
    for (name, _) in SETS {
        let path = format!("/apis/muster.dev/v1alpha1/namespaces/default/tasksets/{name}");
        let gone = http::Request::delete(path).body(Vec::new()).expect("a request");
        house.client.request_text(gone).await.expect("nothing is broken any more");
    }
    let tasks: Api<Task> = Api::namespaced(house.client.clone(), "default");
    let all = tasks.delete_collection(&DeleteParams::default(), &ListParams::default()).await;
    all.expect("nothing is broken any more");
    let gone = async || {
        let left = tasks.list(&ListParams::default()).await.map_err(|error| error.to_string())?;
        let left: Vec<_> = left.items.into_iter().filter_map(|task| task.metadata.name).collect();
        if left.is_empty() { Ok(()) } else { Err(format!("{left:?}")) }
    };
    wait::until("every task is gone", gone).await;
    for machine in &house.machines {
        let dir = house.data_dir(machine).join("tasks");
        let empty = async || {
            let left = std::fs::read_dir(&dir).map_or(0, Iterator::count);
            if left == 0 { Ok(()) } else { Err(format!("{left} directories")) }
        };
        wait::until(&format!("nothing is left on {}", machine.name), empty).await;
    }
    let leases: Api<Lease> = Api::all(house.client.clone());
    for lease in leases.list(&ListParams::default()).await.expect("leases").items {
        if let Some(holder) = lease.status.and_then(|status| status.holder) {
            report.broken(format!("{:?} is held by {holder:?}, who is gone", lease.metadata.name));
        }
    }
    for (name, uid) in residents_of(house) {
        let processes = kernel::with_env("MUSTER_UID", &uid);
        if !processes.is_empty() {
            report.broken(format!("{name} is gone, and {processes:?} of it run"));
        }
        if name == "box" && !docker::containers_of(&uid).is_empty() {
            report.broken(format!("{name} is gone, and a container of {uid} is left"));
        }
    }
}

/// Every uid that has ever begun, by its resident's name.
fn residents_of(house: &House) -> Vec<(String, String)> {
    let all = std::fs::read_dir(house.witness.join("starts")).expect("it is there").flatten();
    let names = all.map(|entry| entry.file_name().to_string_lossy().into_owned());
    names
        .flat_map(|name| {
            let starts = witness::starts(house, &name);
            starts.into_iter().map(move |(uid, _)| (name.clone(), uid))
        })
        .collect()
}
