//! POST …/pods/NAME/eviction: the task ends, unless its robot is in the middle of a mission. `kubectl drain` asks again
//! after a while when it is told so.

use http::StatusCode;
use muster_api::kind::node::Node;
use serde_json::{Value, json};

use super::path::Object;
use super::{Answer, Call, body, delete, failure::Failure};
use crate::objects;

pub(super) async fn evict(call: Call, target: Object) -> Answer {
    let key = target.key()?;
    let dry = call.query.dry_run()?;
    let Call { context, request, .. } = call;
    let (parts, body) = request.into_parts();
    let eviction = body::optional_json(&parts.headers, body).await?;
    let stored = context.store.get(&key);
    let stored = stored.ok_or_else(|| Failure::not_found(target.entry, &key.name))?;
    let object = stored.value();
    let ended = !delete::is_held(key.resource, &object);
    if let Some(lock) = object["status"]["node"].as_str().filter(|_| !ended).and_then(|name| {
        let node: Node = objects::read(&*context.store.get(&objects::node_key(name))?)?;
        node.mission_lock().map(|lock| (name.to_owned(), lock))
    }) {
        let (node, lock) = lock;
        let message = format!(
            "Cannot evict pod {}: node {node} is on a mission of {} ({}); try again later",
            key.name, lock.holder, lock.reason
        );
        let failure = Failure::new(StatusCode::TOO_MANY_REQUESTS, "TooManyRequests", message);
        return Err(failure.about(target.entry, &key.name).retry_after(10));
    }
    let options = &eviction["deleteOptions"];
    let uid = options["preconditions"]["uid"].as_str();
    if uid.is_some_and(|uid| *uid != *stored.uid) {
        return Err(Failure::conflict(target.entry, &key.name, "it is another pod of that name"));
    }
    let dry = dry || options["dryRun"].as_array().is_some_and(|list| !list.is_empty());
    if !dry {
        let grace = options["gracePeriodSeconds"].as_i64();
        if grace.is_some_and(|grace| grace < 0) {
            return Err(Failure::bad_request("gracePeriodSeconds must not be negative"));
        }
        // Of this one: another may have taken its name meanwhile.
        delete::end_this(&context, &stored, grace).await?;
    }
    let status: Value = json!({"kind": "Status", "apiVersion": "v1", "metadata": {}, "status": "Success", "code": 201});
    Ok(super::json(StatusCode::CREATED, &status))
}
