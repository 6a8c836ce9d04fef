//! What every part of a running controller shares.

use std::fmt;
use std::net::SocketAddr;
use std::sync::{Arc, OnceLock};

use jiff::Timestamp;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio_util::sync::CancellationToken;

use crate::audit::Audit;
use crate::auth::Rights;
use crate::config::Config;
use crate::events::Recorder;
use crate::pki::Pki;
use crate::quota::Door;
use crate::rates::Rates;
use crate::reconcile::schedule;
use crate::rest::log::LogSource;
use crate::rest::{Bodies, Rendered, Streams};
use crate::session::Sessions;
use crate::session::execs::Execs;
use crate::session::frameworks::Frameworks;
use crate::session::poses::LivePoses;
use crate::store::Store;

/// Requests that are worked on at once. A client that finds all places taken is told to come back: a queue would only make
/// everybody late. One core answers thousands in a second.
const AT_ONCE: usize = 512;

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
    /// A place for each request that is worked on at once, without those that last (watches, logs).
    pub places: tokio::sync::Semaphore,
    /// Room for what clients send.
    pub bodies: Bodies,
    /// Answers that last: watches, logs, long lists.
    pub streams: Streams,
    /// Changes as they were last shown to watchers.
    pub rendered: Rendered,
    /// Who changed what.
    pub audit: Audit,
    /// What Access objects give, read.
    pub(crate) rights: Rights,
    pub(crate) rates: Rates,
    /// Cancelled when a part of the controller has failed for good: the process is to end, and to be started again.
    pub(crate) broken: CancellationToken,
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
    /// Programs that clients run in tasks.
    pub(crate) execs: Arc<Execs>,
    /// Who takes offers.
    pub frameworks: Arc<Frameworks>,
    /// Where robots are.
    pub poses: Arc<LivePoses>,
}

impl Context {
    /// A context that nothing works on yet: see [`crate::app::work`].
    #[must_use]
    pub fn new(
        store: Store,
        pki: Pki,
        config: Config,
        address: SocketAddr,
        metrics: PrometheusHandle,
        events: Recorder,
    ) -> Self {
        Self {
            audit: Audit::in_dir(config.data_dir.join("audit")),
            rights: Rights::default(),
            rates: Rates::new(config.requests_per_second),
            store,
            clock: Arc::new(SystemClock),
            pki,
            config,
            address,
            stop: CancellationToken::new(),
            events,
            places: tokio::sync::Semaphore::new(AT_ONCE),
            bodies: Bodies::default(),
            streams: Streams::default(),
            rendered: Rendered::default(),
            broken: CancellationToken::new(),
            placing: tokio::sync::RwLock::new(()),
            door: Arc::default(),
            metrics,
            logs: OnceLock::new(),
            live: OnceLock::new(),
        }
    }

    /// The same with another clock.
    #[must_use]
    pub fn with_clock(self, clock: Arc<dyn Clock>) -> Self {
        Self { clock, ..self }
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

    /// What is known of the live cluster; none: nothing works on the context yet.
    #[must_use]
    pub fn live(&self) -> Option<&Live> {
        self.live.get()
    }

    pub(crate) fn log_source(&self) -> Option<&Arc<dyn LogSource>> {
        self.logs.get()
    }
}

/// A context over `store` with its files in `dir`; nothing works on it.
#[cfg(test)]
pub(crate) fn for_tests(dir: &std::path::Path, store: Store) -> Arc<Context> {
    let pki = Pki::open(dir, SystemClock.now()).expect("a certificate authority");
    let config = Config {
        data_dir: dir.to_owned(),
        listen: "127.0.0.1:0".parse().expect("an address"),
        kubeconfig: dir.join("kubeconfig"),
        kubeconfig_asked: true,
        advertise: Vec::new(),
        encryption_key: None,
        certificate_ttl: crate::pki::TTL,
        requests_per_second: crate::config::REQUESTS_PER_SECOND,
    };
    let (address, (events, _)) = (config.listen, Recorder::new());
    let metrics = crate::metrics::recorder().expect("the process's recorder");
    Arc::new(Context::new(store, pki, config, address, metrics, events))
}
