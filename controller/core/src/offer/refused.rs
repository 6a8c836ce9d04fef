//! What a framework declined, or did not answer: not offered again for a while, unless the node gains something.

use muster_api::name::NodeName;
use muster_api::resource::Compute;

use super::book::Book;
use super::{Seat, allocator};
use crate::cluster::{Cluster, Member, NodeFacts};
use crate::node_health::Monotonic;
use crate::space::Slot;

/// An offered robot gives its place to one that is closer by this part of its own score …
const CLOSER_BY: f64 = 0.1;
/// … and by at least so much (metres or seconds): two robots that pass each other must not take turns.
const CLOSER_BY_AT_LEAST: f64 = 0.5;

/// What a framework does not want to see again for a while.
#[derive(Debug, Clone)]
pub(super) struct Refused {
    pub(super) until: Monotonic,
    free: Compute,
    actuators_free: bool,
    facts_version: u64,
    score: Option<f64>,
}

impl Refused {
    pub(super) fn new(member: &Member, score: Option<f64>, until: Monotonic) -> Self {
        Refused {
            until,
            free: member.ledger.open(),
            actuators_free: allocator::actuators_free(member),
            facts_version: member.facts_version,
            score,
        }
    }

    /// What was refused has changed: there is more of something now, or it is closer.
    pub(super) fn has_gained(&self, member: &Member, score: Option<f64>) -> bool {
        self.facts_version != member.facts_version
            || (allocator::actuators_free(member) && !self.actuators_free)
            || self.free.shortage_for(&member.ledger.open()).is_some()
            || matches!((self.score, score), (Some(then), Some(now)) if is_closer(now, then))
    }
}

/// Whether a robot is so much closer than another that it takes its place.
pub(super) fn is_closer(new: f64, old: f64) -> bool {
    new + (old * CLOSER_BY).max(CLOSER_BY_AT_LEAST) < old
}

/// A refusal without a number of its node: it outlasts a cluster that is made anew.
#[derive(Debug, Clone)]
pub struct Kept {
    node: NodeName,
    refused: Refused,
    /// What the node was.
    facts: Option<NodeFacts>,
}

impl Book {
    /// What a framework refuses now, to be put into another book.
    #[must_use]
    pub fn refusals(&self, cluster: &Cluster, seat: Seat) -> Vec<Kept> {
        let kept = |(slot, refused): (&Slot, &Refused)| {
            let member = cluster.at(*slot);
            let (node, facts) = (member.name.clone(), member.facts.clone());
            Kept { node, refused: refused.clone(), facts }
        };
        let refused = self.places.get(&seat).into_iter().flat_map(|place| &place.refused);
        let same =
            |(slot, r): &(&Slot, &Refused)| r.facts_version == cluster.at(**slot).facts_version;
        refused.filter(same).map(kept).collect()
    }

    /// Takes refusals of another book in, but for those of nodes that are others now.
    pub fn refuse_still(&mut self, cluster: &Cluster, seat: Seat, refusals: Vec<Kept>) {
        for Kept { node, mut refused, facts: then } in refusals {
            let Some(slot) = cluster.slot_of(node.as_str()) else { continue };
            let member = cluster.at(slot);
            let same = then.zip(member.facts.as_ref());
            if same.is_some_and(|(then, now)| then.same_but_for_pose(now)) {
                refused.facts_version = member.facts_version;
                self.put_refusal(seat, slot, refused);
            }
        }
    }
}
