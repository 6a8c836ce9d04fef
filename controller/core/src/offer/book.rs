//! Which offers are out, when they end, and what is refused until when.
//!
//! The book changes in two ways: by what a framework says (each method marks the framework as one to look at again) and
//! by [`Book::refresh`], which takes the cluster's changes and looks at whoever they or the framework's own words concern.
//! A look compares what the framework holds with what it can be offered now, and the difference is the notice.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use muster_api::resource::Compute;

use super::allocator::{self, Allocator, Candidate};
use super::{
    EXPIRE_AFTER, IN_FLIGHT, Notice, Offer, OfferId, REFUSED_BY_SILENCE, Rescinded, Seat, Wish,
};
use crate::cluster::{Cluster, Member};
use crate::fairness::Accounts;
use crate::node_health::Monotonic;
use crate::report::Refusal;
use crate::space::Slot;

/// Above this many pairs of a touched node and a framework, every framework is looked at: the looks cost less than
/// finding out who need not be.
const LOOK_AT_ALL_ABOVE: usize = 50_000;

/// An offered robot gives its place to one that is closer by this part of its own score …
const CLOSER_BY: f64 = 0.1;
/// … and by at least so much (metres or seconds): two robots that pass each other must not take turns.
const CLOSER_BY_AT_LEAST: f64 = 0.5;

/// One framework in the book.
#[derive(Debug)]
pub(super) struct Place {
    pub(super) wish: Wish,
    pub(super) connected: bool,
    pub(super) suppressed: bool,
    pub(super) offers: BTreeMap<Slot, Offer>,
    pub(super) refused: HashMap<Slot, Refused>,
    /// The wish is new since the last look.
    rewished: bool,
}

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
    fn new(member: &Member, score: Option<f64>, until: Monotonic) -> Self {
        Refused {
            until,
            free: member.ledger.open(),
            actuators_free: allocator::actuators_free(member),
            facts_version: member.facts_version,
            score,
        }
    }

    /// What was refused has changed: there is more of something now, or it is closer.
    fn has_gained(&self, member: &Member, score: Option<f64>) -> bool {
        self.facts_version != member.facts_version
            || (allocator::actuators_free(member) && !self.actuators_free)
            || self.free.shortage_for(&member.ledger.open()).is_some()
            || matches!((self.score, score), (Some(then), Some(now)) if is_closer(now, then))
    }
}

fn is_closer(new: f64, old: f64) -> bool {
    new + (old * CLOSER_BY).max(CLOSER_BY_AT_LEAST) < old
}

/// Every framework, and what it is shown.
#[derive(Debug)]
pub struct Book {
    allocator: Box<dyn Allocator>,
    pub(super) places: BTreeMap<Seat, Place>,
    offers: HashMap<OfferId, (Seat, Slot)>,
    /// Who is shown a node.
    shown: HashMap<Slot, BTreeSet<Seat>>,
    expiries: BTreeSet<(Monotonic, OfferId)>,
    thaws: BTreeSet<(Monotonic, Seat, Slot)>,
    /// Ended lately, and still good in an Accept that was on its way.
    in_flight: HashMap<OfferId, (Seat, Slot)>,
    landings: BTreeSet<(Monotonic, OfferId)>,
    pub(super) dirty: BTreeSet<Seat>,
    notices: BTreeMap<Seat, Notice>,
    pub(super) gathered: Vec<(Monotonic, super::settle::Order)>,
    next_offer: u64,
    next_seat: u32,
}

impl Book {
    /// Nobody is registered.
    #[must_use]
    pub fn new(allocator: Box<dyn Allocator>) -> Self {
        Book {
            allocator,
            places: BTreeMap::new(),
            offers: HashMap::new(),
            shown: HashMap::new(),
            expiries: BTreeSet::new(),
            thaws: BTreeSet::new(),
            in_flight: HashMap::new(),
            landings: BTreeSet::new(),
            dirty: BTreeSet::new(),
            notices: BTreeMap::new(),
            gathered: Vec::new(),
            next_offer: 1,
            next_seat: 1,
        }
    }

    /// A framework subscribes; it is connected from now on.
    pub fn register(&mut self, wish: Wish) -> Seat {
        let seat = Seat(self.next_seat);
        self.next_seat += 1;
        let place = Place {
            wish,
            connected: true,
            suppressed: false,
            offers: BTreeMap::new(),
            refused: HashMap::new(),
            rewished: false,
        };
        self.places.insert(seat, place);
        self.dirty.insert(seat);
        seat
    }

    /// The framework's session ended: what it was offered is offered no more. It may come back by [`Book::reconnect`].
    pub fn disconnect(&mut self, seat: Seat) {
        if let Some(place) = self.places.get_mut(&seat) {
            place.connected = false;
            self.withdraw_all(seat, Rescinded::Suppressed);
            self.notices.remove(&seat);
        }
    }

    /// The framework is back. What it declined before is offered again.
    pub fn reconnect(&mut self, seat: Seat, wish: Wish) {
        self.disconnect(seat);
        if let Some(place) = self.places.get_mut(&seat) {
            place.connected = true;
            place.suppressed = false;
            place.wish = wish;
            self.forget_refusals(seat);
            self.dirty.insert(seat);
        }
    }

    /// The framework ends.
    pub fn remove(&mut self, seat: Seat) {
        self.disconnect(seat);
        self.forget_refusals(seat);
        self.places.remove(&seat);
        self.dirty.remove(&seat);
        self.gathered.retain(|(_, order)| order.seat != seat);
    }

    /// SetPosition and SetFilter: everything is looked at anew, what was declined too.
    pub fn set_wish(&mut self, seat: Seat, wish: Wish) {
        if let Some(place) = self.places.get_mut(&seat) {
            place.wish = wish;
            place.rewished = true;
            self.forget_refusals(seat);
            self.dirty.insert(seat);
        }
    }

    /// What the framework wants.
    #[must_use]
    pub fn wish(&self, seat: Seat) -> Option<&Wish> {
        self.places.get(&seat).map(|p| &p.wish)
    }

    /// No offers until [`Book::revive`].
    pub fn suppress(&mut self, seat: Seat) {
        if let Some(place) = self.places.get_mut(&seat) {
            place.suppressed = true;
            self.withdraw_all(seat, Rescinded::Suppressed);
        }
    }

    /// Offers are wanted again, of everything.
    pub fn revive(&mut self, seat: Seat) {
        if let Some(place) = self.places.get_mut(&seat) {
            place.suppressed = false;
            self.forget_refusals(seat);
            self.dirty.insert(seat);
        }
    }

    /// Whether the framework wants no offers.
    #[must_use]
    pub fn is_suppressed(&self, seat: Seat) -> bool {
        self.places.get(&seat).is_some_and(|p| p.suppressed)
    }

    /// The framework does not want these, for `refuse` or until the node has more than now. Gives those that are not
    /// its offers any more.
    pub fn decline(
        &mut self,
        cluster: &Cluster,
        seat: Seat,
        offers: &[OfferId],
        (refuse, now): (Duration, Monotonic),
    ) -> Vec<OfferId> {
        let mut unknown = Vec::new();
        for id in offers {
            match self.offers.get(id) {
                Some((owner, slot)) if *owner == seat => {
                    let slot = *slot;
                    self.answered(cluster, seat, slot, (refuse, now));
                }
                _ => unknown.push(*id),
            }
        }
        unknown
    }

    /// An offer was answered: it ends without a word.
    pub(super) fn answered(
        &mut self,
        cluster: &Cluster,
        seat: Seat,
        slot: Slot,
        (refuse, now): (Duration, Monotonic),
    ) {
        let Some(offer) = self.take_out(seat, slot) else { return };
        if !refuse.is_zero() {
            self.refuse(cluster, seat, (slot, offer.score), now.saturating_add(refuse));
        }
        self.dirty.insert(seat);
    }

    fn refuse(
        &mut self,
        cluster: &Cluster,
        seat: Seat,
        (slot, score): (Slot, Option<f64>),
        until: Monotonic,
    ) {
        let Some(place) = self.places.get_mut(&seat) else { return };
        let refused = Refused::new(cluster.at(slot), score, until);
        if let Some(earlier) = place.refused.insert(slot, refused) {
            self.thaws.remove(&(earlier.until, seat, slot));
        }
        self.thaws.insert((until, seat, slot));
    }

    fn forget_refusals(&mut self, seat: Seat) {
        let Some(place) = self.places.get_mut(&seat) else { return };
        for (slot, refused) in place.refused.drain() {
            self.thaws.remove(&(refused.until, seat, slot));
        }
    }

    /// Every framework is looked at again, as after a change of quotas.
    pub fn look_at_all(&mut self) {
        self.dirty.extend(self.places.keys());
    }

    /// Takes in what changed in the cluster and what ran out, and says what each framework is to be told.
    #[must_use = "a framework is told once"]
    pub fn refresh(&mut self, cluster: &mut Cluster, now: Monotonic) -> BTreeMap<Seat, Notice> {
        let (changed, moved) = cluster.take_changes();
        self.mark(cluster, &changed, &moved);
        self.run_out(cluster, now);
        let dirty = std::mem::take(&mut self.dirty);
        let accounts = (cluster.has_quotas() && !dirty.is_empty()).then(|| Accounts::of(cluster));
        for seat in dirty {
            self.look(cluster, seat, accounts.as_ref(), now);
        }
        let mut notices = std::mem::take(&mut self.notices);
        notices.retain(|_, notice| !notice.is_empty());
        notices
    }

    /// Marks the frameworks that changes of nodes may concern.
    fn mark(&mut self, cluster: &Cluster, changed: &BTreeSet<Slot>, moved: &BTreeSet<Slot>) {
        let touched = changed.len() + moved.len();
        if touched == 0 || self.places.is_empty() {
            return;
        }
        // What a node frees may free a quota.
        if touched * self.places.len() > LOOK_AT_ALL_ABOVE
            || (cluster.has_quotas() && !changed.is_empty())
        {
            return self.look_at_all();
        }
        for slot in changed.union(moved) {
            let member = cluster.at(*slot);
            for (seat, place) in &self.places {
                if place.offers.contains_key(slot)
                    || allocator::reach_refusal(member, &place.wish).is_none()
                {
                    self.dirty.insert(*seat);
                }
            }
        }
    }

    fn run_out(&mut self, cluster: &Cluster, now: Monotonic) {
        while let Some(&(at, id)) = self.expiries.first().filter(|(at, _)| *at <= now) {
            self.expiries.remove(&(at, id));
            let Some(&(seat, slot)) = self.offers.get(&id) else { continue };
            let score = self.places[&seat].offers.get(&slot).and_then(|o| o.score);
            self.withdraw(seat, slot, Rescinded::Expired, now);
            self.refuse(cluster, seat, (slot, score), now + REFUSED_BY_SILENCE);
            self.dirty.insert(seat);
        }
        while let Some(&thaw) = self.thaws.first().filter(|(at, ..)| *at <= now) {
            self.thaws.remove(&thaw);
            let (_, seat, slot) = thaw;
            if let Some(place) = self.places.get_mut(&seat) {
                place.refused.remove(&slot);
                self.dirty.insert(seat);
            }
        }
        while let Some(&(at, id)) = self.landings.first().filter(|(at, _)| *at <= now) {
            self.landings.remove(&(at, id));
            self.in_flight.remove(&id);
        }
    }

    /// Compares what a framework holds with what it can be offered.
    fn look(&mut self, cluster: &Cluster, seat: Seat, accounts: Option<&Accounts>, now: Monotonic) {
        let Some(place) = self.places.get_mut(&seat) else { return };
        if !place.connected || place.suppressed {
            return;
        }
        let rewished = std::mem::take(&mut place.rewished);
        if accounts.is_some_and(|a| a.is_exhausted(cluster, &place.wish.namespace)) {
            return self.withdraw_all(seat, Rescinded::Quota);
        }
        let ended: Vec<(Slot, Rescinded)> = place
            .offers
            .values()
            .filter_map(|o| Some((o.slot, end_of(cluster.at(o.slot), &place.wish, o, rewished)?)))
            .collect();
        for (slot, why) in ended {
            self.withdraw(seat, slot, why, now);
        }
        let place = &self.places[&seat];
        let refused = |slot: Slot, score: Option<f64>| {
            let refused = place.refused.get(&slot);
            refused.is_some_and(|r| !r.has_gained(cluster.at(slot), score))
        };
        let candidates = self.allocator.candidates(cluster, &place.wish, &refused);
        let is_robot = |slot: Slot| {
            let facts = cluster.at(slot).facts.as_ref();
            facts.is_some_and(|f| f.kind == muster_api::kind::node::NodeKind::Robot)
        };
        let (robots, clouds): (Vec<Candidate>, Vec<Candidate>) =
            candidates.into_iter().partition(|c| is_robot(c.slot));
        for (wanted, of_robots) in [(robots, true), (clouds, false)] {
            let held: Vec<Offer> = self.places[&seat]
                .offers
                .values()
                .filter(|o| is_robot(o.slot) == of_robots)
                .copied()
                .collect();
            self.fill(cluster, seat, (&held, &wanted), now);
        }
    }

    /// Offers what is wanted and not held, as far as there are places; a robot that is clearly closer takes the place
    /// of the farthest one.
    fn fill(
        &mut self,
        cluster: &Cluster,
        seat: Seat,
        (held, wanted): (&[Offer], &[Candidate]),
        now: Monotonic,
    ) {
        let limit = self.places[&seat].wish.filter.limit();
        let is_held = |slot: Slot| held.iter().any(|o| o.slot == slot);
        let mut fresh = wanted.iter().filter(|c| !is_held(c.slot));
        for candidate in fresh.by_ref().take(limit.saturating_sub(held.len())) {
            self.offer(cluster, seat, *candidate, now);
        }
        // The present score counts: a held robot may have moved since it was offered.
        let wish = self.places[&seat].wish.clone();
        let score_now = |slot: Slot| allocator::score(cluster.at(slot).facts.as_ref()?, &wish);
        let mut leaving: Vec<(f64, Slot)> = held
            .iter()
            .filter(|o| !wanted.iter().any(|c| c.slot == o.slot))
            .filter_map(|o| Some((score_now(o.slot)?, o.slot)))
            .collect();
        leaving.sort_by(|a, b| b.0.total_cmp(&a.0).then(b.1.cmp(&a.1)));
        let over = held.len().saturating_sub(limit);
        for (i, (score, slot)) in leaving.into_iter().enumerate() {
            if i < over {
                self.withdraw(seat, slot, Rescinded::Filtered, now);
                continue;
            }
            let Some(candidate) = fresh.next() else { break };
            if !candidate.score.is_some_and(|s| is_closer(s, score)) {
                break;
            }
            self.withdraw(seat, slot, Rescinded::Closer, now);
            self.offer(cluster, seat, *candidate, now);
        }
    }

    fn offer(&mut self, cluster: &Cluster, seat: Seat, candidate: Candidate, now: Monotonic) {
        let Some(place) = self.places.get_mut(&seat) else { return };
        let id = OfferId(self.next_offer);
        self.next_offer += 1;
        let Candidate { slot, score } = candidate;
        let version = cluster.at(slot).version;
        let offer = Offer { id, slot, score, made_at: now, version };
        place.offers.insert(slot, offer);
        if let Some(refused) = place.refused.remove(&slot) {
            self.thaws.remove(&(refused.until, seat, slot));
        }
        self.offers.insert(id, (seat, slot));
        self.shown.entry(slot).or_default().insert(seat);
        self.expiries.insert((now + EXPIRE_AFTER, id));
        self.notices.entry(seat).or_default().offered.push(offer);
    }

    fn take_out(&mut self, seat: Seat, slot: Slot) -> Option<Offer> {
        let offer = self.places.get_mut(&seat)?.offers.remove(&slot)?;
        self.offers.remove(&offer.id);
        self.expiries.remove(&(offer.made_at + EXPIRE_AFTER, offer.id));
        if let Some(seats) = self.shown.get_mut(&slot) {
            seats.remove(&seat);
            if seats.is_empty() {
                self.shown.remove(&slot);
            }
        }
        Some(offer)
    }

    /// Ends an offer, and tells the framework why.
    pub(super) fn withdraw(&mut self, seat: Seat, slot: Slot, why: Rescinded, now: Monotonic) {
        let Some(offer) = self.take_out(seat, slot) else { return };
        if matches!(why, Rescinded::Changed | Rescinded::Closer | Rescinded::Expired) {
            self.in_flight.insert(offer.id, (seat, slot));
            self.landings.insert((now + IN_FLIGHT, offer.id));
        }
        let notice = self.notices.entry(seat).or_default();
        let before = notice.offered.len();
        notice.offered.retain(|o| o.id != offer.id);
        // One that the framework was never told of needs no end.
        if notice.offered.len() == before {
            notice.rescinded.push((offer.id, why));
        }
    }

    fn withdraw_all(&mut self, seat: Seat, why: Rescinded) {
        let slots: Vec<Slot> =
            self.places.get(&seat).into_iter().flat_map(|p| p.offers.keys().copied()).collect();
        for slot in slots {
            self.withdraw(seat, slot, why, Monotonic::ZERO);
        }
    }

    /// The node that an offer of this framework is about, and whether the offer is still out; one that ended a moment
    /// ago counts, because the Accept may have been on its way.
    #[must_use]
    pub fn find(&self, seat: Seat, id: OfferId) -> Option<(Slot, bool)> {
        let of = |table: &HashMap<OfferId, (Seat, Slot)>| {
            table.get(&id).filter(|(owner, _)| *owner == seat).map(|(_, slot)| *slot)
        };
        of(&self.offers).map(|s| (s, true)).or_else(|| of(&self.in_flight).map(|s| (s, false)))
    }

    /// Whether a framework of another namespace is shown the node as well.
    pub(super) fn is_contested(&self, slot: Slot, namespace: &Arc<str>) -> bool {
        let seats = self.shown.get(&slot).into_iter().flatten();
        seats.filter_map(|s| self.places.get(s)).any(|p| p.wish.namespace != *namespace)
    }

    /// The offers that a framework holds, by node.
    pub fn offers_of(&self, seat: Seat) -> impl Iterator<Item = &Offer> {
        self.places.get(&seat).into_iter().flat_map(|p| p.offers.values())
    }

    /// When something ends even if nothing happens.
    #[must_use]
    pub fn next_deadline(&self) -> Option<Monotonic> {
        let expiry = self.expiries.first().map(|(at, _)| *at);
        let thaw = self.thaws.first().map(|(at, ..)| *at);
        let gathered = self.gathered.first().map(|(at, _)| *at);
        [expiry, thaw, gathered].into_iter().flatten().min()
    }
}

/// Why an offer that is out must end; none: it stays.
fn end_of(member: &Member, wish: &Wish, offer: &Offer, rewished: bool) -> Option<Rescinded> {
    if allocator::reach_refusal(member, wish).is_some() {
        return Some(if rewished { Rescinded::Filtered } else { Rescinded::OutOfRange });
    }
    match allocator::holdings_refusal(member, wish) {
        Some(Refusal::NotReady { .. } | Refusal::Cordoned | Refusal::Tainted { .. }) => {
            Some(Rescinded::NodeLost)
        }
        Some(_) if rewished => Some(Rescinded::Filtered),
        Some(_) => Some(Rescinded::Changed),
        // Its score is that of the old position.
        None if rewished && score_of(member, wish) != offer.score => Some(Rescinded::Filtered),
        None => (member.version != offer.version).then_some(Rescinded::Changed),
    }
}

fn score_of(member: &Member, wish: &Wish) -> Option<f64> {
    allocator::score(member.facts.as_ref()?, wish)
}
