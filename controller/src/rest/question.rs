//! Answers that are no objects: what would be decided, why a task waits, what is used now.

use std::collections::HashMap;
use std::sync::Arc;

use http::StatusCode;
use muster_api::id::TaskUid;
use muster_api::kind::namespace::DEFAULT;
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_api::validate::{Violations, element_path};
use muster_controller_core::hold::Hold;
use muster_controller_core::schedule::{Demand, Plan, Wait};
use serde_json::{Value, json};

use super::failure::Failure;
use super::path::Object;
use super::{Answer, Call, body, registry, sets, together};
use crate::context::{Context, Live};
use crate::objects::TASKS;
use crate::session::frameworks::owner_of;
use crate::store::Key;
use crate::{configs, depends, objects, quota};

pub(super) fn live(context: &Context) -> Result<&Live, Failure> {
    context.live().ok_or_else(|| Failure::unavailable("the scheduler is not running"))
}

fn ended<E: std::fmt::Display>(error: E) -> Failure {
    Failure::unavailable(error.to_string())
}

/// GET …/usage: the last sample of every connected node, read from its kernel; of its tasks those that the client may read.
pub(super) fn usage(call: &Call) -> Answer {
    let live = live(&call.context)?;
    let (mut nodes, mut tasks) = (Vec::new(), Vec::new());
    for (name, usage) in live.sessions.usage() {
        let mut node = json!({
            "name": name.as_str(),
            "cpuMillis": usage.node.cpu_millis,
            "memoryBytes": usage.node.memory_bytes,
        });
        if let Some(link) = usage.link {
            // To the controller and back; and of the last heartbeats, the share that was answered late.
            node["link"] = json!({
                "roundTripUsec": u64::try_from(link.round_trip.as_micros()).unwrap_or(u64::MAX),
                "late": link.late,
            });
        }
        nodes.push(node);
        for task in &usage.tasks {
            let Some((_, key)) = live.sessions.board().find(&task.uid) else { continue };
            let namespace = key.namespace().unwrap_or_default();
            if !call.asker.may(&super::offers::read_in("tasks", namespace)) {
                continue;
            }
            let amount = task.usage.unwrap_or_default();
            tasks.push(json!({
                "namespace": key.namespace(),
                "name": &*key.name,
                "uid": task.uid,
                "node": name.as_str(),
                "cpuMillis": amount.cpu_millis,
                "memoryBytes": amount.memory_bytes,
                "cpuTotalUsec": amount.cpu_total_usec,
            }));
        }
    }
    Ok(super::json(StatusCode::OK, &json!({ "nodes": nodes, "tasks": tasks })))
}

/// GET …/tasks/NAME/why: every node's reason, not only those that fit into the status.
pub(super) async fn why(call: Call, target: Object) -> Answer {
    if target.entry.info.kind == "Framework" {
        return super::offers::why(call.context, &target).await;
    }
    let key = target.key()?;
    let stored =
        call.context.store.get(&key).ok_or_else(|| Failure::not_found(target.entry, &key.name))?;
    let task: Task =
        objects::read(&stored).ok_or_else(|| Failure::internal("the task does not read as one"))?;
    let status = task.status.unwrap_or_default();
    let why = if status.phase == TaskPhase::Pending {
        let scheduler = live(&call.context)?.scheduler.clone();
        let title = format!("{}/{}", key.namespace().unwrap_or_default(), key.name);
        let demand = Demand {
            uid: TaskUid::new(&*stored.uid),
            title: title.into(),
            framework: owner_of(&task.metadata),
            spec: Arc::new(task.spec),
            since: 0,
            avoid: Arc::default(),
        };
        scheduler.why(demand).await.map_err(ended)?
    } else {
        Vec::new()
    };
    let why = if why.is_empty() { status.why.clone() } else { why };
    let decision = status.node.as_ref().map(|node| {
        json!({ "node": node, "score": status.score, "lease": status.lease, "boundAt": status.bound_at })
    });
    let answer = json!({ "phase": status.phase, "why": why, "decision": decision });
    Ok(super::json(StatusCode::OK, &answer))
}

/// POST …/plan: what applying some objects would do. The real scheduler decides, on a copy of what it
/// knows; nothing is changed.
pub(super) async fn plan(call: Call) -> Answer {
    let Call { context, request, asker, .. } = call;
    let (parts, body) = request.into_parts();
    let body = body::json(&parts.headers, body).await?;
    let objects = body.get("objects").and_then(Value::as_array);
    let objects =
        objects.ok_or_else(|| Failure::bad_request("the body must be {\"objects\": […]}"))?;
    body::check_count(objects.len())?;
    together::may_read(&asker, objects)?;
    let revision = context.store.revision();
    let (mut changes, mut demands, mut outcomes) = (Vec::new(), Vec::new(), Vec::new());
    for (i, object) in objects.iter().enumerate() {
        let object = with_defaults(&context, object);
        let object = muster_api::kind::admit(&object).map_err(|v| refused(i, v))?;
        let change = change_of(&context, &object)?;
        if object["kind"] == "Task" && change["action"] == "create" {
            demands.push(demand(i, &object)?);
        } else if object["kind"] == "TaskSet" && change["action"] != "unchanged" {
            let (outcome, begins) = sets::outcome(&context, &object)?;
            outcomes.push(outcome);
            demands.extend(begins);
        }
        changes.push(change);
    }
    let names: HashMap<TaskUid, Value> = demands
        .iter()
        .map(|d| {
            let (namespace, name) = d.title.split_once('/').unwrap_or_default();
            (d.uid.clone(), json!({ "namespace": namespace, "name": name }))
        })
        .collect();
    let (held, demands) = hold_back(&context, objects, demands);
    let (mut plan, seen) = live(&context)?.scheduler.plan(demands).await.map_err(ended)?;
    // Whatever was written after this may not be in it.
    let revision = revision.min(seen);
    plan.waits.extend(held);
    let mut answer = describe(&context, &names, &plan);
    answer["changes"] = changes.into();
    answer["sets"] = outcomes.into();
    answer["revision"] = revision.to_string().into();
    Ok(super::json(StatusCode::OK, &answer))
}

/// A task that would be created, with what its namespace's quota fills in; anything else as it is.
pub(super) fn with_defaults(context: &Context, object: &Value) -> Value {
    let mut object = object.clone();
    let text = |pointer: &str| object.pointer(pointer).and_then(Value::as_str);
    let namespace = text("/metadata/namespace").unwrap_or(DEFAULT).to_owned();
    let key = Key::namespaced(TASKS, &*namespace, text("/metadata/name").unwrap_or_default());
    if object["kind"] == "Task"
        && context.store.get(&key).is_none()
        && let Some(quota) = quota::of(&context.store, &namespace)
    {
        quota::fill_defaults(&quota.defaults, &mut object);
    }
    object
}

/// Tasks that would not be considered, with their reasons, and the others. ConfigMaps and Secrets that would be applied
/// with them count as there.
fn hold_back(
    context: &Context,
    objects: &[Value],
    demands: Vec<Demand>,
) -> (Vec<Wait>, Vec<Demand>) {
    let (mut held, mut free) = (Vec::new(), Vec::new());
    for demand in demands {
        let (namespace, _) = demand.title.split_once('/').unwrap_or_default();
        let mut holds = depends::holds_with(&context.store, objects, namespace, &demand.spec);
        holds.extend(configs::holds_with(&context.store, objects, namespace, &demand.spec));
        if holds.is_empty() {
            free.push(demand);
        } else {
            let why = holds.iter().map(Hold::refusal).collect();
            held.push(Wait { uid: demand.uid, why, brief: false });
        }
    }
    (held, free)
}

fn refused(index: usize, violations: Violations) -> Failure {
    let texts: Vec<String> =
        violations.iter().map(|v| format!("{}: {v}", element_path("objects", index))).collect();
    Failure::bad_request(texts.join("; "))
}

fn change_of(context: &Context, object: &Value) -> Result<Value, Failure> {
    let text = |pointer: &str| object.pointer(pointer).and_then(Value::as_str);
    let kind = text("/kind").unwrap_or_default();
    let name = text("/metadata/name")
        .ok_or_else(|| Failure::bad_request("a planned object needs metadata.name"))?;
    let info = muster_api::kind::find(text("/apiVersion").unwrap_or_default(), kind)
        .expect("admission found the kind before");
    let entry = registry::find(info.group, info.plural)
        .ok_or_else(|| Failure::bad_request(format!("{kind} objects cannot be planned")))?;
    let namespace = info.namespaced.then(|| text("/metadata/namespace").unwrap_or(DEFAULT));
    let present = context.store.get(&entry.key(namespace, name)).map(|s| s.value());
    let same = |present: &Value| {
        let asked = |part: &str| {
            object.pointer(part).is_none_or(|o| present.pointer(part).is_some_and(|p| holds(p, o)))
        };
        let values = ["/data", "/binaryData", "/type", "/immutable"];
        let parts = ["/spec", "/metadata/labels", "/metadata/annotations"].into_iter();
        parts.chain(values).all(asked)
    };
    let action = match &present {
        None => "create",
        Some(present) if same(present) => "unchanged",
        Some(_) => "update",
    };
    Ok(json!({ "action": action, "kind": kind, "namespace": namespace, "name": name }))
}

/// Everything that `asked` says is so in `present`, which may say more: what the server filled in.
fn holds(present: &Value, asked: &Value) -> bool {
    match (present, asked) {
        (Value::Object(present), Value::Object(asked)) => {
            asked.iter().all(|(key, value)| present.get(key).is_some_and(|p| holds(p, value)))
        }
        _ => present == asked,
    }
}

fn demand(index: usize, object: &Value) -> Result<Demand, Failure> {
    let task: Task = serde_json::from_value(object.clone())
        .map_err(|e| Failure::bad_request(format!("{}: {e}", element_path("objects", index))))?;
    let namespace = task.metadata.namespace.as_deref().unwrap_or(DEFAULT);
    let name = task.metadata.name.as_deref().unwrap_or_default();
    Ok(Demand {
        uid: TaskUid::new(format!("plan-{index}")),
        title: format!("{namespace}/{name}").into(),
        framework: owner_of(&task.metadata),
        spec: Arc::new(task.spec),
        // After everything that waits.
        since: u64::MAX / 2 + index as u64,
        avoid: Arc::default(),
    })
}

fn describe(context: &Context, names: &HashMap<TaskUid, Value>, plan: &Plan) -> Value {
    let with_name = |uid: &TaskUid, fields: Value| {
        let mut named = names.get(uid).cloned().unwrap_or_else(|| json!({}));
        if let (Some(named), Value::Object(fields)) = (named.as_object_mut(), fields) {
            named.extend(fields);
        }
        named
    };
    let placements: Vec<Value> = plan
        .binds
        .iter()
        .map(|bind| {
            let leases: Vec<Value> = bind
                .leases
                .iter()
                .map(|(group, epoch)| json!({ "group": group, "epoch": epoch }))
                .collect();
            with_name(
                &bind.uid,
                json!({ "node": bind.node.as_str(), "score": bind.score, "leases": leases }),
            )
        })
        .collect();
    let waits: Vec<Value> =
        plan.waits.iter().map(|wait| with_name(&wait.uid, json!({ "why": &*wait.why }))).collect();
    let preemptions: Vec<Value> = plan
        .preemptions
        .iter()
        .map(|preemption| {
            let victims: Vec<&str> = preemption.victims.iter().map(|v| &*v.title).collect();
            // Each passes on when its holder's processes are gone.
            let lost = victims.iter().filter_map(|victim| victim.split_once('/'));
            let lost = lost.flat_map(|(ns, name)| sets::leases_of(&context.store, ns, name));
            let lost: Vec<String> = lost.collect();
            let fields =
                json!({ "node": preemption.node.as_str(), "victims": victims, "leases": lost });
            with_name(&preemption.uid, fields)
        })
        .collect();
    json!({ "placements": placements, "waits": waits, "preemptions": preemptions })
}
