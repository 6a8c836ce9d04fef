//! POST …/nodes/NAME/fence: a person confirms that a node is off, or that its processes are gone.
//!
//! What the node's tasks held is given free on that word alone (invariant 1: the other way is the
//! agent's own report), so it is refused while anything says that the node lives. All of it is one
//! transaction: a task never ends without its lease, and none of the node's tasks is left behind. If
//! the person erred, the agent's next session finds strays (see [`crate::session`]), and nothing new
//! begins on the node until they are gone.

use std::sync::Arc;

use http::StatusCode;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{MicroTime, Time};
use muster_api::condition::{self, Condition, ConditionStatus, set_condition};
use muster_api::kind::node::Node;
use muster_api::kind::task::Task;
use muster_api::name::NodeName;
use muster_api::phase::TaskPhase;
use muster_api::validate::Violations;
use serde::Deserialize;
use serde_json::json;

use super::path::Object;
use super::{Answer, Call, body, failure::Failure};
use crate::context::Context;
use crate::objects;
use crate::session::Sessions;
use crate::store::{Op, StoreError, Stored};

/// Why a task ended that was on a fenced node.
const REASON: &str = "NodeFenced";

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Request {
    /// What the person saw.
    reason: String,
    /// Who saw it, when it is not the one who asks.
    #[serde(default)]
    by: Option<String>,
}

/// What a person confirms.
struct Word<'a> {
    node: &'a NodeName,
    /// The identity that asked, and for whom.
    who: String,
    reason: String,
}

pub(super) async fn fence(call: Call, target: Object) -> Answer {
    let key = target.key()?;
    let node = NodeName::new(&*key.name).map_err(|e| Failure::bad_request(e.to_string()))?;
    let Call { context, request, asker, .. } = call;
    let (parts, body) = request.into_parts();
    let asked: Request = body::typed("NodeFence", body::json(&parts.headers, body).await?)?;
    let reason = asked.reason.trim().to_owned();
    if reason.is_empty() {
        let mut violations = Violations::new();
        violations.required("reason");
        return Err(Failure::invalid_body("NodeFence", &violations));
    }
    let who = match asked.by.as_deref().map(str::trim).filter(|by| !by.is_empty()) {
        Some(by) => format!("{by} (through {})", asker.identity.name()),
        None => asker.identity.name(),
    };
    let word = Word { node: &node, who, reason };
    let live =
        context.live().ok_or_else(|| Failure::unavailable("no session service is running"))?;
    let sessions = &live.sessions;
    // The board knows no placed task before it has looked at the store, so neither do sessions.
    sessions.board().ready().await;
    let _no_session_begins = sessions.hold_back().await;
    let (stored, ended) = carry_out(&context, sessions, &target, &word).await?;
    // What is left of a session must begin anew, and tell all that runs.
    sessions.kick(&node);
    tell(&context, &word, &ended);
    Ok(match stored {
        Some(stored) => super::raw(StatusCode::OK, stored.bytes.clone()),
        None => gone(&word, &ended),
    })
}

/// Ends the node's tasks and marks it, in one transaction. Gives the Node, where there is one.
async fn carry_out(
    context: &Context,
    sessions: &Sessions,
    target: &Object,
    word: &Word<'_>,
) -> Result<(Option<Arc<Stored>>, Vec<Task>), Failure> {
    let name = word.node.as_str();
    loop {
        let present = context.store.get(&objects::node_key(name));
        let node = present.as_ref().and_then(|stored| objects::read::<Node>(stored));
        if let Some(why) = alive(sessions, word.node, node.as_ref()) {
            let refused = Failure::new(StatusCode::CONFLICT, "NodeAlive", why);
            return Err(refused.about(target.entry, name));
        }
        let holding = objects::tasks_holding(&context.store, name);
        if node.is_none() && holding.is_empty() {
            return Err(Failure::not_found(target.entry, name));
        }
        let (mut ops, marked) = (Vec::new(), node.is_some());
        if let (Some(stored), Some(mut node)) = (&present, node) {
            mark(context, &mut node, word);
            ops.push(objects::replace(stored, &node));
        }
        let mut ended = Vec::new();
        for (stored, mut task) in holding {
            ops.extend(end(context, &stored, &mut task, word));
            ended.push(task);
        }
        match context.store.apply(ops).await {
            Ok(written) => {
                return Ok((written.into_iter().next().filter(|_| marked), ended));
            }
            Err(error) if objects::is_race(&error) => tokio::task::yield_now().await,
            Err(error) => {
                // It may be there all the same.
                sessions.kick(word.node);
                return Err(refused(target, name, &error));
            }
        }
    }
}

fn refused(target: &Object, name: &str, error: &StoreError) -> Failure {
    Failure::of_store(target.entry, name, error)
}

/// What says that the node is not off.
fn alive(sessions: &Sessions, name: &NodeName, node: Option<&Node>) -> Option<String> {
    // A connection alone says nothing: that of a robot without power stays until the kernel gives it up.
    let ready = node.and_then(|n| n.status.as_ref()).is_some_and(|status| status.is_ready());
    if !ready && !sessions.is_heard(name) {
        return None;
    }
    Some(format!(
        "node {name} is not off: its agent is connected; `muster drain {name}` ends its tasks in order"
    ))
}

fn mark(context: &Context, node: &mut Node, word: &Word<'_>) {
    let now = context.clock.now();
    let fenced = Condition::new(
        condition::FENCED,
        ConditionStatus::True,
        "ConfirmedOff",
        format!("{} confirmed at {now:.0} that it is off: {}", word.who, word.reason),
    );
    set_condition(&mut node.status.get_or_insert_default().conditions, fenced, &Time(now));
}

/// The end of a task, and of the lease that it holds.
fn end(context: &Context, stored: &Stored, task: &mut Task, word: &Word<'_>) -> Vec<Op> {
    let status = task.status.get_or_insert_default();
    let lease = status.lease.clone();
    status.message = format!(
        "node {} was fenced by {} while the task was {}: {}",
        word.node, word.who, status.phase, word.reason
    );
    status.phase = TaskPhase::Failed;
    status.reason = REASON.to_owned();
    status.set_ready(status.ready, MicroTime(context.clock.now()));
    status.finished_at = Some(MicroTime(context.clock.now()));
    let mut ops = vec![objects::replace(stored, task)];
    ops.extend(lease.and_then(|l| objects::release_lease(&context.store, &l.name, &stored.uid)));
    ops
}

/// Who gave the word stands in the log and under the objects.
fn tell(context: &Context, word: &Word<'_>, ended: &[Task]) {
    let names: Vec<String> = ended.iter().map(|task| objects::task_key(task).to_string()).collect();
    tracing::warn!(
        target: "audit",
        verb = "fence",
        node = %word.node,
        who = word.who,
        reason = word.reason,
        tasks = names.join(","),
        "a node was fenced"
    );
    let message = format!("{} confirmed that it is off: {}", word.who, word.reason);
    context.events.warn_node(word.node.as_str(), "Fenced", message);
    for task in ended {
        let status = task.status.as_ref();
        let message = status.map(|s| s.message.clone()).unwrap_or_default();
        context.events.warn_task(task, REASON, message);
    }
}

/// The answer about a node that has no object any more.
fn gone(word: &Word<'_>, ended: &[Task]) -> axum::response::Response {
    let message = format!("node {} has no object; {} of its tasks ended", word.node, ended.len());
    let status = json!({
        "kind": "Status", "apiVersion": "v1", "metadata": {}, "status": "Success", "message": message,
    });
    super::json(StatusCode::OK, &status)
}
