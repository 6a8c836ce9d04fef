//! PUT and PATCH of a core Node: what kubectl cordons, taints, labels and annotates is a Node of ours.

use http::StatusCode;
use muster_api::kind::node::Node;
use muster_controller_core::project;
use serde::Deserialize as _;
use serde_json::Value;

use super::path::{Object, Subresource, Verb};
use super::update::{self, Options};
use super::{Answer, Call, body, failure::Failure, patch, registry, scale};
use crate::objects::NODES;

pub(super) async fn write(call: Call, verb: Verb, target: Object) -> Answer {
    if target.subresource == Some(Subresource::Status) {
        return Err(Failure::method_not_allowed(verb, &target));
    }
    let options = Options::read(&call, &target)?;
    let entry = registry::of(NODES).ok_or_else(|| Failure::internal("nodes are not served"))?;
    let ours = Object { entry, ..target.clone() };
    let Call { context, request, .. } = call;
    let changed = if verb == Verb::Patch {
        let patch = patch::of_request(request, true).await?;
        let make = |present: &Value| {
            let node = read(present)?;
            let view = project::node::node(present, &node);
            Ok(project::node::changed(present, &node, &patch::apply(&patch, &view)?))
        };
        update::change(&context, &ours, &options, make).await?
    } else {
        let (parts, body) = request.into_parts();
        let view = body::json(&parts.headers, body).await?;
        let make = |present: &Value| Ok(project::node::changed(present, &read(present)?, &view));
        update::change(&context, &ours, &options, make).await?
    };
    let object = scale::read(changed.into_body()).await?;
    let view = project::node::node(&object, &read(&object)?);
    Ok(super::json(StatusCode::OK, &view))
}

fn read(object: &Value) -> Result<Node, Failure> {
    Node::deserialize(object).map_err(|error| Failure::internal(error.to_string()))
}
