//! POST …/check: whether objects that each would be stored would be stored one after the other.
//!
//! What every object has wrong by itself its own dry run says. Here is what only all of them have wrong together: new
//! tasks that their namespace's Quota lets in one by one, and not all. Nothing is let in by asking.

use std::collections::BTreeMap;

use http::StatusCode;
use muster_api::kind;
use muster_api::kind::namespace::DEFAULT;
use muster_api::kind::quota::{QUOTA_NAME, Quota, QuotaSpec};
use muster_api::kind::task::Resources;
use serde_json::{Value, json};

use super::failure::Failure;
use super::path::{Object, Verb};
use super::{Answer, Call, body, create, question, registry};
use crate::auth::{self, Asker};
use crate::context::Context;
use crate::objects::{self, TASKS};
use crate::quota;
use crate::store::Key;

/// Whether somebody may look at what these objects are now, each of them.
///
/// # Errors
/// 403 for the first that they may not.
pub(super) fn may_read(asker: &Asker, objects: &[Value]) -> Result<(), Failure> {
    for object in objects {
        let text = |pointer: &str| object.pointer(pointer).and_then(Value::as_str);
        let (version, kind) = (text("/apiVersion"), text("/kind"));
        let info = kind::find(version.unwrap_or_default(), kind.unwrap_or_default());
        // What is no object is refused for that.
        let Some(entry) = info.and_then(|info| registry::find(info.group, info.plural)) else {
            continue;
        };
        let namespace = text("/metadata/namespace").unwrap_or(DEFAULT).to_owned();
        let namespace = entry.info.namespaced.then_some(namespace);
        let name = text("/metadata/name").map(str::to_owned);
        let target = Object { entry, namespace, name, subresource: None };
        asker.needs(&auth::of_object(Verb::Get, &target))?;
    }
    Ok(())
}

/// A task that would be created: where in the list, its name, what it asks for.
struct Asking {
    index: usize,
    name: String,
    resources: Resources,
}

pub(super) async fn check(call: Call) -> Answer {
    let Call { context, request, asker, .. } = call;
    let (parts, body) = request.into_parts();
    let body = body::json(&parts.headers, body).await?;
    let objects = body.get("objects").and_then(Value::as_array);
    let objects =
        objects.ok_or_else(|| Failure::bad_request("the body must be {\"objects\": […]}"))?;
    body::check_count(objects.len())?;
    may_read(&asker, objects)?;
    let mut refusals: Vec<(usize, Value)> = Vec::new();
    for (namespace, asking) in new_tasks(&context, objects)? {
        let Some(quota) = quota_of(&context, objects, &namespace) else { continue };
        let all = asking.iter().map(|one| &one.resources);
        let judged = context.door.rehearse(&context.store, (&namespace, &quota), all);
        for (one, judged) in asking.iter().zip(judged) {
            if let Err(violations) = judged {
                let status = create::refused(&one.name, &violations).status();
                refusals.push((one.index, status));
            }
        }
    }
    refusals.sort_by_key(|(index, _)| *index);
    let refusals: Vec<Value> = refusals
        .into_iter()
        .map(|(index, status)| json!({ "index": index, "status": status }))
        .collect();
    Ok(super::json(StatusCode::OK, &json!({ "refusals": refusals })))
}

/// By namespace, in the order in which they were given.
fn new_tasks(
    context: &Context,
    objects: &[Value],
) -> Result<BTreeMap<String, Vec<Asking>>, Failure> {
    let mut new: BTreeMap<String, Vec<Asking>> = BTreeMap::new();
    for (index, object) in objects.iter().enumerate().filter(|(_, o)| o["kind"] == "Task") {
        let text = |pointer: &str| object.pointer(pointer).and_then(Value::as_str);
        let namespace = text("/metadata/namespace").unwrap_or(DEFAULT).to_owned();
        let name = text("/metadata/name").unwrap_or_default().to_owned();
        if context.store.get(&Key::namespaced(TASKS, &*namespace, &*name)).is_some() {
            continue;
        }
        let object = question::with_defaults(context, object);
        // What cannot be read is refused by itself, with its place.
        let Ok(resources) = create::resources_of(&object) else { continue };
        new.entry(namespace).or_default().push(Asking { index, name, resources });
    }
    Ok(new)
}

/// The quota that there is when the tasks come: one among the objects is stored before them.
pub(super) fn quota_of(context: &Context, objects: &[Value], namespace: &str) -> Option<QuotaSpec> {
    let planned = objects::among(objects, "Quota", (namespace, QUOTA_NAME));
    let planned = planned.and_then(|object| serde_json::from_value::<Quota>(object.clone()).ok());
    planned.map(|quota| quota.spec).or_else(|| quota::of(&context.store, namespace))
}
