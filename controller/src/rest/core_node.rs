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
            let changed = patch::apply(&patch, &view)?;
            check(&changed)?;
            Ok(project::node::changed(present, &node, &changed))
        };
        update::change(&context, &ours, &options, make).await?
    } else {
        let (parts, body) = request.into_parts();
        let view = body::json(&parts.headers, body).await?;
        check(&view)?;
        let make = |present: &Value| Ok(project::node::changed(present, &read(present)?, &view));
        update::change(&context, &ours, &options, make).await?
    };
    let object = scale::read(changed.into_body()).await?;
    let view = project::node::node(&object, &read(&object)?);
    Ok(super::json(StatusCode::OK, &view))
}

/// A core Node, as far as something of it counts here: what is left out would be taken away.
fn check(view: &Value) -> Result<(), Failure> {
    let wrong =
        |what: &str| Err(Failure::bad_request(format!("{what}; send the Node as it was read")));
    if view["apiVersion"] != "v1" || view["kind"] != "Node" {
        return wrong("apiVersion and kind are not those of a core Node");
    }
    if !view["metadata"]["name"].is_string() {
        return wrong("metadata.name is missing");
    }
    for field in ["labels", "annotations"] {
        let map = &view["metadata"][field];
        let texts = map.as_object().is_some_and(|map| map.values().all(Value::is_string));
        if !map.is_null() && !texts {
            return wrong(&format!("metadata.{field} is no map of texts"));
        }
    }
    let (closed, taints) = (&view["spec"]["unschedulable"], &view["spec"]["taints"]);
    if !closed.is_null() && !closed.is_boolean() {
        return wrong("spec.unschedulable is neither true nor false");
    }
    let listed = taints.as_array().is_some_and(|list| list.iter().all(Value::is_object));
    if !taints.is_null() && !listed {
        return wrong("spec.taints is no list of taints");
    }
    Ok(())
}

fn read(object: &Value) -> Result<Node, Failure> {
    Node::deserialize(object).map_err(|error| Failure::internal(error.to_string()))
}
