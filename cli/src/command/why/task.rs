//! A task: where it runs and why there, how it ended, or, per node, what refuses it.

use muster_api::kind::task::{Cost, NodeRefusal, Task, TaskStatus};
use muster_api::phase::TaskPhase;
use serde_json::{Value, json};

use super::{Asked, advice, refusals_and_hints, tries_table};
use crate::output::columns::task as columns;
use crate::output::human;
use crate::output::style::Styles;

/// The text, and what programs get when the controller has no answer of its own.
pub(super) fn told(
    asked: &Asked<'_>,
    styles: &Styles,
) -> Result<(String, Value), serde_json::Error> {
    let task: Task = serde_json::from_value(asked.object.clone())?;
    let status = task.status.clone().unwrap_or_default();
    let why = asked.refusals().unwrap_or_else(|| status.why.clone());
    let text = story(asked.name, &task, &why, styles);
    Ok((text, json!({"phase": status.phase, "why": why, "decision": null})))
}

fn story(name: &str, task: &Task, why: &[NodeRefusal], styles: &Styles) -> String {
    let status = task.status.clone().unwrap_or_default();
    let mut text = format!("{}\n", headline(name, &status));
    match status.phase {
        TaskPhase::Pending if why.is_empty() => {
            text.push_str("The scheduler has not looked at it yet.\n");
        }
        TaskPhase::Pending => {
            let hints = advice(why, "spec.placement.within");
            text.push_str(&refusals_and_hints(why, &hints, styles));
        }
        _ => {
            for line in placed(task, &status) {
                text.push_str(&format!("{line}\n"));
            }
            if !status.message.is_empty() {
                text.push_str(&format!("{}\n", human::plain(&status.message)));
            }
        }
    }
    if !status.earlier.is_empty() {
        text.push_str(&format!(
            "\nIt was tried before:\n{}",
            tries_table(&status.earlier).text(styles)
        ));
    }
    text
}

/// The first line: what is so.
fn headline(name: &str, status: &TaskStatus) -> String {
    let since = |time: &Option<k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime>| {
        time.as_ref()
            .map(|t| format!(" for {}", human::age(t.0, jiff::Timestamp::now())))
            .unwrap_or_default()
    };
    let node = status.node.as_deref().unwrap_or("a node");
    let reason = Some(status.reason.as_str()).filter(|r| !r.is_empty());
    let because = reason.map(|r| format!(" ({r})")).unwrap_or_default();
    match status.phase {
        TaskPhase::Pending => match status.why.iter().find(|w| w.reason == "BackOff") {
            Some(hold) => format!("task/{name} waits: it {}.", hold.message),
            None => format!("task/{name} waits: no node takes it now."),
        },
        TaskPhase::Bound => {
            format!(
                "task/{name} is placed on {node}{}; its agent has not started it yet{because}.",
                since(&status.bound_at)
            )
        }
        TaskPhase::Starting => {
            format!("task/{name} is being started on {node}{because}.")
        }
        TaskPhase::Running => {
            format!(
                "task/{name} runs on {node}{}, attempt {}{because}.",
                since(&status.started_at),
                status.attempt
            )
        }
        TaskPhase::Stopping => {
            format!(
                "task/{name} is being ended on {node}; its reservation and lease stay until its processes are gone{because}."
            )
        }
        TaskPhase::Succeeded | TaskPhase::Failed => {
            let verb = if status.phase == TaskPhase::Succeeded { "succeeded" } else { "failed" };
            let place = status.node.as_ref().map(|n| format!(" on {n}")).unwrap_or_default();
            let exit = columns::exit(status);
            let exit = match (status.signal, exit.is_empty()) {
                (_, true) => String::new(),
                (Some(_), _) => format!(", ended by {exit}"),
                (None, _) => format!(", exit code {exit}"),
            };
            format!("task/{name} {verb}{place}, attempt {}{exit}{because}.", status.attempt)
        }
        TaskPhase::Unknown => {
            format!(
                "task/{name} was placed on {node}, which cannot be reached; what it does there is not known{because}."
            )
        }
    }
}

/// Why there: the score and the lease that came with the placement.
fn placed(task: &Task, status: &TaskStatus) -> Vec<String> {
    let mut lines = Vec::new();
    let Some(node) = &status.node else { return lines };
    let placement = &task.spec.placement;
    match (status.score, &placement.at) {
        (Some(score), Some(at)) => {
            let what = match placement.cost {
                Cost::Distance => "from the operation position",
                Cost::TravelTime => "of travel to the operation position",
            };
            lines.push(format!(
                "{node} had the lowest score: {} {what} {:.2},{:.2} in {:?}.",
                columns::score(score, placement.cost), at.x, at.y, at.map
            ));
        }
        _ if placement.node.is_some() => lines.push(format!("It is pinned to {node}.")),
        _ => lines.push(format!(
            "It has no operation position; {node} was the best of the nodes that fit it (class {}).",
            task.spec.resources.class()
        )),
    }
    if let Some(lease) = &status.lease {
        let verb = if status.phase.is_terminal() { "held" } else { "holds" };
        lines.push(format!("It {verb} the lease {}, epoch {}.", lease.name, lease.epoch));
    }
    lines
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::{Fake, task};

    #[tokio::test]
    async fn a_waiting_task_says_per_node_what_refuses_it() {
        let fake = Fake::new();
        let refusals = json!([
            {"node": "r1", "reason": "LeaseHeld", "message": "actuators (body) are held by default/gmapping; waits until its processes are gone"},
            {"node": "c1", "reason": "WrongKind", "message": "is a Cloud and has no sensors or actuators; the task needs some"},
        ]);
        fake.put(
            "tasks/default/second",
            task("second", json!({"phase": "Pending", "why": refusals})),
        );
        let (code, text) = fake.run(&["why", "task/second"]).await;
        assert_eq!(code, exit::OK);
        assert_eq!(
            text,
            "task/second waits: no node takes it now.\n\n\
             NODE   REFUSED BY   WHY\n\
             r1     LeaseHeld    actuators (body) are held by default/gmapping; waits until its processes are gone\n\
             c1     WrongKind    is a Cloud and has no sensors or actuators; the task needs some\n\n\
             hint: `muster get leases` shows who drives; when the holder ends, the lease is free\n"
        );
    }

    #[tokio::test]
    async fn the_full_answer_of_the_controller_wins_over_the_status() {
        let fake = Fake::new();
        fake.put("tasks/default/t", task("t", json!({"phase": "Pending"})));
        let answer = json!({"phase": "Pending", "why": [{"node": "r9", "reason": "Cordoned", "message": "is cordoned"}], "decision": null});
        fake.answer("GET /apis/muster.dev/v1alpha1/namespaces/default/tasks/t/why", answer.clone());
        assert!(fake.run(&["why", "t"]).await.1.contains("r9     Cordoned     is cordoned"));
        let (_, text) = fake.run(&["why", "t", "-o", "json"]).await;
        assert_eq!(serde_json::from_str::<serde_json::Value>(&text).expect("JSON"), answer);
    }

    #[tokio::test]
    async fn a_placed_or_ended_task_has_a_story() {
        let fake = Fake::new();
        let mut object = task(
            "t",
            json!({"phase": "Failed", "node": "r1", "score": 2.5, "attempt": 2, "signal": 9,
            "reason": "OOMKilled", "message": "used more than 64Mi", "lease": {"name": "r1.body", "epoch": 7}}),
        );
        object["spec"]["placement"] = json!({"at": {"x": 3, "y": 4}});
        fake.put("tasks/default/t", object);
        assert_eq!(
            fake.run(&["why", "t"]).await.1,
            "task/t failed on r1, attempt 2, ended by signal 9 (OOMKilled).\n\
             r1 had the lowest score: 2.50m from the operation position 3.00,4.00 in \"map\".\n\
             It held the lease r1.body, epoch 7.\nused more than 64Mi\n"
        );
    }
}
