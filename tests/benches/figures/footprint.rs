//! Memory and idle CPU of both daemons, from /proc.

use std::time::Duration;

use muster_tests::{AgentOptions, Cluster, wait};
use serde_json::{Value, json};

use crate::stats::figure;

/// The span over which idle CPU is counted. Agents send heartbeats every 0.6 s.
const IDLE: Duration = Duration::from_secs(20);

/// Resident memory of a process, MB (10⁶ bytes).
pub(crate) fn rss(pid: u32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("it runs");
    let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:")).expect("a resident size");
    let kib: f64 = line.trim().trim_end_matches("kB").trim().parse().expect("a number");
    kib * 1024.0 / 1e6
}

/// Cpu time that a process has used.
pub(crate) fn cpu(pid: u32) -> Duration {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).expect("it runs");
    let fields: Vec<u64> = stat
        .rsplit_once(')')
        .expect("a name")
        .1
        .split_whitespace()
        .skip(11)
        .take(2)
        .map(|f| f.parse().expect("ticks"))
        .collect();
    // USER_HZ is 100 on every Linux that Debian builds.
    Duration::from_millis(fields.iter().sum::<u64>() * 10)
}

pub(crate) async fn all() {
    let mut cluster = Cluster::start().await;
    let controller = cluster.controller_pid();
    figure("controller, empty: RSS", rss(controller), " MB", "<= 30 MB");
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0).flag("--docker-socket", "none")).await;
    let agent = cluster.agent_pid("robot");
    let (agent_before, controller_before) = (cpu(agent), cpu(controller));
    wait::idle(IDLE).await;
    figure("agent, idle: RSS", rss(agent), " MB", "<= 9 MB");
    let percent = |used: Duration| used.as_secs_f64() / IDLE.as_secs_f64() * 100.0;
    figure("agent, idle: CPU of one core", percent(cpu(agent) - agent_before), " %", "report");
    figure(
        "controller, one agent, idle: CPU of one core",
        percent(cpu(controller) - controller_before),
        " %",
        "report",
    );
    crate::list::fill(&cluster, 10_000).await;
    let client = cluster.client().await;
    let make = |i: usize| {
        let client = client.clone();
        async move {
            // Placed nowhere, so that nothing runs: a selector that no node has.
            let task = json!({
                "apiVersion": muster_api::API_VERSION, "kind": "Task", "metadata": { "name": format!("t{i:04}") },
                "spec": {
                    "placement": { "node": "no-such-node" },
                    "resources": { "cpu": "500m", "memory": "256Mi", "sensors": ["kinect:ImageGen"] },
                    "run": { "process": { "command": ["/usr/bin/env", "sleep", "1000"], "env": [{ "name": "A", "value": "b" }] } },
                },
            });
            let request = http::Request::post("/apis/muster.dev/v1alpha1/namespaces/default/tasks")
                .header("content-type", "application/json")
                .body(serde_json::to_vec(&task).expect("JSON"))
                .expect("a request");
            client.request::<Value>(request).await.expect("taken");
        }
    };
    for batch in (0..6_000_usize).collect::<Vec<_>>().chunks(128) {
        futures::future::join_all(batch.iter().map(|i| make(*i))).await;
    }
    figure("controller, 10 000 nodes and 6 000 tasks: RSS", rss(controller), " MB", "<= 107 MB");
}
