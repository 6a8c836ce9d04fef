//! Accepts: who gets what it wants.
//!
//! An Accept is all or nothing, against the ledger. One whose nodes nobody of another namespace is shown passes at
//! once. Others are gathered with those that are about the same nodes, for [`GATHER`], and settled together, the
//! namespace with the least weighted share first, its share counted anew after every Accept that passed; of equals the
//! one that was served less, then the one that came first.
//!
//! Who is far away answers later, and would lose every race. So a framework that lost one is waited for the next time,
//! for [`COURTESY`] at most, by Accepts of namespaces that have more than its own; those of namespaces that have no more
//! do not wait with them. It is waited for until it has answered; one that was waited for and did not answer is not waited
//! for again before it has lost another race, to what others took since the offer was made: who is refused what it was not
//! offered has lost none. So a framework that freezes holds others up once, for that long, if it had just lost.
//!
//! An Accept does not pass declared tasks of a namespace with less that leave its node to somebody else for a moment, either:
//! see [`super::courtesy`].

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use muster_api::id::TaskUid;
use muster_api::kind::task::TaskSpec;
use muster_api::name::NodeName;

use super::book::Book;
use super::{COURTESY, GATHER, OfferId, Rescinded, Seat, allocator};
use crate::cluster::Cluster;
use crate::fairness::{OverQuota, Rank, namespace_of};
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
    /// Uid of the framework that launches it.
    pub framework: Arc<str>,
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
    /// The launches want what the offer did not show: more than the node has, or more than it had left.
    Exceeds {
        /// Index of the launch.
        launch: usize,
        /// The node.
        node: NodeName,
        /// Why.
        refusal: Refusal,
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

impl Denied {
    /// Whether somebody else was first, or the offer `showed` that it is not there.
    fn seen_by(self, showed: bool) -> Self {
        match self {
            Denied::Refused { launch, node, refusal } if exceeds(&refusal, showed) => {
                Denied::Exceeds { launch, node, refusal }
            }
            other => other,
        }
    }

    /// Whether what others have stands against it, and nothing else.
    fn is_of_others(&self) -> bool {
        let Denied::Refused { refusal, .. } = self else { return false };
        matches!(
            refusal,
            Refusal::Exhausted { .. } | Refusal::LeaseHeld { .. } | Refusal::Kept { .. }
        )
    }
}

fn exceeds(refusal: &Refusal, showed: bool) -> bool {
    match refusal {
        Refusal::TooSmall { .. } | Refusal::NoSensor { .. } | Refusal::NoActuator { .. } => true,
        Refusal::Exhausted { .. } => showed,
        _ => false,
    }
}

/// An Accept that waits for its window.
#[derive(Debug)]
pub(super) struct Gathered {
    pub(super) order: Order,
    /// The nodes that it is about.
    slots: BTreeSet<Slot>,
    came: Monotonic,
    /// When it may be settled, if nobody is waited for.
    ripe: Monotonic,
    /// When it is to be looked at even if nothing happens; none: something that has its own time stands before it.
    look: Option<Monotonic>,
}

/// Accepts that are settled together.
#[derive(Debug)]
pub(super) struct Window {
    /// Who is waited for, and has not answered.
    awaited: BTreeSet<Seat>,
    /// In the order in which they came.
    pub(super) orders: Vec<Gathered>,
}

impl Window {
    /// When nobody is waited for any more: whoever came first never waits longer than [`COURTESY`].
    fn closes(&self) -> Option<Monotonic> {
        self.orders.iter().map(|gathered| gathered.came + COURTESY).min()
    }

    fn is_about(&self, slot: Slot) -> bool {
        self.orders.iter().any(|gathered| gathered.slots.contains(&slot))
    }

    fn merge(&mut self, later: Window) {
        self.awaited.extend(later.awaited);
        self.orders.extend(later.orders);
    }
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
        let slots: BTreeSet<Slot> = order
            .offers
            .iter()
            .filter_map(|id| self.find(order.seat, *id))
            .map(|(slot, _)| slot)
            .collect();
        self.has_answered(order.seat, &slots);
        let contested = namespace.as_ref().is_some_and(|namespace| {
            !order.launches.is_empty()
                && (slots.iter().any(|slot| self.is_contested(*slot, namespace))
                    || self.is_claimed_by_less(cluster, namespace, &slots))
        });
        if let Some(namespace) = namespace.filter(|_| contested) {
            let awaited = self.worth_waiting_for(cluster, &namespace, &slots);
            self.gather((order, slots), awaited, now);
            return None;
        }
        let verdict = self.settle(cluster, &order, now);
        Some((order, verdict))
    }

    /// Frameworks that are shown one of these nodes, lost the last race, and whose namespaces have less than this one.
    fn worth_waiting_for(
        &self,
        cluster: &Cluster,
        namespace: &Arc<str>,
        slots: &BTreeSet<Slot>,
    ) -> BTreeSet<Seat> {
        let own = cluster.rank(namespace);
        let shown = slots.iter().flat_map(|slot| self.seats_shown(*slot));
        shown
            .filter(|seat| {
                let place = self.places.get(seat).filter(|place| place.behind);
                place.is_some_and(|place| cluster.rank(&place.wish.namespace) < own)
            })
            .collect()
    }

    /// Puts an Accept to those that are about the same nodes.
    fn gather(
        &mut self,
        (order, slots): (Order, BTreeSet<Slot>),
        awaited: BTreeSet<Seat>,
        now: Monotonic,
    ) {
        self.is_gathered_for(&slots, now);
        let (same, others): (Vec<Window>, Vec<Window>) = std::mem::take(&mut self.gathered)
            .into_iter()
            .partition(|window| slots.iter().any(|slot| window.is_about(*slot)));
        self.gathered = others;
        // Who comes later is settled with who came first: at once where the first waited for nobody else.
        let gathering = same.iter().flat_map(|window| &window.orders).map(|gathered| gathered.ripe);
        let ripe = gathering.chain([now + GATHER]).fold(now + GATHER, Monotonic::min).max(now);
        let came = now;
        let orders = vec![Gathered { order, slots, came, ripe, look: Some(ripe) }];
        let fresh = Window { awaited, orders };
        let together = same.into_iter().chain([fresh]).reduce(|mut first, next| {
            first.merge(next);
            first
        });
        self.gathered.extend(together.map(|mut window| {
            // Some may have come before the one that would have waited for them.
            let here: BTreeSet<Seat> = window.orders.iter().map(|g| g.order.seat).collect();
            window.awaited.retain(|seat| !here.contains(seat));
            for gathered in window.orders.iter_mut().filter(|gathered| gathered.ripe > now) {
                (gathered.ripe, gathered.look) = (ripe, Some(ripe));
            }
            window
        }));
    }

    /// Nobody waits for this framework any more.
    pub(super) fn is_awaited_no_more(&mut self, seat: Seat) {
        for window in &mut self.gathered {
            window.awaited.remove(&seat);
        }
    }

    /// The namespaces whose Accepts of a node are gathered, or waited for in a window about it.
    pub(super) fn in_windows(&self, slot: Slot) -> impl Iterator<Item = &Arc<str>> {
        let about = self.gathered.iter().filter(move |window| window.is_about(slot));
        about
            .flat_map(move |window| {
                let orders = window.orders.iter().filter(move |g| g.slots.contains(&slot));
                let shown = self.seats_shown(slot).filter(|seat| window.awaited.contains(seat));
                orders.map(|g| g.order.seat).chain(shown)
            })
            .filter_map(|seat| self.wish(seat))
            .map(|wish| &wish.namespace)
    }

    /// Whether an Accept that is gathered names the offer.
    pub(super) fn is_named(&self, id: OfferId) -> bool {
        let mut orders = self.gathered.iter().flat_map(|window| &window.orders);
        orders.any(|gathered| gathered.order.offers.contains(&id))
    }

    /// The next time at which a gathered Accept is looked at even if nothing happens.
    pub(super) fn next_look(&self) -> Option<Monotonic> {
        let orders = self.gathered.iter().flat_map(|window| &window.orders);
        orders.filter_map(|gathered| gathered.look).min()
    }

    /// The verdicts of the Accepts whose time has come.
    #[must_use = "an Accept is settled once"]
    pub fn settle_due(&mut self, cluster: &mut Cluster, now: Monotonic) -> Vec<(Order, Verdict)> {
        let mut due = Vec::new();
        for mut window in std::mem::take(&mut self.gathered) {
            if window.closes().is_some_and(|closes| closes <= now) {
                for seat in std::mem::take(&mut window.awaited) {
                    if let Some(place) = self.places.get_mut(&seat) {
                        place.behind = false;
                    }
                }
            }
            self.sift(cluster, &mut window, now, &mut due);
            if !window.orders.is_empty() {
                self.gathered.push(window);
            }
        }
        self.settle_all(cluster, due, now)
    }

    /// Takes those out of a window that have gathered for long enough and pass nobody by who has less and is waited for.
    fn sift(&self, cluster: &Cluster, window: &mut Window, now: Monotonic, due: &mut Vec<Order>) {
        let rank = |seat: Seat| self.wish(seat).map(|wish| cluster.rank(&wish.namespace));
        let least = window.awaited.iter().filter_map(|seat| rank(*seat)).min();
        let closes = window.closes();
        for mut gathered in std::mem::take(&mut window.orders) {
            let seat = gathered.order.seat;
            let namespace = self.wish(seat).map(|wish| Arc::clone(&wish.namespace));
            let passes_by =
                |namespace| self.is_claimed_by_less(cluster, namespace, &gathered.slots);
            gathered.look = if now < gathered.ripe {
                Some(gathered.ripe)
            } else if least.is_some_and(|least| rank(seat).is_some_and(|own| own > least)) {
                closes
            } else if namespace.as_ref().is_some_and(passes_by) {
                // Looked at when what they wait for is over.
                None
            } else {
                due.push(gathered.order);
                continue;
            };
            window.orders.push(gathered);
        }
    }

    /// Settles Accepts one after the other, always one of the namespace that has least by then.
    fn settle_all(
        &mut self,
        cluster: &mut Cluster,
        orders: Vec<Order>,
        now: Monotonic,
    ) -> Vec<(Order, Verdict)> {
        let mut settled = Vec::with_capacity(orders.len());
        // By namespace, in the order in which they came: only the share of whose turn it was changes.
        let mut waiting: BTreeMap<Arc<str>, VecDeque<(usize, Order)>> = BTreeMap::new();
        for (came, order) in orders.into_iter().enumerate() {
            let namespace = self.wish(order.seat).map(|w| Arc::clone(&w.namespace));
            waiting.entry(namespace.unwrap_or_default()).or_default().push_back((came, order));
        }
        let mut ranks: BTreeMap<Arc<str>, Rank> =
            waiting.keys().map(|ns| (Arc::clone(ns), cluster.rank(ns))).collect();
        loop {
            // The first of equals.
            let first = |queue: &VecDeque<(usize, Order)>| queue.front().map(|(came, _)| *came);
            let next = waiting.iter().min_by(|(a, of_a), (b, of_b)| {
                ranks[*a].cmp(&ranks[*b]).then_with(|| first(of_a).cmp(&first(of_b)))
            });
            let Some(namespace) = next.map(|(namespace, _)| Arc::clone(namespace)) else { break };
            let Some((_, order)) = waiting.get_mut(&namespace).and_then(VecDeque::pop_front) else {
                waiting.remove(&namespace);
                continue;
            };
            let verdict = self.settle(cluster, &order, now);
            ranks.insert(Arc::clone(&namespace), cluster.rank(&namespace));
            settled.push((order, verdict));
        }
        settled
    }

    fn settle(&mut self, cluster: &mut Cluster, order: &Order, now: Monotonic) -> Verdict {
        let decided = self.decide(cluster, order);
        if let Some(place) = self.places.get_mut(&order.seat) {
            // Who won because it was waited for is as far away as before, and would lose the next one.
            place.behind |= matches!(decided, Err((_, true)));
        }
        let found = order.offers.iter().filter_map(|id| Some((*id, self.find(order.seat, *id)?)));
        let (out, landing): (Vec<_>, Vec<_>) = found.partition(|(_, (_, is_out))| *is_out);
        for (_, (slot, _)) in out {
            if decided.is_ok() {
                self.answered(cluster, order.seat, slot, (order.refuse, now));
            } else if self.is_stale(cluster, order.seat, slot) {
                self.withdraw(order.seat, slot, Rescinded::Taken, now);
                self.dirty.insert(order.seat);
            }
        }
        for (id, _) in landing.into_iter().filter(|_| decided.is_ok()) {
            self.landed(cluster, id, (order.refuse, now));
        }
        decided.map_err(|(denied, _)| denied)
    }

    /// The nodes of which the framework was shown what they have now.
    fn shown_as_is(&self, cluster: &Cluster, order: &Order) -> BTreeSet<Slot> {
        let slots = order.offers.iter().filter_map(|id| self.find(order.seat, *id));
        slots
            .filter(|(slot, is_out)| *is_out && !self.is_stale(cluster, order.seat, *slot))
            .map(|(slot, _)| slot)
            .collect()
    }

    fn is_stale(&self, cluster: &Cluster, seat: Seat, slot: Slot) -> bool {
        let offer = self.places.get(&seat).and_then(|p| p.offers.get(&slot));
        offer.is_some_and(|o| o.version != cluster.at(slot).version)
    }

    /// Reserves for every launch, or for none; says of a refusal whether it is a lost race.
    fn decide(&self, cluster: &mut Cluster, order: &Order) -> Result<Vec<Bind>, (Denied, bool)> {
        let gone: Vec<OfferId> = order
            .offers
            .iter()
            .copied()
            .filter(|id| self.find(order.seat, *id).is_none())
            .collect();
        if !gone.is_empty() {
            return Err((Denied::OffersGone { offers: gone }, false));
        }
        // Before anything of it is reserved.
        let as_is = self.shown_as_is(cluster, order);
        let mut binds: Vec<Bind> = Vec::with_capacity(order.launches.len());
        for (i, launch) in order.launches.iter().enumerate() {
            let slot = order
                .offers
                .contains(&launch.offer)
                .then(|| self.find(order.seat, launch.offer))
                .flatten()
                .map(|(slot, _)| slot);
            let bound = match slot {
                Some(slot) => reserve(cluster, slot, (i, launch)),
                None => Err(Denied::NotNamed { launch: i }),
            };
            match bound {
                Ok(mut bind) => {
                    // A task that says nothing of where it works has the score of its offer.
                    let facts = slot.and_then(|slot| cluster.at(slot).facts.as_ref());
                    let wish = self.wish(order.seat);
                    let offered =
                        facts.zip(wish).and_then(|(f, w)| allocator::score(cluster.sites(), f, w));
                    bind.score = bind.score.or(offered);
                    binds.push(bind);
                }
                Err(denied) => {
                    for bind in &binds {
                        cluster.undo(&bind.uid);
                    }
                    let showed = slot.is_some_and(|slot| as_is.contains(&slot));
                    let lost = !showed && denied.is_of_others();
                    return Err((denied.seen_by(showed), lost));
                }
            }
        }
        for (launch, bind) in order.launches.iter().zip(&binds) {
            let compute = launch.spec.resources.reserved();
            cluster.serve(namespace_of(&launch.title), &compute, bind.leases.len() as u64);
        }
        Ok(binds)
    }
}

fn reserve(
    cluster: &mut Cluster,
    slot: Slot,
    (i, launch): (usize, &Launch),
) -> Result<Bind, Denied> {
    let demand = Demand {
        uid: launch.uid.clone(),
        title: Arc::clone(&launch.title),
        spec: Arc::clone(&launch.spec),
        since: 0,
        avoid: Arc::default(),
        framework: Some(Arc::clone(&launch.framework)),
    };
    let member = cluster.at(slot);
    if let Some(refusal) = filter::refusal(cluster.sites(), member, &demand) {
        return Err(Denied::Refused { launch: i, node: member.name.clone(), refusal });
    }
    let namespace = namespace_of(&launch.title);
    let compute = launch.spec.resources.reserved();
    let groups = member.facts.as_ref().map(|f| f.groups_for(&launch.spec.resources.actuators));
    let leases = groups.map_or(0, |g| g.len() as u64);
    if let Some(over) = cluster.accounts().over_quota(cluster, namespace, &compute, leases) {
        return Err(Denied::Quota { launch: i, over });
    }
    Ok(schedule::take(cluster, &demand, slot))
}
