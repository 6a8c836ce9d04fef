//! What an agent that was away has to be told again. Pure.

use std::collections::{BTreeMap, BTreeSet};

use muster_api::wire::executor::v1 as proto;

use super::Status;

/// Tasks that are not over and updates that are not acknowledged.
#[derive(Debug, Default)]
pub(crate) struct Book {
    sequence: u64,
    tasks: BTreeSet<String>,
    unacknowledged: BTreeMap<u64, proto::StatusUpdate>,
}

impl Book {
    /// A task was given to the executor. False: it has it already, and the agent says it again.
    pub(crate) fn launched(&mut self, task: &str) -> bool {
        self.tasks.insert(task.to_owned())
    }

    /// Gives an update its number.
    pub(crate) fn update(&mut self, status: Status) -> proto::StatusUpdate {
        let Status { task, state, message, exit_code } = status;
        if is_end(state) {
            self.tasks.remove(&task);
        }
        self.sequence += 1;
        let (sequence, state) = (self.sequence, state.into());
        let update = proto::StatusUpdate { task, sequence, state, message, exit_code };
        self.unacknowledged.insert(sequence, update.clone());
        update
    }

    /// The agent has this update.
    pub(crate) fn acknowledged(&mut self, sequence: u64) {
        self.unacknowledged.remove(&sequence);
    }

    /// Whether the agent has everything.
    pub(crate) fn is_settled(&self) -> bool {
        self.unacknowledged.is_empty()
    }

    /// The first frame of a connection.
    pub(crate) fn register(&self, token: &str) -> proto::Register {
        proto::Register {
            token: token.to_owned(),
            tasks: self.tasks.iter().cloned().collect(),
            unacknowledged: self.unacknowledged.values().cloned().collect(),
        }
    }
}

fn is_end(state: proto::TaskState) -> bool {
    matches!(
        state,
        proto::TaskState::Succeeded | proto::TaskState::Failed | proto::TaskState::Killed
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_register_says_what_is_not_over_and_not_acknowledged() {
        let mut book = Book::default();
        assert!(book.launched("a") && book.launched("b"));
        assert!(!book.launched("a"), "said again");
        book.update(Status::new("a", proto::TaskState::Running));
        book.update(Status::new("b", proto::TaskState::Failed).exit_code(3));
        book.acknowledged(1);
        let register = book.register("secret");
        assert_eq!(register.tasks, ["a"]);
        assert_eq!(register.unacknowledged.len(), 1);
        let update = &register.unacknowledged[0];
        assert_eq!((update.sequence, update.exit_code), (2, Some(3)));
        assert!(!book.is_settled());
        book.acknowledged(2);
        assert!(book.is_settled());
    }
}
