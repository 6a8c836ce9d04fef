//! `metrics.k8s.io/v1beta1`: what nodes and tasks use now, in the form that `kubectl top` reads. It is the last sample of
//! every connected node.

use http::StatusCode;
use muster_controller_core::node_health::HEARTBEAT_EVERY;
use serde_json::{Value, json};

use super::failure::Failure;
use super::registry::{self, Entry};
use super::selector::Selection;
use super::{Answer, Call};
use crate::store::Stored;

/// What the API is called.
pub(super) const GROUP: &str = "metrics.k8s.io";
pub(super) const VERSION: &str = "v1beta1";

/// Whose use is asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Measured {
    /// Tasks, as pods; else nodes.
    pub(crate) pods: bool,
    pub(crate) namespace: Option<String>,
    pub(crate) name: Option<String>,
}

pub(super) fn answer(call: &Call, measured: &Measured) -> Answer {
    let plural = if measured.pods { "pods" } else { "nodes" };
    let entry = registry::find("", plural).ok_or_else(|| Failure::internal("no such core kind"))?;
    let selection = Selection::read(entry, measured.namespace.as_deref(), &call.query)?;
    let live = super::question::live(&call.context)?;
    let mut samples = Vec::new();
    for (node, usage) in live.sessions.usage() {
        if !measured.pods {
            samples.push((entry.key(None, node.as_str()), usage.node));
            continue;
        }
        for task in &usage.tasks {
            if let (Some((_, key)), Some(usage)) =
                (live.sessions.board().find(&task.uid), task.usage)
            {
                samples.push((entry.key(key.namespace(), &key.name), usage));
            }
        }
    }
    samples.sort_by(|(a, _), (b, _)| a.cmp(b));
    let now = call.context.stamp();
    let items: Vec<Value> = samples
        .into_iter()
        .filter(|(key, _)| measured.name.as_deref().is_none_or(|name| *name == *key.name))
        .filter_map(|(key, usage)| Some((call.context.store.get(&key)?, usage)))
        .filter(|(stored, _)| selection.matches(stored))
        .map(|(stored, usage)| {
            let used = json!({
                "cpu": format!("{}m", usage.cpu_millis),
                "memory": format!("{}Ki", usage.memory_bytes / 1024),
            });
            shown(entry, &stored, &now, used)
        })
        .collect();
    if let Some(name) = &measured.name {
        let one = items.into_iter().next();
        let one = one.ok_or_else(|| Failure::not_found(entry, name))?;
        return Ok(super::json(StatusCode::OK, &one));
    }
    let list = json!({
        "kind": if measured.pods { "PodMetricsList" } else { "NodeMetricsList" },
        "apiVersion": format!("{GROUP}/{VERSION}"),
        "metadata": {"resourceVersion": call.context.store.revision().to_string()},
        "items": items,
    });
    Ok(super::json(StatusCode::OK, &list))
}

fn shown(entry: &Entry, stored: &Stored, now: &str, used: Value) -> Value {
    let object = entry.value(stored);
    let mut metadata = json!({"name": &*stored.key.name, "creationTimestamp": now});
    if let Some(namespace) = stored.key.namespace() {
        metadata["namespace"] = namespace.into();
    }
    if !object["metadata"]["labels"].is_null() {
        metadata["labels"] = object["metadata"]["labels"].clone();
    }
    let mut metrics = json!({
        "apiVersion": format!("{GROUP}/{VERSION}"),
        "metadata": metadata,
        "timestamp": now,
        // Agents measure between two heartbeats.
        "window": format!("{}ms", HEARTBEAT_EVERY.as_millis()),
    });
    if entry.info.kind == "Pod" {
        metrics["kind"] = "PodMetrics".into();
        metrics["containers"] =
            json!([{"name": muster_controller_core::project::pod::CONTAINER, "usage": used}]);
    } else {
        metrics["kind"] = "NodeMetrics".into();
        metrics["usage"] = used;
    }
    metrics
}
