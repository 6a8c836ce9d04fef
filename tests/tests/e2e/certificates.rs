//! Certificates are renewed by themselves, and nothing that runs notices.

use std::sync::Arc;
use std::time::{Duration, Instant};

use muster_api::kind::node::Node;
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use rustls::pki_types::{CertificateDer, ServerName};
use serde_json::json;
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

/// The shortest that a controller takes.
const TTL: Duration = Duration::from_secs(60);

/// What the controller shows to who connects now.
async fn shown(cluster: &Cluster) -> CertificateDer<'static> {
    let tcp = TcpStream::connect(cluster.address()).await.expect("it listens");
    let tls = TlsConnector::from(Arc::new(cluster.admin_tls(b"h2")));
    let host = ServerName::try_from("127.0.0.1").expect("an address");
    let stream = tls.connect(host, tcp).await.expect("TLS");
    let chain = stream.get_ref().1.peer_certificates().expect("a server has one");
    chain[0].clone().into_owned()
}

fn keys(node: Option<&Node>) -> Vec<String> {
    node.and_then(|node| node.status.as_ref()).map(|s| s.agent_keys.clone()).unwrap_or_default()
}

#[tokio::test(flavor = "multi_thread")]
async fn certificates_are_renewed_and_nothing_that_runs_notices() {
    let begun = Instant::now();
    let mut cluster = Cluster::start_with(&["--certificate-ttl", "60s"]).await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    let joined = Instant::now();
    let spec = json!({"run": {"process": {"command": ["sleep", "1000"]}}, "gracePeriodSeconds": 0});
    let task = cluster.create("t", spec).await;
    let uid = task.metadata.uid.expect("set by the server");
    cluster.phase("t", TaskPhase::Running).await;
    let process = kernel::with_env("MUSTER_UID", &uid);
    assert_eq!(process.len(), 1, "{process:?}");
    let (server, config) = (shown(&cluster).await, cluster.kubeconfig());
    let admin = std::fs::read_to_string(&config).expect("it was written");
    let node = cluster.nodes().await.get("robot").await.expect("it is there");
    let first = keys(Some(&node));

    let another = |node: Option<&Node>| keys(node).first() != first.first();
    wait::object(cluster.nodes().await, "robot", "another key", another).await;
    wait::until("another certificate of the server's", || async {
        if shown(&cluster).await == server { Err(String::new()) } else { Ok(()) }
    })
    .await;
    wait::until("another kubeconfig", || async {
        let now = std::fs::read_to_string(&config).expect("it is there");
        if now == admin { Err(String::new()) } else { Ok(()) }
    })
    .await;
    assert_eq!(kernel::with_env("MUSTER_UID", &uid), process);
    let log = cluster.log_of("controller");
    assert_eq!(log.matches("agent connected").count(), 1, "the session went on: {log}");

    // The certificate of the join does not count any more: the agent comes back by a renewed one.
    wait::until("the end of the first", || async {
        if joined.elapsed() > TTL { Ok(()) } else { Err(format!("{:?}", begun.elapsed())) }
    })
    .await;
    cluster.kill_agent("robot");
    cluster.restart_agent("robot").await;
    assert_eq!(kernel::with_env("MUSTER_UID", &uid), process);
    assert_eq!(cluster.phase("t", TaskPhase::Running).await.metadata.uid.as_ref(), Some(&uid));
}
