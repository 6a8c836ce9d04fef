//! When a node counts as lost, and when it is back.
//!
//! Time is monotonic and comes in as an argument: the span since some fixed start of the process. A
//! node is lost when nothing was heard of it for `detect_after` (DESIGN §5: the first of the three
//! clocks); what follows for its tasks is decided elsewhere.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use muster_api::name::NodeName;

/// How long without a heartbeat until a node is not ready.
pub const DETECT_AFTER: Duration = Duration::from_secs(2);
/// How often agents send a heartbeat: two may be lost before the node is.
pub const HEARTBEAT_EVERY: Duration = Duration::from_millis(600);

/// Monotonic time since the process's start.
pub type Monotonic = Duration;

/// Who was heard when.
#[derive(Debug, Clone, Default)]
pub struct NodeHealth {
    heard: BTreeMap<NodeName, Monotonic>,
    /// The same, by time: the first is the next to be lost.
    by_time: BTreeSet<(Monotonic, NodeName)>,
    /// When those that are lost were heard last.
    lost: BTreeMap<NodeName, Monotonic>,
    detect_after: Duration,
}

impl NodeHealth {
    /// Nobody heard yet.
    #[must_use]
    pub fn new(detect_after: Duration) -> Self {
        NodeHealth { detect_after, ..NodeHealth::default() }
    }

    /// A node was heard at `now`. True: it was not known or lost before, so it is back.
    pub fn heard(&mut self, node: &NodeName, now: Monotonic) -> bool {
        self.lost.remove(node);
        let before = self.heard.insert(node.clone(), now);
        if let Some(before) = before {
            self.by_time.remove(&(before, node.clone()));
        }
        self.by_time.insert((now, node.clone()));
        before.is_none()
    }

    /// Gives a node time as if it was heard now, unless it was: after a restart of the controller
    /// a node that was ready counts as ready until it had the chance to say so again.
    pub fn presume(&mut self, node: &NodeName, now: Monotonic) {
        if !self.heard.contains_key(node) {
            self.heard(node, now);
        }
    }

    /// A node does not exist any more.
    pub fn forget(&mut self, node: &NodeName) {
        self.lost.remove(node);
        if let Some(before) = self.heard.remove(node) {
            self.by_time.remove(&(before, node.clone()));
        }
    }

    /// The node counts as there.
    #[must_use]
    pub fn is_alive(&self, node: &NodeName) -> bool {
        self.heard.contains_key(node)
    }

    /// For how long a node surely has not been heard. Of one that was not heard since the process started nothing else is
    /// known.
    #[must_use]
    pub fn silence(&self, node: &NodeName, now: Monotonic) -> Duration {
        let heard = self.heard.get(node).or_else(|| self.lost.get(node));
        now.saturating_sub(heard.copied().unwrap_or_default())
    }

    /// Nodes that are lost as of `now`, each with how long nothing was heard of it. They are told once.
    #[must_use = "a lost node is told once"]
    pub fn lost(&mut self, now: Monotonic) -> Vec<(NodeName, Duration)> {
        let mut lost = Vec::new();
        while let Some((at, node)) = self.by_time.first().cloned() {
            let silence = now.saturating_sub(at);
            if silence < self.detect_after {
                break;
            }
            self.forget(&node);
            self.lost.insert(node.clone(), at);
            lost.push((node, silence));
        }
        lost
    }

    /// When [`NodeHealth::lost`] can next have something to tell; none: when somebody was heard.
    #[must_use]
    pub fn next_deadline(&self) -> Option<Monotonic> {
        self.by_time.first().map(|(at, _)| *at + self.detect_after)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_silent_node_is_lost_once_and_back_when_heard() {
        let ms = Duration::from_millis;
        let (a, b) = (NodeName::new("a").expect("a name"), NodeName::new("b").expect("a name"));
        let mut health = NodeHealth::new(ms(2000));
        assert!(health.heard(&a, ms(0)) && health.heard(&b, ms(500)));
        assert!(!health.heard(&a, ms(600)), "it was there all along");
        assert_eq!(health.next_deadline(), Some(ms(2500)));
        assert_eq!(health.lost(ms(2499)), []);
        assert_eq!(health.lost(ms(2500)), [(b.clone(), ms(2000))]);
        assert_eq!(health.lost(ms(2500)), []);
        assert_eq!([&a, &b].map(|node| health.silence(node, ms(2501))), [ms(1901), ms(2001)]);
        assert!(health.is_alive(&a) && !health.is_alive(&b));
        assert!(health.heard(&b, ms(2550)), "it is back");
        health.forget(&b);
        assert_eq!(health.lost(ms(9000)), [(a, ms(8400))]);
        assert_eq!(health.next_deadline(), None);
    }

    #[test]
    fn nobody_is_silent_for_longer_than_the_controller_can_know() {
        let ms = Duration::from_millis;
        let (a, b) = (NodeName::new("a").expect("a name"), NodeName::new("b").expect("a name"));
        let mut health = NodeHealth::new(ms(2000));
        // Before a restart it was ready.
        health.presume(&a, ms(3010));
        assert_eq!([&a, &b].map(|node| health.silence(node, ms(1000))), [ms(0), ms(1000)]);
        assert_eq!(health.lost(ms(5010)).len(), 1);
        assert_eq!(health.silence(&a, ms(6000)), ms(2990));
        health.forget(&a);
        assert_eq!(health.silence(&a, ms(6000)), ms(6000));
    }
}
