//! Quotas are real: measured in the kernel's own accounts, for both runtimes.

use std::time::{Duration, Instant};

use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::{Value, json};

const SPIN: [&str; 3] = ["sh", "-c", "while :; do :; done"];

fn process(cpu: &str, command: &[&str]) -> Value {
    json!({
        "resources": {"cpu": cpu, "memory": "64Mi"},
        "run": {"process": {"command": command}},
        "gracePeriodSeconds": 0,
    })
}

/// Cores that a task gets, over a span that the kernel's counters define.
async fn share(cluster: &Cluster, name: &str) -> f64 {
    let task = cluster.phase(name, TaskPhase::Running).await;
    let uid = task.metadata.uid.expect("set by the server");
    let pid = wait::until("visible in /proc", || async {
        kernel::with_env("MUSTER_UID", &uid).first().map(|p| p.pid).ok_or_else(|| "no process".to_owned())
    })
    .await;
    let read = || kernel::cgroup_cpu_time(pid).expect("a task is in a cgroup");
    // Let the first period of the quota pass, so that a burst at the start does not count.
    let begin = read();
    wait::until("running for a period", || async move {
        if read() > begin + Duration::from_millis(100) { Ok(()) } else { Err("starting".to_owned()) }
    })
    .await;
    let (cpu, wall) = (read(), Instant::now());
    wait::until("measured", || async move {
        if wall.elapsed() > Duration::from_secs(4) { Ok(()) } else { Err("measuring".to_owned()) }
    })
    .await;
    (read() - cpu).as_secs_f64() / wall.elapsed().as_secs_f64()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_process_that_spins_gets_its_quota_and_no_more() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud")).await;
    cluster.create("spin", process("500m", &SPIN)).await;
    let share = share(&cluster, "spin").await;
    assert!((share - 0.5).abs() <= 0.03, "{share:.3} cores instead of 0.500");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_process_over_its_memory_is_killed_and_says_so() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud")).await;
    // One line of 200 MiB, which `tail` must hold whole.
    let hungry = "exec tail -n 1 <<EOF\n$(head -c 209715200 /dev/zero | tr '\\0' x)\nEOF";
    cluster.create("hungry", process("1", &["sh", "-c", hungry])).await;
    let status = cluster.phase("hungry", TaskPhase::Failed).await.status.expect("failed");
    assert_eq!((status.reason.as_str(), status.exit_code), ("OOMKilled", Some(137)), "{status:?}");
}
