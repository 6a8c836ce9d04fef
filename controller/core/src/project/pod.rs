//! A Task as a Pod.

use muster_api::kind::task::{EnvVar, Network, RestartPolicy, Task, TaskSpec, TaskStatus};
use muster_api::phase::TaskPhase;
use serde_json::{Value, json};

use super::{condition, metadata, resources, set_texts, take_metadata};

/// Fields of a Pod's spec that may change, and where they stand in a Task. Tolerations and the grace period are those that
/// Kubernetes lets change as well.
const CHANGEABLE: [(&str, &[&str]); 3] = [
    ("tolerations", &["spec", "placement", "tolerations"]),
    ("terminationGracePeriodSeconds", &["spec", "gracePeriodSeconds"]),
    ("priority", &["spec", "priority"]),
];

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

/// Our Task with what `changed`, a changed copy of its view, asks for: its metadata, and what of a Task's spec may change.
/// What it says of the status says nothing here.
///
/// # Errors
/// The fields of the view that were changed and cannot be.
pub fn changed(object: &Value, task: &Task, changed: &Value) -> Result<Value, Vec<String>> {
    let (view, mut object) = (pod(object, task), object.clone());
    for field in ["labels", "annotations"] {
        let texts = changed["metadata"][field].as_object().cloned().unwrap_or_default();
        set_texts(&mut object, field, texts);
    }
    take_metadata(&mut object, changed);
    let fields = |view: &Value| view["spec"].as_object().cloned().unwrap_or_default();
    let (before, after) = (fields(&view), fields(changed));
    let mut refused = Vec::new();
    for field in before.keys().chain(after.keys().filter(|field| !before.contains_key(*field))) {
        if before.get(field) == after.get(field) {
            continue;
        }
        let place = CHANGEABLE.iter().find(|(name, _)| name == field).map(|(_, place)| *place);
        match (place, after.get(field)) {
            (Some(place), value) => put(&mut object, place, value.filter(|v| !v.is_null())),
            (None, _) => refused.push(format!("spec.{field}")),
        }
    }
    if refused.is_empty() { Ok(object) } else { Err(refused) }
}

/// Puts a value at a place; none takes away what is there, which is the default.
fn put(object: &mut Value, place: &[&str], value: Option<&Value>) {
    let Some((last, way)) = place.split_last() else { return };
    let parent = way.iter().fold(object, |object, step| &mut object[*step]);
    match value {
        Some(value) => parent[*last] = value.clone(),
        None => {
            if let Some(fields) = parent.as_object_mut() {
                fields.remove(*last);
            }
        }
    }
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
    // Names of users, which processes may have, are nothing that a pod could say.
    let user = spec.run.container.as_ref().and_then(|run| run.user.as_deref());
    if let Some(user) = user {
        let (uid, gid) = user.split_once(':').map_or((user, None), |(uid, gid)| (uid, Some(gid)));
        for (field, id) in [("runAsUser", Some(uid)), ("runAsGroup", gid)] {
            if let Some(id) = id.and_then(|id| id.parse::<u32>().ok()) {
                container["securityContext"][field] = id.into();
            }
        }
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

    #[test]
    fn a_changed_pod_is_a_changed_task_or_says_which_field_it_cannot_be() {
        let object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Task",
            "metadata": {"name": "t", "uid": "u", "resourceVersion": "7", "labels": {"a": "b"}, "finalizers": ["x/y"]},
            "spec": {"priority": 1, "run": {"process": {"command": ["sh"]}}},
        });
        let task: Task = serde_json::from_value(object.clone()).expect("a task");
        let view = pod(&object, &task);
        let same = changed(&object, &task, &view).expect("nothing was changed");
        assert_eq!(same, object);

        let mut wanted = view;
        wanted["metadata"]["labels"] = json!({"c": "d"});
        wanted["metadata"]["finalizers"] = json!([]);
        wanted["spec"]["priority"] = 5.into();
        wanted["spec"]["tolerations"] = json!([{"key": "k", "operator": "Exists"}]);
        wanted["status"]["phase"] = "Failed".into();
        let new = changed(&object, &task, &wanted).expect("all of it may change");
        assert_eq!(new["metadata"]["labels"], json!({"c": "d"}));
        assert!(new["metadata"].get("finalizers").is_none());
        assert_eq!(new["spec"]["priority"], 5);
        assert_eq!(new["spec"]["placement"]["tolerations"][0]["key"], "k");
        assert!(new.get("status").is_none());
        let again: Task = serde_json::from_value(new.clone()).expect("a task");
        assert_eq!(pod(&new, &again)["spec"], wanted["spec"], "and shows what was wanted");

        wanted["spec"]["containers"][0]["image"] = "other".into();
        wanted["spec"]["hostPID"] = true.into();
        let refused = changed(&object, &task, &wanted).expect_err("what runs is the Task's");
        assert_eq!(refused, ["spec.containers", "spec.hostPID"]);
    }
}
