//! PUT and PATCH of core Nodes and Pods: what kubectl cordons, taints, labels, annotates, edits or applies is a Node or a
//! Task of ours. A change of what only the view shows is refused, by the field's name, or says nothing.

use http::StatusCode;
use muster_api::kind::node::Node;
use muster_api::kind::task::Task;
use muster_api::validate::{Violations, member_path};
use muster_controller_core::project;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::path::{Object, Subresource, Verb};
use super::registry::{self, Entry, View};
use super::update::{self, Options};
use super::{Answer, Call, body, failure::Failure, metadata, patch, scale};

pub(super) async fn write(call: Call, verb: Verb, target: Object) -> Answer {
    if target.subresource == Some(Subresource::Status) {
        return Err(Failure::method_not_allowed(verb, &target));
    }
    let options = Options::read(&call, &target)?;
    let entry = target.entry;
    let stored = registry::of(entry.resource);
    let stored = stored.ok_or_else(|| Failure::internal("what it shows is not served"))?;
    let ours = Object { entry: stored, ..target.clone() };
    let changed = if body::media_type(call.request.headers()) == patch::APPLY {
        let config = |config: Value| configuration(entry, stored, config);
        patch::server_side(call, ours, options, (entry, &config)).await?
    } else if verb == Verb::Patch {
        let Call { context, request, .. } = call;
        let patch = patch::of_request(request, true).await?;
        let make = |present: &Value| {
            let wanted = patch::apply(&patch, &show(entry, present)?)?;
            becomes(entry, present, &wanted)
        };
        update::change(&context, &ours, &options, make).await?
    } else {
        let Call { context, request, .. } = call;
        let (parts, body) = request.into_parts();
        let wanted = body::json(&parts.headers, body).await?;
        let make = |present: &Value| becomes(entry, present, &wanted);
        update::change(&context, &ours, &options, make).await?
    };
    // Warnings go with the answer.
    let (mut parts, body) = changed.into_parts();
    let object = scale::read(body).await?;
    let shown = super::json(StatusCode::OK, &show(entry, &object)?);
    parts.headers.remove(http::header::CONTENT_LENGTH);
    let (_, body) = shown.into_parts();
    Ok(http::Response::from_parts(parts, body))
}

/// The view of a stored object.
fn show(entry: &Entry, object: &Value) -> Result<Value, Failure> {
    Ok(match entry.view {
        View::Pod => project::pod::pod(object, &read::<Task>(object)?),
        _ => project::node::node(object, &read::<Node>(object)?),
    })
}

/// The stored object that is shown as wanted.
fn becomes(entry: &Entry, present: &Value, wanted: &Value) -> Result<Value, Failure> {
    check(entry, wanted)?;
    if entry.view != View::Pod {
        return Ok(project::node::changed(present, &read(present)?, wanted));
    }
    project::pod::changed(present, &read(present)?, wanted).map_err(|fields| {
        let mut violations = Violations::new();
        for field in fields {
            violations.forbidden(field, "cannot be changed: it shows what the Task is").suggest(
                "change the Task (tasks.muster.dev); through a pod only tolerations, \
                 terminationGracePeriodSeconds, priority and metadata are",
            );
        }
        let name = present["metadata"]["name"].as_str().unwrap_or_default();
        Failure::invalid(entry, name, &violations)
    })
}

/// What is applied to a view, as what is applied to the stored object: both have the same metadata, and what a Node of
/// Kubernetes shares with ours (whether it is schedulable, its taints) stands in the same place.
fn configuration(entry: &Entry, stored: &Entry, mut config: Value) -> Result<Value, Failure> {
    if entry.view == View::Pod && config.get("spec").is_some_and(|spec| !spec.is_null()) {
        let mut violations = Violations::new();
        violations
            .forbidden("spec", "is not applied: a pod is only another view of a Task")
            .suggest("apply the Task; of a pod only metadata can be applied");
        let name = metadata::text(&config, "name").unwrap_or_default();
        return Err(Failure::invalid(entry, name, &violations));
    }
    if entry.view == View::Node {
        node_configuration(entry, &mut config)?;
    }
    config["apiVersion"] = stored.info.api_version().into();
    config["kind"] = stored.info.kind.into();
    if let Some(fields) = config.as_object_mut() {
        fields.retain(|field, value| field != "status" && !value.is_null());
    }
    Ok(config)
}

/// Holds what is applied to a core Node to what it has in common with ours: by the name of one of our fields nobody means the
/// core Node, and a robot's stop is set and released by who applies the Node itself.
fn node_configuration(entry: &Entry, config: &mut Value) -> Result<(), Failure> {
    let name = metadata::text(config, "name").unwrap_or_default().to_owned();
    let Some(spec) = config.get_mut("spec").and_then(Value::as_object_mut) else { return Ok(()) };
    let mut violations = Violations::new();
    for field in spec.keys().filter(|field| !matches!(field.as_str(), "unschedulable" | "taints")) {
        violations
            .forbidden(member_path("spec", field), "is not applied through a core Node")
            .suggest("apply the Node (nodes.muster.dev); through this view unschedulable, taints and metadata are");
    }
    if !violations.is_empty() {
        return Err(Failure::invalid(entry, &name, &violations));
    }
    if let Some(taints) = spec.get_mut("taints").and_then(Value::as_array_mut) {
        // The view says by it what spec.unschedulable says.
        taints.retain(|taint| taint["key"] != project::node::UNSCHEDULABLE);
    }
    Ok(())
}

/// A core object, as far as something of it counts here: what is left out would be taken away.
fn check(entry: &Entry, view: &Value) -> Result<(), Failure> {
    let kind = entry.info.kind;
    let wrong =
        |what: &str| Err(Failure::bad_request(format!("{what}; send the {kind} as it was read")));
    if view["apiVersion"] != "v1" || view["kind"] != kind {
        return wrong(&format!("apiVersion and kind are not those of a core {kind}"));
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
    for field in ["finalizers", "ownerReferences"] {
        let list = &view["metadata"][field];
        if !list.is_null() && !list.is_array() {
            return wrong(&format!("metadata.{field} is no list"));
        }
    }
    if entry.view == View::Pod {
        return Ok(());
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

fn read<T: DeserializeOwned>(object: &Value) -> Result<T, Failure> {
    T::deserialize(object).map_err(|error| Failure::internal(error.to_string()))
}
