//! Marks nodes that fall silent, and their tasks, and nothing else.
//!
//! The first of the three clocks (DESIGN §5): after [`DETECT_AFTER`] without a heartbeat the node's
//! Ready condition becomes Unknown and its tasks' phase Unknown. Reservations and leases stay: what
//! runs there may still run. A node comes back through its session (see [`crate::session`]).

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use futures::future::join_all;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{MicroTime, Time};
use muster_api::condition::{self, Condition, ConditionStatus, set_condition};
use muster_api::kind::node::Node;
use muster_api::kind::task::Task;
use muster_api::name::NodeName;
use muster_api::phase::TaskPhase;
use muster_controller_core::node_health::HEARTBEAT_EVERY;
use tokio::time::Instant;

use super::RETRY;
use crate::context::Context;
use crate::objects::{self, NODES};
use crate::session::Sessions;
use crate::store::StoreError;

/// What agents get to reconnect after the controller started, on top of the usual detection time.
/// A restart takes at most this long and must disturb nobody.
const RESTART_GRACE: Duration = Duration::from_secs(3);

/// How long tasks are looked for that were bound to a node while it was marked.
const MARK_FOR: Duration = Duration::from_secs(10);

/// Works until dropped.
pub async fn run(context: Arc<Context>, sessions: Arc<Sessions>) {
    presume(&context, &sessions);
    let mut marked = Marked::default();
    loop {
        let deadline = sessions.next_silence();
        tokio::select! {
            () = until(deadline) => {}
            () = until(marked.next()) => {
                marked.look(&context, &sessions).await;
                continue;
            }
            // The first deadline is another one now.
            () = sessions.health_changed() => continue,
        }
        // This process stood still, or the machine: what agents said meanwhile lies in their sockets, and is read first.
        if deadline.is_some_and(|deadline| deadline.elapsed() > HEARTBEAT_EVERY / 2) {
            tokio::time::sleep(HEARTBEAT_EVERY).await;
        }
        let lost = sessions.silent_nodes();
        let nodes: Vec<NodeName> = lost.iter().map(|(node, _)| node.clone()).collect();
        join_all(lost.into_iter().map(|(node, silence)| mark(&context, &sessions, node, silence)))
            .await;
        marked.add(nodes);
    }
}

async fn until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline).await,
        None => std::future::pending().await,
    }
}

/// Nodes that were just marked: a task may have been bound while that was written, and a bind whose fate was not known may
/// be found on the disk later.
#[derive(Debug, Default)]
struct Marked(BTreeMap<NodeName, Instant>);

impl Marked {
    fn add(&mut self, nodes: Vec<NodeName>) {
        let until = Instant::now() + MARK_FOR;
        self.0.extend(nodes.into_iter().map(|node| (node, until)));
    }

    fn next(&self) -> Option<Instant> {
        (!self.0.is_empty()).then(|| Instant::now() + RETRY)
    }

    async fn look(&mut self, context: &Context, sessions: &Sessions) {
        let now = Instant::now();
        self.0.retain(|node, until| *until > now && !sessions.is_heard(node));
        for node in self.0.keys() {
            if let Err(error) = mark_tasks(context, sessions, node).await {
                let error = crate::app::chain(&error);
                tracing::warn!(%node, error, "tasks of a silent node are not marked yet");
            }
        }
    }
}

/// Nodes that were ready before a restart count as heard a little after now.
fn presume(context: &Context, sessions: &Sessions) {
    for stored in context.store.list(NODES, None).items {
        let Some(node) = objects::read::<Node>(&stored) else { continue };
        let ready = node.status.as_ref().is_some_and(muster_api::kind::node::NodeStatus::is_ready);
        if let (true, Ok(name)) = (ready, NodeName::new(&*stored.key.name)) {
            sessions.presume_heard(&name, RESTART_GRACE);
        }
    }
}

async fn mark(context: &Context, sessions: &Sessions, node: NodeName, silence: Duration) {
    tracing::warn!(%node, ?silence, "node is silent");
    while let Err(error) = mark_once(context, sessions, &node, silence).await {
        tracing::warn!(%node, error = crate::app::chain(&error), "a silent node is not marked yet");
        tokio::time::sleep(RETRY).await;
    }
    // It came back while a write of ours was on its way to the disk, so something may say "silent" of a
    // node that is there. Only a new Hello tells everything anew.
    if sessions.is_heard(&node) {
        sessions.kick(&node);
    }
}

async fn mark_once(
    context: &Context,
    sessions: &Sessions,
    node: &NodeName,
    silence: Duration,
) -> Result<(), StoreError> {
    let now = context.clock.now();
    let heard = now.checked_sub(silence).unwrap_or(now);
    let changed = objects::change(
        &context.store,
        &objects::node_key(node.as_str()),
        |stored, mut object: Node| {
            // It may have come back while this waited for the store.
            if sessions.is_heard(node) {
                return None;
            }
            let status = object.status.get_or_insert_default();
            status.last_seen = Some(MicroTime(heard));
            let condition = Condition::new(
                condition::READY,
                ConditionStatus::Unknown,
                "AgentSilent",
                format!("its agent has not been heard since {heard:.0}"),
            );
            set_condition(&mut status.conditions, condition, &Time(now));
            Some(vec![objects::replace(stored, &object)])
        },
    )
    .await?;
    if changed.is_none() {
        return Ok(());
    }
    context.events.warn_node(
        node.as_str(),
        "NodeSilent",
        format!("the agent has not been heard for {silence:.1?}"),
    );
    mark_tasks(context, sessions, node).await
}

async fn mark_tasks(
    context: &Context,
    sessions: &Sessions,
    node: &NodeName,
) -> Result<(), StoreError> {
    for key in sessions.board().tasks_on(node) {
        objects::change(&context.store, &key, |stored, mut task: Task| {
            let status = task.status.get_or_insert_default();
            let here = status.node.as_deref() == Some(node.as_str());
            if !here
                || !status.phase.holds_node()
                || status.phase == TaskPhase::Unknown
                || sessions.is_heard(node)
            {
                return None;
            }
            status.message = format!("node {node} cannot be reached; it was {}", status.phase);
            status.phase = TaskPhase::Unknown;
            // `ready_at` stays: it is ready again when it is heard again and says so.
            status.ready = status.ready.map(|_| false);
            status.reason = "NodeSilent".to_owned();
            Some(vec![objects::replace(stored, &task)])
        })
        .await?;
    }
    Ok(())
}

/// How long without a heartbeat until a node counts as silent.
pub use muster_controller_core::node_health::DETECT_AFTER;
