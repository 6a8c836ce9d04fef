//! A controller that answers joins, takes sessions and does what a test says.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};

use bytes::Bytes;
use futures::{Stream, StreamExt};
use hyper_util::rt::{TokioExecutor, TokioIo};
use hyper_util::service::TowerToHyperService;
use muster_api::direct::server_name;
use muster_api::wire::agent::v1 as proto;
use proto::agent_message::Body as Heard;
use proto::controller_message::Body as Say;
use rcgen::{
    BasicConstraints, CertificateParams, CertificateSigningRequestParams, DnType,
    ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::{UnboundedReceiverStream, WatchStream};
use tonic::{Request, Response, Status, Streaming};

use super::until;

mod service {
    #![allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        missing_debug_implementations,
        unreachable_pub,
        reason = "generated"
    )]
    include!(concat!(env!("OUT_DIR"), "/server/muster.agent.v1.rs"));
}
use service::agent_service_server::{AgentService, AgentServiceServer};

pub const SECRET: &str = "muster1.id.secret";

/// What the controller saw, and whom it can speak to.
#[derive(Default)]
struct Seen {
    reports: BTreeMap<String, Vec<proto::TaskReport>>,
    hellos: Vec<proto::Hello>,
    states: Vec<proto::NodeState>,
    poses: Vec<proto::Pose>,
    usage: BTreeMap<String, proto::Usage>,
    beats: u64,
    logs: BTreeMap<u64, (Vec<u8>, Option<String>)>,
    messages: Vec<proto::Message>,
    executors: Vec<Vec<String>>,
    /// Where the agent takes messages of frameworks, as it said when it last had executors.
    door: String,
    /// Certificates are for clients only.
    older: bool,
    session: Option<mpsc::UnboundedSender<Result<proto::ControllerMessage, Status>>>,
    told: Option<mpsc::UnboundedSender<Result<proto::Message, Status>>>,
    /// What every session begins with.
    assignments: BTreeMap<String, proto::Assignment>,
    /// Heartbeats and reports are not answered.
    mute: bool,
    /// Sessions are refused.
    away: bool,
    /// What agents say is not read.
    stuck: watch::Sender<bool>,
    /// Of that, messages of executors.
    stuck_messages: watch::Sender<bool>,
    order: watch::Sender<proto::NodeOrder>,
    joins: u32,
}

struct Ca {
    pem: String,
    der: Vec<u8>,
    issuer: Issuer<'static, KeyPair>,
}

/// The controller, in a thread of its own.
#[derive(Clone)]
pub struct Controller {
    seen: Arc<Mutex<Seen>>,
    ca: Arc<Ca>,
    pub address: SocketAddr,
}

impl Controller {
    pub fn start() -> Controller {
        let ca = Arc::new(make_ca());
        let seen = Arc::new(Mutex::new(Seen::default()));
        let (ready, started) = std::sync::mpsc::channel();
        let (ca_there, seen_there) = (Arc::clone(&ca), Arc::clone(&seen));
        std::thread::spawn(move || {
            let runtime =
                tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async move {
                let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
                ready.send(listener.local_addr().unwrap()).unwrap();
                serve(listener, ca_there, seen_there).await;
            });
        });
        Controller { seen, ca, address: started.recv().unwrap() }
    }

    pub fn url(&self) -> String {
        format!("https://127.0.0.1:{}", self.address.port())
    }

    pub fn token(&self) -> String {
        let hash = ring::digest::digest(&ring::digest::SHA256, &self.ca.der);
        let hex: String = hash.as_ref().iter().map(|byte| format!("{byte:02x}")).collect();
        format!("{SECRET}.{hex}")
    }

    fn seen<T>(&self, look: impl FnOnce(&mut Seen) -> T) -> T {
        look(&mut self.seen.lock().unwrap())
    }

    pub fn joins(&self) -> u32 {
        self.seen(|seen| seen.joins)
    }

    pub fn beats(&self) -> u64 {
        self.seen(|seen| seen.beats)
    }

    pub fn hellos(&self) -> Vec<proto::Hello> {
        self.seen(|seen| seen.hellos.clone())
    }

    #[track_caller]
    pub fn wait_hello(&self, count: usize) -> proto::Hello {
        until("a hello", || self.seen(|seen| seen.hellos.get(count - 1).cloned()))
    }

    pub fn state(&self) -> Option<proto::NodeState> {
        self.seen(|seen| seen.states.last().cloned())
    }

    /// Live poses, apart from those of a Hello.
    pub fn poses(&self) -> Vec<proto::Pose> {
        self.seen(|seen| seen.poses.clone())
    }

    pub fn set_mute(&self, mute: bool) {
        self.seen(|seen| seen.mute = mute);
    }

    /// Whether what agents say is left where it is.
    pub fn set_stuck(&self, stuck: bool) {
        self.seen(|seen| seen.stuck.send_replace(stuck));
    }

    pub fn set_stuck_messages(&self, stuck: bool) {
        self.seen(|seen| seen.stuck_messages.send_replace(stuck));
    }

    /// Ends the session, and refuses others until told otherwise.
    pub fn set_away(&self, away: bool) {
        self.seen(|seen| {
            seen.away = away;
            if away {
                seen.session = None;
                seen.told = None;
            }
        });
    }

    fn say(&self, body: Say) {
        self.seen(|seen| {
            if let Some(session) = &seen.session {
                let _ = session.send(Ok(proto::ControllerMessage { body: Some(body) }));
            }
        });
    }

    /// Assigns a task; `spec` is its JSON.
    pub fn assign(&self, uid: &str, spec: serde_json::Value) {
        self.assign_with(proto::Assignment {
            uid: uid.to_owned(),
            namespace: "default".to_owned(),
            name: format!("task-{uid}"),
            spec: serde_json::to_vec(&spec).unwrap(),
            ..proto::Assignment::default()
        });
    }

    pub fn assign_with(&self, assignment: proto::Assignment) {
        self.seen(|seen| seen.assignments.insert(assignment.uid.clone(), assignment.clone()));
        self.say(Say::Assignments(proto::Assignments {
            complete: false,
            upserts: vec![assignment],
            released: vec![],
            kept: Vec::new(),
        }));
    }

    pub fn stop(&self, uid: &str, grace_ms: u32) {
        let mut assignment = self.seen(|seen| seen.assignments[uid].clone());
        assignment.stop =
            Some(proto::Stop { grace_period_ms: grace_ms, reason: "Deleted".to_owned() });
        self.assign_with(assignment);
    }

    pub fn release(&self, uid: &str) {
        self.seen(|seen| seen.assignments.remove(uid));
        self.say(Say::Assignments(proto::Assignments {
            complete: false,
            upserts: vec![],
            released: vec![uid.to_owned()],
            kept: Vec::new(),
        }));
    }

    /// Drops a task without a word; the next session's complete set lacks it.
    pub fn unassign(&self, uid: &str) {
        self.seen(|seen| seen.assignments.remove(uid));
    }

    pub fn reports(&self, uid: &str) -> Vec<proto::TaskReport> {
        self.seen(|seen| seen.reports.get(uid).cloned().unwrap_or_default())
    }

    /// Waits for a report that is as wanted.
    #[track_caller]
    pub fn wait(
        &self,
        uid: &str,
        what: &str,
        mut wanted: impl FnMut(&proto::TaskReport) -> bool,
    ) -> proto::TaskReport {
        let begun = std::time::Instant::now();
        loop {
            let reports = self.reports(uid);
            if let Some(found) = reports.iter().find(|report| wanted(report)) {
                return found.clone();
            }
            assert!(begun.elapsed() < super::PATIENCE, "{uid}: no {what} in {reports:#?}");
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
    }

    #[track_caller]
    pub fn wait_running(&self, uid: &str) -> proto::TaskReport {
        self.wait(uid, "running", |report| report.phase() == proto::TaskPhase::Running)
    }

    #[track_caller]
    pub fn wait_end(&self, uid: &str) -> proto::TaskReport {
        self.wait(uid, "end", |report| {
            matches!(report.phase(), proto::TaskPhase::Succeeded | proto::TaskPhase::Failed)
        })
    }

    pub fn usage(&self, uid: &str) -> Option<proto::Usage> {
        self.seen(|seen| seen.usage.get(uid).cloned())
    }

    pub fn ask_logs(&self, request: proto::LogRequest) {
        self.seen(|seen| seen.logs.insert(request.id, (Vec::new(), None)));
        self.say(Say::Log(request));
    }

    /// Says something to an executor, as its framework would.
    pub fn message(&self, executor: &str, data: Vec<u8>) {
        let executor = executor.to_owned();
        self.tell(proto::Message { executor, data: data.into(), mark: 0 });
    }

    /// The mark of a line, behind what was said to the executor before.
    pub fn mark(&self, executor: &str, mark: u64) {
        let executor = executor.to_owned();
        self.tell(proto::Message { executor, mark, ..Default::default() });
    }

    /// Waits for the stream of messages that the agent opens when it has executors.
    #[track_caller]
    fn tell(&self, message: proto::Message) {
        let stream = until("a stream of messages", || self.seen(|seen| seen.told.clone()));
        let _ = stream.send(Ok(message));
    }

    /// Says who may come to an executor directly; none: nobody.
    pub fn ticket(&self, executor: &str, secret: Option<[u8; 32]>) {
        let secret = secret.map(|secret| secret.to_vec()).unwrap_or_default();
        let ticket = proto::Ticket { executor: executor.to_owned(), secret };
        self.say(Say::Tickets(proto::Tickets { tickets: vec![ticket] }));
    }

    /// Where frameworks may come.
    pub fn door(&self) -> Option<SocketAddr> {
        self.seen(|seen| seen.door.parse().ok())
    }

    /// From now on certificates are for clients only, as they were once.
    pub fn sign_as_before(&self) {
        self.seen(|seen| seen.older = true);
    }

    /// TLS of a framework's side, with or without a certificate.
    pub fn framework_tls(&self, known: bool) -> rustls::ClientConfig {
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let mut roots = rustls::RootCertStore::empty();
        roots.add(CertificateDer::from(self.ca.der.clone())).unwrap();
        let config = rustls::ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_root_certificates(roots);
        let key = KeyPair::generate().unwrap();
        let leaf = CertificateParams::default().signed_by(&key, &self.ca.issuer).unwrap();
        let key = PrivateKeyDer::from_pem_slice(key.serialize_pem().as_bytes()).unwrap();
        let mut config = match known {
            true => config.with_client_auth_cert(vec![leaf.der().clone()], key).unwrap(),
            false => config.with_no_client_auth(),
        };
        config.alpn_protocols = vec![muster_api::direct::ALPN.to_vec()];
        config
    }

    /// What executors said to frameworks.
    pub fn messages(&self) -> Vec<proto::Message> {
        self.seen(|seen| seen.messages.clone())
    }

    /// The executors that were said to be there, each time.
    pub fn executors(&self) -> Vec<Vec<String>> {
        self.seen(|seen| seen.executors.clone())
    }

    /// What a person decides about the node.
    pub fn order_estop(&self, estop_tier: u32, estop_release: u64) {
        let order = proto::NodeOrder { estop_tier, estop_release, ..proto::NodeOrder::default() };
        self.seen(|seen| seen.order.send_replace(order));
    }

    pub fn cancel_logs(&self, id: u64) {
        self.say(Say::LogCancel(proto::LogCancel { id }));
    }

    /// What came so far.
    pub fn logs_now(&self, id: u64) -> String {
        self.seen(|seen| String::from_utf8_lossy(&seen.logs[&id].0).into_owned())
    }

    /// All of it: text, and why it ended early.
    #[track_caller]
    pub fn logs(&self, request: proto::LogRequest) -> (String, String) {
        let id = request.id;
        self.ask_logs(request);
        until("the end of a log", || {
            self.seen(|seen| {
                let (text, end) = &seen.logs[&id];
                Some((String::from_utf8_lossy(text).into_owned(), end.clone()?))
            })
        })
    }
}

fn make_ca() -> Ca {
    let key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.distinguished_name.push(DnType::CommonName, "test ca");
    let certificate = params.self_signed(&key).unwrap();
    Ca { pem: certificate.pem(), der: certificate.der().to_vec(), issuer: Issuer::new(params, key) }
}

fn server_tls(ca: &Ca) -> rustls::ServerConfig {
    let key = KeyPair::generate().unwrap();
    let params = CertificateParams::new(vec!["127.0.0.1".to_owned()]).unwrap();
    let certificate = params.signed_by(&key, &ca.issuer).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut roots = rustls::RootCertStore::empty();
    roots.add(CertificateDer::from(ca.der.clone())).unwrap();
    let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider.clone())
        .allow_unauthenticated()
        .build()
        .unwrap();
    let mut config = rustls::ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_client_cert_verifier(verifier)
        .with_single_cert(
            vec![certificate.der().clone(), CertificateDer::from(ca.der.clone())],
            PrivateKeyDer::from_pem_slice(key.serialize_pem().as_bytes()).unwrap(),
        )
        .unwrap();
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    config
}

async fn serve(listener: TcpListener, ca: Arc<Ca>, seen: Arc<Mutex<Seen>>) {
    let acceptor = tokio_rustls::TlsAcceptor::from(Arc::new(server_tls(&ca)));
    let routes = tonic::service::Routes::new(
        AgentServiceServer::new(Service(Arc::clone(&seen)))
            .max_decoding_message_size(5 << 20)
            .max_encoding_message_size(5 << 20),
    );
    loop {
        let (tcp, _) = listener.accept().await.unwrap();
        let (acceptor, routes) = (acceptor.clone(), routes.clone().prepare());
        let (ca, seen) = (Arc::clone(&ca), Arc::clone(&seen));
        tokio::spawn(async move {
            let Ok(tls) = acceptor.accept(tcp).await else { return };
            let service =
                tower::service_fn(move |request: http::Request<hyper::body::Incoming>| {
                    let (ca, seen, mut routes) =
                        (Arc::clone(&ca), Arc::clone(&seen), routes.clone());
                    async move {
                        if request.uri().path().ends_with("/join") {
                            return Ok::<_, Infallible>(answer_join(request, &ca, &seen).await);
                        }
                        let request = request.map(tonic::body::Body::new);
                        tower::Service::call(&mut routes, request).await
                    }
                });
            let _ = hyper_util::server::conn::auto::Builder::new(TokioExecutor::new())
                .serve_connection(TokioIo::new(tls), TowerToHyperService::new(service))
                .await;
        });
    }
}

async fn answer_join(
    request: http::Request<hyper::body::Incoming>,
    ca: &Ca,
    seen: &Mutex<Seen>,
) -> http::Response<tonic::body::Body> {
    let mut body = tonic::body::Body::new(request.into_body());
    let mut bytes = Vec::new();
    while let Some(frame) =
        std::future::poll_fn(|context| hyper::body::Body::poll_frame(Pin::new(&mut body), context))
            .await
    {
        bytes.extend_from_slice(&frame.unwrap().into_data().unwrap_or_default());
    }
    let asked: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
    let token = asked["token"].as_str().unwrap();
    let (status, answer) = if token.starts_with(&format!("{SECRET}.")) {
        let csr = CertificateSigningRequestParams::from_pem(asked["csr"].as_str().unwrap());
        let mut csr = csr.unwrap();
        csr.params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        if !seen.lock().unwrap().older {
            let name = server_name(asked["nodeName"].as_str().unwrap());
            csr.params.subject_alt_names =
                CertificateParams::new(vec![name]).unwrap().subject_alt_names;
            csr.params.extended_key_usages.push(ExtendedKeyUsagePurpose::ServerAuth);
        }
        let certificate = csr.signed_by(&ca.issuer).unwrap();
        seen.lock().unwrap().joins += 1;
        (201, serde_json::json!({ "certificate": certificate.pem(), "ca": ca.pem }))
    } else {
        (401, serde_json::json!({ "kind": "Status", "message": "the token has expired" }))
    };
    let body = Bytes::from(serde_json::to_vec(&answer).unwrap());
    let body = tonic::body::Body::new(Whole(Some(body)));
    http::Response::builder().status(status).body(body).unwrap()
}

struct Whole(Option<Bytes>);

impl hyper::body::Body for Whole {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        _: &mut std::task::Context<'_>,
    ) -> std::task::Poll<Option<Result<hyper::body::Frame<Bytes>, Infallible>>> {
        std::task::Poll::Ready(self.0.take().map(|bytes| Ok(hyper::body::Frame::data(bytes))))
    }
}

struct Service(Arc<Mutex<Seen>>);

#[tonic::async_trait]
impl AgentService for Service {
    type SessionStream =
        Pin<Box<dyn Stream<Item = Result<proto::ControllerMessage, Status>> + Send>>;
    type MessagesStream = Pin<Box<dyn Stream<Item = Result<proto::Message, Status>> + Send>>;
    type OrdersStream = Pin<Box<dyn Stream<Item = Result<proto::NodeOrder, Status>> + Send>>;

    async fn orders(
        &self,
        _: Request<proto::OrdersRequest>,
    ) -> Result<Response<Self::OrdersStream>, Status> {
        let seen = self.0.lock().unwrap();
        if seen.away {
            return Err(Status::unavailable("away"));
        }
        let orders = WatchStream::new(seen.order.subscribe());
        Ok(Response::new(Box::pin(orders.map(Ok))))
    }

    async fn messages(
        &self,
        request: Request<Streaming<proto::Message>>,
    ) -> Result<Response<Self::MessagesStream>, Status> {
        let (told, messages) = mpsc::unbounded_channel();
        let (mut heard, seen) = (request.into_inner(), Arc::clone(&self.0));
        let mut stuck = {
            let mut seen = seen.lock().unwrap();
            if seen.away {
                return Err(Status::unavailable("away"));
            }
            seen.told = Some(told);
            seen.stuck_messages.subscribe()
        };
        tokio::spawn(async move {
            while stuck.wait_for(|stuck| !stuck).await.is_ok()
                && let Some(Ok(message)) = heard.next().await
            {
                seen.lock().unwrap().messages.push(message);
            }
        });
        Ok(Response::new(Box::pin(UnboundedReceiverStream::new(messages))))
    }

    async fn session(
        &self,
        request: Request<Streaming<proto::AgentMessage>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (out, messages) = mpsc::unbounded_channel();
        let mut heard = request.into_inner();
        let seen = Arc::clone(&self.0);
        {
            let mut seen = seen.lock().unwrap();
            if seen.away {
                return Err(Status::unavailable("away"));
            }
            let say = |body| {
                let _ = out.send(Ok(proto::ControllerMessage { body: Some(body) }));
            };
            say(Say::Welcome(proto::Welcome {
                controller: "test".to_owned(),
                heartbeat_interval_ms: 100,
                detect_after_ms: 1_000,
            }));
            say(Say::Assignments(proto::Assignments {
                complete: true,
                upserts: seen.assignments.values().cloned().collect(),
                released: vec![],
                kept: Vec::new(),
            }));
            seen.session = Some(out);
        }
        let mut stuck = seen.lock().unwrap().stuck.subscribe();
        tokio::spawn(async move {
            while stuck.wait_for(|stuck| !stuck).await.is_ok()
                && let Some(Ok(message)) = heard.next().await
            {
                take(&mut seen.lock().unwrap(), message.body.unwrap());
            }
        });
        Ok(Response::new(Box::pin(UnboundedReceiverStream::new(messages))))
    }
}

fn take(seen: &mut Seen, heard: Heard) {
    let answer = match heard {
        Heard::Hello(hello) => {
            for report in &hello.tasks {
                seen.reports.entry(report.uid.clone()).or_default().push(report.clone());
            }
            seen.states.extend(hello.state.clone());
            seen.hellos.push(hello);
            None
        }
        Heard::Heartbeat(beat) => {
            seen.beats += 1;
            for task in beat.usage {
                seen.usage.insert(task.uid, task.usage.unwrap());
            }
            Some(Say::Heartbeat(proto::HeartbeatAck { sequence: beat.sequence }))
        }
        Heard::Node(state) => {
            seen.states.push(state);
            None
        }
        Heard::Pose(pose) => {
            seen.poses.push(pose);
            None
        }
        Heard::Task(report) => {
            let ack = proto::TaskReportAck { uid: report.uid.clone(), sequence: report.sequence };
            seen.reports.entry(report.uid.clone()).or_default().push(report);
            Some(Say::Task(ack))
        }
        Heard::Executors(executors) => {
            seen.executors.push(executors.tasks);
            // Also when the last executor has gone: who knows the place may still come there.
            if !executors.address.is_empty() {
                seen.door = executors.address;
            }
            None
        }
        Heard::Log(chunk) => {
            let (text, end) = seen.logs.entry(chunk.id).or_default();
            text.extend_from_slice(&chunk.data);
            if chunk.end {
                *end = Some(chunk.error);
            }
            None
        }
    };
    if let (Some(answer), Some(session), false) = (answer, &seen.session, seen.mute) {
        let _ = session.send(Ok(proto::ControllerMessage { body: Some(answer) }));
    }
}
