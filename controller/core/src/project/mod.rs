//! Tasks and nodes as core Pods and Nodes, for tools that know only these: pure functions of one stored object.
//!
//! | module | shows |
//! |---|---|
//! | [`pod`] | a Task as a Pod with one container, `task`, and what a change of that means for the Task |
//! | [`node`] | a Node as a core Node, and what a change of that means for ours |

pub mod node;
pub mod pod;

use muster_api::resource::Compute;
use serde_json::{Map, Value, json};

/// The metadata that both views share.
const METADATA: [&str; 12] = [
    "name",
    "namespace",
    "uid",
    "resourceVersion",
    "generation",
    "creationTimestamp",
    "deletionTimestamp",
    "deletionGracePeriodSeconds",
    "labels",
    "annotations",
    "finalizers",
    "ownerReferences",
];

fn metadata(object: &Value) -> Map<String, Value> {
    let of = |field: &&str| Some(((*field).to_owned(), object["metadata"].get(*field)?.clone()));
    METADATA.iter().filter_map(of).collect()
}

/// Gives `object` what its changed view says of the metadata that clients own, labels and annotations apart. Which object it
/// is about, and at which version, goes along: that is held against what there is.
fn take_metadata(object: &mut Value, changed: &Value) {
    for field in ["uid", "resourceVersion", "name"] {
        object["metadata"][field] = changed["metadata"][field].clone();
    }
    let Some(metadata) = object["metadata"].as_object_mut() else { return };
    for field in ["finalizers", "ownerReferences"] {
        match changed["metadata"][field].as_array().filter(|list| !list.is_empty()) {
            Some(list) => drop(metadata.insert(field.to_owned(), list.clone().into())),
            None => drop(metadata.remove(field)),
        }
    }
}

fn set_texts(object: &mut Value, field: &str, texts: Map<String, Value>) {
    let Some(metadata) = object["metadata"].as_object_mut() else { return };
    match texts.is_empty() {
        true => drop(metadata.remove(field)),
        false => drop(metadata.insert(field.to_owned(), texts.into())),
    }
}

/// CR as a Kubernetes resource list.
fn resources(compute: &Compute) -> Map<String, Value> {
    let mut list = Map::new();
    if compute.cpu.0 > 0 {
        list.insert("cpu".into(), compute.cpu.to_string().into());
    }
    if compute.memory.0 > 0 {
        list.insert("memory".into(), compute.memory.to_string().into());
    }
    for (name, count) in &compute.extended {
        // Kubernetes wants a domain before the names of such resources.
        let name = if name.contains('/') { name.clone() } else { format!("muster.dev/{name}") };
        list.insert(name, count.to_string().into());
    }
    list
}

fn condition(r#type: &str, holds: bool, reason: &str, since: &Value) -> Value {
    let mut condition = json!({"type": r#type, "status": if holds { "True" } else { "False" }});
    if !reason.is_empty() {
        condition["reason"] = reason.into();
    }
    if !since.is_null() {
        condition["lastTransitionTime"] = since.clone();
    }
    condition
}
