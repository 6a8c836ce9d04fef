//! A Node of ours as a core Node, and back: cordon, labels, annotations and taints are written through it.

use std::net::{IpAddr, SocketAddr};

use muster_api::kind::node::{Node, NodeKind, NodeStatus};
use muster_api::selector::Labels;
use serde_json::{Value, json};

use super::{metadata, resources, set_texts, take_metadata};

/// What Kubernetes' own node controller puts on a cordoned node.
pub const UNSCHEDULABLE: &str = "node.kubernetes.io/unschedulable";

/// The core Node that shows a stored Node.
#[must_use]
pub fn node(object: &Value, node: &Node) -> Value {
    let status = node.status.clone().unwrap_or_default();
    let mut metadata = metadata(object);
    let labels = metadata.entry("labels").or_insert_with(|| json!({}));
    for (key, value) in own_labels(object, node) {
        labels[key] = value.into();
    }
    let mut spec = json!({});
    let mut taints = object["spec"]["taints"].as_array().cloned().unwrap_or_default();
    if node.spec.unschedulable {
        spec["unschedulable"] = true.into();
        if !is_tainted(object) {
            taints.push(json!({"key": UNSCHEDULABLE, "effect": "NoSchedule"}));
        }
    }
    if !taints.is_empty() {
        spec["taints"] = taints.into();
    }
    json!({
        "apiVersion": "v1",
        "kind": "Node",
        "metadata": metadata,
        "spec": spec,
        "status": node_status(object, node, &status),
    })
}

/// Whether somebody has set the taint that the view adds.
fn is_tainted(object: &Value) -> bool {
    let taints = object["spec"]["taints"].as_array();
    taints.into_iter().flatten().any(|taint| taint["key"] == UNSCHEDULABLE)
}

/// Labels that the view adds where nobody set them.
fn own_labels(object: &Value, node: &Node) -> Vec<(&'static str, String)> {
    let name = node.metadata.name.as_deref().unwrap_or_default();
    let labels = added(node.spec.kind, name);
    labels.into_iter().filter(|(key, _)| object["metadata"]["labels"].get(*key).is_none()).collect()
}

fn added(kind: NodeKind, name: &str) -> [(&'static str, String); 2] {
    let role = match kind {
        NodeKind::Robot => "node-role.kubernetes.io/robot",
        NodeKind::Cloud => "node-role.kubernetes.io/cloud",
    };
    [(role, String::new()), ("kubernetes.io/hostname", name.to_owned())]
}

/// The labels of the core Node that shows a Node with these.
#[must_use]
pub fn labels(stored: &Labels, kind: NodeKind, name: &str) -> Labels {
    let mut labels = stored.clone();
    for (key, value) in added(kind, name) {
        labels.entry(key.to_owned()).or_insert(value);
    }
    labels
}

fn node_status(object: &Value, node: &Node, status: &NodeStatus) -> Value {
    let label = |key: &str| {
        let labels = node.metadata.labels.as_ref();
        labels.and_then(|labels| labels.get(key)).cloned().unwrap_or_default()
    };
    let runtimes: Vec<String> = status
        .runtimes
        .iter()
        .filter(|runtime| runtime.available)
        .map(|runtime| format!("{}://{}", runtime.name, runtime.version))
        .collect();
    let mut addresses = vec![json!({"type": "Hostname", "address": node.metadata.name})];
    if !status.address.is_empty() {
        // The port of the agent's connection is nobody's to call.
        let socket = status.address.parse::<SocketAddr>().map(|address| address.ip());
        let address = socket.or_else(|_| status.address.parse::<IpAddr>());
        addresses.insert(
            0,
            match address {
                Ok(ip) => json!({"type": "InternalIP", "address": ip.to_string()}),
                Err(_) => json!({"type": "InternalDNS", "address": status.address}),
            },
        );
    }
    json!({
        "capacity": resources(&status.capacity),
        "allocatable": resources(&status.allocatable),
        "conditions": conditions(object),
        "addresses": addresses,
        "nodeInfo": {
            "kubeletVersion": status.agent_version,
            "kubeProxyVersion": "",
            "osImage": "",
            "kernelVersion": "",
            "operatingSystem": label("muster.dev/os"),
            "architecture": label("muster.dev/arch"),
            "containerRuntimeVersion": runtimes.join(","),
            "machineID": "",
            "systemUUID": "",
            "bootID": status.incarnation,
        },
    })
}

/// The conditions as they are; all have Kubernetes' form.
fn conditions(object: &Value) -> Value {
    let mut conditions = object["status"]["conditions"].as_array().cloned().unwrap_or_default();
    for condition in &mut conditions {
        condition["lastHeartbeatTime"] = object["status"]["lastSeen"].clone();
    }
    conditions.into()
}

/// Our Node with what `changed`, a changed copy of its view, asks for: whether it takes tasks, its taints, labels and
/// annotations. Everything else of a core Node says nothing here.
#[must_use]
pub fn changed(object: &Value, node: &Node, changed: &Value) -> Value {
    let mut object = object.clone();
    let mut labels = changed["metadata"]["labels"].as_object().cloned().unwrap_or_default();
    for (key, value) in own_labels(&object, node) {
        if labels.get(key).is_some_and(|said| *said == value.as_str()) {
            labels.remove(key);
        }
    }
    set_texts(&mut object, "labels", labels);
    let annotations = changed["metadata"]["annotations"].as_object().cloned().unwrap_or_default();
    set_texts(&mut object, "annotations", annotations);
    take_metadata(&mut object, changed);
    object["spec"]["unschedulable"] =
        (changed["spec"]["unschedulable"] == Value::Bool(true)).into();
    let mut taints = changed["spec"]["taints"].as_array().cloned().unwrap_or_default();
    // What the view adds is not written; what somebody has set stays theirs.
    if !is_tainted(&object) {
        taints.retain(|taint| taint["key"] != UNSCHEDULABLE);
    }
    for taint in &mut taints {
        if let Some(taint) = taint.as_object_mut() {
            taint.remove("timeAdded");
        }
    }
    object["spec"]["taints"] = taints.into();
    object
}

#[cfg(test)]
mod tests {
    use muster_api::kind::projected;

    use super::*;

    #[test]
    fn a_view_is_read_by_kubectl_and_changes_come_back() {
        let object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Node",
            "metadata": {"name": "r1", "uid": "u", "resourceVersion": "3", "labels": {"floor": "2"}},
            "spec": {"kind": "Robot", "speed": 0.5},
            "status": {"capacity": {"cpu": "2", "memory": "4Gi"}, "allocatable": {"cpu": "1500m", "memory": "3Gi"},
                "address": "127.0.0.1:4711", "agentVersion": "0.1.0", "lastSeen": "2026-01-01T00:00:00.000000Z",
                "conditions": [{"type": "Ready", "status": "True"}]},
        });
        let ours: Node = serde_json::from_value(object.clone()).expect("a node");
        let mut view = node(&object, &ours);
        serde_json::from_value::<projected::Node>(view.clone())
            .expect("kubectl reads it as a Node");
        assert_eq!(view["status"]["addresses"][0]["address"], "127.0.0.1");
        assert_eq!(view["metadata"]["labels"]["node-role.kubernetes.io/robot"], "");

        view["spec"]["unschedulable"] = true.into();
        view["spec"]["taints"] = json!([{"key": "k", "effect": "NoSchedule", "timeAdded": "x"}]);
        view["metadata"]["labels"]["floor"] = "3".into();
        let changed = changed(&object, &ours, &view);
        assert_eq!(
            changed["spec"],
            json!({"kind": "Robot", "speed": 0.5, "unschedulable": true,
            "taints": [{"key": "k", "effect": "NoSchedule"}]})
        );
        assert_eq!(
            changed["metadata"]["labels"],
            json!({"floor": "3"}),
            "what the view adds is not written"
        );
        let again: Node = serde_json::from_value(changed.clone()).expect("a node");
        let shown = node(&changed, &again);
        assert_eq!(shown["spec"]["taints"][1]["key"], UNSCHEDULABLE);
    }

    #[test]
    fn a_taint_that_somebody_set_is_not_taken_for_the_views_own() {
        let object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Node", "metadata": {"name": "r1", "labels": {"a": "b"}},
            "spec": {"kind": "Robot", "unschedulable": true, "taints": [{"key": UNSCHEDULABLE, "effect": "NoSchedule"}]},
        });
        let ours: Node = serde_json::from_value(object.clone()).expect("a node");
        let mut view = node(&object, &ours);
        assert_eq!(view["spec"]["taints"], object["spec"]["taints"], "once");
        let stored: Labels =
            serde_json::from_value(object["metadata"]["labels"].clone()).expect("texts");
        assert_eq!(json!(labels(&stored, NodeKind::Robot, "r1")), view["metadata"]["labels"]);
        view["metadata"]["labels"]["floor"] = "3".into();
        assert_eq!(changed(&object, &ours, &view)["spec"]["taints"], object["spec"]["taints"]);
    }
}
