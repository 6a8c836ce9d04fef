//! An agent that joins, joins anew, or renews its certificate.

use muster_failpoint::{Failpoint, Moment};
use muster_tests::{AgentOptions, Cluster};
use serde_json::{Value, json};

use crate::crash::{Crash, moments, nothing_half};

fn cloud(name: &str) -> AgentOptions {
    AgentOptions::cloud(name).flag("--docker-socket", "none").flag("--cpu", "1")
}

/// A token for one use, for a node of this name or for any.
async fn token(cluster: &Cluster, node: Option<&str>) -> String {
    let spec = json!({"spec": {"uses": 1, "nodeName": node}});
    let made = cluster.post("/apis/muster.dev/v1alpha1/jointokens", &spec).await;
    made.pointer("/status/token").and_then(Value::as_str).expect("a token").to_owned()
}

/// The same command again is enough, with the same token.
async fn again(cluster: &mut Cluster, crash: &Crash, name: &str, token: &str) {
    cluster.spawn_agent(name, Some(token));
    crash.of_daemon(cluster).await;
    cluster.spawn_agent(name, Some(token));
    cluster.node_ready(name).await;
}

pub(crate) async fn join(points: &[Failpoint]) {
    let mut cluster = Cluster::start().await;
    for (number, moment) in moments(points).into_iter().enumerate() {
        let name = format!("n{number}");
        let token = token(&cluster, None).await;
        cluster.enlist(cloud(&name));
        let crash = Crash::at(&mut cluster, &name, moment, 1);
        again(&mut cluster, &crash, &name, &token).await;
        // And by what it has from now on.
        cluster.kill_agent(&name);
        cluster.restart_agent(&name).await;
        cluster.kill_agent(&name);
        nothing_half(&cluster.dir().join(&name)).await;
    }
}

pub(crate) async fn join_anew(points: &[Failpoint]) {
    let mut cluster = Cluster::start().await;
    cluster.join(cloud("node")).await;
    for moment in moments(points) {
        let token = token(&cluster, Some("node")).await;
        cluster.kill_agent("node");
        let crash = Crash::at(&mut cluster, "node", moment, 1);
        again(&mut cluster, &crash, "node", &token).await;
    }
    cluster.kill_agent("node");
    cluster.restart_agent("node").await;
    nothing_half(&cluster.dir().join("node")).await;
}

/// The certificate counts for the shortest time that there is, and is due after half of a minute. From then on each start
/// of the agent renews it, until it is renewed.
pub(crate) async fn renew(points: &[Failpoint]) {
    let mut cluster = Cluster::start_with(&["--certificate-ttl", "60s"]).await;
    let moments: Vec<Moment> = moments(points);
    let crash = Crash::at(&mut cluster, "node", moments[0], 1);
    cluster.join(cloud("node")).await;
    crash.of_daemon(&mut cluster).await;
    for moment in &moments[1..] {
        let crash = Crash::at(&mut cluster, "node", *moment, 1);
        cluster.spawn_agent("node", None);
        crash.of_daemon(&mut cluster).await;
    }
    cluster.restart_agent("node").await;
    let data = cluster.dir().join("node");
    assert!(data.join("pki/renewed.json").exists());
    nothing_half(&data).await;
}
