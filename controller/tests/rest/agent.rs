//! An agent that does what a test says: it joins with a token, speaks the session, and runs nothing.

use std::collections::BTreeSet;
use std::sync::Arc;

use http::Uri;
use hyper_util::rt::TokioIo;
use muster_api::wire::agent::v1 as wire;
use rcgen::{CertificateParams, KeyPair};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_rustls::TlsConnector;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Endpoint;
use tonic::{Status, Streaming};
use wire::agent_message::Body as Say;
use wire::controller_message::Body as Hear;

use super::support::{Cluster, G, send};

mod service {
    #![allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        missing_debug_implementations,
        unreachable_pub,
        reason = "generated"
    )]
    include!(concat!(env!("OUT_DIR"), "/client/muster.agent.v1.rs"));
}
use service::agent_service_client::AgentServiceClient;

/// A key and what the controller signed for it.
pub(crate) struct Credential {
    pub(crate) node: String,
    key: String,
    certificate: String,
    ca: String,
}

impl Credential {
    pub(crate) fn certificate(&self) -> &str {
        &self.certificate
    }

    pub(crate) fn key(&self) -> &str {
        &self.key
    }
}

/// Asks to join as the robot `node`; the code, and the answer's JSON.
pub(crate) async fn ask_to_join(
    cluster: &Cluster,
    node: &str,
    token: &str,
) -> (u16, Value, String) {
    let key = KeyPair::generate().unwrap();
    let csr = CertificateParams::default().serialize_request(&key).unwrap().pem().unwrap();
    let body = json!({"token": token, "nodeName": node, "kind": "Robot", "csr": csr});
    let (code, answer) = send(&cluster.anonymous().await, "POST", &format!("{G}/join"), body).await;
    (code, answer, key.serialize_pem())
}

/// A token, for one node or for any.
pub(crate) async fn token(cluster: &Cluster, node: Option<&str>) -> String {
    let spec = node.map_or_else(|| json!({}), |node| json!({"nodeName": node}));
    let admin = cluster.admin().await;
    let (code, made) =
        send(&admin, "POST", &format!("{G}/jointokens"), json!({"spec": spec})).await;
    assert_eq!(code, 201, "{made}");
    made["status"]["token"].as_str().unwrap().to_owned()
}

pub(crate) async fn join(cluster: &Cluster, node: &str) -> Credential {
    let token = token(cluster, Some(node)).await;
    let (code, answer, key) = ask_to_join(cluster, node, &token).await;
    assert_eq!(code, 200, "{answer}");
    let text = |field: &str| answer[field].as_str().unwrap().to_owned();
    Credential { node: node.to_owned(), key, certificate: text("certificate"), ca: text("ca") }
}

/// The admin's, as it stands in the kubeconfig.
pub(crate) fn admin(cluster: &Cluster) -> Credential {
    use base64::Engine as _;
    let file = std::fs::read_to_string(cluster.kubeconfig()).unwrap();
    let text = |field: &str| {
        let line = file.lines().find_map(|l| l.trim().strip_prefix(field)).unwrap();
        let data = line.trim_start_matches("-data:").trim();
        let bytes = base64::engine::general_purpose::STANDARD.decode(data).unwrap();
        String::from_utf8(bytes).unwrap()
    };
    Credential {
        node: "admin".to_owned(),
        key: text("client-key"),
        certificate: text("client-certificate"),
        ca: text("certificate-authority"),
    }
}

/// What a test says about a task.
pub(crate) fn report(uid: &str, sequence: u64, phase: wire::TaskPhase) -> wire::TaskReport {
    wire::TaskReport {
        uid: uid.to_owned(),
        sequence,
        phase: phase.into(),
        attempt: 1,
        ..wire::TaskReport::default()
    }
}

/// A session. While it is held, heartbeats go out; dropped, it is as if the robot had no power.
pub(crate) struct Session {
    say: mpsc::Sender<wire::AgentMessage>,
    heard: Streaming<wire::ControllerMessage>,
    beats: JoinHandle<()>,
    /// Uids of the tasks that it was told of.
    known: BTreeSet<String>,
}

impl Drop for Session {
    fn drop(&mut self) {
        self.beats.abort();
    }
}

impl Session {
    /// Says Hello with these tasks; the first answer is still to be heard.
    pub(crate) async fn open(
        cluster: &Cluster,
        credential: &Credential,
        tasks: Vec<wire::TaskReport>,
    ) -> Result<Self, Status> {
        let mut client = AgentServiceClient::new(channel(cluster, credential).await);
        let (say, outbound) = mpsc::channel(16);
        let hello = wire::Hello {
            node: credential.node.clone(),
            incarnation: uuid::Uuid::new_v4().to_string(),
            version: "test".to_owned(),
            state: Some(robot()),
            tasks,
        };
        say.send(wire::AgentMessage { body: Some(Say::Hello(hello)) }).await.unwrap();
        let heard = client.session(ReceiverStream::new(outbound)).await?.into_inner();
        let beat = say.clone();
        let beats = tokio::spawn(async move {
            let mut ticks = tokio::time::interval(std::time::Duration::from_millis(300));
            for sequence in 1.. {
                ticks.tick().await;
                let heartbeat = wire::Heartbeat { sequence, ..wire::Heartbeat::default() };
                let message = wire::AgentMessage { body: Some(Say::Heartbeat(heartbeat)) };
                if beat.send(message).await.is_err() {
                    return;
                }
            }
        });
        Ok(Self { say, heard, beats, known: BTreeSet::new() })
    }

    pub(crate) async fn say(&self, report: wire::TaskReport) {
        self.say.send(wire::AgentMessage { body: Some(Say::Task(report)) }).await.unwrap();
    }

    /// The same once it was told of the task, as an agent would: a task that is bound is on its way to it.
    pub(crate) async fn say_of(&mut self, report: wire::TaskReport) {
        if !self.known.contains(&report.uid) {
            self.assigned(&report.uid).await;
        }
        self.say(report).await;
    }

    pub(crate) async fn say_state(&self, state: wire::NodeState) {
        self.say.send(wire::AgentMessage { body: Some(Say::Node(state)) }).await.unwrap();
    }

    pub(crate) async fn say_pose(&self, pose: wire::Pose) {
        // An ended session takes nothing any more, which is what some tests look at.
        drop(self.say.send(wire::AgentMessage { body: Some(Say::Pose(pose)) }).await);
    }

    /// The next message that is neither an acknowledgement nor a welcome.
    pub(crate) async fn assignments(&mut self) -> Result<wire::Assignments, Status> {
        loop {
            let message = tokio::time::timeout(super::support::DEADLINE, self.heard.message());
            let message = message.await.expect("an answer in time")?;
            match message.and_then(|m| m.body) {
                Some(Hear::Assignments(page)) => {
                    self.known.extend(page.upserts.iter().map(|a| a.uid.clone()));
                    return Ok(page);
                }
                Some(_) => {}
                None => return Err(Status::cancelled("the stream ended without a word")),
            }
        }
    }

    /// The first assignments that name this task.
    pub(crate) async fn assigned(&mut self, uid: &str) -> wire::Assignment {
        loop {
            let page = self.assignments().await.unwrap();
            if let Some(found) = page.upserts.into_iter().find(|a| a.uid == uid) {
                return found;
            }
        }
    }
}

/// What it says of itself.
pub(crate) fn robot() -> wire::NodeState {
    let compute =
        wire::Compute { cpu_millis: 1000, memory_bytes: 1 << 30, ..wire::Compute::default() };
    let runtime =
        wire::Runtime { name: "process".to_owned(), available: true, ..wire::Runtime::default() };
    wire::NodeState {
        kind: wire::NodeKind::Robot.into(),
        capacity: Some(compute.clone()),
        allocatable: Some(compute),
        actuators: vec!["base:Drive".to_owned()],
        runtimes: vec![runtime],
        ..wire::NodeState::default()
    }
}

pub(crate) async fn channel(
    cluster: &Cluster,
    credential: &Credential,
) -> tonic::transport::Channel {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(credential.ca.as_bytes()).unwrap()).unwrap();
    let certificate = CertificateDer::from_pem_slice(credential.certificate.as_bytes()).unwrap();
    let key = PrivateKeyDer::from_pem_slice(credential.key.as_bytes()).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut config = ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_root_certificates(roots)
        .with_client_auth_cert(vec![certificate], key)
        .unwrap();
    config.alpn_protocols = vec![b"h2".to_vec()];
    let (connector, address) = (TlsConnector::from(Arc::new(config)), cluster.running.address());
    let dial = tower::service_fn(move |_: Uri| {
        let connector = connector.clone();
        async move {
            let stream = TcpStream::connect(address).await?;
            let name = ServerName::IpAddress(address.ip().into());
            connector.connect(name, stream).await.map(TokioIo::new)
        }
    });
    let endpoint = Endpoint::from_shared(format!("http://{address}")).unwrap();
    endpoint.connect_with_connector(dial).await.unwrap()
}
