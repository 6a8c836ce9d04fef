//! POST …/pods/NAME/eviction: the task ends, unless its robot is in the middle of a mission. `kubectl drain` asks again
//! after a while when it is told so. That there is no mission is a condition of the transaction that ends the task: a lock
//! that was set before it is never passed over.

use http::StatusCode;
use muster_api::kind::node::Node;
use serde_json::{Value, json};

use super::path::Object;
use super::{Answer, Call, body, delete, failure::Failure};
use crate::context::Context;
use crate::objects;
use crate::store::{Op, Stored};

pub(super) async fn evict(call: Call, target: Object) -> Answer {
    let key = target.key()?;
    let dry = call.query.dry_run()?;
    let Call { context, request, .. } = call;
    let (parts, body) = request.into_parts();
    let eviction = body::optional_json(&parts.headers, body).await?;
    let stored = context.store.get(&key);
    let stored = stored.ok_or_else(|| Failure::not_found(target.entry, &key.name))?;
    let no_mission = |task: &Stored| no_mission(&context, &target, task);
    no_mission(&stored)?;
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
        delete::end_this(&context, &stored, grace, &no_mission).await?;
    }
    let status: Value = json!({"kind": "Status", "apiVersion": "v1", "metadata": {}, "status": "Success", "code": 201});
    Ok(super::json(StatusCode::CREATED, &status))
}

/// That the task's node stays as it is, which is without a mission; none: the task holds nothing of a node.
fn no_mission(context: &Context, target: &Object, task: &Stored) -> Result<Option<Op>, Failure> {
    let (name, object) = (&task.key.name, task.value());
    let Some(node) = object["status"]["node"].as_str() else { return Ok(None) };
    if !delete::is_held(task.key.resource, &object) {
        return Ok(None);
    }
    let key = objects::node_key(node);
    let Some(stored) = context.store.get(&key) else {
        return Ok(Some(objects::absent(&key)));
    };
    let lock = objects::read::<Node>(&stored).and_then(|node| node.mission_lock());
    if let Some(lock) = lock {
        let message = format!(
            "Cannot evict pod {name}: node {node} is on a mission of {} ({}); try again later",
            lock.holder, lock.reason
        );
        let failure = Failure::new(StatusCode::TOO_MANY_REQUESTS, "TooManyRequests", message);
        return Err(failure.about(target.entry, name).retry_after(10));
    }
    Ok(Some(objects::unchanged(&stored)))
}
