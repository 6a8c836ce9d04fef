//! Offers: what of which node is shown to which framework (Avalon, III-C; Mesos for semantics).
//!
//! ```text
//!   Cluster ── changed, moved ──▶ Book::refresh ──▶ Notices { rescinded, offered } ──▶ sessions
//!   sessions ── decline, accept, … ──▶ Book ──▶ Verdict { binds } or a refusal
//! ```
//!
//! | module | decides |
//! |---|---|
//! | [`allocator`] | which nodes a framework may be offered, best first: Algorithm 1 behind a trait |
//! | [`book`] | which offers are out, when they end, what is refused until when |
//! | [`courtesy`] | what declared tasks leave to frameworks for a moment |
//! | [`explain`] | why a framework is not offered a node |
//! | [`refused`] | when what was declined is offered again |
//! | [`settle`] | whether an Accept gets what it wants, and who goes first when several want the same |
//!
//! **Offers are optimistic.** Many frameworks may hold an offer of the same node; nothing is set aside for any of
//! them, so a framework that does not answer delays nobody. What counts is the ledger at the moment of the Accept.
//!
//! **Offers are level-triggered.** After every [`Book::refresh`](book::Book::refresh) each framework that wants offers
//! holds one for every node that it can be offered, up to its limit: nothing depends on having seen an event, and
//! nobody is left out by the order of events (the property tests hold it against a scan over everything).

pub mod allocator;
pub mod book;
pub mod courtesy;
pub mod explain;
pub mod refused;
pub mod settle;
#[cfg(test)]
mod tests;

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use muster_api::kind::framework::{FrameworkSpec, OfferFilter};
use muster_api::kind::task::Cost;
use muster_api::pose::OperationPosition;

use crate::fairness::Spent;
use crate::node_health::Monotonic;
use crate::space::Slot;

/// Number of an offer, never used again: the upper half says in which life of the controller it was made, by a random number
/// ([`OfferId::first`]), so that an Accept from before a restart cannot mean another robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct OfferId(pub u64);

/// Lower half: the offers of one life. When they run over, they go on in the next prefix.
const LIFE_SHIFT: u32 = 32;

impl OfferId {
    /// The first offer of a life of the controller; `life` is random.
    #[must_use]
    pub fn first(life: u32) -> Self {
        OfferId(u64::from(life) << LIFE_SHIFT | 1)
    }

    /// The next number.
    #[must_use]
    pub fn next(self) -> Self {
        OfferId(self.0.wrapping_add(1))
    }
}

/// A text that is no offer's id.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoOfferId;

impl FromStr for OfferId {
    type Err = NoOfferId;

    fn from_str(text: &str) -> Result<Self, NoOfferId> {
        let (life, number) = text.split_once('-').ok_or(NoOfferId)?;
        let life = u32::from_str_radix(life, 16).map_err(|_| NoOfferId)?;
        let number: u32 = number.parse().map_err(|_| NoOfferId)?;
        Ok(OfferId(u64::from(life) << LIFE_SHIFT | u64::from(number)))
    }
}

impl fmt::Display for OfferId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:x}-{}", self.0 >> LIFE_SHIFT, self.0 & u64::from(u32::MAX))
    }
}

/// Number of a framework in the book, for as long as it is registered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Seat(pub u32);

/// How long an offer waits for an answer. It costs nobody anything while it waits; the limit only ends what a
/// forgotten framework would hold for ever, and keeps ages honest in `muster offers`.
pub const EXPIRE_AFTER: Duration = Duration::from_secs(60);
/// For how long an offer that ran out is not made again unless the node gains something: who did not answer in a
/// minute will not in the next second.
pub const REFUSED_BY_SILENCE: Duration = Duration::from_secs(5);
/// For how long a decline holds when the framework names no time (Mesos' default).
pub const DEFAULT_REFUSE: Duration = Duration::from_secs(5);
/// How long contested Accepts are gathered. Frameworks that react to the same change answer within a few milliseconds
/// of each other; longer would only slow the first one down.
pub const GATHER: Duration = Duration::from_millis(5);
/// How long an Accept waits at most for a framework that has less and lost the last race, and a declared task for one that has
/// less and is offered what was freed: a round trip over a slow link and its thinking.
pub const COURTESY: Duration = Duration::from_millis(100);
/// For how long an offer that was rescinded because its node changed can still be accepted: the Accept may have been
/// on its way. The ledger decides, as for any other.
pub const IN_FLIGHT: Duration = Duration::from_secs(2);

/// What a framework wants to be offered.
#[derive(Debug, Clone, PartialEq)]
pub struct Wish {
    /// Its namespace: whose share and quota count.
    pub namespace: Arc<str>,
    /// Where it works; none: everywhere, and offers have no score.
    pub position: Option<OperationPosition>,
    /// How far from there a robot may be, metres.
    pub radius: f64,
    /// How robots are scored.
    pub cost: Cost,
    /// What a node must have.
    pub filter: OfferFilter,
    /// What the namespace's quota leaves nothing of, at the last look.
    pub spent: Spent,
}

impl Wish {
    /// What a framework's spec says.
    #[must_use]
    pub fn new(namespace: &str, spec: &FrameworkSpec) -> Self {
        Wish {
            namespace: namespace.into(),
            position: spec.position.clone(),
            radius: spec.radius.unwrap_or(f64::INFINITY),
            cost: spec.cost,
            filter: spec.filter.clone(),
            spent: Spent::default(),
        }
    }
}

/// One node, shown to one framework.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Offer {
    /// Its number.
    pub id: OfferId,
    /// The node.
    pub slot: Slot,
    /// Metres or seconds, by the framework's cost; none for a cloud node, or without a position.
    pub score: Option<f64>,
    /// When it was made.
    pub made_at: Monotonic,
    /// The node's version that it shows.
    pub version: u64,
    /// What the quota left nothing of when it was made: it does not show that.
    pub spent: Spent,
}

/// Why an offer ended without an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Rescinded {
    /// The node has more, less or other things; a fresh offer follows where it still fits.
    Changed,
    /// An Accept used it.
    Taken,
    /// The robot is too far away, in another map, or does not know where it is.
    OutOfRange,
    /// The framework changed its filter or position: the node does not fit any more, or has another score, and a fresh
    /// offer follows.
    Filtered,
    /// The node is not ready, cordoned, tainted or gone.
    NodeLost,
    /// No answer came in time.
    Expired,
    /// The framework wants no offers.
    Suppressed,
    /// A closer robot takes its place.
    Closer,
    /// What the namespace's quota leaves is all used, or not any more; a fresh offer follows where something is left.
    Quota,
}

/// What a framework is to be told.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Notice {
    /// Offers that ended.
    pub rescinded: Vec<(OfferId, Rescinded)>,
    /// New offers, best first.
    pub offered: Vec<Offer>,
}

impl Notice {
    /// Nothing to tell.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rescinded.is_empty() && self.offered.is_empty()
    }
}
