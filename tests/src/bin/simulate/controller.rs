//! One life of the real controller: everything of it but its port, on a clock that stands until it is told to go on.
//!
//! It is a tokio runtime of one thread with paused time. [`Controller::run_until`] lets it work up to a moment of the world,
//! or until it says something. Dropping it is `kill -9`: every task ends where it waits.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use bytes::Bytes;
use http::Request;
use jiff::Timestamp;
use metrics_exporter_prometheus::PrometheusBuilder;
use muster_api::kind::node::{Node, NodeKind, NodeSpec};
use muster_api::kind::task::Task;
use muster_api::name::NodeName;
use muster_api::phase::TaskPhase;
use muster_api::wire::agent::v1 as wire;
use muster_api::wire::framework::v1 as framework;
use muster_controller::app;
use muster_controller::audit::Audit;
use muster_controller::auth::{Asker, Identity};
use muster_controller::config::Config;
use muster_controller::context::{Clock, Context};
use muster_controller::events::Recorder;
use muster_controller::objects;
use muster_controller::pki::Pki;
use muster_controller::rest;
use muster_controller::session::agents::Agents;
use muster_controller::session::frameworks::Frameworks;
use muster_controller::store::memory::Disk;
use muster_controller::store::{Key, Op, Precondition, Store, Stored};
use tokio::runtime::{Builder, Runtime};
use tokio::sync::{Notify, mpsc, watch};
use tokio::task::AbortHandle;
use tokio::time::Instant;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::UnboundedReceiverStream;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tonic::Status;
use tower::ServiceExt as _;

use crate::net::Conn;

/// The date at which every run begins, milliseconds since 1970.
pub(crate) const EPOCH: i64 = 1_760_000_000_000;

/// How far the controller's date is off, milliseconds.
#[derive(Debug, Clone, Default)]
pub(crate) struct Skew(Arc<AtomicI64>);

impl Skew {
    /// Sets the clock.
    pub(crate) fn set(&self, millis: i64) {
        self.0.store(millis, Ordering::SeqCst);
    }
}

/// The controller's date: the world's time, and the error of its clock.
#[derive(Debug)]
struct Wall {
    base: Instant,
    began: u64,
    skew: Skew,
}

impl Clock for Wall {
    fn now(&self) -> Timestamp {
        let passed = i64::try_from(self.base.elapsed().as_millis()).unwrap_or(i64::MAX);
        let began = self.began.cast_signed();
        let millis = EPOCH + began + passed + self.skew.0.load(Ordering::SeqCst);
        Timestamp::from_millisecond(millis).unwrap_or(Timestamp::MAX)
    }
}

/// What comes out of a controller.
#[derive(Debug)]
pub(crate) enum Said {
    /// It answers from now on.
    Up,
    /// It did not start.
    Failed(String),
    /// To an agent.
    ToAgent(Conn, Box<wire::ControllerMessage>),
    /// To a framework.
    ToFramework(Conn, Box<framework::Event>),
    /// To an agent: what people order.
    Order(Conn, wire::NodeOrder),
    /// It has closed a session.
    Closed(Conn),
    /// The answer to a client's request: code and body.
    Answer(u64, u16, Bytes),
}

#[derive(Debug, Default)]
struct Outbox {
    said: Mutex<Vec<Said>>,
    news: Notify,
    port: Mutex<Option<Port>>,
}

impl Outbox {
    fn say(&self, said: Said) {
        self.said.lock().unwrap_or_else(PoisonError::into_inner).push(said);
        self.news.notify_one();
    }
}

/// What a started controller is reached by.
#[derive(Debug)]
struct Port {
    context: Arc<Context>,
    agents: Agents,
    frameworks: Arc<Frameworks>,
    router: Router,
}

/// One life of the controller.
#[derive(Debug)]
pub(crate) struct Controller {
    runtime: Runtime,
    base: Instant,
    began: u64,
    outbox: Arc<Outbox>,
    port: Option<Port>,
    inbound: BTreeMap<Conn, mpsc::UnboundedSender<Result<wire::AgentMessage, Status>>>,
    guests: BTreeMap<Conn, Guest>,
    orders: BTreeMap<Conn, AbortHandle>,
}

/// A framework's connection.
#[derive(Debug)]
struct Guest {
    calls: mpsc::UnboundedSender<Result<framework::Call, Status>>,
    /// It reads what it is told.
    reads: watch::Sender<bool>,
}

impl Controller {
    /// Starts on what the disk has; it is [`Said::Up`] when it answers. `now`: the world's time.
    pub(crate) fn start(house: &House, now: u64) -> Controller {
        let runtime = Builder::new_current_thread()
            .enable_time()
            .start_paused(true)
            .build()
            .expect("a runtime without I/O needs nothing of the system");
        let base = runtime.block_on(async { Instant::now() });
        let outbox = Arc::new(Outbox::default());
        let (to, house) = (Arc::clone(&outbox), house.clone());
        runtime.spawn(async move {
            let wall = Wall { base, began: now, skew: house.skew.clone() };
            match boot(&house, wall).await {
                Ok(port) => {
                    *to.port.lock().unwrap_or_else(PoisonError::into_inner) = Some(port);
                    to.say(Said::Up);
                }
                Err(why) => to.say(Said::Failed(why)),
            }
        });
        Controller {
            runtime,
            base,
            began: now,
            outbox,
            port: None,
            inbound: BTreeMap::new(),
            guests: BTreeMap::new(),
            orders: BTreeMap::new(),
        }
    }

    /// Lets it work until the world's time is `at`, or it says something; gives the time then.
    pub(crate) fn run_until(&mut self, at: u64) -> u64 {
        let deadline = self.base + Duration::from_millis(at.saturating_sub(self.began));
        let outbox = Arc::clone(&self.outbox);
        let reached = self.runtime.block_on(async {
            tokio::select! {
                biased;
                () = outbox.news.notified() => {}
                () = tokio::time::sleep_until(deadline) => {}
            }
            Instant::now()
        });
        let passed = reached.duration_since(self.base).as_millis();
        self.began + u64::try_from(passed).unwrap_or(u64::MAX)
    }

    /// What it said since the last call.
    pub(crate) fn take(&mut self) -> Vec<Said> {
        if self.port.is_none() {
            self.port = self.outbox.port.lock().unwrap_or_else(PoisonError::into_inner).take();
        }
        std::mem::take(&mut *self.outbox.said.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// The objects, when it answers.
    pub(crate) fn store(&self) -> Option<&Store> {
        self.port.as_ref().map(|port| &port.context.store)
    }

    /// An agent has connected, with this certificate. False: nobody listens.
    pub(crate) fn connect(&mut self, conn: Conn, node: &NodeName, key: &str) -> bool {
        let Some(port) = &self.port else { return false };
        let _entered = self.runtime.enter();
        let (sender, inbound) = mpsc::unbounded_channel();
        self.inbound.insert(conn, sender);
        let inbound = Box::pin(UnboundedReceiverStream::new(inbound));
        let mut outbound = port.agents.begin(node.clone(), key.to_owned(), inbound);
        let outbox = Arc::clone(&self.outbox);
        drop(self.runtime.spawn(async move {
            while let Some(Ok(message)) = outbound.next().await {
                outbox.say(Said::ToAgent(conn, Box::new(message)));
            }
            outbox.say(Said::Closed(conn));
        }));
        true
    }

    /// A message of an agent. False: the session is over.
    pub(crate) fn deliver(&mut self, conn: Conn, message: wire::AgentMessage) -> bool {
        self.inbound.get(&conn).is_some_and(|inbound| inbound.send(Ok(message)).is_ok())
    }

    /// The other end of a connection is closed.
    pub(crate) fn hang_up(&mut self, conn: Conn) {
        self.inbound.remove(&conn);
        self.guests.remove(&conn);
        self.orders.remove(&conn).inspect(AbortHandle::abort);
    }

    /// An agent wants to hear what people order. False: nobody listens, or not to this one.
    pub(crate) fn order(&mut self, conn: Conn, node: &NodeName, key: &str) -> bool {
        let Some(port) = &self.port else { return false };
        let _entered = self.runtime.enter();
        let Ok(orders) = port.agents.orders_for(node, key) else { return false };
        let outbox = Arc::clone(&self.outbox);
        let told = self.runtime.spawn(async move {
            let mut orders = pin!(orders);
            while let Some(order) = orders.next().await {
                outbox.say(Said::Order(conn, order));
            }
            outbox.say(Said::Closed(conn));
        });
        self.orders.insert(conn, told.abort_handle());
        true
    }

    /// A framework has connected. False: nobody listens.
    pub(crate) fn welcome(&mut self, conn: Conn) -> bool {
        let Some(port) = &self.port else { return false };
        let _entered = self.runtime.enter();
        let (calls, inbound) = mpsc::unbounded_channel();
        let (reads, mut may_read) = watch::channel(true);
        self.guests.insert(conn, Guest { calls, reads });
        let mut told = port
            .frameworks
            .begin(Asker::admin("simulation"), Box::pin(UnboundedReceiverStream::new(inbound)));
        let outbox = Arc::clone(&self.outbox);
        drop(self.runtime.spawn(async move {
            // Whoever hangs up reads nothing more: what it would be told is dropped with the stream.
            while may_read.wait_for(|may| *may).await.is_ok() {
                let Some(event) = told.next().await else { break };
                outbox.say(Said::ToFramework(conn, Box::new(event)));
            }
            outbox.say(Said::Closed(conn));
        }));
        true
    }

    /// A call of a framework. False: the session is over.
    pub(crate) fn call(&mut self, conn: Conn, call: framework::Call) -> bool {
        self.guests.get(&conn).is_some_and(|guest| guest.calls.send(Ok(call)).is_ok())
    }

    /// A framework reads what it is told, or does not.
    pub(crate) fn reads(&mut self, conn: Conn, reads: bool) {
        if let Some(guest) = self.guests.get(&conn) {
            guest.reads.send_replace(reads);
        }
    }

    /// A request of an administrator, or of whom it names. False: nobody listens.
    pub(crate) fn request(&self, id: u64, mut request: Request<Body>) -> bool {
        let Some(port) = &self.port else { return false };
        if request.extensions().get::<Identity>().is_none() {
            let admin = Identity::Admin { name: "simulation".to_owned() };
            request.extensions_mut().insert(admin);
        }
        let (router, outbox) = (port.router.clone(), Arc::clone(&self.outbox));
        drop(self.runtime.spawn(async move {
            let Ok(response) = router.oneshot(request).await;
            let code = response.status().as_u16();
            let body = axum::body::to_bytes(response.into_body(), usize::MAX).await;
            outbox.say(Said::Answer(id, code, body.unwrap_or_default()));
        }));
        true
    }
}

impl Controller {
    /// Removes an object at once, as no part of the controller does.
    pub(crate) fn remove(&self, key: &Key) {
        let Some(store) = self.store().cloned() else { return };
        let key = key.clone();
        drop(self.runtime.spawn(async move {
            // A planted fault may fail.
            drop(store.apply_one(Op::Delete { key, precondition: Precondition::Any }).await);
        }));
    }

    /// Ends a task in the books alone, as no part of the controller does.
    pub(crate) fn end_without_lease(&self, key: &Key) {
        let Some(store) = self.store().cloned() else { return };
        let key = key.clone();
        drop(self.runtime.spawn(async move {
            let change = |stored: &Arc<Stored>, mut task: Task| {
                task.status.get_or_insert_default().phase = TaskPhase::Failed;
                Some(vec![objects::replace(stored, &task)])
            };
            // A planted fault may fail.
            let _ = objects::change(&store, &key, change).await;
        }));
    }
}

/// What outlives a controller.
#[derive(Debug, Clone)]
pub(crate) struct House {
    pub(crate) disk: Disk,
    pub(crate) skew: Skew,
    /// Its data directory, for its certificates.
    pub(crate) dir: PathBuf,
    /// Who has joined.
    pub(crate) members: Vec<Member>,
}

/// A node that has joined: its name, its kind and the key of its agent's certificate.
#[derive(Debug, Clone)]
pub(crate) struct Member {
    pub(crate) name: NodeName,
    pub(crate) kind: NodeKind,
    pub(crate) key: String,
}

async fn boot(house: &House, wall: Wall) -> Result<Port, String> {
    let House { disk, dir, members, .. } = house;
    let pki = Pki::open(&dir.join("pki"), wall.now()).map_err(|error| app::chain(&error))?;
    let (store, writer) = disk.open().await;
    // It ends with the last handle of the store, or with the runtime.
    drop(tokio::spawn(writer.run(CancellationToken::new())));
    let (events, happenings) = Recorder::new();
    let metrics = PrometheusBuilder::new().build_recorder().handle();
    let address = SocketAddr::from(([127, 0, 0, 1], 7443));
    let mut context = Context::new(store, pki, config(dir, address), address, metrics, events);
    context.audit = Audit::at_once(dir.join("audit"));
    let context = Arc::new(context.with_clock(Arc::new(wall)));
    app::prepare(&context).await.map_err(|error| app::chain(&error))?;
    for member in members {
        join(&context, member).await?;
    }
    let (agents, _publishers) = app::work(&context, &TaskTracker::new(), happenings);
    let router = rest::router(Arc::clone(&context));
    let frameworks = context.live().map(|live| Arc::clone(&live.frameworks));
    let frameworks = frameworks.ok_or("nothing works on the context")?;
    Ok(Port { context, agents, frameworks, router })
}

/// What a join leaves in the store.
async fn join(context: &Context, member: &Member) -> Result<(), String> {
    let key = objects::node_key(member.name.as_str());
    if context.store.get(&key).is_some() {
        return Ok(());
    }
    let mut node = Node::new(member.name.as_str(), NodeSpec::new(member.kind));
    objects::stamp_new(&mut node.metadata, context.clock.now());
    node.status.get_or_insert_default().agent_keys = vec![member.key.clone()];
    let joined = context.store.apply_one(objects::create(key, &node)).await;
    joined.map(drop).map_err(|error| app::chain(&error))
}

fn config(dir: &Path, listen: SocketAddr) -> Config {
    Config {
        data_dir: dir.to_owned(),
        listen,
        kubeconfig: dir.join("kubeconfig"),
        kubeconfig_asked: true,
        advertise: Vec::new(),
        encryption_key: None,
        certificate_ttl: muster_controller::pki::TTL,
        requests_per_second: muster_controller::config::REQUESTS_PER_SECOND,
    }
}
