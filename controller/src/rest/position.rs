//! POST …/frameworks/NAME/position: where a connected framework works from now on, as a person says it.
//!
//! The framework's session writes it, as it does when the framework says so itself, and tells the framework; one that is away
//! would come back with a position of its own, so that it is refused.

use std::time::Duration;

use http::StatusCode;
use muster_api::kind::framework::{Framework, FrameworkPosition};
use serde::Deserialize;

use super::path::Object;
use super::{Answer, Call, body, failure::Failure};
use crate::objects;

/// The session answers at once; but it may be sending to a framework on a bad link.
const TOLD_WITHIN: Duration = Duration::from_secs(10);

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Request {
    spec: FrameworkPosition,
}

pub(super) async fn set(call: Call, target: Object) -> Answer {
    let key = target.key()?;
    let Call { context, request, asker, .. } = call;
    let (parts, body) = request.into_parts();
    let asked: Request = body::typed("FrameworkPosition", body::json(&parts.headers, body).await?)?;
    let live = super::question::live(&context)?;
    let stored = context.store.get(&key);
    let stored = stored.ok_or_else(|| Failure::not_found(target.entry, &key.name))?;
    let framework: Framework = objects::read(&stored)
        .ok_or_else(|| Failure::internal(format!("framework {:?} does not read", key.name)))?;
    let violations = asked.spec.of(&framework.spec).violations();
    if !violations.is_empty() {
        return Err(Failure::invalid(target.entry, &key.name, &violations));
    }
    let by = asker.identity.name();
    let set = live.frameworks.set_position(&stored.uid, asked.spec, by);
    let done = tokio::time::timeout(TOLD_WITHIN, set).await;
    let done = done.map_err(|_| Failure::unavailable("the framework's session does not answer"))?;
    match done {
        Some(Ok(())) => {}
        Some(Err(error)) => return Err(Failure::of_store(target.entry, &key.name, &error)),
        None => {
            let message = format!(
                "framework {:?} is not connected, and says where it works when it comes back",
                key.name
            );
            let refused = Failure::new(StatusCode::CONFLICT, "NotConnected", message);
            return Err(refused.about(target.entry, &key.name));
        }
    }
    match context.store.get(&key) {
        Some(stored) => Ok(super::raw(StatusCode::OK, stored.bytes.clone())),
        None => Err(Failure::not_found(target.entry, &key.name)),
    }
}
