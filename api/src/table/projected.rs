//! Tasks and nodes as core kinds, in kubectl's own columns.

use k8s_openapi::api::core::v1::{Node, NodeStatus, Pod, PodStatus};

use super::{Cell, Column, age};

pub(super) const POD: &[Column<Pod>] = &[
    Column::new("READY", |pod, _| {
        let containers = pod.status.as_ref().and_then(|s| s.container_statuses.as_ref());
        let ready = containers.into_iter().flatten().filter(|c| c.ready).count();
        let all = pod.spec.as_ref().map_or(0, |spec| spec.containers.len());
        format!("{ready}/{all}").into()
    }),
    Column::new("STATUS", |pod, _| pod_state(pod)),
    Column::new("RESTARTS", |pod, _| {
        let containers = pod.status.as_ref().and_then(|s| s.container_statuses.as_ref());
        let restarts: i32 = containers.into_iter().flatten().map(|c| c.restart_count).sum();
        restarts.to_string().into()
    }),
    Column::new("AGE", |pod, now| age(pod.metadata.creation_timestamp.as_ref(), now)),
    Column::wide("IP", |pod, _| of_pod(pod, |s| s.pod_ip.clone())),
    Column::wide("NODE", |pod, _| {
        or_none(pod.spec.as_ref().and_then(|spec| spec.node_name.clone()))
    }),
    Column::wide("NOMINATED NODE", |pod, _| of_pod(pod, |s| s.nominated_node_name.clone())),
    Column::wide("READINESS GATES", |_, _| or_none(None)),
];

pub(super) const NODE: &[Column<Node>] = &[
    Column::new("STATUS", |node, _| node_state(node)),
    Column::new("ROLES", |node, _| {
        const ROLE: &str = "node-role.kubernetes.io/";
        let labels = node.metadata.labels.iter().flatten();
        let roles: Vec<&str> = labels.filter_map(|(key, _)| key.strip_prefix(ROLE)).collect();
        or_none((!roles.is_empty()).then(|| roles.join(",")))
    }),
    Column::new("AGE", |node, now| age(node.metadata.creation_timestamp.as_ref(), now)),
    Column::new("VERSION", |node, _| of_machine(node, |i| &i.kubelet_version)),
    Column::wide("INTERNAL-IP", |node, _| {
        let addresses = node.status.as_ref().and_then(|s| s.addresses.as_ref());
        let internal = addresses.into_iter().flatten().find(|a| a.type_ == "InternalIP");
        or_none(internal.map(|a| a.address.clone()))
    }),
    Column::wide("EXTERNAL-IP", |_, _| or_none(None)),
    Column::wide("OS-IMAGE", |node, _| of_machine(node, |i| &i.os_image)),
    Column::wide("KERNEL-VERSION", |node, _| of_machine(node, |i| &i.kernel_version)),
    Column::wide("CONTAINER-RUNTIME", |node, _| of_machine(node, |i| &i.container_runtime_version)),
];

fn or_none(text: Option<String>) -> Cell {
    text.filter(|t| !t.is_empty()).unwrap_or_else(|| "<none>".to_owned()).into()
}

fn of_pod(pod: &Pod, text: impl Fn(&PodStatus) -> Option<String>) -> Cell {
    or_none(pod.status.as_ref().and_then(text))
}

/// One word for where the pod is in its life, as kubectl has it: the reason of its container before its phase.
fn pod_state(pod: &Pod) -> Cell {
    if pod.metadata.deletion_timestamp.is_some() {
        return "Terminating".into();
    }
    let Some(status) = &pod.status else { return "Unknown".into() };
    let state = status.container_statuses.iter().flatten().find_map(|c| c.state.as_ref());
    let waits = state.and_then(|s| s.waiting.as_ref()).and_then(|w| w.reason.clone());
    let ended = state.and_then(|s| s.terminated.as_ref()).and_then(|t| t.reason.clone());
    waits.or(ended).or_else(|| status.phase.clone()).unwrap_or_default().into()
}

fn node_state(node: &Node) -> Cell {
    let conditions = node.status.as_ref().and_then(|s| s.conditions.as_ref());
    let ready = conditions.into_iter().flatten().find(|c| c.type_ == "Ready");
    let ready = match ready.map(|c| c.status.as_str()) {
        Some("True") => "Ready",
        Some(_) => "NotReady",
        None => "Unknown",
    };
    let cordoned = node.spec.as_ref().and_then(|s| s.unschedulable).unwrap_or_default();
    if cordoned { format!("{ready},SchedulingDisabled").into() } else { ready.into() }
}

fn of_machine(
    node: &Node,
    text: fn(&k8s_openapi::api::core::v1::NodeSystemInfo) -> &String,
) -> Cell {
    let machine = node.status.as_ref().and_then(|s: &NodeStatus| s.node_info.as_ref());
    or_none(machine.map(|info| text(info).clone()))
}
