//! Accepts: who gets what it wants.
//!
//! An Accept is all or nothing, against the ledger. One whose nodes nobody of another namespace is shown passes at
//! once. Others are gathered for [`GATHER`] and settled together, the namespace with the least weighted share first,
//! its share counted anew after every Accept that passed: so fairness is enforced among those who want the same at the
//! same time, and a framework that does not answer holds nobody up.

use std::sync::Arc;
use std::time::Duration;

use muster_api::id::TaskUid;
use muster_api::kind::task::TaskSpec;
use muster_api::name::NodeName;

use super::book::Book;
use super::{GATHER, OfferId, Rescinded, Seat, allocator};
use crate::cluster::Cluster;
use crate::fairness::{Accounts, OverQuota, namespace_of};
use crate::node_health::Monotonic;
use crate::report::Refusal;
use crate::schedule::{self, Bind, Demand, filter};
use crate::space::Slot;

/// A task to launch on an offered node.
#[derive(Debug, Clone)]
pub struct Launch {
    /// The uid it will have.
    pub uid: TaskUid,
    /// `namespace/name`.
    pub title: Arc<str>,
    /// What it is and needs.
    pub spec: Arc<TaskSpec>,
    /// The offer it uses.
    pub offer: OfferId,
}

/// An Accept.
#[derive(Debug, Clone)]
pub struct Order {
    /// Whose.
    pub seat: Seat,
    /// The caller's number for it.
    pub ticket: u64,
    /// The offers that it answers.
    pub offers: Vec<OfferId>,
    /// What is to run.
    pub launches: Vec<Launch>,
    /// For how long the nodes are not to be offered again.
    pub refuse: Duration,
}

/// Why an Accept gets nothing.
#[derive(Debug, Clone, PartialEq)]
pub enum Denied {
    /// Offers that ended before, were answered before, or never were this framework's.
    OffersGone {
        /// Which.
        offers: Vec<OfferId>,
    },
    /// A launch names an offer that the Accept does not.
    NotNamed {
        /// Index of the launch.
        launch: usize,
    },
    /// The node does not take it (any more).
    Refused {
        /// Index of the launch.
        launch: usize,
        /// The node.
        node: NodeName,
        /// Why.
        refusal: Refusal,
    },
    /// The namespace's quota does not allow it.
    Quota {
        /// Index of the launch.
        launch: usize,
        /// What it passes.
        over: OverQuota,
    },
}

/// What becomes of an Accept: where each launch goes, in their order.
pub type Verdict = Result<Vec<Bind>, Denied>;

impl Book {
    /// Takes an Accept. None: it is gathered, and [`Book::settle_due`] gives its verdict.
    pub fn submit(
        &mut self,
        cluster: &mut Cluster,
        order: Order,
        now: Monotonic,
    ) -> Option<(Order, Verdict)> {
        let namespace = self.wish(order.seat).map(|w| Arc::clone(&w.namespace));
        let contested = namespace.is_some_and(|namespace| {
            let slots = order.offers.iter().filter_map(|id| self.find(order.seat, *id));
            !order.launches.is_empty()
                && slots.into_iter().any(|(slot, _)| self.is_contested(slot, &namespace))
        });
        if contested {
            // One window for all: whoever comes while it is open is settled with the first.
            let due = self.gathered.first().map_or(now + GATHER, |(due, _)| *due);
            self.gathered.push((due, order));
            return None;
        }
        let mut accounts = cluster.has_quotas().then(|| Accounts::of(cluster));
        let verdict = self.settle(cluster, &order, accounts.as_mut(), now);
        Some((order, verdict))
    }

    /// The verdicts of the Accepts whose window has closed.
    #[must_use = "an Accept is settled once"]
    pub fn settle_due(&mut self, cluster: &mut Cluster, now: Monotonic) -> Vec<(Order, Verdict)> {
        if self.gathered.first().is_none_or(|(due, _)| *due > now) {
            return Vec::new();
        }
        let mut waiting: Vec<Order> =
            std::mem::take(&mut self.gathered).into_iter().map(|(_, order)| order).collect();
        let mut accounts = Accounts::of(cluster);
        let mut settled = Vec::with_capacity(waiting.len());
        while !waiting.is_empty() {
            let share = |order: &Order| {
                let wish = self.wish(order.seat);
                wish.map_or(0.0, |w| accounts.share(cluster, &w.namespace))
            };
            // The first of equals: they came in this order.
            let next = (0..waiting.len())
                .min_by(|a, b| share(&waiting[*a]).total_cmp(&share(&waiting[*b])))
                .expect("somebody waits");
            let order = waiting.remove(next);
            let verdict = self.settle(cluster, &order, Some(&mut accounts), now);
            settled.push((order, verdict));
        }
        settled
    }

    fn settle(
        &mut self,
        cluster: &mut Cluster,
        order: &Order,
        accounts: Option<&mut Accounts>,
        now: Monotonic,
    ) -> Verdict {
        let verdict = self.decide(cluster, order, accounts);
        for id in &order.offers {
            let Some((slot, true)) = self.find(order.seat, *id) else { continue };
            if verdict.is_ok() {
                self.answered(cluster, order.seat, slot, (order.refuse, now));
            } else if self.is_stale(cluster, order.seat, slot) {
                self.withdraw(order.seat, slot, Rescinded::Taken, now);
                self.dirty.insert(order.seat);
            }
        }
        verdict
    }

    fn is_stale(&self, cluster: &Cluster, seat: Seat, slot: Slot) -> bool {
        let offer = self.places.get(&seat).and_then(|p| p.offers.get(&slot));
        offer.is_some_and(|o| o.version != cluster.at(slot).version)
    }

    /// Reserves for every launch, or for none.
    fn decide(
        &self,
        cluster: &mut Cluster,
        order: &Order,
        mut accounts: Option<&mut Accounts>,
    ) -> Verdict {
        let gone: Vec<OfferId> = order
            .offers
            .iter()
            .copied()
            .filter(|id| self.find(order.seat, *id).is_none())
            .collect();
        if !gone.is_empty() {
            return Err(Denied::OffersGone { offers: gone });
        }
        let mut binds: Vec<Bind> = Vec::with_capacity(order.launches.len());
        for (i, launch) in order.launches.iter().enumerate() {
            let slot = order
                .offers
                .contains(&launch.offer)
                .then(|| self.find(order.seat, launch.offer))
                .flatten()
                .map(|(slot, _)| slot);
            let bound = match slot {
                Some(slot) => reserve(cluster, slot, (i, launch), accounts.as_deref_mut()),
                None => Err(Denied::NotNamed { launch: i }),
            };
            match bound {
                Ok(mut bind) => {
                    // A task that says nothing of where it works has the score of its offer.
                    let facts = slot.and_then(|slot| cluster.at(slot).facts.as_ref());
                    let wish = self.wish(order.seat);
                    let offered = facts.zip(wish).and_then(|(f, w)| allocator::score(f, w));
                    bind.score = bind.score.or(offered);
                    binds.push(bind);
                }
                Err(denied) => {
                    for (bind, launch) in binds.iter().zip(&order.launches) {
                        cluster.undo(&bind.uid);
                        if let Some(accounts) = accounts.as_deref_mut() {
                            let compute = launch.spec.resources.reserved();
                            let leases = bind.leases.len() as u64;
                            accounts.sub(namespace_of(&launch.title), &compute, leases);
                        }
                    }
                    return Err(denied);
                }
            }
        }
        Ok(binds)
    }
}

fn reserve(
    cluster: &mut Cluster,
    slot: Slot,
    (i, launch): (usize, &Launch),
    accounts: Option<&mut Accounts>,
) -> Result<Bind, Denied> {
    let demand = Demand {
        uid: launch.uid.clone(),
        title: Arc::clone(&launch.title),
        spec: Arc::clone(&launch.spec),
        since: 0,
        avoid: Arc::default(),
    };
    let member = cluster.at(slot);
    if let Some(refusal) = filter::refusal(member, &demand) {
        return Err(Denied::Refused { launch: i, node: member.name.clone(), refusal });
    }
    let namespace = namespace_of(&launch.title);
    let compute = launch.spec.resources.reserved();
    let groups = member.facts.as_ref().map(|f| f.groups_for(&launch.spec.resources.actuators));
    let leases = groups.map_or(0, |g| g.len() as u64);
    if let Some(accounts) = accounts {
        if let Some(over) = accounts.over_quota(cluster, namespace, &compute, leases) {
            return Err(Denied::Quota { launch: i, over });
        }
        accounts.add(namespace, &compute, leases);
    }
    Ok(schedule::take(cluster, &demand, slot))
}
