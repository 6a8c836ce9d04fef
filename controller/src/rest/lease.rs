//! POST …/leases/NAME/acquire, take, return: a person's hold on a robot's actuators.
//!
//! ```text
//!   core::person::step ──▶ Lease object: next epoch, holder, fence ──▶ orders ──▶ agent ──▶ gate: REVOKED for whoever had it
//!                                                                                  └── NodeState ──▶ the answer
//! ```
//!
//! Acquire and Take are answered when the robot's gate has said that the person's grant counts, whoever held it before: a
//! task that was granted it once may run on and drive until then. From then on the gate refuses every command of such a task,
//! and the robot has been stopped. The task itself runs on, without the actuators.

use std::sync::Arc;
use std::time::Duration;

use http::StatusCode;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use muster_api::condition::{ACTUATORS_FENCED, ConditionStatus, READY};
use muster_api::id::Epoch;
use muster_api::kind::lease::{DEFAULT_GROUP, HolderKind, Lease, LeaseHolder, LeaseSpec};
use muster_api::kind::node::{Node, NodeStatus};
use muster_api::kind::task::Task;
use muster_api::name::NodeName;
use muster_controller_core::person::{self, Outcome, Robot, Step};
use serde::Deserialize;
use serde_json::Value;

use super::path::Object;
use super::{Answer, Call, body, failure::Failure};
use crate::audit::Named;
use crate::context::{Context, Live};
use crate::objects::{self, NODES, TASKS};
use crate::session::Sessions;
use crate::session::nodes::STRAY_TASKS;
use crate::store::{Key, Op, Precondition, Stored};

/// The order goes out at once; a robot on a bad link is given this long to say that its gate counts it.
const TOLD_WITHIN: Duration = Duration::from_secs(10);

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Request {
    /// For those who find the robot taken.
    #[serde(default)]
    reason: String,
}

/// Who does it, and why.
struct Word {
    user: String,
    reason: String,
}

/// What was written.
struct Done {
    stored: Arc<Stored>,
    lease: Lease,
    from: Option<LeaseHolder>,
    changed: bool,
    robot: Robot,
}

pub(super) async fn answer(call: Call, target: Object, step: Step) -> Answer {
    let key = target.key()?;
    let Call { context, request, asker, .. } = call;
    let (parts, body) = request.into_parts();
    let asked: Request = match body::optional_json(&parts.headers, body).await? {
        Value::Null => Request::default(),
        body => body::typed("LeaseRequest", body)?,
    };
    let word = Word { user: asker.identity.name(), reason: asked.reason.trim().to_owned() };
    let live = context.live();
    let live = live.ok_or_else(|| Failure::unavailable("no session service is running"))?;
    let done = carry_out(&context, &live.sessions, (&target, &key), step, &word).await?;
    if done.changed {
        live.sessions.orders().tell_lease(&done.lease, done.stored.revision);
        tell(&context, &done, step, &word);
    }
    // Asked for twice is waited for twice: the first answer may have been lost.
    if step != Step::Return && done.lease.spec.group == DEFAULT_GROUP {
        wait_for_gate(live, &target, &done).await?;
    }
    let mut response = super::raw(StatusCode::OK, done.stored.bytes.clone());
    if let Some(from) = done.from {
        response.extensions_mut().insert(Named {
            kind: Some(format!("{:?}", from.kind)),
            namespace: Some(from.namespace).filter(|namespace| !namespace.is_empty()),
            name: Some(from.name),
            uid: Some(from.uid.to_string()),
        });
    }
    Ok(response)
}

async fn carry_out(
    context: &Context,
    sessions: &Sessions,
    (target, key): (&Object, &Key),
    step: Step,
    word: &Word,
) -> Result<Done, Failure> {
    let (entry, name) = (target.entry, &*key.name);
    loop {
        let stored = context.store.get(key).ok_or_else(|| Failure::not_found(entry, name))?;
        let mut lease: Lease = objects::read(&stored)
            .ok_or_else(|| Failure::internal(format!("lease {name:?} does not read as one")))?;
        let before = lease.status.clone().unwrap_or_default();
        let robot = robot(context, sessions, &lease);
        let outcome = person::step(step, &word.user, &before, &robot).map_err(|refused| {
            let message = format!("lease {name:?}: {refused}");
            Failure::new(StatusCode::CONFLICT, refused.reason(), message).about(entry, name)
        })?;
        let changed = outcome != Outcome::AsItWas;
        let from = match outcome {
            Outcome::AsItWas => None,
            Outcome::Held { mut status, from } => {
                status.acquired = Some(MicroTime(context.clock.now()));
                lease.status = Some(status);
                from
            }
            Outcome::Free { status } => {
                lease.status = Some(status);
                None
            }
        };
        let node = Op::Check {
            key: Key::cluster(NODES, lease.spec.node.as_str()),
            precondition: Precondition::PRESENT,
        };
        let lease_op = match changed {
            true => objects::replace(&stored, &lease),
            // They may have given it back, and were told that this failed.
            false => objects::unchanged(&stored),
        };
        match context.store.apply(vec![node, lease_op]).await {
            Ok(mut written) => {
                let stored = written.pop().unwrap_or(stored);
                return Ok(Done { stored, lease, from, changed, robot });
            }
            Err(error) if objects::is_race(&error) => {
                if context.store.get(&objects::node_key(&lease.spec.node)).is_none() {
                    let message = format!("lease {name:?}: its node is gone");
                    return Err(Failure::new(StatusCode::CONFLICT, "NodeGone", message));
                }
                tokio::task::yield_now().await;
            }
            Err(error) => return Err(Failure::of_store(entry, name, &error)),
        }
    }
}

/// What its robot is able to.
fn robot(context: &Context, sessions: &Sessions, lease: &Lease) -> Robot {
    let name = lease.spec.node.as_str();
    let node = context.store.get(&objects::node_key(name));
    let node = node.and_then(|stored| objects::read::<Node>(&stored));
    let status = node.and_then(|node| node.status);
    let condition = status.as_ref().and_then(|status| status.condition(ACTUATORS_FENCED));
    let unfenced = match condition {
        Some(condition) if condition.status == ConditionStatus::True => None,
        Some(condition) => Some(condition.message.clone()),
        None => Some("no gate stands before its drivers".to_owned()),
    };
    let is_heard = NodeName::new(name).is_ok_and(|name| sessions.is_heard(&name));
    let is_driven = is_driven(context, lease) || status.as_ref().is_some_and(runs_strays);
    Robot { unfenced, is_heard, is_driven }
}

/// What was called off there lives, and nobody knows any more what it was granted.
fn runs_strays(status: &NodeStatus) -> bool {
    status.condition(READY).is_some_and(|ready| ready.reason == STRAY_TASKS)
}

/// Whether a task that has not ended on its node was granted the lease once, held or taken since.
fn is_driven(context: &Context, lease: &Lease) -> bool {
    let node = lease.spec.node.as_str();
    let name = LeaseSpec::object_name(node, &lease.spec.group);
    let tasks = context.store.list(TASKS, None).items;
    let mut there = tasks.iter().filter(|stored| stored.mentions(&name));
    there.any(|stored| {
        let status = objects::read::<Task>(stored).and_then(|task| task.status);
        status.is_some_and(|status| {
            status.node.as_deref() == Some(node)
                && status.phase.holds_node()
                && status.lease.is_some_and(|lease| lease.name == name)
        })
    })
}

/// Returns when the gate has said that the person's grant counts.
async fn wait_for_gate(live: &Live, target: &Object, done: &Done) -> Result<(), Failure> {
    let status = done.lease.status.clone().unwrap_or_default();
    let Ok(node) = NodeName::new(done.lease.spec.node.clone()) else { return Ok(()) };
    let Robot { unfenced, is_heard, is_driven } = &done.robot;
    let has_gate = unfenced.is_none() && *is_heard;
    // Without a gate, or while it is away, nobody got this far whom a task could drive against.
    if !has_gate && !is_driven {
        return Ok(());
    }
    let told = live.sessions.person_counts(&node, status.epoch);
    if tokio::time::timeout(TOLD_WITHIN, told).await.is_ok() {
        return Ok(());
    }
    let name = done.stored.key.name.as_ref();
    Err(Failure::timeout(format!(
        "lease {name:?} is yours (epoch {}), but {node} has not said in {} s that everybody else is refused: take it for one that \
         moves, and ask again",
        status.epoch,
        TOLD_WITHIN.as_secs()
    ))
    .about(target.entry, name))
}

/// What happened stands in the log and under the objects.
fn tell(context: &Context, done: &Done, step: Step, word: &Word) {
    let node = done.lease.spec.node.as_str();
    let epoch = done.lease.status.as_ref().map_or(Epoch(0), |status| status.epoch);
    let why = match word.reason.as_str() {
        "" => String::new(),
        reason => format!(": {reason}"),
    };
    let (reason, did) = match step {
        Step::Acquire => ("LeaseAcquired", "acquired"),
        Step::Take => ("LeaseTaken", "took"),
        Step::Return => ("LeaseReturned", "returned"),
    };
    let from = done.from.as_ref().map(|from| format!(" from {from}")).unwrap_or_default();
    let user = &word.user;
    tracing::warn!(target: "audit", node, user, epoch = epoch.0, reason = word.reason, "{reason}");
    context.events.node(
        node,
        reason,
        format!("{user} {did} the actuators ({}){from}{why}", done.lease.spec.group),
    );
    let Some(from) = done.from.as_ref().filter(|from| from.kind == HolderKind::Task) else {
        return;
    };
    let key = Key::namespaced(TASKS, &*from.namespace, &*from.name);
    let task = context.store.get(&key).filter(|stored| *stored.uid == *from.uid.as_str());
    if let Some(task) = task.and_then(|stored| objects::read::<Task>(&stored)) {
        let message = format!("{user} took the actuators of {node} from it{why}");
        context.events.warn_task(&task, reason, message);
    }
}

#[cfg(test)]
mod tests {
    use muster_api::kind::lease::LeaseStatus;
    use muster_api::kind::node::{NodeKind, NodeSpec};

    use super::super::registry;
    use super::*;
    use crate::objects::LEASES;
    use crate::store::memory;

    #[tokio::test]
    async fn who_is_told_that_a_robot_is_theirs_as_it_was_has_it() {
        let dir = tempfile::tempdir().expect("a directory");
        let (store, failures) = memory::start_failing().await;
        let context = crate::context::for_tests(dir.path(), store);
        let sessions = Sessions::default();
        let mut node = Node::new("r1", NodeSpec::new(NodeKind::Robot));
        objects::stamp_new(&mut node.metadata, context.clock.now());
        let spec = LeaseSpec {
            node: "r1".to_owned(),
            group: DEFAULT_GROUP.to_owned(),
            actuators: Vec::new(),
        };
        let key = objects::lease_key("r1", DEFAULT_GROUP);
        let mut lease = Lease::new(&key.name, spec);
        objects::stamp_new(&mut lease.metadata, context.clock.now());
        lease.status = Some(LeaseStatus::default());
        let ops = vec![
            objects::create(objects::node_key("r1"), &node),
            objects::create(key.clone(), &lease),
        ];
        context.store.apply(ops).await.expect("they are new");
        let target = Object {
            entry: registry::of(LEASES).expect("they are served"),
            namespace: None,
            name: Some(key.name.to_string()),
            subresource: None,
        };
        let word = Word { user: "ada".to_owned(), reason: String::new() };
        let ada = async |step| carry_out(&context, &sessions, (&target, &key), step, &word).await;
        let told = |done: Result<Done, Failure>| {
            let done = done.unwrap_or_else(|failure| panic!("{}", failure.message()));
            (done.changed, done.lease.status.expect("it has one").epoch)
        };
        assert_eq!(told(ada(Step::Acquire).await), (true, Epoch(1)));
        assert_eq!(told(ada(Step::Acquire).await), (false, Epoch(1)));
        failures.mislead_next(1);
        assert!(ada(Step::Return).await.is_err(), "it seems to fail");
        assert_eq!(told(ada(Step::Acquire).await), (true, Epoch(2)), "it was given back");
        let lease: Lease = objects::read(&context.store.get(&key).expect("there")).expect("one");
        let holder = lease.status.and_then(|status| status.holder);
        assert_eq!(holder.map(|holder| holder.name).as_deref(), Some("ada"));
    }
}
