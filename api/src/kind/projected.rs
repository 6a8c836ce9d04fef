//! Tasks and nodes as core kinds: what tools show that know only Pods and Nodes. They are made when somebody reads them;
//! nothing is stored under these kinds, and nothing new is admitted.

pub use k8s_openapi::api::core::v1::{Node, Pod, Service};
use serde_json::Value;

use super::{KindInfo, any_change};
use crate::validate::Violations;

fn refuse(_: &mut Value, violations: &mut Violations) {
    violations
        .forbidden("kind", "is only another view of muster's own kinds")
        .suggest("create a Task or a Node of muster.dev/v1alpha1");
}

/// Every Task, as a Pod with one container.
pub static POD: KindInfo = KindInfo {
    group: "",
    version: "v1",
    kind: "Pod",
    plural: "pods",
    singular: "pod",
    short_names: &["po"],
    namespaced: true,
    has_status: true,
    selectable: &[
        "spec.hostNetwork",
        "spec.nodeName",
        "spec.restartPolicy",
        "spec.schedulerName",
        "spec.serviceAccountName",
        "status.nominatedNodeName",
        "status.phase",
        "status.podIP",
    ],
    schema: |g| g.subschema_for::<Pod>(),
    admit_body: refuse,
    admit_change: any_change,
};

/// Every Node of muster's, as a core Node.
pub static NODE: KindInfo = KindInfo {
    group: "",
    version: "v1",
    kind: "Node",
    plural: "nodes",
    singular: "node",
    short_names: &["no"],
    namespaced: false,
    has_status: true,
    selectable: &["spec.unschedulable"],
    schema: |g| g.subschema_for::<Node>(),
    admit_body: refuse,
    admit_change: any_change,
};

/// Services, of which there are none here: tasks find each other by ROS or by address. Clients ask for them as a matter of
/// course (`kubectl cluster-info` before it says where the cluster is), and an empty list is the true answer.
pub static SERVICE: KindInfo = KindInfo {
    group: "",
    version: "v1",
    kind: "Service",
    plural: "services",
    singular: "service",
    short_names: &["svc"],
    namespaced: true,
    has_status: false,
    selectable: &["spec.clusterIP", "spec.type"],
    schema: |g| g.subschema_for::<Service>(),
    admit_body: refuse,
    admit_change: any_change,
};
