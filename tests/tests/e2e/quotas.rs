//! Quotas are real: measured in the kernel's own accounts, for both runtimes.
//!
//! [`process`] also runs in a guest with cgroup v2 (see tests/guest).

use std::time::{Duration, Instant};

use muster_api::kind::task::TaskStatus;
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::{Value, json};

const SPIN: [&str; 3] = ["sh", "-c", "while :; do :; done"];
/// Doubles a text until the kernel ends it; 200 MiB are passed on the way.
const HOARD: [&str; 2] = ["awk", "BEGIN { s = \"x\"; while (1) s = s s }"];

async fn cloud() -> Cluster {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud")).await;
    cluster
}

fn task(run: Value) -> Value {
    json!({
        "resources": {"cpu": "500m", "memory": "64Mi"},
        "run": run,
        "gracePeriodSeconds": 0,
    })
}

/// A running task's group, warm: some periods of its quota have passed, so that the burst at the start does not count.
async fn warm(cluster: &Cluster, name: &str) -> u32 {
    let task = cluster.phase(name, TaskPhase::Running).await;
    let uid = task.metadata.uid.expect("set by the server");
    let pid = wait::until("visible in /proc", || async {
        kernel::with_env("MUSTER_UID", &uid)
            .first()
            .map(|p| p.pid)
            .ok_or_else(|| "no process".to_owned())
    })
    .await;
    let begin = cpu_time(pid);
    wait::until("warm", || async move {
        if cpu_time(pid) > begin + Duration::from_millis(200) {
            Ok(())
        } else {
            Err("starting".to_owned())
        }
    })
    .await;
    pid
}

fn cpu_time(pid: u32) -> Duration {
    kernel::cgroup_cpu_time(pid).expect("a task is in a cgroup")
}

/// When it was, and the account of a task's group then. The clock is read first here and last in [`share`]: what is read late
/// makes a share smaller, never larger than it was.
fn account(pid: u32) -> (Instant, Duration) {
    (Instant::now(), cpu_time(pid))
}

/// Cores that a task's group got since then.
fn share(pid: u32, (wall, cpu): (Instant, Duration)) -> f64 {
    let used = cpu_time(pid) - cpu;
    used.as_secs_f64() / wall.elapsed().as_secs_f64()
}

/// Not more than its quota over some seconds; and all of it, unless others leave it less of a busy machine.
async fn gets_half_a_core(run: Value) {
    let cluster = cloud().await;
    cluster.create("spin", task(run)).await;
    let pid = warm(&cluster, "spin").await;
    let (end, mut from) = (Instant::now() + wait::DEADLINE, account(pid));
    loop {
        wait::idle(Duration::from_secs(4)).await;
        let share = share(pid, from);
        if (0.47..=0.53).contains(&share) {
            break;
        }
        assert!(Instant::now() < end, "{share:.3} cores, not 0.500");
        // Less: it is measured anew. More: the kernel has it pay that back, so it is measured on from the same beginning.
        if share < 0.47 {
            from = account(pid);
        }
    }
    cluster.delete("spin").await;
}

async fn ends_as_oom_killed(run: Value) -> TaskStatus {
    let cluster = cloud().await;
    cluster.create("hoard", task(run)).await;
    let status = cluster.phase("hoard", TaskPhase::Failed).await.status.expect("failed");
    assert_eq!((status.reason.as_str(), status.exit_code), ("OOMKilled", Some(137)), "{status:?}");
    cluster.delete("hoard").await;
    status
}

mod process {
    use super::*;

    fn run(command: &[&str]) -> Value {
        json!({"process": {"command": command}})
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_spinning_process_gets_its_quota_and_no_more() {
        gets_half_a_core(run(&SPIN)).await;
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_process_over_its_memory_is_killed_and_says_so() {
        ends_as_oom_killed(run(&HOARD)).await;
    }
}

mod container {
    use muster_tests::docker;

    use super::*;

    fn run(command: &[&str]) -> Value {
        docker::image();
        json!({"container": {"image": docker::IMAGE, "command": command, "network": "None", "pullPolicy": "Never"}})
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_spinning_container_gets_its_quota_and_no_more() {
        gets_half_a_core(run(&SPIN)).await;
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_container_over_its_memory_is_killed_and_says_so() {
        ends_as_oom_killed(run(&HOARD)).await;
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_container_outlives_its_agent_and_tells_its_true_end() {
        let mut cluster = cloud().await;
        let until_told = json!({"container": {
            "image": docker::IMAGE,
            "command": ["sh", "-c", "until [ -e /told/now ]; do sleep 0.1; done; exit 7"],
            "mounts": [{"hostPath": cluster.dir(), "mountPath": "/told"}],
            "network": "None",
        }});
        docker::image();
        let task = cluster.create("patient", task(until_told)).await;
        let uid = task.metadata.uid.expect("set by the server");
        cluster.phase("patient", TaskPhase::Running).await;
        // Its first process; `sleep`s come and go beside it.
        let main =
            || kernel::with_env("MUSTER_UID", &uid).into_iter().min_by_key(|p| (p.start, p.pid));
        let before = wait::until("visible in /proc", || async {
            main().ok_or_else(|| "no process".to_owned())
        })
        .await;
        cluster.kill_agent("cloud");
        cluster.restart_agent("cloud").await;
        cluster.phase("patient", TaskPhase::Running).await;
        assert_eq!(main(), Some(before), "the container was touched");
        cluster.kill_agent("cloud");
        std::fs::write(cluster.dir().join("now"), "").expect("writable");
        cluster.restart_agent("cloud").await;
        let status = cluster.phase("patient", TaskPhase::Failed).await.status.expect("failed");
        assert_eq!((status.exit_code, status.attempt), (Some(7), 1), "{status:?}");
        cluster.delete("patient").await;
        // The agent hears of the deletion after the object is gone.
        wait::until("containers are removed with their task", || {
            let left = docker::containers_of(&uid);
            async move { if left.is_empty() { Ok(()) } else { Err(format!("{left:?}")) } }
        })
        .await;
    }
}
