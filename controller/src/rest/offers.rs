//! What frameworks are offered now, and why the rest is not: from the scheduler's desk, not from objects.

use std::sync::Arc;

use http::StatusCode;
use muster_controller_core::access::{Action, Asked};
use serde_json::json;
use tokio::sync::oneshot;

use super::failure::Failure;
use super::path::{Object, Verb};
use super::{Answer, Call};
use crate::context::Context;
use crate::reconcile::desk::{Depth, Request};

/// GET …/offers: every framework at the desk that the client may read, with its share and its offers.
pub(super) async fn list(call: Call) -> Answer {
    let Call { context, asker, .. } = call;
    let live = super::question::live(&context)?;
    let mut frameworks = live.frameworks.look(Depth::Offers).await;
    frameworks.retain(|view| asker.may(&read_in("frameworks", &view.namespace)));
    Ok(super::json(StatusCode::OK, &json!({ "frameworks": frameworks })))
}

/// Reading objects of a kind in a namespace.
pub(super) fn read_in<'a>(resource: &'a str, namespace: &'a str) -> Asked<'a> {
    let (verb, group, namespace) = (Verb::List, muster_api::GROUP, Some(namespace));
    Asked::Right(Action { verb, group, resource, subresource: None, namespace, name: None })
}

/// GET …/frameworks/NAME/why: why each node is not offered to it.
pub(super) async fn why(context: Arc<Context>, target: &Object) -> Answer {
    let key = target.key()?;
    let stored =
        context.store.get(&key).ok_or_else(|| Failure::not_found(target.entry, &key.name))?;
    let live = super::question::live(&context)?;
    let (answer, answered) = oneshot::channel();
    let ended = || Failure::unavailable("the scheduler has ended");
    let request = Request::Why { uid: (*stored.uid).into(), answer };
    live.scheduler.desk(request).await.map_err(|_| ended())?;
    let why = answered.await.map_err(|_| ended())?;
    let frameworks = live.frameworks.look(Depth::Offers).await;
    let view = frameworks.into_iter().find(|v| *v.uid == *stored.uid);
    // None: it has been away since before the controller began.
    let answer = json!({ "why": why.unwrap_or_default(), "framework": view });
    Ok(super::json(StatusCode::OK, &answer))
}
