//! A Task as a Pod.

use muster_api::kind::task::{EnvVar, Network, RestartPolicy, Task, TaskSpec, TaskStatus};
use muster_api::phase::TaskPhase;
use serde_json::{Value, json};

use super::{condition, metadata, resources};

/// The name of a task's one container.
pub const CONTAINER: &str = "task";

/// The Pod that shows a stored Task; none when it does not read as one.
#[must_use]
pub fn pod(object: &Value, task: &Task) -> Value {
    let status = task.status.clone().unwrap_or_default();
    json!({
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": metadata(object),
        "spec": spec(&task.spec, &status),
        "status": pod_status(object, &task.spec, &status),
    })
}

fn spec(spec: &TaskSpec, status: &TaskStatus) -> Value {
    let mut pod = json!({
        "containers": [container(spec)],
        "restartPolicy": match spec.restart_policy {
            RestartPolicy::Never => "Never",
            RestartPolicy::OnFailure => "OnFailure",
            RestartPolicy::Always => "Always",
        },
        "terminationGracePeriodSeconds": spec.grace_period_seconds,
        "priority": spec.priority,
        "hostNetwork": spec.run.container.as_ref().is_none_or(|c| c.network == Network::Host),
        "enableServiceLinks": false,
    });
    if let Some(node) = &status.node {
        pod["nodeName"] = node.as_str().into();
    }
    if !spec.placement.selector.match_labels.is_empty() {
        pod["nodeSelector"] = json!(spec.placement.selector.match_labels);
    }
    if !spec.placement.tolerations.is_empty() {
        pod["tolerations"] = json!(spec.placement.tolerations);
    }
    if let Some(seconds) = spec.active_deadline_seconds {
        pod["activeDeadlineSeconds"] = seconds.into();
    }
    pod
}

fn container(spec: &TaskSpec) -> Value {
    let reserved = resources(&spec.resources.reserved());
    let mut container = json!({"name": CONTAINER});
    if !reserved.is_empty() {
        container["resources"] = json!({"requests": reserved, "limits": reserved});
    }
    let (image, command, args, env, dir) = if let Some(run) = &spec.run.container {
        (run.image.as_str(), &run.command, &run.args, &run.env, &run.working_dir)
    } else if let Some(run) = &spec.run.process {
        ("process", &run.command, &run.args, &run.env, &run.working_dir)
    } else {
        container["image"] = "executor".into();
        return container;
    };
    container["image"] = image.into();
    for (field, list) in [("command", command), ("args", args)] {
        if !list.is_empty() {
            container[field] = json!(list);
        }
    }
    // Where a value comes from elsewhere, only the name is shown.
    let named = |var: &EnvVar| match &var.value_from {
        None => json!({"name": var.name, "value": var.value}),
        Some(_) => json!({"name": var.name}),
    };
    if !env.is_empty() {
        container["env"] = env.iter().map(named).collect();
    }
    if let Some(dir) = dir {
        container["workingDir"] = dir.as_str().into();
    }
    container
}

fn phase(phase: TaskPhase) -> &'static str {
    match phase {
        TaskPhase::Pending | TaskPhase::Bound | TaskPhase::Starting => "Pending",
        TaskPhase::Running | TaskPhase::Stopping => "Running",
        TaskPhase::Succeeded => "Succeeded",
        TaskPhase::Failed => "Failed",
        TaskPhase::Unknown => "Unknown",
    }
}

fn pod_status(object: &Value, spec: &TaskSpec, status: &TaskStatus) -> Value {
    let written = &object["status"];
    let ready = status.is_ready();
    let since =
        if written["readyAt"].is_null() { &written["startedAt"] } else { &written["readyAt"] };
    let mut shown = json!({
        "phase": phase(status.phase),
        "qosClass": if spec.resources.reserved() == Default::default() { "BestEffort" } else { "Guaranteed" },
        "conditions": [
            condition("PodScheduled", status.node.is_some(), if status.node.is_some() { "" } else { "Unschedulable" }, &written["boundAt"]),
            condition("Initialized", status.node.is_some(), "", &written["boundAt"]),
            condition("ContainersReady", ready, "", since),
            condition("Ready", ready, "", since),
        ],
    });
    let texts = [
        ("reason", Some(&status.reason).filter(|_| status.phase.is_terminal())),
        ("message", Some(&status.message)),
        ("nominatedNodeName", status.nominated_node.as_ref()),
    ];
    for (field, text) in texts {
        if let Some(text) = text.filter(|text| !text.is_empty()) {
            shown[field] = text.as_str().into();
        }
    }
    if !written["boundAt"].is_null() {
        shown["startTime"] = written["boundAt"].clone();
    }
    if status.node.is_some() {
        shown["containerStatuses"] = json!([container_status(object, spec, status)]);
    }
    shown
}

fn container_status(object: &Value, spec: &TaskSpec, status: &TaskStatus) -> Value {
    let written = &object["status"];
    let image = spec.run.container.as_ref().map_or("process", |run| run.image.as_str());
    let runs = matches!(status.phase, TaskPhase::Running | TaskPhase::Stopping);
    let terminated = || {
        let mut end = json!({
            // What a shell says of a signal; kubectl knows nothing else.
            "exitCode": status.exit_code.or_else(|| status.signal.map(|s| 128 + s)).unwrap_or_default(),
            "reason": match (status.phase, status.reason.as_str()) {
                (TaskPhase::Succeeded, _) => "Completed",
                (_, "") => "Error",
                (_, reason) => reason,
            },
        });
        if let Some(signal) = status.signal {
            end["signal"] = signal.into();
        }
        for field in ["startedAt", "finishedAt"] {
            if !written[field].is_null() {
                end[field] = written[field].clone();
            }
        }
        end
    };
    let state = if status.phase.is_terminal() {
        json!({"terminated": terminated()})
    } else if runs {
        json!({"running": {"startedAt": written["startedAt"]}})
    } else {
        let reason = if status.reason.is_empty() { status.phase.as_str() } else { &status.reason };
        json!({"waiting": {"reason": reason, "message": status.message}})
    };
    let before =
        !status.phase.is_terminal() && (status.exit_code.is_some() || status.signal.is_some());
    json!({
        "name": CONTAINER,
        "image": image,
        "imageID": "",
        "ready": status.is_ready(),
        "started": runs,
        "restartCount": status.attempt.saturating_sub(1),
        "state": state,
        "lastState": if before { json!({"terminated": terminated()}) } else { json!({}) },
    })
}

#[cfg(test)]
mod tests {
    use muster_api::kind::projected::Pod;

    use super::*;

    fn show(status: Value) -> Value {
        let object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Task",
            "metadata": {"name": "t", "namespace": "lab", "uid": "u", "resourceVersion": "7",
                         "creationTimestamp": "2026-01-01T00:00:00Z", "labels": {"a": "b"}},
            "spec": {
                "resources": {"cpu": "500m", "memory": "64Mi", "extended": {"gpu": 1}},
                "run": {"process": {"command": ["sh", "-c"], "args": ["x"], "env": [{"name": "A", "value": "1"}]}},
            },
            "status": status,
        });
        let task: Task = serde_json::from_value(object.clone()).expect("a task");
        let shown = pod(&object, &task);
        serde_json::from_value::<Pod>(shown.clone()).expect("kubectl reads it as a Pod");
        shown
    }

    #[test]
    fn a_running_task_is_a_ready_pod() {
        let shown = show(json!({"phase": "Running", "node": "r1", "attempt": 3, "exitCode": 7,
            "startedAt": "2026-01-01T00:00:01.000000Z", "finishedAt": "2026-01-01T00:00:00.500000Z"}));
        assert_eq!(shown["spec"]["nodeName"], "r1");
        assert_eq!(shown["metadata"]["resourceVersion"], "7");
        let container = &shown["spec"]["containers"][0];
        assert_eq!(container["command"], json!(["sh", "-c"]));
        assert_eq!(container["resources"]["limits"]["muster.dev/gpu"], "1");
        let status = &shown["status"]["containerStatuses"][0];
        assert_eq!((&status["ready"], &status["restartCount"]), (&json!(true), &json!(2)));
        assert_eq!(status["lastState"]["terminated"]["exitCode"], 7);
        assert!(status["state"]["running"].is_object());
    }

    #[test]
    fn a_waiting_and_an_ended_task_say_why() {
        let waiting =
            show(json!({"phase": "Pending", "reason": "Unschedulable", "message": "no node"}));
        assert_eq!(waiting["status"]["phase"], "Pending");
        assert!(waiting["status"].get("containerStatuses").is_none(), "it is on no node");
        let killed = show(
            json!({"phase": "Failed", "node": "r1", "attempt": 1, "signal": 9, "reason": "OOMKilled"}),
        );
        let end = &killed["status"]["containerStatuses"][0]["state"]["terminated"];
        assert_eq!((&end["exitCode"], &end["reason"]), (&json!(137), &json!("OOMKilled")));
    }
}
