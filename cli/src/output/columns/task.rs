//! Tasks: how far each is, where, and why not further.

use muster_api::kind::task::{Cost, NodeRefusal, Task, TaskSpec, TaskStatus};
use muster_api::phase::TaskPhase;

use super::{Column, age};
use crate::output::human;
use crate::output::style::Mood;
use crate::output::table::Cell;

pub(super) const COLUMNS: &[Column<Task>] = &[
    Column::new("PHASE", |task, _| phase(task)),
    Column::new("NODE", |task, _| status(task, |s| s.node.clone().unwrap_or_default())),
    Column::new("SCORE", |task, _| {
        status(task, |s| s.score.map(|v| score(v, task.spec.placement.cost)).unwrap_or_default())
    }),
    Column::new("CLASS", |task, _| task.spec.resources.class().into()),
    Column::new("ATTEMPT", |task, _| status(task, |s| attempts(&task.spec, s))),
    Column::new("AGE", |task, now| age(task.metadata.creation_timestamp.as_ref(), now)),
    Column::new("REASON", |task, _| status(task, reason)),
    Column::wide("READY", |task, _| status(task, |s| ready(s).unwrap_or_default().to_owned())),
    Column::wide("EPOCH", |task, _| {
        status(task, |s| s.lease.as_ref().map(|l| l.epoch.to_string()).unwrap_or_default())
    }),
    Column::wide("CPU", |task, _| status(task, |s| cpu(&task.spec, s))),
    Column::wide("MEMORY", |task, _| status(task, |s| memory(&task.spec, s))),
    Column::wide("EXIT", |task, _| status(task, exit)),
    Column::wide("MESSAGE", |task, _| status(task, |s| s.message.clone())),
];

fn status(task: &Task, text: impl Fn(&TaskStatus) -> String) -> Cell {
    task.status.as_ref().map(text).unwrap_or_default().into()
}

/// What a phase means to the reader.
pub(crate) fn mood(phase: TaskPhase) -> Mood {
    match phase {
        TaskPhase::Running => Mood::Good,
        TaskPhase::Succeeded => Mood::Dim,
        TaskPhase::Failed | TaskPhase::Unknown => Mood::Bad,
        TaskPhase::Pending | TaskPhase::Bound | TaskPhase::Starting | TaskPhase::Stopping => {
            Mood::Warn
        }
    }
}

/// Whether a running task serves; of others nothing is said.
pub(crate) fn ready(status: &TaskStatus) -> Option<&'static str> {
    let runs = status.phase == TaskPhase::Running;
    runs.then(|| if status.is_ready() { "True" } else { "False" })
}

fn phase(task: &Task) -> Cell {
    let phase = task.status.as_ref().map(|s| s.phase).unwrap_or_default();
    Cell::new(phase.as_str(), mood(phase))
}

/// Which attempt it is; of a task that is tried on other nodes counted over all of them, and how many there may be.
pub(crate) fn attempts(spec: &TaskSpec, status: &TaskStatus) -> String {
    let attempt = status.attempts_used.saturating_add(status.attempt);
    match (&spec.reschedule, attempt) {
        (_, 0) => String::new(),
        (Some(block), _) => format!("{attempt}/{}", block.max_attempts),
        (None, _) => attempt.to_string(),
    }
}

/// A score with its unit.
pub(crate) fn score(value: f64, cost: Cost) -> String {
    match cost {
        Cost::Distance => format!("{value:.2}m"),
        Cost::TravelTime => format!("{value:.1}s"),
    }
}

/// The reason of the phase; of a waiting task, the filters that refuse it and on how many nodes.
pub(crate) fn reason(status: &TaskStatus) -> String {
    if status.phase == TaskPhase::Pending && !status.why.is_empty() {
        return refusals(&status.why);
    }
    status.reason.clone()
}

/// `LeaseHeld×2,OutOfRange`: most frequent first.
pub(crate) fn refusals(why: &[NodeRefusal]) -> String {
    let mut counts: Vec<(&str, usize)> = Vec::new();
    for refusal in why {
        match counts.iter_mut().find(|(reason, _)| *reason == refusal.reason) {
            Some((_, n)) => *n += 1,
            None => counts.push((&refusal.reason, 1)),
        }
    }
    counts.sort_by_key(|(_, n)| std::cmp::Reverse(*n));
    let texts = counts.into_iter().map(|(reason, n)| match n {
        1 => reason.to_owned(),
        _ => format!("{reason}×{n}"),
    });
    texts.collect::<Vec<_>>().join(",")
}

fn cpu(spec: &TaskSpec, status: &TaskStatus) -> String {
    let used = status.usage.as_ref().map(|u| human::cores(u.cpu));
    let reserved = spec.resources.cpu.map(human::cores);
    of_reserved(used, reserved)
}

fn memory(spec: &TaskSpec, status: &TaskStatus) -> String {
    let used = status.usage.as_ref().map(|u| human::bytes(u.memory));
    let reserved = spec.resources.memory.map(human::bytes);
    of_reserved(used, reserved)
}

fn of_reserved(used: Option<String>, reserved: Option<String>) -> String {
    match (used, reserved) {
        (None, None) => String::new(),
        (used, reserved) => {
            let dash = || "-".to_owned();
            format!("{}/{}", used.unwrap_or_else(dash), reserved.unwrap_or_else(dash))
        }
    }
}

/// How the last attempt that ended ended.
pub(crate) fn exit(status: &TaskStatus) -> String {
    match (status.signal, status.exit_code) {
        (Some(signal), _) => format!("signal {signal}"),
        (None, Some(code)) => code.to_string(),
        (None, None) => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use serde_json::{Value, json};

    use crate::output::columns::{Layout, table};
    use crate::output::style::Styles;

    fn task(name: &str, resources: Value, status: Value) -> Value {
        json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Task",
            "metadata": {"name": name, "namespace": "lab", "creationTimestamp": "1970-01-01T00:00:00Z"},
            "spec": {"resources": resources, "run": {"process": {"command": ["x"]}}},
            "status": status,
        })
    }

    fn text(wide: bool, namespaces: bool) -> String {
        let info = muster_api::kind::find_by_word("task").expect("served");
        let refusal =
            |node: &str, reason: &str| json!({"node": node, "reason": reason, "message": "m"});
        let objects = [
            task(
                "gmapping",
                json!({"cpu": "500m", "memory": "64Mi", "sensors": ["k:L"], "actuators": ["b:D"]}),
                json!({"phase": "Running", "node": "r1", "score": 2.345, "attempt": 1,
                       "lease": {"name": "r1.body", "epoch": 4}, "usage": {"cpu": "153m", "memory": "12Mi"}}),
            ),
            task(
                "second",
                json!({"actuators": ["b:D"]}),
                json!({"phase": "Pending", "attempt": 0,
                       "why": [refusal("c1", "WrongKind"), refusal("r1", "LeaseHeld"), refusal("r2", "LeaseHeld")]}),
            ),
            task(
                "crash",
                json!({}),
                json!({"phase": "Failed", "node": "c1", "attempt": 3, "exitCode": 137, "signal": 9,
                       "reason": "OOMKilled", "message": "out of memory"}),
            ),
        ];
        let now = Timestamp::from_second(300).expect("in range");
        table(info, &objects, Layout { wide, namespaces, kinds: false, now })
            .text(&Styles::default())
    }

    #[test]
    fn the_plain_table_says_where_and_why() {
        assert_eq!(
            text(false, true),
            "NAMESPACE   NAME       PHASE     NODE   SCORE   CLASS      ATTEMPT   AGE   REASON\n\
             lab         gmapping   Running   r1     2.35m   AR-CR-SR   1         5m    -\n\
             lab         second     Pending   -      -       AR         -         5m    LeaseHeld×2,WrongKind\n\
             lab         crash      Failed    c1     -       none       3         5m    OOMKilled\n"
        );
    }

    #[test]
    fn the_wide_table_adds_readiness_lease_usage_and_end() {
        let text = text(true, false);
        let squeezed: Vec<String> =
            text.lines().map(|l| l.split_whitespace().collect::<Vec<_>>().join(" ")).collect();
        assert_eq!(
            squeezed[1],
            "gmapping Running r1 2.35m AR-CR-SR 1 5m - True 4 0.153/0.5 12Mi/64Mi - -"
        );
        assert_eq!(
            squeezed[3],
            "crash Failed c1 - none 3 5m OOMKilled - - - - signal 9 out of memory"
        );
    }

    #[test]
    fn an_object_of_a_newer_controller_keeps_its_row() {
        let info = muster_api::kind::find_by_word("task").expect("served");
        let object = task("new", json!({}), json!({"phase": "Dreaming"}));
        let layout =
            Layout { wide: false, namespaces: false, kinds: true, now: Timestamp::UNIX_EPOCH };
        let text = table(info, &[object], layout).text(&Styles::default());
        assert!(text.lines().nth(1).expect("a row").starts_with("task/new   ?"), "{text}");
    }
}
