//! What the agent wants of its gate, as it says it. Pure; the simulation in `tests/` uses it as the keeper does.

use std::collections::BTreeMap;

use muster_api::id::TaskUid;
use muster_api::wire::agent::v1::NodeOrder;
use muster_api::wire::gate::v1 as proto;

/// An agent that goes down in order is back within this, or the robot is stopped: the time of an upgrade. Milliseconds.
const LEAVES_FOR: u32 = 10_000;

/// Who holds the robot when a person does: no task has such a uid.
pub(super) const PERSON: &str = "person";

/// A task that may connect.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Seat {
    token: String,
    /// The epoch of the robot's lease, when it is granted to this task.
    epoch: Option<u64>,
}

/// What is wanted of the gate. What changes it says whether that is news.
#[derive(Debug, Default)]
pub struct Wanted {
    id: u64,
    seats: BTreeMap<TaskUid, Seat>,
    /// None: not heard yet.
    estop: Option<u32>,
    release: u64,
    /// The newest grant to a person: those of tasks count after it.
    fence: u64,
    /// The person holds it still.
    held: bool,
    leaves: bool,
}

impl Wanted {
    /// Grows with every change.
    #[must_use]
    pub fn id(&self) -> u64 {
        self.id
    }

    /// Processes of the task may live: it may connect with this token, and drive if the lease is its own.
    pub fn seat(&mut self, task: &TaskUid, token: &str, epoch: Option<u64>) -> bool {
        let seat = Seat { token: token.to_owned(), epoch };
        let news = self.seats.get(task) != Some(&seat);
        self.seats.insert(task.clone(), seat);
        self.is_news(news)
    }

    /// Nothing of the task lives.
    pub fn unseat(&mut self, task: &TaskUid) -> bool {
        let news = self.seats.remove(task).is_some();
        self.is_news(news)
    }

    /// The controller says what people decide: how far the robot is stopped, up to which stop they have released it, and who
    /// holds it. Releases and grants only grow: what is older is not heard.
    pub fn order(&mut self, order: &NodeOrder) -> bool {
        let stops = (self.estop, self.release);
        (self.estop, self.release) =
            (Some(order.estop_tier), order.estop_release.max(self.release));
        let person = (self.fence, self.held);
        if order.lease_fence >= self.fence {
            self.fence = order.lease_fence;
            self.held = order.lease_held && order.lease_fence > 0;
        }
        self.is_news(stops != (self.estop, self.release) || person != (self.fence, self.held))
    }

    /// The agent goes down in order.
    pub fn leave(&mut self) -> bool {
        let news = !std::mem::replace(&mut self.leaves, true);
        self.is_news(news)
    }

    fn is_news(&mut self, news: bool) -> bool {
        self.id += u64::from(news);
        news
    }

    /// As the gate is told.
    #[must_use]
    pub fn message(&self) -> proto::Wanted {
        let seat = |(task, seat): (&TaskUid, &Seat)| proto::Seat {
            task: task.to_string(),
            token: seat.token.clone(),
        };
        // Two tasks have a lease while one of them ends. The newer grant counts.
        let granted = self.seats.iter().filter_map(|(task, seat)| Some((seat.epoch?, task)));
        let granted = granted.filter(|(epoch, _)| *epoch > self.fence).max();
        let person = || self.held.then(|| proto::Holder { task: PERSON.into(), epoch: self.fence });
        proto::Wanted {
            id: self.id,
            seats: self.seats.iter().map(seat).collect(),
            grant: granted
                .map(|(epoch, task)| proto::Holder { task: task.to_string(), epoch })
                .or_else(person),
            estop: self.estop,
            release: self.release,
            leaves_for_ms: if self.leaves { LEAVES_FOR } else { 0 },
            fence: self.fence,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn granted(wanted: &Wanted) -> Option<(String, u64)> {
        wanted.message().grant.map(|holder| (holder.task, holder.epoch))
    }

    #[test]
    fn what_was_granted_before_a_person_counts_no_more() {
        let mut wanted = Wanted::default();
        assert!(wanted.seat(&TaskUid::new("a"), "", Some(4)));
        assert!(!wanted.seat(&TaskUid::new("a"), "", Some(4)), "it is so already");
        assert_eq!(granted(&wanted), Some(("a".to_owned(), 4)));
        let mut order = NodeOrder { lease_fence: 5, lease_held: true, ..NodeOrder::default() };
        assert!(wanted.order(&order));
        assert_eq!(granted(&wanted), Some((PERSON.to_owned(), 5)));
        order.lease_held = false;
        assert!(wanted.order(&order) && !wanted.order(&order));
        assert_eq!(granted(&wanted), None, "it is nobody's: the task does not get it back");
        assert_eq!(wanted.message().fence, 5, "the gate keeps it for an agent that forgets it");
        wanted.seat(&TaskUid::new("b"), "", Some(6));
        assert_eq!(granted(&wanted), Some(("b".to_owned(), 6)));
    }
}
