//! What declared tasks leave to frameworks for a moment.
//!
//! A declared task is looked at in the pass in which something comes free; a framework can answer only when it has heard.
//! Were nothing done about it, who declares tasks would get everything that a framework waits for too, whatever the
//! weights. So a node that was freed is *left*, for [`COURTESY`] at most, by declared tasks of a namespace to the frameworks
//! of namespaces with a smaller weighted share that are offered it. It is left to each until that one has answered:
//! accepted it, declined it, or let the time pass. Nor does a declared task pass by Accepts of less that are being gathered.
//!
//! - A node is left for [`COURTESY`] from when it was freed or an Accept of it was gathered, and for a [`GATHER`] more to
//!   Accepts that came meanwhile. What is freed in that time does not prolong it, and in the pass in which it ends
//!   nothing of the node is left: so long waits a task at most.
//! - Nothing is left to a framework that let a node pass without a word while somebody waited for it, for
//!   [`SILENT_FOR`] or until it says something: one that freezes holds nobody up.
//!
//! A task goes to the next best node that is not left, if there is one. Priorities come before shares: a task of more than
//! the usual priority (0), and one for which room is made, leaves nothing. Without a framework that is connected, wants
//! offers, is shown the node and has less, nothing is ever left; while no declared task waits, nothing is looked at.
//!
//! While a task of a namespace leaves a node (it *claims* it), Accepts of namespaces with more than its own wait, too: what is
//! left to the poorest is no gain of the richest.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use super::book::Book;
use super::settle::{Order, Verdict};
use super::{COURTESY, GATHER, Seat};
use crate::cluster::Cluster;
use crate::node_health::Monotonic;
use crate::schedule::Claim;
use crate::space::Slot;

/// For how long nothing is left to a framework that let a courtesy pass. It may have nothing to launch, and say nothing
/// for hours; it may be frozen; and it may get work in the next minute, and must find a free robot then. So it costs who waits
/// one [`COURTESY`] in this time: 2 %.
pub const SILENT_FOR: Duration = Duration::from_secs(5);

/// What is known of a node that is left, or could be.
#[derive(Debug)]
pub(super) struct Courtesy {
    since: Monotonic,
    /// It was freed; else only Accepts that are being gathered are waited for.
    freed: bool,
    answered: BTreeSet<Seat>,
    /// Namespaces whose declared tasks leave it.
    claims: BTreeSet<Arc<str>>,
    /// When it is looked at even if nothing happens.
    look: Monotonic,
}

impl Courtesy {
    fn new(since: Monotonic, freed: bool) -> Self {
        let (answered, claims) = (BTreeSet::new(), BTreeSet::new());
        Courtesy { since, freed, answered, claims, look: since + COURTESY }
    }

    /// Nobody is waited for any more who has not answered.
    fn closes(&self) -> Monotonic {
        self.since + COURTESY
    }

    /// Nothing is left any more.
    fn ends(&self) -> Monotonic {
        self.closes() + GATHER
    }
}

impl Book {
    /// What comes before declared tasks are looked at: settles the Accepts whose time has come, and says in the cluster
    /// what declared tasks leave. `anybody_waits`: there are some.
    #[must_use = "an Accept is settled once"]
    pub fn begin_pass(
        &mut self,
        cluster: &mut Cluster,
        anybody_waits: bool,
        now: Monotonic,
    ) -> Vec<(Order, Verdict)> {
        let settled = self.settle_due(cluster, now);
        let freed = cluster.take_freed();
        if !anybody_waits {
            self.claim(&[]);
        }
        if anybody_waits && !self.places.is_empty() {
            freed.into_iter().for_each(|slot| self.open(slot, true, now));
        }
        self.close(cluster, now);
        if !anybody_waits || self.courtesies.is_empty() {
            cluster.leave(BTreeMap::new());
            return settled;
        }
        // Who is offered what was freed is known after that.
        self.take_in(cluster, now);
        cluster.leave(self.left(now));
        settled
    }

    /// Takes in what declared tasks leave by what was just decided: all of it.
    pub fn claim(&mut self, claims: &[Claim]) {
        for courtesy in self.courtesies.values_mut() {
            courtesy.claims.clear();
        }
        for Claim { slot, namespace } in claims {
            if let Some(courtesy) = self.courtesies.get_mut(slot) {
                courtesy.claims.insert(Arc::clone(namespace));
            }
        }
    }

    /// A node is left from now on, if it is not already.
    fn open(&mut self, slot: Slot, freed: bool, now: Monotonic) {
        match self.courtesies.get_mut(&slot) {
            Some(courtesy) if now < courtesy.ends() => {
                courtesy.freed |= freed;
                if freed {
                    // There is more than they answered.
                    courtesy.answered.clear();
                }
            }
            // It ends first: who waits has a pass without any.
            Some(courtesy) if !courtesy.claims.is_empty() => {}
            _ => drop(self.courtesies.insert(slot, Courtesy::new(now, freed))),
        }
    }

    /// Forgets what is over, and who let it pass.
    fn close(&mut self, cluster: &Cluster, now: Monotonic) {
        let mut over = Vec::new();
        self.courtesies.retain(|slot, courtesy| {
            let ends = courtesy.ends();
            if now >= courtesy.closes() && courtesy.look < ends {
                courtesy.look = ends;
                if courtesy.freed && !courtesy.claims.is_empty() {
                    over.push((*slot, courtesy.claims.clone(), courtesy.answered.clone()));
                }
            }
            now < ends
        });
        for (slot, claims, answered) in over {
            let most = claims.iter().map(|claim| cluster.rank(claim)).max();
            let seats: Vec<Seat> = self.seats_shown(slot).collect();
            for seat in seats.into_iter().filter(|seat| !answered.contains(seat)) {
                let Some(place) = self.places.get_mut(&seat) else { continue };
                if Some(cluster.rank(&place.wish.namespace)) < most {
                    place.silent_until = now + SILENT_FOR;
                }
            }
        }
    }

    /// Which namespaces' frameworks each node is left to, by those that have more.
    fn left(&self, now: Monotonic) -> BTreeMap<Slot, BTreeSet<Arc<str>>> {
        let to = |slot: Slot, courtesy: &Courtesy| -> BTreeSet<Arc<str>> {
            let hears = courtesy.freed && now < courtesy.closes();
            let shown = self.seats_shown(slot).filter(|_| hears);
            let asked = shown
                .filter(|seat| !courtesy.answered.contains(seat))
                .filter_map(|seat| self.places.get(&seat))
                .filter(|place| place.silent_until <= now)
                .map(|place| &place.wish.namespace);
            asked.chain(self.in_windows(slot)).map(Arc::clone).collect()
        };
        let left = self.courtesies.iter().map(|(slot, courtesy)| (*slot, to(*slot, courtesy)));
        left.filter(|(_, to)| !to.is_empty()).collect()
    }

    /// A framework said something, of these nodes: nobody waits for it any more.
    pub(super) fn has_answered(&mut self, seat: Seat, slots: &BTreeSet<Slot>) {
        self.is_awaited_no_more(seat);
        if let Some(place) = self.places.get_mut(&seat) {
            place.silent_until = Monotonic::ZERO;
        }
        for slot in slots {
            if let Some(courtesy) = self.courtesies.get_mut(slot) {
                courtesy.answered.insert(seat);
            }
        }
    }

    /// An Accept of these nodes is gathered: declared tasks do not pass it by.
    pub(super) fn is_gathered_for(&mut self, slots: &BTreeSet<Slot>, now: Monotonic) {
        for slot in slots {
            self.open(*slot, false, now);
        }
    }

    /// Whether a declared task of a namespace with less than this one leaves one of the nodes to somebody else.
    pub(super) fn is_claimed_by_less(
        &self,
        cluster: &Cluster,
        namespace: &Arc<str>,
        slots: &BTreeSet<Slot>,
    ) -> bool {
        let own = cluster.rank(namespace);
        let claims =
            slots.iter().filter_map(|slot| self.courtesies.get(slot)).flat_map(|c| &c.claims);
        claims.into_iter().any(|claim| cluster.rank(claim) < own)
    }

    /// When something that is left to somebody, while others wait, is left no more.
    pub(super) fn next_end(&self) -> Option<Monotonic> {
        let claimed = self.courtesies.values().filter(|courtesy| !courtesy.claims.is_empty());
        claimed.map(|courtesy| courtesy.look).min()
    }
}
