//! What a planned TaskSet would do to its tasks.

use serde::Deserialize;

use super::{Plan, PlannedChange, placed};
use crate::command::why::refusal_table;
use crate::output::style::Styles;

/// A set among what is planned.
#[derive(Debug, Deserialize)]
pub(super) struct Set {
    namespace: String,
    name: String,
    /// Tasks that begin at once; where, the placements say.
    #[serde(default)]
    begins: Vec<String>,
    /// Tasks that begin when those are there.
    #[serde(default)]
    later: u32,
    /// Tasks that are replaced, robot by robot.
    #[serde(default)]
    changes: Vec<Affected>,
    /// How many of them first.
    #[serde(default)]
    first: usize,
    #[serde(default)]
    ends: Vec<Affected>,
    /// Tasks that would be replaced, and stay while their node is on a mission.
    #[serde(default)]
    held: Vec<Affected>,
}

/// A task that is there.
#[derive(Debug, Deserialize)]
struct Affected {
    task: String,
    #[serde(default)]
    node: Option<String>,
    /// Leases that it loses.
    #[serde(default)]
    leases: Vec<String>,
    #[serde(default)]
    lock: Option<String>,
    #[serde(default)]
    why: Option<String>,
}

impl Affected {
    /// `watch-0 on r1 (loses r1.body)`.
    fn text(&self) -> String {
        let mut text = self.task.clone();
        if let Some(node) = &self.node {
            text.push_str(&format!(" on {node}"));
        }
        let loses = (!self.leases.is_empty()).then(|| format!("loses {}", self.leases.join(", ")));
        let notes: Vec<&str> = self.why.as_deref().into_iter().chain(loses.as_deref()).collect();
        if !notes.is_empty() {
            text.push_str(&format!(" ({})", notes.join("; ")));
        }
        text
    }
}

/// Lines under the change of a set.
pub(super) fn render(plan: &Plan, change: &PlannedChange, styles: &Styles) -> String {
    let is_it =
        |s: &&Set| change.namespace.as_deref() == Some(&*s.namespace) && s.name == change.name;
    let Some(set) = plan.sets.iter().find(is_it) else { return String::new() };
    let mut lines = Vec::new();
    for name in &set.begins {
        begins(plan, (&set.namespace, name), styles, &mut lines);
    }
    if set.later > 0 {
        lines.push(format!(
            "{} {} more tasks, when these are there",
            styles.good.paint("+"),
            set.later
        ));
    }
    let list = |tasks: &[Affected]| tasks.iter().map(Affected::text).collect::<Vec<_>>().join(", ");
    if !set.changes.is_empty() {
        let first = match set.first.min(set.changes.len()) {
            0 => String::new(),
            n => format!(", {n} first"),
        };
        lines.push(format!("would change{first}: {}", list(&set.changes)));
    }
    if !set.ends.is_empty() {
        lines.push(styles.bad.paint(format!("would end: {}", list(&set.ends))));
    }
    for task in &set.held {
        let lock = task.lock.as_deref().unwrap_or_default();
        let line = format!("stays for now: {}, locked by {lock}", task.text());
        lines.push(styles.warn.paint(line));
    }
    lines.into_iter().map(|line| format!("    {line}\n")).collect()
}

fn begins(plan: &Plan, (namespace, name): (&str, &str), styles: &Styles, lines: &mut Vec<String>) {
    let place = plan.placements.iter().find(|p| p.namespace == namespace && p.name == name);
    let place = place.map(placed).unwrap_or_default();
    lines.push(format!("{} task/{name}{place}", styles.good.paint("+")));
    let mut rooms = plan.preemptions.iter();
    let room = rooms.find(|p| p.namespace == namespace && p.name == name);
    if let Some(room) = room.filter(|room| !room.victims.is_empty()) {
        lines.push(format!("  {}", styles.bad.paint(room.text())));
    }
    let wait = plan.waits.iter().find(|w| w.namespace == namespace && w.name == name);
    if let Some(wait) = wait {
        lines.push(styles.warn.paint("  would wait:"));
        let table = refusal_table(&wait.why).text(styles);
        lines.extend(table.lines().map(|line| format!("  {line}")));
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::fake::Fake;

    #[tokio::test]
    async fn a_sets_tasks_are_shown_under_it() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("s.yaml");
        let text = "apiVersion: muster.dev/v1alpha1\nkind: TaskSet\nmetadata: {name: watch}\n\
                    spec: {replicas: 3, template: {spec: {run: {process: {command: [x]}}}}}\n";
        std::fs::write(&path, text).expect("written");
        let fake = Fake::new();
        let lease = json!({"group": "body", "epoch": 4});
        let refusal = json!({"node": "r1", "reason": "LeaseHeld", "message": "held"});
        fake.answer(
            "POST /apis/muster.dev/v1alpha1/plan",
            json!({
                "placements": [{"namespace": "default", "name": "watch-0", "node": "r1", "score": 2.0, "leases": [lease]}],
                "waits": [{"namespace": "default", "name": "watch-3", "why": [refusal]}],
                "sets": [{
                    "namespace": "default", "name": "watch", "begins": ["watch-0", "watch-3"], "later": 36, "first": 1,
                    "changes": [{"task": "watch-1", "node": "r2", "leases": ["r2.body"]}],
                    "held": [{"task": "watch-2", "node": "r3", "lock": "ada: carries a tray"}],
                    "ends": [{"task": "watch-9", "node": "r9", "why": "there are more tasks than replicas"}],
                }],
            }),
        );
        let (_, text) = fake.run(&["plan", "-f", &path.display().to_string()]).await;
        let wanted = "+ taskset/watch in default\n    \
                      + task/watch-0 → r1, score 2.00, lease r1.body epoch 4\n    \
                      + task/watch-3\n      would wait:\n      \
                      NODE   REFUSED BY   WHY\n      r1     LeaseHeld    held\n    \
                      + 36 more tasks, when these are there\n    \
                      would change, 1 first: watch-1 on r2 (loses r2.body)\n    \
                      would end: watch-9 on r9 (there are more tasks than replicas)\n    \
                      stays for now: watch-2 on r3, locked by ada: carries a tray\n";
        assert!(text.starts_with(wanted), "{text}");
    }
}
