//! Which offers are out, when they end, and what is refused until when.
//!
//! The book changes in two ways: by what a framework says (each method marks the framework as one to look at again) and
//! by [`Book::refresh`], which takes the cluster's changes and looks at whoever they or the framework's own words concern.
//! A look compares what the framework holds with what it can be offered now, and the difference is the notice.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use super::allocator::{self, Allocator, Candidate};
use super::refused::{Refused, is_closer};
use super::{
    COURTESY, EXPIRE_AFTER, IN_FLIGHT, Notice, Offer, OfferId, REFUSED_BY_SILENCE, Rescinded, Seat,
    Wish,
};
use crate::cluster::{Cluster, Member};
use crate::fairness::Spent;
use crate::node_health::Monotonic;
use crate::report::Refusal;
use crate::space::Slot;

/// Above this many pairs of a touched node and a framework, every framework is looked at: the looks cost less than
/// finding out who need not be.
const LOOK_AT_ALL_ABOVE: usize = 50_000;

/// One framework in the book.
#[derive(Debug)]
pub(super) struct Place {
    pub(super) wish: Wish,
    pub(super) connected: bool,
    pub(super) suppressed: bool,
    pub(super) offers: BTreeMap<Slot, Offer>,
    pub(super) refused: HashMap<Slot, Refused>,
    /// It lost a race, and has not been waited for in vain since.
    pub(super) behind: bool,
    /// It let a [`super::courtesy`] pass without a word: declared tasks leave nothing to it until then.
    pub(super) silent_until: Monotonic,
    /// The wish is new since the last look.
    rewished: bool,
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
    pub(super) gathered: Vec<super::settle::Window>,
    /// Nodes that were freed lately, or that gathered Accepts are about.
    pub(super) courtesies: BTreeMap<Slot, super::courtesy::Courtesy>,
    next_offer: OfferId,
    next_seat: u32,
}

impl Book {
    /// Nobody is registered; the first offer has the number `first`.
    #[must_use]
    pub fn new(allocator: Box<dyn Allocator>, first: OfferId) -> Self {
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
            courtesies: BTreeMap::new(),
            next_offer: first,
            next_seat: 1,
        }
    }

    /// The number of the next offer: a book that takes this one's place begins there.
    #[must_use]
    pub fn next_offer(&self) -> OfferId {
        self.next_offer
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
            behind: false,
            silent_until: Monotonic::ZERO,
            rewished: false,
        };
        self.places.insert(seat, place);
        self.dirty.insert(seat);
        seat
    }

    /// The framework's session ended: what it was offered is offered no more. It may come back by [`Book::reconnect`].
    pub fn disconnect(&mut self, seat: Seat) {
        if let Some(place) = self.places.get_mut(&seat) {
            (place.connected, place.behind) = (false, false);
            self.is_awaited_no_more(seat);
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
            place.silent_until = Monotonic::ZERO;
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
        for window in &mut self.gathered {
            window.orders.retain(|gathered| gathered.order.seat != seat);
        }
    }

    /// SetPosition and SetFilter: everything is looked at anew, what was declined too.
    pub fn set_wish(&mut self, seat: Seat, wish: Wish) {
        if let Some(place) = self.places.get_mut(&seat) {
            place.wish = wish;
            place.rewished = true;
            place.silent_until = Monotonic::ZERO;
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
            (place.suppressed, place.behind) = (true, false);
            self.is_awaited_no_more(seat);
            self.withdraw_all(seat, Rescinded::Suppressed);
        }
    }

    /// Offers are wanted again, of everything.
    pub fn revive(&mut self, seat: Seat) {
        if let Some(place) = self.places.get_mut(&seat) {
            place.suppressed = false;
            place.silent_until = Monotonic::ZERO;
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
        let slots = offers.iter().filter_map(|id| self.find(seat, *id)).map(|(slot, _)| slot);
        self.has_answered(seat, &slots.collect());
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

    /// An Accept of an offer that had ended while it was on its way was granted: the offer is good for no other one.
    pub(super) fn landed(
        &mut self,
        cluster: &Cluster,
        id: OfferId,
        (refuse, now): (Duration, Monotonic),
    ) {
        let Some((seat, slot)) = self.in_flight.remove(&id) else { return };
        if !refuse.is_zero() {
            let wish = self.wish(seat);
            let score = wish.and_then(|wish| score_of(cluster, cluster.at(slot), wish));
            self.refuse(cluster, seat, (slot, score), now.saturating_add(refuse));
            // One that was made meanwhile shows what is refused now.
            self.withdraw(seat, slot, Rescinded::Taken, now);
            self.dirty.insert(seat);
        }
    }

    fn refuse(
        &mut self,
        cluster: &Cluster,
        seat: Seat,
        (slot, score): (Slot, Option<f64>),
        until: Monotonic,
    ) {
        self.put_refusal(seat, slot, Refused::new(cluster.at(slot), score, until));
    }

    pub(super) fn put_refusal(&mut self, seat: Seat, slot: Slot, refused: Refused) {
        let Some(place) = self.places.get_mut(&seat) else { return };
        let until = refused.until;
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
        self.take_in(cluster, now);
        let mut notices = std::mem::take(&mut self.notices);
        notices.retain(|_, notice| !notice.is_empty());
        notices
    }

    /// Looks at everybody whom changes or what ran out concern; the notices wait for [`Book::refresh`].
    pub(super) fn take_in(&mut self, cluster: &mut Cluster, now: Monotonic) {
        let (changed, moved) = cluster.take_changes();
        self.mark(cluster, &changed, &moved);
        self.run_out(cluster, now);
        self.mark_spent(cluster, !changed.is_empty());
        for seat in std::mem::take(&mut self.dirty) {
            self.look(cluster, seat, now);
        }
    }

    /// Marks the frameworks that changes of nodes may concern.
    fn mark(&mut self, cluster: &Cluster, changed: &BTreeSet<Slot>, moved: &BTreeSet<Slot>) {
        let touched = changed.len() + moved.len();
        if touched == 0 || self.places.is_empty() {
            return;
        }
        if touched * self.places.len() > LOOK_AT_ALL_ABOVE {
            return self.look_at_all();
        }
        for slot in changed.union(moved) {
            let member = cluster.at(*slot);
            for (seat, place) in &self.places {
                if place.offers.contains_key(slot)
                    || allocator::reach_refusal(cluster.sites(), member, &place.wish).is_none()
                {
                    self.dirty.insert(*seat);
                }
            }
        }
    }

    /// Marks the frameworks whose quota leaves nothing of something, or something again. What a node frees may free a quota.
    fn mark_spent(&mut self, cluster: &Cluster, is_anything_changed: bool) {
        if !is_anything_changed && self.dirty.is_empty() {
            return;
        }
        let limited = cluster.has_quotas()
            && self.places.values().any(|place| cluster.quota(&place.wish.namespace).is_some());
        // Without a quota nothing is; who had one is dirty since it went.
        let spent = |namespace: &str| {
            if limited { cluster.accounts().spent(cluster, namespace) } else { Spent::default() }
        };
        for (seat, place) in &mut self.places {
            let now = spent(&place.wish.namespace);
            if place.wish.spent != now {
                place.wish.spent = now;
                self.dirty.insert(*seat);
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
            if self.in_flight.contains_key(&id) && self.is_named(id) {
                // It came in time, and waits for its window.
                self.landings.insert((now + COURTESY, id));
            } else {
                self.in_flight.remove(&id);
            }
        }
    }

    /// Compares what a framework holds with what it can be offered.
    fn look(&mut self, cluster: &Cluster, seat: Seat, now: Monotonic) {
        let Some(place) = self.places.get_mut(&seat) else { return };
        if !place.connected || place.suppressed {
            return;
        }
        let rewished = std::mem::take(&mut place.rewished);
        let ended: Vec<(Slot, Rescinded)> = place
            .offers
            .values()
            .filter_map(|o| {
                Some((o.slot, end_of(cluster, cluster.at(o.slot), (&place.wish, rewished), o)?))
            })
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
        let score_now = |slot: Slot| score_of(cluster, cluster.at(slot), &wish);
        let mut leaving: Vec<(f64, Slot)> = held
            .iter()
            .filter(|o| !wanted.iter().any(|c| c.slot == o.slot))
            // Without a score it is as good as any, and goes first where there are too many.
            .map(|o| (score_now(o.slot).unwrap_or(f64::INFINITY), o.slot))
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
        let id = self.next_offer;
        self.next_offer = id.next();
        let Candidate { slot, score } = candidate;
        let version = cluster.at(slot).version;
        let offer = Offer { id, slot, score, made_at: now, version, spent: place.wish.spent };
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
        if matches!(
            why,
            Rescinded::Changed | Rescinded::Closer | Rescinded::Expired | Rescinded::Quota
        ) {
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
        self.seats_shown(slot)
            .filter_map(|s| self.places.get(&s))
            .any(|p| p.wish.namespace != *namespace)
    }

    /// The frameworks that are shown the node.
    pub(super) fn seats_shown(&self, slot: Slot) -> impl Iterator<Item = Seat> {
        self.shown.get(&slot).into_iter().flatten().copied()
    }

    /// How many frameworks are shown the node.
    #[must_use]
    pub fn shown_to(&self, slot: Slot) -> usize {
        self.shown.get(&slot).map_or(0, BTreeSet::len)
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
        [expiry, thaw, self.next_look(), self.next_end()].into_iter().flatten().min()
    }
}

/// Why an offer that is out must end; none: it stays.
fn end_of(
    cluster: &Cluster,
    member: &Member,
    (wish, rewished): (&Wish, bool),
    offer: &Offer,
) -> Option<Rescinded> {
    if allocator::reach_refusal(cluster.sites(), member, wish).is_some() {
        return Some(if rewished { Rescinded::Filtered } else { Rescinded::OutOfRange });
    }
    match allocator::holdings_refusal(member, wish) {
        Some(Refusal::NotReady { .. } | Refusal::Cordoned | Refusal::Tainted { .. }) => {
            Some(Rescinded::NodeLost)
        }
        Some(_) if rewished => Some(Rescinded::Filtered),
        Some(_) => Some(Rescinded::Changed),
        None if offer.spent != wish.spent || allocator::is_spent(member, wish) => {
            Some(Rescinded::Quota)
        }
        // Its score is that of the old position.
        None if rewished && score_of(cluster, member, wish) != offer.score => {
            Some(Rescinded::Filtered)
        }
        None => (member.version != offer.version).then_some(Rescinded::Changed),
    }
}

fn score_of(cluster: &Cluster, member: &Member, wish: &Wish) -> Option<f64> {
    allocator::score(cluster.sites(), member.facts.as_ref()?, wish)
}
