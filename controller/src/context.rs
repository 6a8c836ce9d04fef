//! What every part of a running controller shares.

use std::fmt;
use std::net::SocketAddr;
use std::sync::{Arc, OnceLock};

use jiff::Timestamp;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio_util::sync::CancellationToken;

use crate::config::Config;
use crate::events::Recorder;
use crate::pki::Pki;
use crate::quota::Door;
use crate::reconcile::schedule;
use crate::rest::log::LogSource;
use crate::session::Sessions;
use crate::session::frameworks::Frameworks;
use crate::session::poses::LivePoses;
use crate::store::Store;

/// Where "now" comes from; tests hold it still.
pub trait Clock: fmt::Debug + Send + Sync {
    /// The wall clock.
    fn now(&self) -> Timestamp;
}

/// The machine's clock.
#[derive(Debug, Clone, Copy)]
pub struct SystemClock;

impl Clock for SystemClock {
    fn now(&self) -> Timestamp {
        Timestamp::now()
    }
}

/// Shared by the REST handlers, the sessions and the reconcilers.
#[derive(Debug)]
pub struct Context {
    /// The objects.
    pub store: Store,
    /// The wall clock.
    pub clock: Arc<dyn Clock>,
    /// The certificate authority.
    pub pki: Pki,
    /// What it was started with.
    pub config: Config,
    /// The bound address.
    pub address: SocketAddr,
    /// Cancelled when the controller should end: watches and sessions end, no connection is taken.
    pub stop: CancellationToken,
    /// Takes what people should see under an object.
    pub events: Recorder,
    /// Held while a task is given to a node (shared) and while a Node is deleted (alone): a Node is found unused and is
    /// gone before the next task is given to it, or the other way round.
    pub(crate) placing: tokio::sync::RwLock<()>,
    /// Lets new tasks into namespaces that have a Quota.
    pub(crate) door: Arc<Door>,
    pub(crate) metrics: PrometheusHandle,
    logs: OnceLock<Arc<dyn LogSource>>,
    live: OnceLock<Live>,
}

/// What is known of the cluster and is not in the store.
#[derive(Debug, Clone)]
pub struct Live {
    /// Answers what would be decided now.
    pub scheduler: schedule::Handle,
    /// Who is connected, and what is used.
    pub sessions: Arc<Sessions>,
    /// Who takes offers.
    pub frameworks: Arc<Frameworks>,
    /// Where robots are.
    pub poses: Arc<LivePoses>,
}

impl Context {
    pub(crate) fn new(
        store: Store,
        pki: Pki,
        config: Config,
        address: SocketAddr,
        metrics: PrometheusHandle,
        events: Recorder,
    ) -> Self {
        Self {
            store,
            clock: Arc::new(SystemClock),
            pki,
            config,
            address,
            stop: CancellationToken::new(),
            events,
            placing: tokio::sync::RwLock::new(()),
            door: Arc::default(),
            metrics,
            logs: OnceLock::new(),
            live: OnceLock::new(),
        }
    }

    /// The present time, whole seconds as in `metadata.creationTimestamp`.
    #[must_use]
    pub fn stamp(&self) -> String {
        self.clock.now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
    }

    /// `https://host:port` for people and agents.
    #[must_use]
    pub fn url(&self) -> String {
        crate::kubeconfig::url(&self.config.host(self.address), self.address.port())
    }

    /// Says who can open the logs of tasks. The first one stays.
    pub fn set_log_source(&self, source: Arc<dyn LogSource>) {
        // A second source would be a second session service on one controller, which app.rs never makes.
        drop(self.logs.set(source));
    }

    /// Says who knows the live cluster. The first one stays.
    pub fn set_live(&self, live: Live) {
        // As above: app.rs makes one.
        drop(self.live.set(live));
    }

    pub(crate) fn live(&self) -> Option<&Live> {
        self.live.get()
    }

    pub(crate) fn log_source(&self) -> Option<&Arc<dyn LogSource>> {
        self.logs.get()
    }
}
