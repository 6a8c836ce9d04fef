//! Starts, joins and ends everything. Nothing else in this crate spawns a task that outlives its caller.
//!
//! ```text
//! start: lock DIR → PKI → store (+ writer task) → bind → kubeconfig → background tasks → accept loop
//! end:   stop (no new connection, watches and sessions end) → connections, at most DEADLINE → background tasks
//!        → writer (commits what is queued) → lock
//! ```

use std::any::Any;
use std::collections::BTreeSet;
use std::fs::{File, TryLockError};
use std::io;
use std::net::SocketAddr;
use std::panic::AssertUnwindSafe;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::middleware::from_fn_with_state;
use axum::response::{IntoResponse as _, Response};
use futures::FutureExt as _;
use rustls::ServerConfig;
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinError, JoinHandle};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tower_http::catch_panic::CatchPanicLayer;

use crate::config::Config;
use crate::context::{Clock as _, Context, Live, SystemClock};
use crate::events::{self, Happening, Recorder};
use crate::kubeconfig::KubeconfigError;
use crate::pki::{Pem, Pki, PkiError};
use crate::rest::failure::Failure;
use crate::serve::Server;
use crate::session::agents::Agents;
use crate::session::execs::{self, Execs};
use crate::session::frameworks::proto::framework_service_server::FrameworkServiceServer;
use crate::session::frameworks::service::Service;
use crate::session::frameworks::{Frameworks, MAX_WIRE, lines};
use crate::session::logs::SessionLogs;
use crate::session::poses::proto::pose_service_server::PoseServiceServer;
use crate::session::poses::{self, LivePoses};
use crate::session::proto::exec_service_server::ExecServiceServer;
use crate::session::{self, Sessions};
use crate::store::{self, OpenError, StoreError};
use crate::{auth, footprint, kubeconfig, metrics, rates, reconcile, rest};

/// How long requests in flight may take to finish after a signal.
const DEADLINE: Duration = Duration::from_secs(5);
/// Between two looks at the controller's own certificates, at most.
const LOOK_AT_CERTIFICATES: Duration = Duration::from_secs(3600);

/// Why the controller did not start.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// The data directory cannot be used.
    #[error("cannot use the data directory {}", path.display())]
    DataDir {
        /// Which.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// Another controller works on it.
    #[error("another controller is running on the data directory {}", path.display())]
    Locked {
        /// Which.
        path: PathBuf,
    },
    /// The address cannot be listened on.
    #[error("cannot listen on {address}")]
    Listen {
        /// Which.
        address: SocketAddr,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// Certificates.
    #[error(transparent)]
    Pki(#[from] PkiError),
    /// The admin's kubeconfig.
    #[error(transparent)]
    Kubeconfig(#[from] KubeconfigError),
    /// The store.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The first write failed.
    #[error("cannot write the default namespace, and of which nodes nothing has been heard so far")]
    Bootstrap(#[source] StoreError),
    /// The metrics recorder.
    #[error("cannot install the metrics recorder")]
    Metrics(#[from] metrics_exporter_prometheus::BuildError),
    /// A part of it ended by a panic, which the log tells; without it the rest would only seem to work.
    #[error("a part of the controller has failed; it has to be started again")]
    Broken,
    /// A task ended by a panic.
    #[error("a task of the controller failed")]
    Task(#[source] JoinError),
}

/// A controller that answers.
#[derive(Debug)]
pub struct Running {
    context: Arc<Context>,
    kill: CancellationToken,
    connections: TaskTracker,
    background: TaskTracker,
    accept: JoinHandle<()>,
    writer: JoinHandle<()>,
    stop_writer: CancellationToken,
    /// Held until the writer has ended.
    _lock: File,
}

/// Runs a controller until `shutdown` is ready, then ends it gracefully.
///
/// # Errors
/// When it cannot start.
pub async fn run(
    config: Config,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), AppError> {
    footprint::give_buffers_back();
    footprint::take_descriptors();
    let running = start(config).await?;
    let address = running.address();
    tracing::info!(%address, url = running.context.url(), "serving");
    running.until(shutdown).await
}

/// Starts a controller; it answers when this returns.
///
/// # Errors
/// When it cannot start.
pub async fn start(config: Config) -> Result<Running, AppError> {
    let now = SystemClock.now();
    let lock = lock(&config.data_dir)?;
    let pki = Pki::open(&config.data_dir.join("pki"), now)?.with_ttl(config.certificate_ttl);
    let names = names(&config);
    let server = pki.server(&names, now)?;
    let tls = watch::Sender::new(Arc::new(pki.server_config(&server)?));
    let metrics = metrics::recorder()?;
    let in_data_dir = || config.data_dir.join(store::sqlite::KEY_FILE);
    let keys = config.encryption_key.clone().unwrap_or_else(in_data_dir);
    let path = config.data_dir.join("store.db");
    let (store, writer) = store::sqlite::open_with_keys(&path, &keys).await?;
    let listen = |source| AppError::Listen { address: config.listen, source };
    let listener = TcpListener::bind(config.listen).await.map_err(listen)?;
    let address = listener.local_addr().map_err(listen)?;

    let (events, happenings) = Recorder::new();
    let context = Arc::new(Context::new(store, pki, config, address, metrics, events));
    let stop_writer = CancellationToken::new();
    let writer = writer.run(stop_writer.clone());
    let writer = tokio::spawn(guard(Arc::clone(&context), "writer", writer));
    prepare(&context).await.map_err(AppError::Bootstrap)?;
    let admin = context.pki.admin(now)?;
    write_kubeconfig(&context, &admin)?;

    let background = TaskTracker::new();
    let shown = tls.subscribe();
    let renewal = Renewal { context: Arc::clone(&context), names, server, admin, tls };
    background.spawn(guard(Arc::clone(&context), "certificates", renewal.run()));
    let services = work(&context, &background, happenings);
    let server = Server {
        tls: shown,
        router: router(&context, services),
        stop: context.stop.clone(),
        kill: CancellationToken::new(),
        connections: TaskTracker::new(),
        limits: Arc::default(),
    };
    let (kill, connections) = (server.kill.clone(), server.connections.clone());
    let accept = tokio::spawn(server.accept(listener));
    Ok(Running { context, kill, connections, background, accept, writer, stop_writer, _lock: lock })
}

/// Writes what has to be written before anybody is answered. Once for a context.
///
/// # Errors
/// When the store fails.
pub async fn prepare(context: &Context) -> Result<(), StoreError> {
    rest::namespace::bootstrap(context).await?;
    reconcile::health::doubt(context).await
}

/// Begins everything that works beside the requests: all of a controller but its port. Each part ends when `context.stop`
/// is cancelled; what agents and those who publish poses dial is given back. Once for a context.
pub fn work(
    context: &Arc<Context>,
    background: &TaskTracker,
    happenings: mpsc::Receiver<Happening>,
) -> (Agents, poses::Service) {
    background.spawn(metrics::upkeep(context.metrics.clone(), context.stop.clone()));
    let finalize = rest::namespace::finalize(Arc::clone(context));
    background.spawn(guard(Arc::clone(context), "namespaces", finalize));
    let record = events::run(Arc::clone(context), happenings);
    let record = context.stop.clone().run_until_cancelled_owned(record);
    background.spawn(guard(Arc::clone(context), "events", record));
    let sessions = Arc::new(Sessions::default());
    let poses = Arc::new(LivePoses::default());
    let reconcilers = reconcile::spawn(context, &sessions, &poses, background);
    context.set_log_source(Arc::new(SessionLogs {
        context: Arc::downgrade(context),
        sessions: Arc::clone(&sessions),
    }));
    let frameworks = Arc::new(Frameworks::new(
        Arc::clone(context),
        reconcilers.scheduler.clone(),
        Arc::clone(&sessions),
        background.clone(),
    ));
    reconcile::spawn_for_frameworks(context, &frameworks, background);
    context.set_live(Live {
        scheduler: reconcilers.scheduler,
        sessions: Arc::clone(&sessions),
        execs: Arc::new(Execs::new(Arc::clone(&sessions), background.clone())),
        frameworks,
        poses: Arc::clone(&poses),
    });
    let publishers =
        poses::Service::new(Arc::clone(context), Arc::clone(&poses), background.clone());
    (Agents::new(Arc::clone(context), sessions, poses, background.clone()), publishers)
}

/// Work without which the controller is none. Should it panic, the process is to end: a loop that is silently gone would be
/// missed only when what it does is missing.
pub(crate) async fn guard<T>(
    context: Arc<Context>,
    name: &'static str,
    work: impl Future<Output = T>,
) {
    if AssertUnwindSafe(work).catch_unwind().await.is_err() {
        tracing::error!(name, "a part of the controller has panicked; the process ends");
        context.broken.cancel();
    }
}

/// What a client is told whose request met a fault of ours; the panic is in the log.
fn fault(_: Box<dyn Any + Send>) -> Response {
    ::metrics::counter!("muster_request_panics_total").increment(1);
    Failure::internal("the request met a fault of the controller; its log tells more")
        .into_response()
}

/// REST and gRPC as one router.
fn router(context: &Arc<Context>, (agents, publishers): (Agents, poses::Service)) -> Router {
    // Mounted by path, because the fallback of tonic's own router answers 200 to what it does not know.
    let frameworks = context.live().map(|live| Arc::clone(&live.frameworks));
    let frameworks = frameworks.map(|frameworks| {
        let service = FrameworkServiceServer::new(Service(Arc::clone(&frameworks)))
            .max_decoding_message_size(MAX_WIRE)
            .max_encoding_message_size(MAX_WIRE);
        Router::new()
            .route_service("/muster.framework.v1.FrameworkService/{*method}", service)
            .merge(lines::router(frameworks))
    });
    let execs = context.live().map(|live| Arc::clone(&live.execs)).map(|execs| {
        let service = ExecServiceServer::new(execs::Service(execs));
        Router::new().route_service("/muster.agent.v1.ExecService/{*method}", service)
    });
    Router::new()
        .route_service(
            "/muster.agent.v1.AgentService/{*method}",
            session::proto::agent_service_server::AgentServiceServer::new(agents)
                .max_decoding_message_size(MAX_WIRE),
        )
        .route_service(
            "/muster.pose.v1.PoseService/{*method}",
            PoseServiceServer::new(publishers).max_decoding_message_size(MAX_WIRE),
        )
        .merge(frameworks.unwrap_or_default())
        .merge(execs.unwrap_or_default())
        .merge(rest::router(Arc::clone(context)))
        .layer(from_fn_with_state(Arc::clone(context), rates::hold_back))
        .layer(from_fn_with_state(Arc::clone(context), auth::by_token))
        .layer(CatchPanicLayer::custom(fault))
}

impl Running {
    /// Where it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.context.address
    }

    /// What its parts share.
    #[must_use]
    pub fn context(&self) -> &Arc<Context> {
        &self.context
    }

    /// Works until `shutdown` is ready, or until a part of it has failed for good, and ends it.
    async fn until(self, shutdown: impl Future<Output = ()> + Send) -> Result<(), AppError> {
        let broken = self.context.broken.clone();
        tokio::select! {
            () = shutdown => tracing::info!("shutting down"),
            () = broken.cancelled() => {}
        }
        self.shut_down().await
    }

    /// Ends it: requests in flight are finished, at most for a few seconds, and what was acknowledged is durable.
    ///
    /// # Errors
    /// When a part of it had failed.
    pub async fn shut_down(self) -> Result<(), AppError> {
        self.context.stop.cancel();
        self.accept.await.map_err(AppError::Task)?;
        self.connections.close();
        if tokio::time::timeout(DEADLINE, self.connections.wait()).await.is_err() {
            tracing::warn!(connections = self.connections.len(), "cutting connections");
            self.kill.cancel();
            self.connections.wait().await;
        }
        self.context.streams.ended().await;
        self.background.close();
        self.background.wait().await;
        self.stop_writer.cancel();
        self.writer.await.map_err(AppError::Task)?;
        if self.context.broken.is_cancelled() { Err(AppError::Broken) } else { Ok(()) }
    }
}

/// Refuses a second controller on the same directory. The lock dies with the process.
fn lock(dir: &Path) -> Result<File, AppError> {
    let failed = |source| AppError::DataDir { path: dir.to_owned(), source };
    std::fs::create_dir_all(dir).map_err(failed)?;
    let file = File::options()
        .write(true)
        .create(true)
        .truncate(false)
        .open(dir.join("lock"))
        .map_err(failed)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(AppError::Locked { path: dir.to_owned() }),
        Err(TryLockError::Error(source)) => Err(failed(source)),
    }
}

/// The names and addresses under which clients may dial.
fn names(config: &Config) -> BTreeSet<String> {
    let mut names: BTreeSet<String> =
        ["localhost", "127.0.0.1", "::1"].map(str::to_owned).into_iter().collect();
    if let Ok(host) = std::fs::read_to_string("/proc/sys/kernel/hostname") {
        names.insert(host.trim().to_owned());
    }
    if !config.listen.ip().is_unspecified() {
        names.insert(config.listen.ip().to_string());
    }
    names.extend(config.advertise.iter().cloned());
    names.remove("");
    names
}

fn write_kubeconfig(context: &Context, admin: &Pem) -> Result<(), KubeconfigError> {
    let (file, asked) = (&context.config.kubeconfig, context.config.kubeconfig_asked);
    kubeconfig::write(file, asked, &context.url(), context.pki.ca(), admin)
}

/// What of the controller's own certificates is in use.
struct Renewal {
    context: Arc<Context>,
    names: BTreeSet<String>,
    server: Pem,
    admin: Pem,
    /// For connections that come from now on.
    tls: watch::Sender<Arc<ServerConfig>>,
}

impl Renewal {
    /// Looks now and then whether a certificate nears its end, until `context.stop`. Machines sleep, and clocks are set: the
    /// time is asked each time.
    async fn run(mut self) {
        let stop = self.context.stop.clone();
        let pause = (self.context.config.certificate_ttl / 60).min(LOOK_AT_CERTIFICATES);
        while stop.run_until_cancelled(tokio::time::sleep(pause)).await.is_some() {
            if let Err(error) = self.look() {
                tracing::error!(
                    error = chain(&error),
                    "the controller's certificates cannot be renewed"
                );
            }
        }
    }

    fn look(&mut self) -> Result<(), AppError> {
        let (context, now) = (&self.context, self.context.clock.now());
        let server = context.pki.server(&self.names, now)?;
        if server.certificate != self.server.certificate {
            self.tls.send_replace(Arc::new(context.pki.server_config(&server)?));
            tracing::info!("the server's certificate is renewed");
            self.server = server;
        }
        let admin = context.pki.admin(now)?;
        if admin.certificate != self.admin.certificate {
            write_kubeconfig(context, &admin)?;
            let file = context.config.kubeconfig.display();
            tracing::info!(%file, "the administrator's certificate is renewed");
            self.admin = admin;
        }
        Ok(())
    }
}

/// Ready at SIGINT or SIGTERM.
pub async fn signal() {
    use tokio::signal::unix::{SignalKind, signal};
    let Ok(mut terminate) = signal(SignalKind::terminate()) else {
        // Without a handler the signal ends the process by itself.
        return std::future::pending().await;
    };
    tokio::select! {
        _ = tokio::signal::ctrl_c() => {}
        _ = terminate.recv() => {}
    }
}

/// An error with everything that caused it, in one line.
#[must_use]
pub fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(cause) = next {
        text.push_str(": ");
        text.push_str(&cause.to_string());
        next = cause.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(dir: &Path) -> Config {
        Config {
            data_dir: dir.join("data"),
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            kubeconfig: dir.join("kubeconfig"),
            kubeconfig_asked: true,
            advertise: Vec::new(),
            encryption_key: None,
            certificate_ttl: crate::pki::TTL,
            requests_per_second: crate::config::REQUESTS_PER_SECOND,
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_part_that_panics_ends_the_process() {
        let dir = tempfile::tempdir().unwrap();
        let running = start(config(dir.path())).await.unwrap();
        let loops = guard(Arc::clone(&running.context), "test", async { panic!("a fault") });
        running.background.spawn(loops);
        let ended = running.until(std::future::pending()).await;
        assert!(matches!(ended, Err(AppError::Broken)), "{ended:?}");
    }

    #[tokio::test]
    async fn a_request_that_panics_is_a_status() {
        use tower::ServiceExt as _;
        let faulty = axum::routing::get(async || -> Response { panic!("a fault") });
        let router = Router::new().route("/", faulty).layer(CatchPanicLayer::custom(fault));
        let request = http::Request::get("/").body(axum::body::Body::empty()).unwrap();
        let response = router.oneshot(request).await.unwrap();
        assert_eq!(response.status(), 500);
        let body = axum::body::to_bytes(response.into_body(), 1 << 20).await.unwrap();
        let status: serde_json::Value = serde_json::from_slice(&body).unwrap();
        assert_eq!(
            (&status["kind"], &status["reason"]),
            (&"Status".into(), &"InternalError".into())
        );
    }
}
