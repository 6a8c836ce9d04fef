//! The sessions of agents: who is connected, what each should run, when each was heard.
//!
//! ```text
//!   agent ──gRPC stream──▶ agents (one task a session) ──reports──▶ status of Tasks and Nodes
//!                              ▲                │ heartbeats
//!   store ──▶ board (what each node should have)│
//!                              health ◀─────────┘ who is silent: reconcile::health
//! ```
//!
//! | module | is |
//! |---|---|
//! | [`agents`] | the gRPC service |
//! | [`board`] | assignments by node, kept up to date from the store |
//! | [`nodes`] | what an agent says of its node → the Node object |
//! | [`reports`] | what an agent says of a task → the Task object and its lease |
//! | [`frameworks`] | the sessions of frameworks |
//! | [`poses`] | where robots are: their agents' word, and streams of a building's localisation |
//! | [`orders`] | emergency stops on their way to agents |
//! | [`relay`] | messages of frameworks on their way to executors |
//! | `strays` | what an agent runs and should not |
//! | `execs` | programs that clients run in tasks: a stream of its own for each |
//! | [`logs`] | logs, asked of the agent that has them |

pub mod agents;
pub mod board;
pub(crate) mod execs;
pub mod frameworks;
pub mod logs;
pub mod nodes;
pub mod orders;
pub mod poses;
pub mod relay;
pub mod reports;
mod strays;

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use muster_api::id::Epoch;
use muster_api::name::NodeName;
use muster_api::wire::agent::v1 as wire;
use muster_controller_core::access::{Who, decide};
use muster_controller_core::node_health::{DETECT_AFTER, Monotonic, NodeHealth};
use tokio::sync::{Notify, RwLock, RwLockReadGuard, RwLockWriteGuard, mpsc, watch};
use tokio::time::Instant;

use tonic::{Request, Status};

use crate::auth::{self, Identity};
use crate::rest::failure::Failure;
use board::Board;
use orders::Orders;

/// The generated server side of the session.
#[allow(clippy::all, clippy::allow_attributes, unreachable_pub, reason = "generated")]
pub(crate) mod proto {
    include!(concat!(env!("OUT_DIR"), "/muster.agent.v1.rs"));
}

/// The node for which the client's certificate speaks, and its key.
fn agent_of<T>(request: &Request<T>) -> Result<(NodeName, String), Status> {
    let Some(Identity::Node { name, key }) = request.extensions().get::<Identity>() else {
        return Err(Status::unauthenticated("a node's client certificate is needed"));
    };
    let who = Who::Node(name.clone());
    let asked = auth::stream(("nodes", "session"), None, Some(name));
    decide(&who, &asked).map_err(|denied| Status::permission_denied(denied.to_string()))?;
    let node = NodeName::new(name.clone())
        .map_err(|error| Status::unauthenticated(format!("the certificate's name {error}")))?;
    Ok((node, key.clone()))
}

/// A refusal of a stream.
fn status_of(failure: &Failure) -> Status {
    match failure.code() {
        401 => Status::unauthenticated(failure.message()),
        _ => Status::permission_denied(failure.message()),
    }
}

/// What tasks and nodes use now, as the last heartbeats said.
pub type UsageTable = HashMap<NodeName, NodeUsage>;

/// What one node said with its last heartbeat.
#[derive(Debug, Clone, Default)]
pub struct NodeUsage {
    /// The whole machine.
    pub node: wire::Usage,
    /// By task uid.
    pub tasks: Vec<wire::TaskUsage>,
    /// Its link to here; none: not measured yet.
    pub link: Option<Link>,
}

/// A node's link to the controller, as its heartbeats measure it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    /// There and back.
    pub round_trip: Duration,
    /// The share of heartbeats that were not answered before the next one, 0 to 1.
    pub late: f64,
}

impl From<wire::Link> for Link {
    fn from(link: wire::Link) -> Self {
        Link {
            round_trip: Duration::from_micros(link.round_trip_usec),
            late: f64::from(link.late_permille.min(1000)) / 1000.0,
        }
    }
}

/// A connected agent.
#[derive(Debug, Clone)]
pub(crate) struct Connection {
    /// Tells this session from a later one of the same node.
    pub(crate) id: u64,
    /// Of the certificate by which it began.
    pub(crate) key: Arc<str>,
    /// Messages to the agent, beside its assignments.
    pub(crate) outbound: mpsc::Sender<wire::ControllerMessage>,
    /// Messages of frameworks to its executors.
    pub(crate) relay: relay::Relay,
    /// Who may exchange messages with its executors directly.
    pub(crate) tickets: watch::Sender<wire::Tickets>,
    /// Logs being read.
    pub(crate) logs: Arc<logs::Readers>,
    /// Ends this session: a later one of the same node has begun.
    pub(crate) replaced: tokio_util::sync::CancellationToken,
    /// This session has ended.
    pub(crate) ended: tokio_util::sync::CancellationToken,
    /// What it said first is in the store.
    pub(crate) written: Arc<AtomicBool>,
}

/// Every session.
#[derive(Debug)]
pub struct Sessions {
    board: Board,
    orders: Orders,
    connections: Mutex<HashMap<NodeName, Connection>>,
    /// Read: a session begins. Written: a person decides over a node that must not begin one meanwhile.
    /// Held over writes to the store only, never while an agent is waited for.
    beginnings: RwLock<()>,
    health: Mutex<NodeHealth>,
    health_changed: Notify,
    usage: Mutex<UsageTable>,
    /// The person's grant that counts at each robot's gate; none: no person's does.
    persons: watch::Sender<HashMap<NodeName, u64>>,
    started: Instant,
}

impl Default for Sessions {
    fn default() -> Self {
        Sessions {
            board: Board::default(),
            orders: Orders::default(),
            connections: Mutex::default(),
            beginnings: RwLock::default(),
            health: Mutex::new(NodeHealth::new(DETECT_AFTER)),
            health_changed: Notify::new(),
            usage: Mutex::default(),
            persons: watch::Sender::default(),
            started: Instant::now(),
        }
    }
}

/// The lock of a table that nothing panics in half way through a change.
fn lock<T>(table: &Mutex<T>) -> MutexGuard<'_, T> {
    table.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Sessions {
    /// What each node should run.
    #[must_use]
    pub fn board(&self) -> &Board {
        &self.board
    }

    /// What agents are told of emergency stops.
    pub(crate) fn orders(&self) -> &Orders {
        &self.orders
    }

    fn now(&self) -> Monotonic {
        self.started.elapsed()
    }

    /// A heartbeat came. True: the node had been silent, or was never heard.
    pub fn heard(&self, node: &NodeName) -> bool {
        let mut health = lock(&self.health);
        let before = health.next_deadline();
        let back = health.heard(node, self.now());
        // Somebody waits for the first deadline. One that was presumed to be there may be silent earlier than presumed.
        if before.is_none_or(|before| health.next_deadline() < Some(before)) {
            self.health_changed.notify_one();
        }
        back
    }

    /// Counts a node as heard `extra` after now, unless it was heard already.
    pub fn presume_heard(&self, node: &NodeName, extra: Duration) {
        lock(&self.health).presume(node, self.now() + extra);
        self.health_changed.notify_one();
    }

    /// The node counts as there.
    #[must_use]
    pub fn is_heard(&self, node: &NodeName) -> bool {
        lock(&self.health).is_alive(node)
    }

    /// Nodes that fell silent since the last call, and for how long.
    pub fn silent_nodes(&self) -> Vec<(NodeName, Duration)> {
        lock(&self.health).lost(self.now())
    }

    /// For how long a node surely has not been heard, whatever dates say.
    #[must_use]
    pub fn silence_of(&self, node: &NodeName) -> Duration {
        lock(&self.health).silence(node, self.now())
    }

    /// When a node can next count as silent.
    #[must_use]
    pub fn next_silence(&self) -> Option<Instant> {
        lock(&self.health).next_deadline().map(|d| self.started + d)
    }

    /// Ready when a node was heard that was not before.
    pub async fn health_changed(&self) {
        self.health_changed.notified().await;
    }

    /// The last usage of every node.
    #[must_use]
    pub fn usage(&self) -> UsageTable {
        lock(&self.usage).clone()
    }

    /// What a task used and told, as its node's last heartbeat said.
    #[must_use]
    pub fn usage_of(&self, node: &NodeName, uid: &str) -> Option<wire::TaskUsage> {
        let usage = lock(&self.usage);
        usage.get(node)?.tasks.iter().find(|task| task.uid == uid).cloned()
    }

    /// How a node's link to here does.
    #[must_use]
    pub fn link(&self, node: &NodeName) -> Option<Link> {
        lock(&self.usage).get(node)?.link
    }

    pub(crate) fn set_usage(&self, node: &NodeName, usage: NodeUsage) {
        lock(&self.usage).insert(node.clone(), usage);
    }

    /// What an agent says of its gate.
    fn set_person_epoch(&self, node: &NodeName, epoch: u64) {
        self.persons.send_if_modified(|persons| match epoch {
            0 => persons.remove(node).is_some(),
            epoch => persons.insert(node.clone(), epoch) != Some(epoch),
        });
    }

    /// Returns when the robot's gate counts this grant to a person, so that nobody else drives. Cancel safe.
    pub(crate) async fn person_counts(&self, node: &NodeName, epoch: Epoch) {
        let counts = |persons: &HashMap<NodeName, u64>| persons.get(node) == Some(&epoch.0);
        // Closed: never, this holds its sender.
        let _ = self.persons.subscribe().wait_for(counts).await;
    }

    pub(crate) fn connection(&self, node: &NodeName) -> Option<Connection> {
        lock(&self.connections).get(node).cloned()
    }

    /// The session with this number is the present one of the node.
    pub(crate) fn is_present(&self, node: &NodeName, session: u64) -> bool {
        self.connection(node).is_some_and(|connection| connection.id == session)
    }

    /// Held while a session begins.
    pub(crate) async fn begin(&self) -> RwLockReadGuard<'_, ()> {
        self.beginnings.read().await
    }

    /// Held while a node is fenced or deleted: no session begins meanwhile.
    pub(crate) async fn hold_back(&self) -> RwLockWriteGuard<'_, ()> {
        self.beginnings.write().await
    }

    /// Whether what the agent said first in its present session is in the store.
    pub(crate) fn is_known(&self, node: &NodeName) -> bool {
        self.connection(node).is_some_and(|connection| connection.written.load(Ordering::Acquire))
    }

    /// Takes a session in; an earlier one of the same node ends.
    pub(crate) fn connect(&self, node: &NodeName, connection: Connection) {
        if let Some(earlier) = lock(&self.connections).insert(node.clone(), connection) {
            earlier.replaced.cancel();
        }
    }

    /// Ends the session of a node, if there is one: the agent dials again and says everything anew.
    pub fn kick(&self, node: &NodeName) {
        if let Some(connection) = self.connection(node) {
            connection.replaced.cancel();
        }
    }

    /// A session has ended. A later one of the same node stays.
    pub(crate) fn disconnect(&self, node: &NodeName, id: u64) {
        let mut connections = lock(&self.connections);
        if connections.get(node).is_some_and(|c| c.id == id) {
            connections.remove(node);
            lock(&self.usage).remove(node);
            // Its gate may have been started anew before it is heard again; the next session says what counts then.
            self.set_person_epoch(node, 0);
        }
    }
}
