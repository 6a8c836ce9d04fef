//! The sessions of frameworks (two-level scheduling; Avalon, III-A and IV-B).
//!
//! ```text
//!   gRPC stream ┐                        ┌── Request ──▶ reconcile::desk (offers, Accepts)
//!   JSON lines ─┴─▶ session (one a task) ┤◀── events ────┘
//!                        ▲   ▲           └── Framework and Task objects: store
//!             mailbox of updates   messages of executors
//! ```
//!
//! | module | is |
//! |---|---|
//! | `session` | one framework's session, whatever carries it |
//! | `subscribe` | the first call: who it is, and its Framework object |
//! | `launch` | the launches of an Accept → checked Task objects |
//! | `roster` | the tasks of all frameworks |
//! | `direct` | tickets, with which messages go by without the controller |
//! | [`updates`] | states of tasks → the mailboxes of their frameworks |
//! | [`service`], [`lines`] | the two transports |
//! | `convert` | what is said, as messages |

pub(crate) mod convert;
mod direct;
mod launch;
pub mod lines;
mod roster;
pub mod service;
mod session;
mod subscribe;
pub mod updates;

pub(crate) use session::let_go;
pub(crate) use subscribe::{owner_of, owning, write_presence};

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use muster_api::id::TaskUid;
use muster_api::kind::framework::FrameworkPosition;
use muster_api::kind::task::Task;
use muster_api::name::NodeName;
use muster_api::wire::agent::v1::Message as AgentMessage;
use muster_api::wire::framework::v1 as wire;
use muster_controller_core::access::{Asked, Who};
use muster_controller_core::cluster::Executor;
use tokio::sync::{Notify, mpsc, oneshot};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::lock;
use super::relay::Lost;
use crate::auth::{self, Asker, Identity};
use crate::context::Context;
use crate::objects;
use crate::reconcile::desk::{Depth, FrameworkUid, Outlet, Request, View};
use crate::reconcile::schedule;
use crate::rest::failure::Failure;
use crate::store::StoreError;

/// The generated server side of the session.
#[allow(clippy::all, clippy::allow_attributes, unreachable_pub, reason = "generated")]
pub(crate) mod proto {
    include!(concat!(env!("OUT_DIR"), "/muster.framework.v1.rs"));
}

/// How often a silent session says that it is alive.
pub const HEARTBEAT_EVERY: Duration = Duration::from_secs(5);
/// What may wait to be sent to one framework: some rounds of offers of a large one. Past it the framework is cut off.
const EVENTS: usize = 1024;
/// Calls that wait for their turn in one session.
const CALLS: usize = 64;
/// Largest message between a framework and an executor.
pub const MAX_MESSAGE: usize = 4 << 20;
/// Largest message on the wire: a [`MAX_MESSAGE`] with what is around it.
pub const MAX_WIRE: usize = MAX_MESSAGE + (64 << 10);

/// The newest state of each task that its framework has yet to hear of.
#[derive(Debug, Default)]
pub(crate) struct Mailbox {
    updates: Mutex<BTreeMap<String, wire::Update>>,
    wake: Notify,
}

impl Mailbox {
    pub(crate) fn put(&self, update: wire::Update) {
        let mut updates = lock(&self.updates);
        match updates.get(&update.task) {
            Some(newer) if newer.version >= update.version => return,
            _ => drop(updates.insert(update.task.clone(), update)),
        }
        self.wake.notify_one();
    }

    fn take(&self) -> BTreeMap<String, wire::Update> {
        std::mem::take(&mut *lock(&self.updates))
    }
}

/// Why a message goes to no executor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Unsent {
    /// There is none of this framework.
    NoExecutor(&'static str),
    /// It cannot be reached now.
    NotNow(&'static str),
}

/// What a message says of the task that it comes from or goes to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    /// It registered with its agent, or spoke.
    Executor,
    /// A framework takes it for one.
    Task,
}

#[derive(Debug)]
struct Spoken {
    owner: FrameworkUid,
    is_executor: bool,
}

/// Somebody else sets where a framework works.
#[derive(Debug)]
struct Move {
    position: FrameworkPosition,
    by: String,
    answer: oneshot::Sender<Result<(), StoreError>>,
}

/// An open session.
#[derive(Debug, Clone)]
struct Open {
    outlet: Outlet,
    /// Who opened it.
    by: Arc<Identity>,
    /// It can dial agents.
    direct: bool,
    mailbox: Arc<Mailbox>,
    moves: mpsc::Sender<Move>,
    /// For calls that come over HTTP.
    calls: mpsc::Sender<wire::Call>,
    /// Ends it.
    cut: CancellationToken,
}

/// Running a framework in a namespace.
fn session_in<'a>(namespace: Option<&'a str>, name: Option<&'a str>) -> Asked<'a> {
    auth::stream(("frameworks", "session"), namespace, name)
}

/// Every framework's session.
#[derive(Debug)]
pub struct Frameworks {
    context: Arc<Context>,
    scheduler: schedule::Handle,
    agents: Arc<super::Sessions>,
    tasks: TaskTracker,
    open: Mutex<HashMap<FrameworkUid, Open>>,
    /// Sessions by the id that their frameworks were told.
    by_session: Mutex<HashMap<String, FrameworkUid>>,
    next_session: AtomicU64,
    /// Tasks that messages went to or came from, until they end.
    spoken: Mutex<HashMap<String, Spoken>>,
    roster: roster::Roster,
    doors: direct::Doors,
}

impl Frameworks {
    /// Nobody is connected. Sessions run on `tasks` and end with `context.stop`.
    #[must_use]
    pub fn new(
        context: Arc<Context>,
        scheduler: schedule::Handle,
        agents: Arc<super::Sessions>,
        tasks: TaskTracker,
    ) -> Self {
        Frameworks {
            context,
            scheduler,
            agents,
            tasks,
            open: Mutex::default(),
            by_session: Mutex::default(),
            next_session: AtomicU64::new(1),
            spoken: Mutex::default(),
            roster: roster::Roster::default(),
            doors: direct::Doors::default(),
        }
    }

    fn session_number(&self) -> u64 {
        self.next_session.fetch_add(1, Ordering::Relaxed)
    }

    pub(crate) fn roster(&self) -> &roster::Roster {
        &self.roster
    }

    /// Whether the framework has a session.
    #[must_use]
    pub fn is_connected(&self, uid: &str) -> bool {
        lock(&self.open).contains_key(uid)
    }

    /// Whether this is the framework's present session.
    fn is_session(&self, uid: &str, number: u64) -> bool {
        lock(&self.open).get(uid).is_some_and(|open| open.outlet.session() == number)
    }

    /// Takes a session in; an earlier one of the same framework ends.
    fn connect(&self, uid: &FrameworkUid, session_id: &str, open: Open) {
        lock(&self.by_session).insert(session_id.to_owned(), Arc::clone(uid));
        if let Some(earlier) = lock(&self.open).insert(Arc::clone(uid), open) {
            earlier.cut.cancel();
        }
    }

    /// A session has ended. True: the framework has no other.
    fn disconnect(&self, uid: &FrameworkUid, session_id: &str, number: u64) -> bool {
        lock(&self.by_session).remove(session_id);
        let mut open = lock(&self.open);
        let is_it = open.get(uid).is_some_and(|o| o.outlet.session() == number);
        if is_it {
            open.remove(uid);
        }
        is_it
    }

    /// Ends a framework's session.
    pub fn cut(&self, uid: &str) {
        if let Some(open) = lock(&self.open).get(uid) {
            open.cut.cancel();
        }
    }

    pub(crate) fn put_update(&self, uid: &str, update: wire::Update) {
        if let Some(open) = lock(&self.open).get(uid) {
            open.mailbox.put(update);
        }
    }

    /// Sets where a framework works, and tells it. None: it is away.
    pub(crate) async fn set_position(
        &self,
        uid: &str,
        position: FrameworkPosition,
        by: String,
    ) -> Option<Result<(), StoreError>> {
        let moves = lock(&self.open).get(uid)?.moves.clone();
        let (answer, answered) = oneshot::channel();
        moves.send(Move { position, by, answer }).await.ok()?;
        answered.await.ok()
    }

    /// Tells a framework something. Lost when it is away.
    pub(crate) fn say(&self, uid: &str, event: wire::event::Event) {
        if let Some(open) = lock(&self.open).get(uid) {
            open.outlet.say(event);
        }
    }

    /// Tells every framework something.
    pub(crate) fn say_to_all(&self, event: &wire::event::Event) {
        for open in lock(&self.open).values() {
            open.outlet.say(event.clone());
        }
    }

    /// What every framework is offered now.
    pub(crate) async fn look(&self, depth: Depth) -> Vec<View> {
        let (answer, answered) = oneshot::channel();
        match self.scheduler.desk(Request::Look { depth, answer }).await {
            Ok(()) => answered.await.unwrap_or_default(),
            // The controller ends.
            Err(_) => Vec::new(),
        }
    }

    /// Forgets a framework whose object is gone.
    pub(crate) async fn remove(&self, uid: &str) {
        // The desk ends only with the controller.
        let _ = self.scheduler.desk(Request::Remove { uid: uid.into() }).await;
        lock(&self.spoken).retain(|_, spoken| *spoken.owner != *uid);
        self.nobody_dials(&uid.into());
    }

    /// From an executor of a node's agent to its framework. At most once: lost when the framework is away.
    pub(crate) fn take_from_executor(&self, node: &NodeName, message: AgentMessage) {
        let owner = self.owner_on(node, &message.executor, Role::Executor);
        let Some(owner) = owner else {
            tracing::warn!(%node, executor = message.executor, "a message of no framework's executor is dropped");
            return;
        };
        let AgentMessage { executor, data, mark } = message;
        if mark == 0 {
            direct::count("from_executor");
        } else if !lock(&self.open).get(&*owner).is_some_and(|open| open.direct) {
            // It was meant for a session before this one, which could dial.
            return;
        }
        let message = wire::Message { executor, node: node.to_string(), data, mark };
        if mark != 0 {
            // What comes after it goes another way: without it nothing would.
            return self.say(&owner, wire::event::Event::Message(message));
        }
        let outlet = lock(&self.open).get(&*owner).map(|open| open.outlet.clone());
        if outlet.is_some_and(|outlet| !outlet.relay(message)) {
            tracing::warn!(%node, framework = %owner, "a message is lost: the framework does not keep up");
        }
    }

    /// Those of a node's executors that are a framework's.
    pub(crate) fn executors_on(&self, node: &NodeName, uids: &[String]) -> Vec<Executor> {
        let executor = |uid: &String| {
            let framework = self.owner_on(node, uid, Role::Executor)?;
            let (_, key) = self.agents.board().find(uid)?;
            Some(Executor { uid: TaskUid::new(uid.as_str()), name: (*key.name).into(), framework })
        };
        uids.iter().filter_map(executor).collect()
    }

    /// The framework of a task on this node; remembered while it lives, so that a stream of messages reads no objects.
    fn owner_on(&self, node: &NodeName, uid: &str, role: Role) -> Option<FrameworkUid> {
        let (placed_on, key) = self.agents.board().find(uid)?;
        if placed_on != *node {
            return None;
        }
        // Locked while the store is asked: whoever forgets it looks after the store has said that it ended.
        let mut all = lock(&self.spoken);
        if let Some(spoken) = all.get_mut(uid) {
            spoken.is_executor |= role == Role::Executor;
            return Some(Arc::clone(&spoken.owner));
        }
        let task: Task = objects::read(&*self.context.store.get(&key)?)?;
        let owner = owner_of(&task.metadata)?;
        if objects::uid_of(&task.metadata) == uid
            && task.status.is_some_and(|status| status.phase.holds_node())
        {
            let is_executor = role == Role::Executor;
            all.insert(uid.to_owned(), Spoken { owner: Arc::clone(&owner), is_executor });
        }
        Some(owner)
    }

    /// To an executor. At most once: lost when its node is away.
    fn send_to_executor(&self, framework: &str, message: wire::Message) -> Result<(), Unsent> {
        let uid = &message.executor;
        let found = self.agents.board().find(uid);
        let (node, _) = found.ok_or(Unsent::NoExecutor("there is no such executor"))?;
        let owner = self.owner_on(&node, uid, Role::Task);
        if owner.is_none_or(|owner| *owner != *framework) {
            return Err(Unsent::NoExecutor("the executor is another framework's"));
        }
        let connection = self.agents.connection(&node);
        let connection = connection.ok_or(Unsent::NotNow("its node is not connected"))?;
        let wire::Message { executor, data, mark, .. } = message;
        if mark == 0 {
            direct::count("to_executor");
        }
        connection.relay.send(AgentMessage { executor, data, mark }).map_err(|lost| {
            Unsent::NotNow(match lost {
                Lost::NoWay => "its node takes no messages at the moment",
                Lost::TooMuch => "its node does not keep up with what it is sent",
            })
        })
    }

    /// A task has ended. Says whether it was an executor.
    pub(crate) fn forget_executor(&self, uid: &str) -> bool {
        let spoken = lock(&self.spoken).remove(uid);
        self.not_dialled(uid);
        spoken.is_some_and(|spoken| spoken.is_executor)
    }

    /// Whether somebody may run a framework, wherever that is. Its first call says where, and is held to that.
    fn admit(&self, asker: &Asker) -> Result<(), Failure> {
        let places = match &asker.who {
            Who::User(held) => held.iter().map(|grant| grant.namespace.clone()).collect(),
            Who::Admin | Who::Node(_) | Who::Nobody => Vec::new(),
        };
        let may = |place: &Option<String>| asker.may(&session_in(place.as_deref(), None));
        match places.iter().any(may) {
            true => Ok(()),
            false => asker.needs(&session_in(None, None)),
        }
    }

    fn calls_of(&self, session_id: &str, who: &Identity) -> Option<mpsc::Sender<wire::Call>> {
        let uid = lock(&self.by_session).get(session_id).cloned()?;
        lock(&self.open).get(&uid).filter(|open| open.by.is(who)).map(|open| open.calls.clone())
    }
}
