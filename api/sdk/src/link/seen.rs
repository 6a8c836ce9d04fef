//! Which updates were handed out before. Pure.

use std::collections::{HashMap, VecDeque};

use muster_api::wire::framework::v1 as proto;

/// Ended tasks that are remembered. The controller repeats an end only while its acknowledgement is under way, so this
/// covers what can end within some seconds.
const ENDED: usize = 4096;

/// What to do with an update.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[must_use]
pub(crate) enum Verdict {
    /// Hand it out.
    Fresh,
    /// It was handed out and its acknowledgement was lost: acknowledge it again.
    Acknowledge,
    /// It was handed out and is still being worked on, or is older than what was.
    Ignore,
}

#[derive(Debug, Default)]
struct Task {
    /// The newest version handed out.
    handed: u64,
    /// The newest version acknowledged.
    acknowledged: u64,
    ended: bool,
}

/// The newest version of every task's update.
#[derive(Debug, Default)]
pub(crate) struct Seen {
    tasks: HashMap<String, Task>,
    /// Tasks that ended, oldest first.
    ended: VecDeque<String>,
}

impl Seen {
    /// Judges an update, which counts as handed out when it is [`Verdict::Fresh`].
    pub(crate) fn judge(&mut self, update: &proto::Update) -> Verdict {
        // What is said of a task that there is not has no version; it is only said when asked for.
        if update.version == 0 {
            return Verdict::Fresh;
        }
        let task = self.tasks.entry(update.task.clone()).or_default();
        if update.version > task.handed {
            task.handed = update.version;
            let is_end =
                matches!(update.state(), proto::TaskState::Succeeded | proto::TaskState::Failed);
            if is_end && !std::mem::replace(&mut task.ended, true) {
                self.end(update.task.clone());
            }
            return Verdict::Fresh;
        }
        if update.version <= task.acknowledged { Verdict::Acknowledge } else { Verdict::Ignore }
    }

    pub(crate) fn acknowledged(&mut self, task: &str, version: u64) {
        if let Some(task) = self.tasks.get_mut(task) {
            task.acknowledged = task.acknowledged.max(version);
        }
    }

    /// These tasks' states are asked for, or all when none is named: hand them out though they are known.
    pub(crate) fn ask(&mut self, tasks: &[String]) {
        if tasks.is_empty() {
            self.tasks.values_mut().for_each(|task| task.handed = 0);
        }
        for task in tasks {
            if let Some(task) = self.tasks.get_mut(task) {
                task.handed = 0;
            }
        }
    }

    fn end(&mut self, task: String) {
        self.ended.push_back(task);
        if self.ended.len() > ENDED
            && let Some(oldest) = self.ended.pop_front()
        {
            self.tasks.remove(&oldest);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn update(task: &str, version: u64) -> proto::Update {
        let state = proto::TaskState::Succeeded.into();
        proto::Update { task: task.to_owned(), version, state, ..proto::Update::default() }
    }

    #[test]
    fn an_update_is_handed_out_once_and_acknowledged_again_when_repeated() {
        let mut seen = Seen::default();
        assert_eq!(seen.judge(&update("a", 3)), Verdict::Fresh);
        assert_eq!(seen.judge(&update("a", 3)), Verdict::Ignore, "not acknowledged yet");
        seen.acknowledged("a", 3);
        assert_eq!(seen.judge(&update("a", 3)), Verdict::Acknowledge);
        assert_eq!(seen.judge(&update("a", 4)), Verdict::Fresh);
        assert_eq!(seen.judge(&update("a", 2)), Verdict::Acknowledge, "older than what is known");
    }

    #[test]
    fn what_is_asked_for_is_handed_out_once_more() {
        let mut seen = Seen::default();
        assert_eq!(seen.judge(&update("a", 3)), Verdict::Fresh);
        seen.ask(&[]);
        assert_eq!(seen.judge(&update("a", 3)), Verdict::Fresh);
        assert_eq!(seen.judge(&update("a", 3)), Verdict::Ignore);
        let gone = proto::Update { task: "x".into(), ..proto::Update::default() };
        assert_eq!(seen.judge(&gone), Verdict::Fresh);
        assert_eq!(seen.judge(&gone), Verdict::Fresh, "every question has its answer");
    }

    #[test]
    fn ended_tasks_do_not_gather() {
        let mut seen = Seen::default();
        for n in 0..2 * ENDED as u64 {
            assert_eq!(seen.judge(&update(&n.to_string(), 1)), Verdict::Fresh);
        }
        assert_eq!((seen.tasks.len(), seen.ended.len()), (ENDED, ENDED));
    }
}
