//! A controller that does what a test tells it: gRPC over TLS with client certificates, as the real one.

use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use futures::Stream;
use hyper_util::rt::{TokioExecutor, TokioIo};
use hyper_util::server::conn::auto;
use hyper_util::service::TowerToHyperService;
use muster_api::wire::framework::v1 as proto;
use proto::call::Call as Say;
use proto::event::Event as Tell;
use rcgen::{BasicConstraints, Certificate, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use rustls::pki_types::PrivateKeyDer;
use rustls::pki_types::pem::PemObject as _;
use rustls::server::WebPkiClientVerifier;
use tempfile::TempDir;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::task::AbortOnDropHandle;
use tonic::{Request, Response, Status, Streaming};

mod service {
    #![allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        dead_code,
        missing_debug_implementations,
        unreachable_pub,
        reason = "generated"
    )]
    include!(concat!(env!("OUT_DIR"), "/server/muster.framework.v1.rs"));
}
use service::framework_service_server::{FrameworkService, FrameworkServiceServer};

const MAX_WIRE: usize = (4 << 20) + (64 << 10);
/// Heartbeats that a test never waits for.
pub(crate) const SELDOM_MS: u32 = 60_000;

/// Waits as long as a very slow machine may take.
pub(crate) async fn soon<F: Future>(what: F) -> F::Output {
    tokio::time::timeout(Duration::from_secs(60), what).await.expect("in time")
}

/// One session, in the test's hands. Dropped: the stream breaks.
pub(crate) struct Session {
    calls: Streaming<proto::Call>,
    events: mpsc::Sender<Result<proto::Event, Status>>,
}

impl Session {
    pub(crate) async fn call(&mut self) -> (String, Say) {
        let call = soon(self.calls.message()).await.expect("a stream").expect("a call");
        (call.id, call.call.expect("a call"))
    }

    pub(crate) async fn say(&self, event: Tell) {
        self.events.send(Ok(proto::Event { event: Some(event) })).await.expect("connected");
    }

    /// The first exchange; gives what the framework asked for.
    pub(crate) async fn subscribe(&mut self, id: &str, heartbeat_ms: u32) -> proto::Subscribe {
        let (_, Say::Subscribe(subscribe)) = self.call().await else { panic!("no Subscribe") };
        let subscribed = proto::Subscribed {
            framework_id: id.to_owned(),
            session_id: "s".to_owned(),
            reregistered: !subscribe.framework_id.is_empty(),
            heartbeat_interval_ms: heartbeat_ms,
        };
        self.say(Tell::Subscribed(subscribed)).await;
        subscribe
    }

    pub(crate) async fn answer(&self, id: String, launched: Vec<proto::Launched>) {
        self.say(Tell::Answer(proto::Answer { id, refusal: None, launched })).await;
    }

    /// Waits until the framework has left.
    #[allow(dead_code, clippy::allow_attributes, reason = "each test binary uses its own part")]
    pub(crate) async fn left(&mut self) {
        while let Ok(Some(_)) = soon(self.calls.message()).await {}
    }
}

struct Service(mpsc::UnboundedSender<Session>);

#[tonic::async_trait]
impl FrameworkService for Service {
    type SessionStream = Pin<Box<dyn Stream<Item = Result<proto::Event, Status>> + Send>>;

    async fn session(
        &self,
        request: Request<Streaming<proto::Call>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (events, out) = mpsc::channel(64);
        self.0.send(Session { calls: request.into_inner(), events }).expect("a test");
        Ok(Response::new(Box::pin(ReceiverStream::new(out))))
    }
}

/// The controller.
pub(crate) struct Controller {
    dir: TempDir,
    sessions: mpsc::UnboundedReceiver<Session>,
    ca: CertifiedIssuer<'static, KeyPair>,
    _server: AbortOnDropHandle<()>,
}

impl Controller {
    pub(crate) async fn start() -> Self {
        let dir = tempfile::tempdir().expect("a directory");
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let port = listener.local_addr().expect("bound").port();
        let ca = authority();
        let tls = credentials(port, &dir, &ca);
        let (to_test, sessions) = mpsc::unbounded_channel();
        let server = AbortOnDropHandle::new(tokio::spawn(serve(listener, tls, Service(to_test))));
        Controller { dir, sessions, ca, _server: server }
    }

    pub(crate) fn kubeconfig(&self) -> PathBuf {
        self.path("config")
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// TLS of the agent for which `name` stands.
    #[allow(dead_code, clippy::allow_attributes, reason = "each test binary uses its own part")]
    pub(crate) fn agent_tls(&self, name: &str) -> rustls::ServerConfig {
        let (certificate, key) = leaf(&self.ca, vec![name.to_owned()]);
        server_tls(&self.ca, &certificate, &key, muster_api::direct::ALPN)
    }

    pub(crate) async fn session(&mut self) -> Session {
        soon(self.sessions.recv()).await.expect("a session")
    }
}

fn authority() -> CertifiedIssuer<'static, KeyPair> {
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    CertifiedIssuer::self_signed(params, KeyPair::generate().expect("a key")).expect("a CA")
}

/// A certificate for these names, and its key as PEM.
fn leaf(ca: &CertifiedIssuer<'static, KeyPair>, names: Vec<String>) -> (Certificate, String) {
    let key = KeyPair::generate().expect("a key");
    let params = CertificateParams::new(names).expect("names");
    (params.signed_by(&key, ca).expect("signed"), key.serialize_pem())
}

/// Writes the kubeconfig and gives the server's side of it.
fn credentials(
    port: u16,
    dir: &TempDir,
    ca: &CertifiedIssuer<'static, KeyPair>,
) -> rustls::ServerConfig {
    let (client, client_key) = leaf(ca, Vec::new());
    let (server, server_key) = leaf(ca, vec!["127.0.0.1".to_owned()]);
    let text = format!(
        "clusters: [{{name: c, cluster: {{server: 'https://127.0.0.1:{port}', certificate-authority-data: {ca}}}}}]
users: [{{name: u, user: {{client-certificate-data: {certificate}, client-key-data: {key}}}}}]
contexts: [{{name: c, context: {{cluster: c, user: u, namespace: team}}}}]
current-context: c
",
        ca = STANDARD.encode(ca.pem()),
        certificate = STANDARD.encode(client.pem()),
        key = STANDARD.encode(client_key),
    );
    std::fs::write(dir.path().join("config"), text).expect("written");
    server_tls(ca, &server, &server_key, b"h2")
}

fn server_tls(
    ca: &CertifiedIssuer<'static, KeyPair>,
    certificate: &Certificate,
    key: &str,
    protocol: &[u8],
) -> rustls::ServerConfig {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut roots = rustls::RootCertStore::empty();
    roots.add(ca.der().clone()).expect("a CA");
    let verifier =
        WebPkiClientVerifier::builder_with_provider(Arc::new(roots), Arc::clone(&provider));
    let key = PrivateKeyDer::from_pem_slice(key.as_bytes()).expect("a key");
    let mut config = rustls::ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .expect("versions")
        .with_client_cert_verifier(verifier.build().expect("a verifier"))
        .with_single_cert(vec![certificate.der().clone()], key)
        .expect("a certificate");
    config.alpn_protocols = vec![protocol.to_vec()];
    config
}

async fn serve(listener: TcpListener, tls: rustls::ServerConfig, service: Service) {
    let acceptor = tokio_rustls::TlsAcceptor::from(Arc::new(tls));
    let service = FrameworkServiceServer::new(service)
        .max_decoding_message_size(MAX_WIRE)
        .max_encoding_message_size(MAX_WIRE);
    let routes = tonic::service::Routes::new(service).prepare();
    let mut connections = tokio::task::JoinSet::new();
    loop {
        let (tcp, _) = listener.accept().await.expect("a connection");
        let (acceptor, routes) = (acceptor.clone(), routes.clone());
        connections.spawn(async move {
            let Ok(tls) = acceptor.accept(tcp).await else { return };
            // A framework may leave as it likes.
            drop(
                auto::Builder::new(TokioExecutor::new())
                    .serve_connection(TokioIo::new(tls), TowerToHyperService::new(routes))
                    .await,
            );
        });
    }
}
