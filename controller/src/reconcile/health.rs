//! Marks nodes that fall silent, and their tasks, and nothing else.
//!
//! The first of the three clocks (DESIGN §5): after [`DETECT_AFTER`] without a heartbeat the node's
//! Ready condition becomes Unknown and its tasks' phase Unknown. Reservations and leases stay: what
//! runs there may still run. A node comes back through its session (see [`crate::session`]).

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use futures::future::join_all;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{MicroTime, Time};
use muster_api::condition::{self, Condition, ConditionStatus, set_condition};
use muster_api::kind::application::Application;
use muster_api::kind::node::{Node, NodeStatus};
use muster_api::kind::task::Task;
use muster_api::name::NodeName;
use muster_api::phase::TaskPhase;
use muster_controller_core::node_health::HEARTBEAT_EVERY;
use tokio::time::Instant;

use super::RETRY;
use crate::context::Context;
use crate::objects::{self, APPLICATIONS, NODES};
use crate::session::Sessions;
use crate::store::{Op, StoreError};

/// What agents get to reconnect after the controller started, on top of the usual detection time.
/// A restart takes at most this long and must disturb nobody.
const RESTART_GRACE: Duration = Duration::from_secs(3);

/// How long tasks are looked for that were bound to a node while it was marked.
const MARK_FOR: Duration = Duration::from_secs(10);

/// Works until dropped.
pub async fn run(context: Arc<Context>, sessions: Arc<Sessions>) {
    let mut marked = Marked::default();
    marked.mark(&context, &sessions, presume(&context, &sessions)).await;
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
        marked.mark(&context, &sessions, sessions.silent_nodes()).await;
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
    async fn mark(
        &mut self,
        context: &Context,
        sessions: &Sessions,
        lost: Vec<(NodeName, Duration)>,
    ) {
        let nodes: Vec<NodeName> = lost.iter().map(|(node, _)| node.clone()).collect();
        join_all(lost.into_iter().map(|(node, silence)| mark(context, sessions, node, silence)))
            .await;
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

/// Writes of robots with parts away that no controller has heard them since this one began; before anybody can be told
/// anything. What is away is ended by what is known of its robot's silence, and that outlasts however many starts.
///
/// # Errors
/// When the store fails.
pub async fn doubt(context: &Context) -> Result<(), StoreError> {
    let now = MicroTime(context.clock.now());
    let homes = homes_of_what_is_away(context).into_iter();
    let homes = homes.filter_map(|home| context.store.get(&objects::node_key(&home)));
    let doubts: Vec<Op> = homes
        .filter_map(|stored| {
            let mut node: Node = objects::read(&stored)?;
            let status = node.status.as_mut().filter(|status| was_heard(status))?;
            if status.unheard_since.is_some() {
                return None;
            }
            status.unheard_since = Some(now.clone());
            Some(objects::replace(&stored, &node))
        })
        .collect();
    if !doubts.is_empty() {
        // Nobody else writes yet.
        context.store.apply(doubts).await?;
    }
    Ok(())
}

fn homes_of_what_is_away(context: &Context) -> BTreeSet<String> {
    let all = context.store.list(APPLICATIONS, None).items;
    let all = all.iter().filter_map(|stored| objects::read::<Application>(stored));
    all.filter(is_away).map(|application| application.spec.home).collect()
}

fn is_away(application: &Application) -> bool {
    let parts = application.status.iter().flat_map(|status| &status.parts);
    parts.flat_map(|part| part.tasks()).any(|task| task.scale != application.spec.home)
}

/// As far as it is written down, its agent was there.
fn was_heard(status: &NodeStatus) -> bool {
    let ready = status.condition(condition::READY);
    ready.is_some_and(|ready| ready.status != ConditionStatus::Unknown)
}

/// Nodes that were there before a restart count as heard a little after now. Gives those that do not, as they did so at an
/// earlier start and have not been heard since, with their silence.
fn presume(context: &Context, sessions: &Sessions) -> Vec<(NodeName, Duration)> {
    let now = context.clock.now();
    let mut silent = Vec::new();
    for stored in context.store.list(NODES, None).items {
        let Some(node) = objects::read::<Node>(&stored) else { continue };
        let (Some(status), Ok(name)) = (&node.status, NodeName::new(&*stored.key.name)) else {
            continue;
        };
        if !was_heard(status) {
            continue;
        }
        // A date that was set back tells nothing.
        let unheard = status.unheard_since.as_ref();
        let unheard = unheard.map(|since| Duration::try_from(now.duration_since(since.0)));
        match unheard.unwrap_or(Ok(Duration::ZERO)) {
            Ok(silence) if silence < RESTART_GRACE => {
                sessions.presume_heard(&name, RESTART_GRACE - silence);
            }
            silence => silent.push((name, silence.unwrap_or_default())),
        }
    }
    silent
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

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use muster_api::kind::application::{ApplicationSpec, ApplicationStatus};
    use muster_api::kind::application::{AttemptStatus, PartStatus};
    use muster_api::kind::node::{NodeKind, NodeSpec};

    use super::*;
    use crate::store::{Key, memory};

    async fn node(context: &Context, name: &str, status: ConditionStatus) {
        let mut node = Node::new(name, NodeSpec::new(NodeKind::Robot));
        objects::stamp_new(&mut node.metadata, context.clock.now());
        let ready = Condition::new(condition::READY, status, "Said", String::new());
        node.status.get_or_insert_default().conditions.push(ready);
        let create = objects::create(objects::node_key(name), &node);
        context.store.apply_one(create).await.expect("it is new");
    }

    async fn application(context: &Context, home: &str, scale: &str) {
        let name = format!("of-{home}");
        let spec = serde_json::json!({"home": home, "parts": []});
        let spec: ApplicationSpec = serde_json::from_value(spec).expect("a spec");
        let mut application = Application::new(&name, spec);
        objects::stamp_new(&mut application.metadata, context.clock.now());
        let task = AttemptStatus { scale: scale.to_owned(), ..AttemptStatus::default() };
        let part = PartStatus { task: Some(task), ..PartStatus::default() };
        application.status = Some(ApplicationStatus { parts: vec![part], ..Default::default() });
        let key = Key::namespaced(APPLICATIONS, "default", &*name);
        let create = objects::create(key, &application);
        context.store.apply_one(create).await.expect("it is new");
    }

    fn unheard(context: &Context, name: &str) -> Option<Timestamp> {
        let stored = context.store.get(&objects::node_key(name)).expect("it is there");
        let node: Node = objects::read(&stored).expect("it is a Node");
        node.status.and_then(|status| status.unheard_since).map(|since| since.0)
    }

    #[tokio::test(start_paused = true)]
    async fn a_robot_with_parts_away_is_given_up_a_fixed_time_after_the_first_of_many_starts() {
        let dir = tempfile::tempdir().expect("a directory");
        let context = crate::context::for_tests(dir.path(), memory::start().await);
        for (name, ready, scale) in [
            ("away", ConditionStatus::True, "server"),
            ("stray", ConditionStatus::False, "server"),
            ("home", ConditionStatus::True, "home"),
            ("lost", ConditionStatus::Unknown, "server"),
        ] {
            node(&context, name, ready).await;
            application(&context, name, scale).await;
        }
        doubt(&context).await.expect("it is written");
        let first = ["away", "stray", "home", "lost"].map(|name| unheard(&context, name));
        assert_eq!(first.map(|since| since.is_some()), [true, true, false, false]);
        let sessions = Sessions::default();
        assert_eq!(presume(&context, &sessions), []);
        let heard = ["away", "stray", "home", "lost"]
            .map(|name| sessions.is_heard(&NodeName::new(name).expect("a name")));
        assert_eq!(heard, [true, true, true, false]);

        // It is killed, and started so late that the robot should have been heard meanwhile.
        let key = objects::node_key("away");
        let long_ago = context.clock.now() - RESTART_GRACE;
        objects::change(&context.store, &key, |stored, mut node: Node| {
            node.status.as_mut()?.unheard_since = Some(MicroTime(long_ago));
            Some(vec![objects::replace(stored, &node)])
        })
        .await
        .expect("it is written");
        doubt(&context).await.expect("nothing is to be written");
        let kept = unheard(&context, "away").expect("it is doubted still");
        assert_eq!(kept.as_microsecond(), long_ago.as_microsecond(), "the first start counts");
        let silent = presume(&context, &Sessions::default());
        let names: Vec<&str> = silent.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["away"]);
        assert!(silent[0].1 >= RESTART_GRACE);
    }
}
