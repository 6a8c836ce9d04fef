//! What a task waits for: other tasks of its namespace, on whatever nodes they are.

use std::collections::{BTreeMap, BTreeSet};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::TaskSpec;
use crate::name::check_name;
use crate::phase::TaskPhase;
use crate::validate::{Violations, element_path};

/// Most tasks that one task may wait for.
const MAX: usize = 32;

/// Another task that must have come so far before an attempt of this one begins.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct DependsOn {
    /// Name of a Task of the same namespace. It need not exist yet.
    pub task: String,
    /// How far it must have come.
    #[serde(default)]
    pub condition: DependencyCondition,
    /// True: when it is started again, so is this task, whatever its restart policy.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub restart: bool,
}

/// How far a task must have come.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum DependencyCondition {
    /// Its program runs.
    #[default]
    Running,
    /// It runs, and its readiness probe, if it has one, says that it can serve.
    Ready,
    /// It has ended well.
    Succeeded,
}

impl DependencyCondition {
    /// Why a task in this state has not come so far, a clause whose subject is the task; none: it has.
    #[must_use]
    pub fn unmet(self, phase: TaskPhase, ready: Option<bool>) -> Option<String> {
        use DependencyCondition::{Ready, Running, Succeeded};
        match (self, phase) {
            (Running, TaskPhase::Running) | (Succeeded, TaskPhase::Succeeded) => None,
            (Ready, TaskPhase::Running) if ready != Some(false) => None,
            (Ready, TaskPhase::Running) => Some("is not ready yet".to_owned()),
            (_, ended) if ended.is_terminal() => {
                Some(format!("has ended ({ended:?}) and will not become {self:?}"))
            }
            (_, phase) => Some(format!("is {phase:?}, not yet {self:?}")),
        }
    }
}

pub(super) fn rules(spec: &TaskSpec, violations: &mut Violations) {
    let all = &spec.depends_on;
    if all.len() > MAX {
        violations.invalid("spec.dependsOn", format!("{} tasks; at most {MAX}", all.len()));
    }
    if spec.run.executor.is_some() && all.iter().any(|one| one.restart) {
        violations
            .invalid("spec.dependsOn", "an executor's work is not run again by itself")
            .suggest("leave `restart` out");
    }
    let mut seen = BTreeSet::new();
    for (i, one) in all.iter().enumerate() {
        let path = format!("{}.task", element_path("spec.dependsOn", i));
        if one.task.is_empty() {
            violations.required(path);
        } else if let Err(error) = check_name(&one.task) {
            violations.invalid(path, error.to_string());
        } else if !seen.insert(&one.task) {
            violations.duplicate(path, format!("{:?} is named twice", one.task));
        }
    }
}

/// Who waits for whom: each task with those that it names, in the order of its spec.
pub type Graph = BTreeMap<String, Vec<String>>;

/// A ring of tasks that wait for each other, begun with `from`: `a`, `b`, `a`; none: `from` is in no such ring. The shortest,
/// and of equally short ones the first.
#[must_use]
pub fn cycle(graph: &Graph, from: &str) -> Option<Vec<String>> {
    let mut reached: BTreeMap<&str, &str> = BTreeMap::new();
    let mut frontier = vec![from];
    while !frontier.is_empty() {
        let mut next = Vec::new();
        for at in frontier {
            for to in graph.get(at).into_iter().flatten() {
                if to == from {
                    let mut ring = vec![from.to_owned()];
                    let mut back = at;
                    while back != from {
                        ring.push(back.to_owned());
                        back = reached.get(back).copied().unwrap_or(from);
                    }
                    ring.push(from.to_owned());
                    ring.reverse();
                    return Some(ring);
                }
                if !reached.contains_key(to.as_str()) {
                    reached.insert(to, at);
                    next.push(to.as_str());
                }
            }
        }
        frontier = next;
    }
    None
}

/// The tasks that a Task object waits for, in the order of its spec.
#[must_use]
pub fn named(task: &Value) -> Vec<String> {
    let all = task["spec"]["dependsOn"].as_array().into_iter().flatten();
    all.filter_map(|one| one["task"].as_str().map(str::to_owned)).collect()
}

/// The words for a ring.
#[must_use]
pub fn ring_text(ring: &[String]) -> String {
    format!("waits for itself: {}", ring.join(" → "))
}

/// Refuses the first task of a ring at the field that leads into it. `who` stands before the words.
#[must_use]
pub fn ring_refusal(task: &Value, ring: &[String], who: &str) -> Violations {
    let at = named(task).iter().position(|name| Some(name) == ring.get(1)).unwrap_or(0);
    let mut violations = Violations::new();
    violations
        .invalid(
            format!("{}.task", element_path("spec.dependsOn", at)),
            format!("{who}{}", ring_text(ring)),
        )
        .suggest("leave out one of them");
    violations
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn graph(edges: &[(&str, &str)]) -> Graph {
        let mut graph = Graph::new();
        for (from, to) in edges {
            graph.entry((*from).to_owned()).or_default().push((*to).to_owned());
        }
        graph
    }

    #[test]
    fn a_ring_is_named_from_its_beginning() {
        let ring = graph(&[("a", "b"), ("b", "x"), ("b", "c"), ("c", "a"), ("d", "a")]);
        let found = cycle(&ring, "a").expect("there is one");
        assert_eq!(ring_text(&found), "waits for itself: a → b → c → a");
        assert_eq!(cycle(&ring, "d"), None, "it only leads into one");
        assert_eq!(cycle(&graph(&[("a", "a")]), "a"), Some(vec!["a".to_owned(), "a".to_owned()]));
        assert_eq!(cycle(&Graph::new(), "a"), None);
    }

    #[test]
    fn how_far_a_task_has_come() {
        use DependencyCondition::{Ready, Running, Succeeded};
        let met =
            |condition: DependencyCondition, phase, ready| condition.unmet(phase, ready).is_none();
        for ready in [None, Some(true), Some(false)] {
            assert!(met(Running, TaskPhase::Running, ready));
            assert_eq!(met(Ready, TaskPhase::Running, ready), ready != Some(false));
            for phase in
                [TaskPhase::Pending, TaskPhase::Starting, TaskPhase::Unknown, TaskPhase::Failed]
            {
                for condition in [Running, Ready, Succeeded] {
                    assert!(!met(condition, phase, ready), "{condition:?} {phase:?}");
                }
            }
        }
        assert!(met(Succeeded, TaskPhase::Succeeded, None));
        assert!(!met(Running, TaskPhase::Succeeded, None));
    }

    proptest! {
        /// What is found is a ring of edges that are there, and one is found whenever a walk comes back.
        #[test]
        fn rings_are_real_and_none_is_missed(edges in proptest::collection::vec((0_u8..6, 0_u8..6), 0..14)) {
            let name = |n: u8| format!("t{n}");
            let mut graph = Graph::new();
            let mut reach = [[false; 6]; 6];
            for (from, to) in &edges {
                graph.entry(name(*from)).or_default().push(name(*to));
                reach[usize::from(*from)][usize::from(*to)] = true;
            }
            for k in 0..6 {
                for i in 0..6 {
                    for j in 0..6 {
                        reach[i][j] |= reach[i][k] && reach[k][j];
                    }
                }
            }
            for n in 0..6_u8 {
                let found = cycle(&graph, &name(n));
                prop_assert_eq!(found.is_some(), reach[usize::from(n)][usize::from(n)]);
                for pair in found.unwrap_or_default().windows(2) {
                    prop_assert!(graph[&pair[0]].contains(&pair[1]));
                }
            }
        }
    }
}
