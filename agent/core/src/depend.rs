//! Tasks that a task waits for, before each of its attempts.
//!
//! What this node knows of its own tasks goes before what the controller said of them: it is newer, and it is there
//! without the controller, after a reboot too. Of tasks elsewhere the controller's last word counts.

use std::collections::BTreeMap;

use muster_api::kind::task::depend::DependencyCondition;
use muster_api::phase::TaskPhase;
use serde::{Deserialize, Serialize};

/// A task that is waited for, as the controller said it last.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Dependency {
    /// Its name.
    pub task: String,
    /// Its uid; empty: it is gone.
    pub uid: String,
    /// How far it must have come.
    pub condition: DependencyCondition,
    /// When it is started again, so is the one that waits.
    pub restart: bool,
    /// Why it has not come so far; none: it has.
    pub unmet: Option<String>,
    /// Its attempt.
    pub attempt: u32,
}

/// A task of this node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Seen {
    /// What is told of it.
    pub phase: TaskPhase,
    /// Whether its readiness probe says that it can serve.
    pub ready: Option<bool>,
    /// Its attempt.
    pub attempt: u32,
    /// What is told of it is known in this life of the agent, and not only remembered.
    pub known: bool,
}

/// How the tasks stand that are waited for.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Standing {
    /// What is still waited for, a sentence; none: nothing.
    pub unmet: Option<String>,
    /// Uid and attempt of those whose new start is a new start of the one that waits, by name.
    pub attempts: BTreeMap<String, (String, u32)>,
}

/// Looks at all of them. `here` gives a task of this node by its uid.
#[must_use]
pub fn standing(all: &[Dependency], here: impl Fn(&str) -> Option<Seen>) -> Standing {
    let mut standing = Standing::default();
    for one in all {
        let seen = here(&one.uid).filter(|_| !one.uid.is_empty());
        let unmet = match seen {
            Some(Seen { known: false, .. }) => Some("is being looked for".to_owned()),
            Some(seen) => one.condition.unmet(seen.phase, seen.ready),
            None => one.unmet.clone(),
        };
        if let Some(why) = unmet
            && standing.unmet.is_none()
        {
            standing.unmet = Some(format!("waits for task {}, which {why}", one.task));
        }
        if one.restart && !one.uid.is_empty() {
            let attempt = seen.map_or(one.attempt, |seen| seen.attempt);
            standing.attempts.insert(one.task.clone(), (one.uid.clone(), attempt));
        }
    }
    standing
}

impl Standing {
    /// A task that was started again after `before`.
    #[must_use]
    pub fn restarted_since(&self, before: &BTreeMap<String, (String, u32)>) -> Option<&str> {
        let newer = |task: &&String| {
            let (uid, attempt) = &self.attempts[*task];
            match before.get(*task) {
                Some((old, begun)) if old == uid => begun < attempt,
                // Another task of that name; it may not have begun yet.
                Some(_) | None => *attempt > 0,
            }
        };
        self.attempts.keys().find(newer).map(String::as_str)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn on(task: &str, condition: DependencyCondition) -> Dependency {
        Dependency {
            task: task.to_owned(),
            uid: format!("uid-{task}"),
            condition,
            restart: true,
            unmet: None,
            attempt: 1,
        }
    }

    fn seen(phase: TaskPhase, attempt: u32) -> Seen {
        Seen { phase, ready: None, attempt, known: true }
    }

    #[test]
    fn what_the_node_knows_goes_before_what_it_was_told() {
        let all = [on("near", DependencyCondition::Running), on("far", DependencyCondition::Ready)];
        let here = |seen: Seen| move |uid: &str| (uid == "uid-near").then_some(seen);
        let up = standing(&all, here(seen(TaskPhase::Running, 3)));
        assert_eq!(up.unmet, None);
        assert_eq!(up.attempts["near"], ("uid-near".to_owned(), 3));
        assert_eq!(up.attempts["far"], ("uid-far".to_owned(), 1));
        let down = standing(&all, here(seen(TaskPhase::Starting, 4)));
        assert_eq!(
            down.unmet.as_deref(),
            Some("waits for task near, which is Starting, not yet Running")
        );
        let stale = Seen { known: false, ..seen(TaskPhase::Running, 3) };
        let unsure = standing(&all, here(stale)).unmet;
        assert_eq!(unsure.as_deref(), Some("waits for task near, which is being looked for"));
        let mut told = all;
        told[1].unmet = Some("is not ready yet".to_owned());
        let far = standing(&told, here(seen(TaskPhase::Running, 3))).unmet;
        assert_eq!(far.as_deref(), Some("waits for task far, which is not ready yet"));
    }

    #[test]
    fn a_new_start_is_a_greater_attempt_or_another_task_of_that_name() {
        let all = [on("a", DependencyCondition::Running)];
        let at = |attempt| standing(&all, |_| Some(seen(TaskPhase::Running, attempt)));
        let before = at(2).attempts;
        assert_eq!(at(2).restarted_since(&before), None);
        assert_eq!(at(1).restarted_since(&before), None, "an old word");
        assert_eq!(at(3).restarted_since(&before), Some("a"));
        let mut other = all.clone();
        other[0].uid = "another".to_owned();
        assert_eq!(standing(&other, |_| None).restarted_since(&before), Some("a"));
        other[0].attempt = 0;
        assert_eq!(standing(&other, |_| None).restarted_since(&before), None, "not begun yet");
        other[0].uid = String::new();
        assert_eq!(standing(&other, |_| None).restarted_since(&before), None, "it is gone");
        let mut quiet = all;
        quiet[0].restart = false;
        assert_eq!(standing(&quiet, |_| Some(seen(TaskPhase::Running, 9))).attempts.len(), 0);
    }
}
