//! Which reports a session has to say: each once when it is new, and again until it is acknowledged.

use std::collections::BTreeMap;

use muster_api::id::TaskUid;

use crate::time::Boot;

/// A report without an answer is said again after this.
pub const SAY_AGAIN_MS: u64 = 5_000;

/// What was said in one session. The next one begins with a Hello that says everything.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Journal {
    /// By task: the newest sequence that was said, and when.
    said: BTreeMap<TaskUid, (u64, Boot)>,
}

impl Journal {
    /// A session whose Hello said these reports.
    #[must_use]
    pub fn begun(hello: impl IntoIterator<Item = (TaskUid, u64)>, now: Boot) -> Journal {
        let said = hello.into_iter().map(|(uid, sequence)| (uid, (sequence, now)));
        Journal { said: said.collect() }
    }

    /// Whether the task's report of this sequence is to be said now; then it counts as said. `acknowledged`: the newest
    /// sequence that the controller has answered.
    #[must_use = "it counts as said"]
    pub fn is_due(&mut self, uid: &TaskUid, sequence: u64, acknowledged: u64, now: Boot) -> bool {
        let said = self.said.get(uid);
        let is_new = said.is_none_or(|(newest, _)| sequence > *newest);
        let is_unanswered = acknowledged < sequence
            && said.is_some_and(|(_, at)| now.0.saturating_sub(at.0) >= SAY_AGAIN_MS);
        let due = is_new || is_unanswered;
        if due {
            self.said.insert(uid.clone(), (sequence, now));
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_is_said_when_it_is_new_and_again_until_it_is_answered() {
        let (a, b) = (TaskUid::new("a"), TaskUid::new("b"));
        let mut journal = Journal::begun([(a.clone(), 3)], Boot(0));
        assert!(!journal.is_due(&a, 3, 0, Boot(SAY_AGAIN_MS - 1)), "Hello has just said it");
        assert!(journal.is_due(&a, 3, 0, Boot(SAY_AGAIN_MS)), "nobody answered");
        assert!(!journal.is_due(&a, 3, 0, Boot(SAY_AGAIN_MS + 1)));
        assert!(!journal.is_due(&a, 3, 3, Boot(SAY_AGAIN_MS * 9)), "it was answered");
        assert!(
            journal.is_due(&a, 4, 3, Boot(SAY_AGAIN_MS * 9)) && journal.is_due(&b, 1, 0, Boot(1))
        );
    }
}
