//! Tasks and nodes as core Pods and Nodes, for tools that know only these: pure functions of one stored object.
//!
//! | module | shows |
//! |---|---|
//! | [`pod`] | a Task as a Pod with one container, `task` |
//! | [`node`] | a Node as a core Node, and what a change of that means for ours |

pub mod node;
pub mod pod;

use muster_api::resource::Compute;
use serde_json::{Map, Value, json};

/// The metadata that both views share.
const METADATA: [&str; 11] = [
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
    "ownerReferences",
];

fn metadata(object: &Value) -> Map<String, Value> {
    let of = |field: &&str| Some(((*field).to_owned(), object["metadata"].get(*field)?.clone()));
    METADATA.iter().filter_map(of).collect()
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
