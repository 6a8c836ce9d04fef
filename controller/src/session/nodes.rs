//! What an agent says of its node → the Node object.
//!
//! The agent owns labels, capacity, functions, pose, runtimes and its own conditions; the operator
//! owns `spec` (but for what the agent said when it joined first); the controller owns Ready and the
//! books.

use std::sync::Arc;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{MicroTime, Time};
use muster_api::condition::{self, Condition, ConditionStatus, set_condition};
use muster_api::id::Incarnation;
use muster_api::kind::lease::{DEFAULT_GROUP, Lease, LeaseSpec, LeaseStatus};
use muster_api::kind::node::{Node, NodeKind, NodeStatus};
use muster_api::name::NodeName;
use muster_api::wire::agent_session::NodeReport;

use crate::context::Context;
use crate::objects;
use crate::reconcile::images;
use crate::rest::enrol;
use crate::store::{Op, StoreError, Stored};

/// Reason of Ready=False: what should not run there does.
pub(crate) const STRAY_TASKS: &str = "StrayTasks";

/// What a session says of its agent.
#[derive(Debug, Clone)]
pub(crate) struct Speaker {
    pub(crate) node: NodeName,
    /// The key of its certificate.
    pub(crate) key: String,
    pub(crate) incarnation: Incarnation,
    pub(crate) version: String,
}

/// Why an agent's word about its node is not taken.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NodeError {
    #[error(
        "node {node} joined as a {was:?} and now says that it is a {says:?}; delete the node, or correct the agent's --kind"
    )]
    KindChanged { node: NodeName, was: NodeKind, says: NodeKind },
    #[error(
        "there is no node {node}: it was deleted, and its certificate with it; to take it in again make a token (`muster token create --node {node}`) and start its agent with it"
    )]
    Deleted { node: NodeName },
    #[error(
        "the certificate is not that of node {node}'s agent: the node was registered anew, or another agent has joined in its place; `muster token create --node {node}` makes a token with which this agent may join again"
    )]
    OtherAgent { node: NodeName },
    #[error("a later session of node {node} has begun")]
    Replaced { node: NodeName },
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// The Node for which the agent with this key may speak.
pub(crate) fn admit(
    context: &Context,
    name: &NodeName,
    key: &str,
) -> Result<(Arc<Stored>, Node), NodeError> {
    let stored = context.store.get(&objects::node_key(name.as_str()));
    let node = stored.and_then(|s| objects::read::<Node>(&s).map(|node| (s, node)));
    let (stored, node) = node.ok_or_else(|| NodeError::Deleted { node: name.clone() })?;
    if !enrol::is_agent_of(&node, key) {
        return Err(NodeError::OtherAgent { node: name.clone() });
    }
    Ok((stored, node))
}

/// Writes what an agent says of its node, while the session `is_newest`; gives the Node's uid. Ready becomes true, unless it
/// runs `strays`.
pub(crate) async fn write(
    context: &Context,
    speaker: &Speaker,
    report: &NodeReport,
    strays: &[String],
    is_newest: impl Fn() -> bool,
) -> Result<Box<str>, NodeError> {
    loop {
        let (stored, mut node) = admit(context, &speaker.node, &speaker.key)?;
        // At every try, after reading: what a later session has written since is not written over.
        if !is_newest() {
            return Err(NodeError::Replaced { node: speaker.node.clone() });
        }
        if node.spec.kind != report.kind {
            return Err(NodeError::KindChanged {
                node: speaker.node.clone(),
                was: node.spec.kind,
                says: report.kind,
            });
        }
        let before = node.clone();
        fill(context, speaker, report, &mut node);
        judge(node.status.get_or_insert_default(), strays, context.clock.now());
        let mut ops = Vec::new();
        // What its agent said before may be written after all, and is not what it says now.
        ops.push(match node == before {
            true => objects::unchanged(&stored),
            false => objects::replace(&stored, &node),
        });
        ops.extend(free_lease(context, speaker, report));
        match context.store.apply(ops).await {
            Ok(_) => {
                images::tell(context, &before, &node);
                return Ok(stored.uid.clone());
            }
            Err(error) if objects::is_race(&error) => tokio::task::yield_now().await,
            Err(error) => return Err(error.into()),
        }
    }
}

/// The Lease object of a robot's actuators, so that a free robot can be seen to be free.
fn free_lease(context: &Context, speaker: &Speaker, report: &NodeReport) -> Option<Op> {
    let key = objects::lease_key(speaker.node.as_str(), DEFAULT_GROUP);
    if report.actuators.is_empty() {
        return None;
    }
    let spec = LeaseSpec {
        node: speaker.node.to_string(),
        group: DEFAULT_GROUP.to_owned(),
        actuators: report.actuators.clone(),
    };
    let Some(stored) = context.store.get(&key) else {
        let mut lease = Lease::new(&key.name, spec);
        objects::stamp_new(&mut lease.metadata, context.clock.now());
        lease.status = Some(LeaseStatus::default());
        return Some(objects::create(key, &lease));
    };
    let mut lease: Lease = objects::read(&stored)?;
    if lease.spec == spec {
        return None;
    }
    lease.spec = spec;
    Some(objects::replace(&stored, &lease))
}

fn fill(context: &Context, speaker: &Speaker, report: &NodeReport, node: &mut Node) {
    let now = context.clock.now();
    node.metadata.labels.get_or_insert_default().extend(report.labels.clone());
    if node.spec.speed.is_none() {
        node.spec.speed = report.speed;
    }
    let status = node.status.get_or_insert_default();
    status.capacity = report.capacity.clone();
    status.allocatable = report.allocatable.clone();
    if status.used == muster_api::resource::Compute::default() {
        // Nothing is reserved: all of it is free. From then on the books say what is.
        status.free = report.allocatable.clone();
    }
    status.sensors = report.sensors.clone();
    status.actuators = report.actuators.clone();
    status.runtimes = report.runtimes.clone();
    status.incarnation = Some(speaker.incarnation.clone());
    status.agent_version.clone_from(&speaker.version);
    status.address.clone_from(&report.address);
    status.battery = report.battery;
    status.mission_locks.clone_from(&report.mission_locks);
    status.estop.clone_from(&report.estop);
    status.images.clone_from(&report.images);
    if let Some(pose) = &report.pose
        && status
            .pose
            .as_ref()
            .is_none_or(|old| old.source != pose.source || !old.view().is_at(&pose.view()))
    {
        status.pose = Some(pose.clone());
    }
    for condition in &report.conditions {
        set_condition(&mut status.conditions, condition.clone(), &Time(now));
    }
    let said: Vec<&str> = report.conditions.iter().map(|c| c.r#type.as_str()).collect();
    let ours = [condition::READY, condition::FENCED, condition::BATTERY, condition::MAINTENANCE];
    status.conditions.retain(|c| ours.iter().chain(&said).any(|known| *known == c.r#type.as_str()));
}

/// What the controller says of a node whose agent is connected and runs `strays`.
fn judge(status: &mut NodeStatus, strays: &[String], now: jiff::Timestamp) {
    status.unheard_since = None;
    let fenced = status.condition(condition::FENCED);
    let fenced = fenced.is_some_and(|c| c.status == ConditionStatus::True);
    let conditions = &mut status.conditions;
    let mut set = |r#type: &str, holds: bool, reason: &str, message: String| {
        let condition = Condition::new(r#type, holds, reason, message);
        set_condition(conditions, condition, &Time(now))
    };
    let news = if strays.is_empty() {
        if fenced {
            let message = "its agent is back, and nothing is left of what ran before".to_owned();
            set(condition::FENCED, false, "NothingLeft", message);
        }
        set(condition::READY, true, "AgentReady", "its agent is connected".to_owned())
    } else {
        let names = strays.join(", ");
        let message = format!(
            "its agent runs what it should not, and is told to stop it: {names}; nothing new begins there until that has ended"
        );
        set(condition::READY, false, STRAY_TASKS, message)
    };
    if news {
        status.last_seen = Some(MicroTime(now));
    }
}

/// Writes that the strays of a connected agent are others than before, while the session `is_newest`.
pub(crate) async fn write_strays(
    context: &Context,
    node: &NodeName,
    strays: &[String],
    is_newest: impl Fn() -> bool,
) -> Result<(), StoreError> {
    let key = objects::node_key(node.as_str());
    objects::change(&context.store, &key, |stored, mut object: Node| {
        if !is_newest() {
            return None;
        }
        let before = object.clone();
        judge(object.status.get_or_insert_default(), strays, context.clock.now());
        (object != before).then(|| vec![objects::replace(stored, &object)])
    })
    .await
    .map(drop)
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::pin::pin;
    use std::sync::atomic::{AtomicBool, Ordering};

    use muster_api::kind::node::NodeSpec;
    use muster_api::kind::node::estop::{EStopStatus, EStopTier};
    use muster_api::resource::Compute;

    use super::*;
    use crate::store::{Key, Store, memory};

    fn report(estop: Option<EStopStatus>) -> NodeReport {
        NodeReport {
            kind: NodeKind::Robot,
            labels: std::collections::BTreeMap::new(),
            capacity: Compute::default(),
            allocatable: Compute::default(),
            sensors: Vec::new(),
            actuators: Vec::new(),
            pose: None,
            runtimes: Vec::new(),
            conditions: Vec::new(),
            speed: None,
            address: String::new(),
            battery: None,
            mission_locks: Vec::new(),
            estop,
            images: Vec::new(),
        }
    }

    fn cut() -> Option<EStopStatus> {
        Some(EStopStatus { tier: EStopTier::Cut, ..EStopStatus::default() })
    }

    /// A Node in a store, and who speaks for it.
    struct Robot {
        context: Arc<Context>,
        key: Key,
        speaker: Speaker,
    }

    impl Robot {
        async fn new(dir: &Path, store: Store) -> Robot {
            let context = crate::context::for_tests(dir, store);
            let mut node = Node::new("r1", NodeSpec::new(NodeKind::Robot));
            objects::stamp_new(&mut node.metadata, context.clock.now());
            node.status.get_or_insert_default().agent_keys = vec!["key".to_owned()];
            let key = objects::node_key("r1");
            context.store.apply_one(objects::create(key.clone(), &node)).await.expect("it is new");
            let speaker = Speaker {
                node: NodeName::new("r1").expect("a name"),
                key: "key".to_owned(),
                incarnation: Incarnation::new("1".to_owned()),
                version: String::new(),
            };
            Robot { context, key, speaker }
        }

        async fn says(
            &self,
            estop: Option<EStopStatus>,
            is_newest: impl Fn() -> bool,
        ) -> Result<Box<str>, NodeError> {
            write(&self.context, &self.speaker, &report(estop), &[], is_newest).await
        }

        /// What is on the disk.
        async fn estop(&self) -> Option<EStopStatus> {
            self.context.store.settled().await.expect("the disk answers");
            let stored = self.context.store.get(&self.key).expect("it is there");
            objects::read::<Node>(&stored).and_then(|node| node.status?.estop)
        }
    }

    #[tokio::test]
    async fn what_seemed_to_fail_and_is_there_all_the_same_is_not_what_stands_at_the_end() {
        let (store, failures) = memory::start_failing().await;
        let dir = tempfile::tempdir().expect("a directory");
        let robot = Robot::new(dir.path(), store).await;
        robot.says(cut(), || true).await.expect("the disk is well");
        // Its gate is gone for a moment; the write seems to fail, and it says anew how it is.
        failures.mislead_next(1);
        assert!(robot.says(None, || true).await.is_err());
        robot.says(cut(), || true).await.expect("the disk is well");
        assert_eq!(robot.estop().await, cut());
    }

    #[tokio::test]
    async fn what_an_earlier_session_still_writes_is_not_what_stands_at_the_end() {
        let dir = tempfile::tempdir().expect("a directory");
        let robot = Robot::new(dir.path(), memory::start().await).await;
        let store = &robot.context.store;
        let books = objects::change(store, &robot.key, |stored, mut node: Node| {
            node.spec.unschedulable = true;
            Some(vec![objects::replace(stored, &node)])
        });
        let is_newest = AtomicBool::new(true);
        let earlier = robot.says(None, || is_newest.load(Ordering::Relaxed));
        let (mut books, mut earlier) = (pin!(books), pin!(earlier));
        assert!(futures::poll!(&mut books).is_pending(), "it is queued");
        assert!(futures::poll!(&mut earlier).is_pending(), "and this behind it");
        is_newest.store(false, Ordering::Relaxed);
        robot.says(cut(), || true).await.expect("the disk is well");
        books.await.expect("it was first");
        let said = earlier.await;
        assert!(matches!(said, Err(NodeError::Replaced { .. })), "{said:?}");
        assert_eq!(robot.estop().await, cut());
    }
}
