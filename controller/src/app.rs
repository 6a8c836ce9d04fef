//! Starts, joins and ends everything. Nothing else in this crate spawns a task that outlives its caller.
//!
//! ```text
//! start: lock DIR → PKI → store (+ writer task) → bind → kubeconfig → background tasks → accept loop
//! end:   stop (no new connection, watches and sessions end) → connections, at most DEADLINE → background tasks
//!        → writer (commits what is queued) → lock
//! ```

use std::collections::BTreeSet;
use std::fs::{File, TryLockError};
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::task::{JoinError, JoinHandle};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use crate::config::Config;
use crate::context::{Clock as _, Context, Live, SystemClock};
use crate::events::{self, Happening, Recorder};
use crate::kubeconfig::KubeconfigError;
use crate::pki::{Pki, PkiError};
use crate::serve::Server;
use crate::session::agents::Agents;
use crate::session::frameworks::proto::framework_service_server::FrameworkServiceServer;
use crate::session::frameworks::service::Service;
use crate::session::frameworks::{Frameworks, MAX_WIRE, lines};
use crate::session::logs::SessionLogs;
use crate::session::poses::proto::pose_service_server::PoseServiceServer;
use crate::session::poses::{self, LivePoses};
use crate::session::{self, Sessions};
use crate::store::{self, OpenError, StoreError};
use crate::{kubeconfig, metrics, reconcile, rest};

/// How long requests in flight may take to finish after a signal.
const DEADLINE: Duration = Duration::from_secs(5);

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
    #[error("cannot create the default namespace")]
    Bootstrap(#[source] StoreError),
    /// The metrics recorder.
    #[error("cannot install the metrics recorder")]
    Metrics(#[from] metrics_exporter_prometheus::BuildError),
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
    let running = start(config).await?;
    let address = running.address();
    tracing::info!(%address, url = running.context.url(), "serving");
    shutdown.await;
    tracing::info!("shutting down");
    running.shut_down().await
}

/// Starts a controller; it answers when this returns.
///
/// # Errors
/// When it cannot start.
pub async fn start(config: Config) -> Result<Running, AppError> {
    let now = SystemClock.now();
    let lock = lock(&config.data_dir)?;
    let pki = Pki::open(&config.data_dir.join("pki"), now)?;
    let tls = Arc::new(pki.server_config(&names(&config), now)?);
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
    let writer = tokio::spawn(writer.run(stop_writer.clone()));
    rest::namespace::bootstrap(&context).await.map_err(AppError::Bootstrap)?;
    let admin = context.pki.admin(now)?;
    let (file, asked) = (&context.config.kubeconfig, context.config.kubeconfig_asked);
    kubeconfig::write(file, asked, &context.url(), context.pki.ca(), &admin)?;

    let background = TaskTracker::new();
    let services = spawn_background(&context, &background, happenings);
    let server = Server {
        tls,
        router: router(&context, services),
        stop: context.stop.clone(),
        kill: CancellationToken::new(),
        connections: TaskTracker::new(),
    };
    let (kill, connections) = (server.kill.clone(), server.connections.clone());
    let accept = tokio::spawn(server.accept(listener));
    Ok(Running { context, kill, connections, background, accept, writer, stop_writer, _lock: lock })
}

/// Everything that works beside the requests. Each ends when `context.stop` is cancelled.
fn spawn_background(
    context: &Arc<Context>,
    background: &TaskTracker,
    happenings: mpsc::Receiver<Happening>,
) -> (Agents, poses::Service) {
    background.spawn(metrics::upkeep(context.metrics.clone(), context.stop.clone()));
    background.spawn(rest::namespace::finalize(Arc::clone(context)));
    let record = events::run(Arc::clone(context), happenings);
    background.spawn(context.stop.clone().run_until_cancelled_owned(record));
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
        frameworks,
        poses: Arc::clone(&poses),
    });
    let publishers =
        poses::Service::new(Arc::clone(&poses), background.clone(), context.stop.clone());
    (Agents::new(Arc::clone(context), sessions, poses, background.clone()), publishers)
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
        .merge(rest::router(Arc::clone(context)))
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

    /// Ends it: requests in flight are finished, at most for a few seconds, and what was acknowledged is durable.
    ///
    /// # Errors
    /// When one of its tasks had panicked.
    pub async fn shut_down(self) -> Result<(), AppError> {
        self.context.stop.cancel();
        self.accept.await.map_err(AppError::Task)?;
        self.connections.close();
        if tokio::time::timeout(DEADLINE, self.connections.wait()).await.is_err() {
            tracing::warn!(connections = self.connections.len(), "cutting connections");
            self.kill.cancel();
            self.connections.wait().await;
        }
        self.background.close();
        self.background.wait().await;
        self.stop_writer.cancel();
        self.writer.await.map_err(AppError::Task)
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
