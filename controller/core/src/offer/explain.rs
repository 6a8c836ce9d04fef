//! Why a framework is not offered a node: the same rules as [`super::allocator`] and [`super::book`], in words.

use std::fmt;
use std::time::Duration;

use muster_api::name::NodeName;

use super::book::Book;
use super::{Seat, allocator};
use crate::cluster::{Cluster, Member};
use crate::node_health::Monotonic;
use crate::report::Refusal;
use crate::space::Slot;

/// Why one node is not offered to one framework.
#[derive(Debug, Clone, PartialEq)]
pub enum NotOffered {
    /// The framework has no session.
    Disconnected,
    /// It wants no offers.
    Suppressed,
    /// Of what it could want of the node, its namespace's quota leaves nothing.
    Quota,
    /// It declined the node, or let an offer run out.
    Declined {
        /// How long that holds yet, if the node gains nothing.
        left: Duration,
    },
    /// Others are closer.
    NotAmongTheClosest {
        /// How many are offered at once.
        limit: usize,
    },
    /// The node does not fit.
    Refusal(Refusal),
}

impl NotOffered {
    /// The reason as one word, for programs.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        match self {
            NotOffered::Disconnected => "Disconnected",
            NotOffered::Suppressed => "Suppressed",
            NotOffered::Quota => "QuotaExceeded",
            NotOffered::Declined { .. } => "Declined",
            NotOffered::NotAmongTheClosest { .. } => "NotAmongTheClosest",
            NotOffered::Refusal(refusal) => refusal.reason(),
        }
    }
}

impl fmt::Display for NotOffered {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            NotOffered::Disconnected => f.write_str("the framework is not connected"),
            NotOffered::Suppressed => {
                f.write_str("the framework suppressed its offers; Revive brings them back")
            }
            NotOffered::Quota => f.write_str("has nothing that the namespace's quota leaves"),
            NotOffered::Declined { left } => {
                write!(
                    f,
                    "was declined; offered again in {:.0} s, or when it has more",
                    left.as_secs_f64()
                )
            }
            NotOffered::NotAmongTheClosest { limit } => {
                write!(
                    f,
                    "is not among the {limit} that are offered at once; filter.most sets how many"
                )
            }
            NotOffered::Refusal(refusal) => write!(f, "{refusal}"),
        }
    }
}

impl Book {
    /// Why each node is not offered to a framework.
    #[must_use]
    pub fn explain(
        &self,
        cluster: &Cluster,
        seat: Seat,
        now: Monotonic,
    ) -> Vec<(NodeName, NotOffered)> {
        let Some(place) = self.places.get(&seat) else { return Vec::new() };
        let why = |slot: Slot, member: &Member| {
            if !place.connected {
                return NotOffered::Disconnected;
            }
            if place.suppressed {
                return NotOffered::Suppressed;
            }
            if let Some(refusal) = allocator::refusal(cluster.sites(), member, &place.wish) {
                return NotOffered::Refusal(refusal);
            }
            if allocator::is_spent(member, &place.wish) {
                return NotOffered::Quota;
            }
            let score = member
                .facts
                .as_ref()
                .and_then(|f| allocator::score(cluster.sites(), f, &place.wish));
            // What has gained since would be offered, were there a place for it.
            match place.refused.get(&slot).filter(|r| !r.has_gained(member, score)) {
                Some(r) => NotOffered::Declined { left: r.until.saturating_sub(now) },
                None => NotOffered::NotAmongTheClosest { limit: place.wish.filter.limit() },
            }
        };
        cluster
            .members()
            .filter(|(slot, _)| !place.offers.contains_key(slot))
            .map(|(slot, member)| (member.name.clone(), why(slot, member)))
            .collect()
    }
}
