//! A controller that is killed while a thousand agents are attached: how long until each is back, and all is as it was.
//!
//! The agents are hollow: each has a certificate of its own, a session of its own over TLS, heartbeats, and two tasks that it
//! says to run; they are in this process, on the same cores as the controller. An agent is back when its Hello was welcomed,
//! the controller has told it everything that it should have (its two tasks, and nothing else), and a heartbeat was answered.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures::StreamExt as _;
use futures::future::join_all;
use http::uri::PathAndQuery;
use kube::Client;
use kube::api::ListParams;
use muster_api::phase::TaskPhase;
use muster_api::wire::agent::v1 as proto;
use muster_tests::{Cluster, wait};
use proto::agent_message::Body as Say;
use proto::controller_message::Body as Hear;
use rcgen::{CertificateParams, DnType, KeyPair};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ClientConfig, RootCertStore};
use serde_json::{Value, json};
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tonic::client::Grpc;
use tonic_prost::ProstCodec;

use crate::poses::stream::dial;
use crate::stats::{figure, millis};

const AGENTS: usize = 1_000;
const TASKS: usize = 2;
/// The controller is away for so long: what a supervisor takes to start it anew.
const AWAY: Duration = Duration::from_millis(200);
const API: &str = "/apis/muster.dev/v1alpha1";

pub(crate) async fn all() {
    let mut cluster = Cluster::start().await;
    let (address, client) = (cluster.address(), cluster.client().await);
    let token = cluster.token().await;
    let names: Vec<String> = (0..AGENTS).map(|n| format!("hollow-{n:04}")).collect();
    let (state, _) = watch::channel(Vec::new());
    let herd = Herd { address, state: Arc::new(state) };
    herd.state.send_replace(vec![false; AGENTS]);
    for (part, names) in names.chunks(64).enumerate() {
        let join = names.iter().map(|name| join(&client, &token, name));
        for (n, tls) in join_all(join).await.into_iter().enumerate() {
            tokio::spawn(herd.clone().agent(part * 64 + n, names[n].clone(), tls));
        }
    }
    for names in names.chunks(64) {
        join_all(names.iter().map(|name| apply(&client, name))).await;
    }
    running(&client).await;
    let mut runs = Vec::new();
    for _ in 0..5 {
        herd.back().await;
        cluster.kill_controller();
        herd.state.send_replace(vec![false; AGENTS]);
        tokio::time::sleep(AWAY).await;
        let begun = Instant::now();
        cluster.start_controller().await;
        let ready = begun.elapsed();
        herd.back().await;
        runs.push((begun.elapsed(), ready));
        // Nobody was disturbed: no task was called unknown, none was begun anew.
        let disturbed = disturbed(&client).await;
        assert_eq!(disturbed, 0, "tasks that are not as they were");
    }
    runs.sort();
    let (worst, _) = runs[runs.len() - 1];
    let (median, _) = runs[runs.len() / 2];
    let ready = runs.iter().map(|(_, ready)| *ready).max().expect("some runs");
    println!("controller killed with {AGENTS} agents and {} tasks, 5 times:", AGENTS * TASKS);
    figure("  the controller is ready, at worst", millis(ready), " ms", "report");
    figure("  all agents are back and reconciled, median", millis(median), " ms", "report");
    figure("  all agents are back and reconciled, at worst", millis(worst), " ms", "<= 3000 ms");
}

/// Every task runs.
async fn running(client: &Client) {
    let all = async || match disturbed(client).await {
        0 => Ok(()),
        left => Err(format!("{left} do not run")),
    };
    wait::until("every task runs", all).await;
}

/// Tasks that do not run their first attempt.
async fn disturbed(client: &Client) -> usize {
    let tasks: kube::Api<muster_api::kind::task::Task> =
        kube::Api::namespaced(client.clone(), "default");
    let list = tasks.list(&ListParams::default()).await.expect("the controller answers");
    let runs = |task: &&muster_api::kind::task::Task| {
        let status = task.status.clone().unwrap_or_default();
        status.phase == TaskPhase::Running && status.attempt == 1
    };
    AGENTS * TASKS - list.items.iter().filter(runs).count()
}

async fn post(client: &Client, path: String, body: &Value) -> Value {
    let body = serde_json::to_vec(body).expect("JSON");
    let request = http::Request::post(path).header("content-type", "application/json").body(body);
    client.request(request.expect("a request")).await.expect("it is taken")
}

async fn apply(client: &Client, node: &str) {
    for n in 0..TASKS {
        let task = json!({
            "apiVersion": muster_api::API_VERSION, "kind": "Task",
            "metadata": {"name": format!("{node}-{n}")},
            "spec": {
                "placement": {"node": node}, "resources": {"cpu": "100m", "memory": "16Mi"},
                "restartPolicy": "Always", "run": {"process": {"command": ["sleep", "1000"]}},
            },
        });
        post(client, format!("{API}/namespaces/default/tasks"), &task).await;
    }
}

/// A certificate for a node.
async fn join(client: &Client, token: &str, node: &str) -> Arc<ClientConfig> {
    let key = KeyPair::generate().expect("a key");
    let mut params = CertificateParams::default();
    params.distinguished_name.push(DnType::CommonName, node);
    let csr = params.serialize_request(&key).and_then(|csr| csr.pem()).expect("a request");
    let wish = json!({"token": token, "nodeName": node, "kind": "Cloud", "csr": csr});
    let given = post(client, format!("{API}/join"), &wish).await;
    let pem = |name: &str| given[name].as_str().expect("PEM").as_bytes().to_vec();
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(&pem("ca")).expect("a CA")).expect("a CA");
    let chain = vec![CertificateDer::from_pem_slice(&pem("certificate")).expect("a certificate")];
    let key = PrivateKeyDer::from_pem_slice(key.serialize_pem().as_bytes()).expect("a key");
    let mut config = ClientConfig::builder()
        .with_root_certificates(roots)
        .with_client_auth_cert(chain, key)
        .expect("they belong together");
    config.alpn_protocols = vec![b"h2".to_vec()];
    Arc::new(config)
}

/// All agents, and which of them are back.
#[derive(Clone)]
struct Herd {
    address: SocketAddr,
    state: Arc<watch::Sender<Vec<bool>>>,
}

impl Herd {
    /// All are.
    async fn back(&self) {
        let mut state = self.state.subscribe();
        let all = state.wait_for(|back| back.iter().all(|back| *back));
        let done = tokio::time::timeout(wait::DEADLINE, all).await;
        done.expect("they come back in time").expect("it is kept");
    }

    /// Keeps a session, for ever, with the pauses of a real agent.
    async fn agent(self, index: usize, node: String, tls: Arc<ClientConfig>) {
        let mut pause = Duration::from_millis(50);
        let mut sequence = 1;
        // What it says to run: uid and the sequence of its report.
        let mut tasks: Vec<(String, u64)> = Vec::new();
        loop {
            let ended = self.session(index, &node, &tls, (&mut tasks, &mut sequence)).await;
            if ended.is_some() {
                pause = Duration::from_millis(50);
            }
            tokio::time::sleep(pause).await;
            pause = (pause * 2).min(Duration::from_secs(2));
        }
    }

    /// None: it did not begin.
    async fn session(
        &self,
        index: usize,
        node: &str,
        tls: &Arc<ClientConfig>,
        (tasks, sequence): (&mut Vec<(String, u64)>, &mut u64),
    ) -> Option<()> {
        let mut client = Grpc::new(dial(self.address, Arc::clone(tls)).await.ok()?);
        client.ready().await.ok()?;
        let (say, queue) = mpsc::channel(64);
        let path = PathAndQuery::from_static("/muster.agent.v1.AgentService/Session");
        let body = |body| proto::AgentMessage { body: Some(body) };
        let hello = proto::Hello {
            node: node.to_owned(),
            incarnation: format!("{node}-1"),
            version: "hollow".to_owned(),
            state: Some(state()),
            tasks: tasks.iter().map(|(uid, sequence)| runs(uid, *sequence)).collect(),
        };
        say.send(body(Say::Hello(hello))).await.ok()?;
        let codec = ProstCodec::<proto::AgentMessage, proto::ControllerMessage>::default();
        let request = tonic::Request::new(ReceiverStream::new(queue));
        let mut heard = client.streaming(request, path, codec).await.ok()?.into_inner();
        let mut beats = tokio::time::interval(Duration::from_millis(600));
        let (mut told, mut beat) = (false, 0);
        loop {
            tokio::select! {
                message = heard.next() => match message?.ok()?.body? {
                    Hear::Assignments(all) => {
                        for new in all.upserts {
                            if tasks.iter().all(|(uid, _)| *uid != new.uid) {
                                *sequence += 1;
                                tasks.push((new.uid.clone(), *sequence));
                                say.send(body(Say::Task(runs(&new.uid, *sequence)))).await.ok()?;
                            }
                        }
                        told |= all.complete;
                    }
                    Hear::Heartbeat(_) if told => {
                        self.state.send_if_modified(|back| !std::mem::replace(&mut back[index], true));
                    }
                    _ => {}
                },
                _ = beats.tick() => {
                    beat += 1;
                    let beat = proto::Heartbeat { sequence: beat, ..proto::Heartbeat::default() };
                    say.send(body(Say::Heartbeat(beat))).await.ok()?;
                }
            }
        }
    }
}

fn runs(uid: &str, sequence: u64) -> proto::TaskReport {
    proto::TaskReport {
        uid: uid.to_owned(),
        sequence,
        phase: proto::TaskPhase::Running.into(),
        attempt: 1,
        ..proto::TaskReport::default()
    }
}

fn state() -> proto::NodeState {
    let all = proto::Compute { cpu_millis: 4_000, memory_bytes: 8 << 30, ..Default::default() };
    let runtime =
        proto::Runtime { name: "process".to_owned(), available: true, ..Default::default() };
    proto::NodeState {
        kind: proto::NodeKind::Cloud.into(),
        capacity: Some(all.clone()),
        allocatable: Some(all),
        runtimes: vec![runtime],
        ..Default::default()
    }
}
