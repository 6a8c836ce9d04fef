//! A TaskSet: how many of it serve, what its rollout does, and why the others do not serve.

use jiff::Timestamp;
use muster_api::condition::{ConditionStatus, PROGRESSING, REPLICA_FAILURE};
use muster_api::kind::task::{Task, TaskStatus};
use muster_api::kind::taskset::{TaskSet, TaskSetStatus};
use serde_json::{Value, json};

use super::Asked;
use crate::output::human;
use crate::output::style::Styles;
use crate::output::table::Table;

/// The text, and what programs get.
pub(super) fn told(
    asked: &Asked<'_>,
    tasks: &[Value],
    styles: &Styles,
) -> Result<(String, Value), serde_json::Error> {
    let set: TaskSet = serde_json::from_value(asked.object.clone())?;
    let tasks: Vec<Task> =
        tasks.iter().cloned().map(serde_json::from_value).collect::<Result<_, _>>()?;
    let nothing = TaskSetStatus::default();
    let status = set.status.as_ref().unwrap_or(&nothing);
    let mut text = format!("{}\n", headline(asked.name, &set, status));
    for said in trouble(status) {
        text.push_str(&format!("{}\n", styles.warn.paint(said)));
    }
    let rows: Vec<(String, String, String)> = tasks.iter().filter_map(idle).collect();
    if !rows.is_empty() {
        let mut table = Table::new(["TASK", "PHASE", "WHY"]);
        for (name, phase, why) in &rows {
            table.push([name.as_str(), phase.as_str(), why.as_str()]);
        }
        text.push_str(&format!("\n{}", table.text(styles)));
        if tasks.iter().any(waits) {
            let hint = "`muster why task/NAME` says it for each node";
            text.push_str(&format!("\n{} {hint}\n", styles.dim.paint("hint:")));
        }
    }
    let rows: Vec<Value> = rows
        .into_iter()
        .map(|(task, phase, why)| json!({"task": task, "phase": phase, "why": why}))
        .collect();
    Ok((text, json!({"status": status, "tasks": rows})))
}

fn headline(name: &str, set: &TaskSet, status: &TaskSetStatus) -> String {
    let (available, desired) = (status.available_replicas, status.desired_replicas);
    let rollout = status.condition(PROGRESSING).map_or_else(String::new, |said| {
        let message = Some(&said.message).filter(|m| !m.is_empty());
        let message = message.map(|m| format!(" ({m})")).unwrap_or_default();
        format!(" Its rollout: {}{message}.", said.reason)
    });
    let behind = status.observed_generation < set.metadata.generation.unwrap_or_default();
    let behind = if behind { " Its last change has not been looked at yet." } else { "" };
    format!("taskset/{name}: {available} of {desired} available.{rollout}{behind}")
}

/// What stands in the way of the set itself.
fn trouble(status: &TaskSetStatus) -> Vec<String> {
    let failed = status.condition(REPLICA_FAILURE);
    let failed = failed.filter(|c| c.status == ConditionStatus::True);
    failed.map(|c| format!("{}: {}", c.reason, c.message)).into_iter().collect()
}

fn waits(task: &Task) -> bool {
    task.status.as_ref().is_some_and(|status| !status.why.is_empty())
}

/// A task that does not serve, and why.
fn idle(task: &Task) -> Option<(String, String, String)> {
    let status = task.status.clone().unwrap_or_default();
    if status.is_ready() {
        return None;
    }
    let name = task.metadata.name.clone().unwrap_or_default();
    Some((name, status.phase.as_str().to_owned(), why(&status)))
}

fn why(status: &TaskStatus) -> String {
    if let Some(first) = status.why.first() {
        let node = if first.node.is_empty() { "" } else { &*format!("{} ", first.node) };
        let more = match status.why.len() - 1 {
            0 => String::new(),
            more => format!("; {more} more"),
        };
        return format!("{}: {node}{}{more}", first.reason, first.message);
    }
    let when = status.started_at.as_ref().map(|at| human::age(at.0, Timestamp::now()));
    match (status.reason.is_empty(), status.message.is_empty(), when) {
        (true, true, Some(age)) => format!("since {age}"),
        (true, true, None) => String::new(),
        (true, false, _) => status.message.clone(),
        (false, true, _) => status.reason.clone(),
        (false, false, _) => format!("{}: {}", status.reason, status.message),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_does_not_serve_says_why() {
        let set = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "TaskSet",
            "metadata": {"name": "watch", "generation": 2},
            "spec": {"replicas": 4, "template": {"spec": {"run": {"process": {"command": ["x"]}}}}},
            "status": {
                "observedGeneration": 2, "desiredReplicas": 4, "availableReplicas": 1,
                "conditions": [
                    {"type": "Progressing", "status": "True", "reason": "Replacing", "message": "1 of 4"},
                    {"type": "ReplicaFailure", "status": "True", "reason": "FailedCreate", "message": "asks for 1 cpu"},
                ],
            },
        });
        let task = |name: &str, status: Value| {
            json!({
                "apiVersion": "muster.dev/v1alpha1", "kind": "Task", "metadata": {"name": name},
                "spec": {"run": {"process": {"command": ["x"]}}}, "status": status,
            })
        };
        let refusal = json!({"node": "r1", "reason": "Cordoned", "message": "is cordoned"});
        let tasks = [
            task("watch-0", json!({"phase": "Running"})),
            task("watch-1", json!({"phase": "Pending", "why": [refusal, refusal]})),
            task(
                "watch-2",
                json!({"phase": "Running", "ready": false, "reason": "NotReady", "message": "HTTP status 503"}),
            ),
        ];
        let asked = Asked { name: "watch", object: set, answer: None };
        let (text, value) = told(&asked, &tasks, &Styles::default()).expect("they read");
        assert_eq!(
            text,
            "taskset/watch: 1 of 4 available. Its rollout: Replacing (1 of 4).\n\
             FailedCreate: asks for 1 cpu\n\
             \nTASK      PHASE     WHY\n\
             watch-1   Pending   Cordoned: r1 is cordoned; 1 more\n\
             watch-2   Running   NotReady: HTTP status 503\n\
             \nhint: `muster why task/NAME` says it for each node\n"
        );
        assert_eq!(value["tasks"][1]["task"], "watch-2");
    }
}
