//! The scheduler's desk for frameworks: the part of its task that shows offers and takes Accepts.
//!
//! ```text
//!   sessions ──Request──▶ Desk ── core::offer::Book, on the scheduler's own Cluster ──▶ notices, verdicts
//!                          └──── Accepts that passed: one transaction each, Task + lease ──▶ store
//! ```
//!
//! It lives in the task that owns the cluster, so that declared tasks and frameworks take from the same ledger, one
//! decision after the other. What a framework is told goes into its outlet; one that does not read is cut off when its
//! outlet is full, and nobody waits for it.

mod request;

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use futures::future::join_all;
use muster_api::kind::framework::FrameworkSpec;
use muster_api::kind::task::NodeRefusal;
use muster_api::name::NodeName;
use muster_api::wire::framework::v1 as wire;
use muster_controller_core::access::Verb;
use muster_controller_core::cluster::Cluster;
use muster_controller_core::node_health::Monotonic;
use muster_controller_core::offer::allocator::Closest;
use muster_controller_core::offer::book::Book;
use muster_controller_core::offer::settle::{Denied, Launch, Order, Verdict};
use muster_controller_core::offer::{Notice, OfferId, Rescinded, Seat, Wish};
use muster_controller_core::schedule::{Bind, Claim};
use serde_json::Value;
use tokio::sync::oneshot;
use tokio::time::Instant;

use super::RETRY;
use super::bind;
use crate::audit::{Line, Named};
use crate::auth::Identity;
use crate::context::Context;
use crate::session::frameworks::convert;
use crate::store::{Key, Op, Precondition, StoreError};

pub use request::{Depth, FrameworkUid, OfferView, Outlet, Prepared, Request, View};

#[derive(Debug)]
struct Guest {
    uid: FrameworkUid,
    key: Key,
    /// None: it is away.
    outlet: Option<Outlet>,
}

#[derive(Debug)]
struct Pending {
    uid: FrameworkUid,
    session: u64,
    by: Arc<Identity>,
    call: String,
    launches: Vec<Prepared>,
    guard: Option<Op>,
}

/// Offers and Accepts.
#[derive(Debug)]
pub(super) struct Desk {
    context: Arc<Context>,
    book: Book,
    guests: BTreeMap<Seat, Guest>,
    seats: HashMap<FrameworkUid, Seat>,
    /// Accepts without a verdict, by ticket.
    pending: HashMap<u64, Pending>,
    verdicts: Vec<(Order, Verdict)>,
    next_ticket: u64,
    /// To be told when what they asked for has been done and said.
    told: Vec<oneshot::Sender<()>>,
    /// Accepts whose write seemed to fail.
    unsure: Vec<Unsure>,
    started: Instant,
}

/// An Accept whose write seemed to fail: nobody knows yet whether the disk has it, so it has no answer yet. A framework that was
/// told to try again would launch everything twice.
#[derive(Debug)]
struct Unsure {
    seat: Seat,
    pending: Pending,
    binds: Vec<Bind>,
}

impl Guest {
    /// Where a session hears; none when it is not the present one any more: its answers are no later one's.
    fn outlet_of(&self, session: u64) -> Option<&Outlet> {
        self.outlet.as_ref().filter(|outlet| outlet.session == session)
    }
}

impl Desk {
    pub(super) fn new(context: Arc<Context>) -> Self {
        Desk {
            context,
            book: Book::new(Box::new(Closest), OfferId::first(a_life())),
            guests: BTreeMap::new(),
            seats: HashMap::new(),
            pending: HashMap::new(),
            verdicts: Vec::new(),
            next_ticket: 1,
            told: Vec::new(),
            unsure: Vec::new(),
            started: Instant::now(),
        }
    }

    /// Whether there are Accepts of which nobody knows whether they are written.
    pub(super) fn is_unsure(&self) -> bool {
        !self.unsure.is_empty()
    }

    /// The store knows now what it has: answers those Accepts. Gives the nodes on which nothing was launched after all.
    pub(super) fn resolve(&mut self, cluster: &mut Cluster) -> Vec<NodeName> {
        let mut freed = Vec::new();
        for Unsure { seat, pending, binds } in std::mem::take(&mut self.unsure) {
            let is_there = |prepared: &Prepared| {
                let stored = self.context.store.get(&prepared.key);
                stored.is_some_and(|stored| *stored.uid == *prepared.uid.as_str())
            };
            // One transaction: all of it is there, or nothing. What ended meanwhile is there until it is acknowledged.
            let outlet = self.guests.get(&seat).and_then(|g| g.outlet_of(pending.session));
            if pending.launches.iter().any(is_there) {
                launched_all(&self.context, outlet, pending, &binds);
            } else {
                freed.extend(binds.iter().filter_map(|bind| cluster.withdraw(&bind.uid)));
                refuse(outlet, pending.call, convert::unavailable());
            }
        }
        freed
    }

    fn now(&self) -> Monotonic {
        self.started.elapsed()
    }

    /// The cluster was made anew, and its nodes have other numbers: every offer ends, and fresh ones follow. What was declined
    /// stays declined.
    pub(super) fn begin_anew(&mut self, before: &Cluster, cluster: &Cluster) {
        // No number means two nodes: an Accept may be under way.
        let next = Book::new(Box::new(Closest), self.book.next_offer());
        let old = std::mem::replace(&mut self.book, next);
        let guests = std::mem::take(&mut self.guests);
        self.seats.clear();
        for (_, pending) in self.pending.drain() {
            let guest = guests.values().find(|guest| guest.uid == pending.uid);
            let outlet = guest.and_then(|guest| guest.outlet_of(pending.session));
            refuse(outlet, pending.call, convert::unavailable());
        }
        for (seat, guest) in guests {
            let Some(wish) = old.wish(seat) else { continue };
            let offers: Vec<String> = old.offers_of(seat).map(|o| o.id.to_string()).collect();
            if let Some(outlet) = &guest.outlet {
                rescind(outlet, offers, Rescinded::Changed);
            }
            let anew = self.book.register(wish.clone());
            self.book.refuse_still(cluster, anew, old.refusals(before, seat));
            if old.is_suppressed(seat) {
                self.book.suppress(anew);
            }
            if guest.outlet.is_none() {
                self.book.disconnect(anew);
            }
            self.seats.insert(Arc::clone(&guest.uid), anew);
            self.guests.insert(anew, guest);
        }
    }

    /// What namespaces may have has changed, or the floor of a site.
    pub(super) fn look_at_all(&mut self) {
        self.book.look_at_all();
    }

    /// Takes a request in; what follows from it is done by [`Desk::work`].
    pub(super) fn take(&mut self, cluster: &mut Cluster, request: Request) {
        let now = self.now();
        match request {
            Request::Subscribe { uid, key, spec, outlet } => {
                self.subscribe(uid, key, &spec, outlet)
            }
            Request::Wish { uid, spec, done } => {
                self.told.push(done);
                let Some(seat) = self.seats.get(&uid).copied() else { return };
                let namespace = self.guests[&seat].key.namespace().unwrap_or_default();
                self.book.set_wish(seat, Wish::new(namespace, &spec));
            }
            Request::Revive { uid } => {
                self.seats.get(&uid).into_iter().for_each(|s| self.book.revive(*s))
            }
            Request::Suppress { uid } => {
                self.seats.get(&uid).into_iter().for_each(|s| self.book.suppress(*s));
            }
            Request::Decline { uid, offers, refuse } => {
                if let Some(seat) = self.seats.get(&uid) {
                    // Offers that have ended meanwhile need no answer.
                    drop(self.book.decline(cluster, *seat, &offers, (refuse, now)));
                }
            }
            Request::Accept { uid, session, by, call, offers, launches, refuse, guard } => {
                let pending = Pending { uid, session, by, call, launches, guard };
                self.accept(cluster, pending, (offers, refuse));
            }
            Request::Leave { uid, session } => {
                let Some(seat) = self.seats.get(&uid).copied() else { return };
                let guest = self.guests.get_mut(&seat).expect("a seat has a guest");
                // A later session of the same framework has an outlet of its own.
                if guest.outlet.as_ref().is_some_and(|o| o.session == session) {
                    guest.outlet = None;
                    self.book.disconnect(seat);
                }
            }
            Request::Remove { uid } => {
                if let Some(seat) = self.seats.remove(&uid) {
                    self.guests.remove(&seat);
                    self.book.remove(seat);
                    self.pending.retain(|_, p| p.uid != uid);
                }
            }
            // Nobody waits for an answer any more when its receiver is gone; that is no fault.
            Request::Look { depth, answer } => drop(answer.send(self.look(cluster, depth))),
            Request::Why { uid, answer } => drop(answer.send(self.why(cluster, &uid))),
        }
    }

    fn subscribe(&mut self, uid: FrameworkUid, key: Key, spec: &FrameworkSpec, outlet: Outlet) {
        let wish = Wish::new(key.namespace().unwrap_or_default(), spec);
        let seat = match self.seats.get(&uid) {
            Some(seat) => {
                self.book.reconnect(*seat, wish);
                *seat
            }
            None => self.book.register(wish),
        };
        self.seats.insert(Arc::clone(&uid), seat);
        self.guests.insert(seat, Guest { uid, key, outlet: Some(outlet) });
    }

    fn accept(
        &mut self,
        cluster: &mut Cluster,
        mut pending: Pending,
        (offers, refuse_for): (Vec<OfferId>, Duration),
    ) {
        let Some(seat) = self.seats.get(&pending.uid).copied() else { return };
        for prepared in &mut pending.launches {
            if let Some((slot, _)) = self.book.find(seat, prepared.offer) {
                prepared
                    .spec
                    .placement
                    .node
                    .get_or_insert_with(|| cluster.at(slot).name.to_string());
            }
        }
        let launches = pending
            .launches
            .iter()
            .map(|prepared| Launch {
                uid: prepared.uid.clone(),
                title: format!(
                    "{}/{}",
                    prepared.key.namespace().unwrap_or_default(),
                    prepared.key.name
                )
                .into(),
                spec: Arc::new(prepared.spec.clone()),
                offer: prepared.offer,
                framework: Arc::clone(&pending.uid),
            })
            .collect();
        let ticket = self.next_ticket;
        self.next_ticket += 1;
        self.pending.insert(ticket, pending);
        let order = Order { seat, ticket, offers, launches, refuse: refuse_for };
        let now = self.now();
        self.verdicts.extend(self.book.submit(cluster, order, now));
    }

    /// Before declared tasks are looked at: settles what is due, and says in the cluster what they leave to frameworks.
    /// `anybody_waits`: there are declared tasks without a place.
    pub(super) fn begin_pass(&mut self, cluster: &mut Cluster, anybody_waits: bool) {
        let now = self.now();
        self.verdicts.extend(self.book.begin_pass(cluster, anybody_waits, now));
    }

    /// Takes in what declared tasks leave to frameworks by the last decision.
    pub(super) fn claim(&mut self, claims: &[Claim]) {
        self.book.claim(claims);
    }

    /// Settles what is due, writes what was granted, and tells everybody what changed. Says when to work again even if
    /// nothing happens.
    pub(super) async fn work(&mut self, cluster: &mut Cluster) -> Option<Instant> {
        let now = self.now();
        self.verdicts.extend(self.book.settle_due(cluster, now));
        let verdicts = std::mem::take(&mut self.verdicts);
        if !verdicts.is_empty() {
            self.carry_out(cluster, verdicts).await;
        }
        for (seat, notice) in self.book.refresh(cluster, self.now()) {
            if let Some(guest) = self.guests.get(&seat) {
                tell(guest, cluster, self.context.clock.now(), &notice);
            }
        }
        for done in self.told.drain(..) {
            // A session that has ended meanwhile need not be told.
            let _ = done.send(());
        }
        let unsure = (!self.unsure.is_empty()).then(|| Instant::now() + RETRY);
        let due = self.book.next_deadline().map(|at| self.started + at);
        due.into_iter().chain(unsure).min()
    }

    async fn carry_out(&mut self, cluster: &mut Cluster, verdicts: Vec<(Order, Verdict)>) {
        let (mut passed, mut transactions) = (Vec::new(), Vec::new());
        for (order, verdict) in verdicts {
            let Some(pending) = self.pending.remove(&order.ticket) else {
                release(cluster, verdict.iter().flatten());
                continue;
            };
            match verdict {
                Ok(binds) => {
                    transactions.push(self.launch_ops(&pending, &binds));
                    passed.push((order.seat, pending, binds));
                }
                Err(denied) => self.deny(order.seat, pending, &denied),
            }
        }
        let _nodes_stay = self.context.placing.read().await;
        let store = &self.context.store;
        let results = join_all(transactions.into_iter().map(|ops| async move {
            let ops = ops?;
            if ops.is_empty() { Ok(Vec::new()) } else { store.apply(ops).await }
        }))
        .await;
        for ((seat, pending, binds), result) in passed.into_iter().zip(results) {
            let outlet = self.guests.get(&seat).and_then(|g| g.outlet_of(pending.session));
            match result {
                Ok(_) => launched_all(&self.context, outlet, pending, &binds),
                Err(error) if crate::objects::is_race(&error) => {
                    release(cluster, binds.iter());
                    refuse(outlet, pending.call, not_written(&pending.launches, &error));
                }
                Err(error) => {
                    tracing::warn!(
                        error = crate::app::chain(&error),
                        "an Accept is not written, as it seems"
                    );
                    self.unsure.push(Unsure { seat, pending, binds });
                }
            }
        }
    }

    fn deny(&self, seat: Seat, pending: Pending, denied: &Denied) {
        metrics::counter!("muster_framework_refusals_total").increment(1);
        let outlet = self.guests.get(&seat).and_then(|g| g.outlet_of(pending.session));
        refuse(outlet, pending.call, convert::denied(denied));
    }

    /// Tasks and leases of an Accept, as one transaction.
    ///
    /// # Errors
    ///
    /// As [`bind::grants`].
    fn launch_ops(&self, pending: &Pending, binds: &[Bind]) -> Result<Vec<Op>, StoreError> {
        let now = self.context.clock.now();
        let mut ops = Vec::with_capacity(1 + 2 * binds.len());
        ops.extend(pending.guard.clone().filter(|_| !binds.is_empty()));
        for (prepared, bound) in pending.launches.iter().zip(binds) {
            let mut value = prepared.object.clone();
            value["spec"]["placement"]["node"] = Value::from(bound.node.as_str());
            value["status"] = crate::objects::to_value(&bind::status(bound, None, now));
            ops.push(Op::Put {
                key: prepared.key.clone(),
                value,
                precondition: Precondition::Absent,
            });
            ops.extend(bind::grants(&self.context.store, bound, &prepared.key, now)?);
        }
        Ok(ops)
    }

    fn look(&self, cluster: &Cluster, depth: Depth) -> Vec<View> {
        if self.guests.is_empty() {
            return Vec::new();
        }
        let (accounts, now) = (cluster.accounts(), self.now());
        let offer_view = |offer: &muster_controller_core::offer::Offer| {
            let member = cluster.at(offer.slot);
            OfferView {
                id: offer.id.to_string(),
                node: member.name.to_string(),
                score: offer.score,
                age_ms: u64::try_from(now.saturating_sub(offer.made_at).as_millis())
                    .unwrap_or(u64::MAX),
                free: member.ledger.open(),
                actuators: muster_controller_core::offer::allocator::actuators_free(member),
                shared_with: self.book.shown_to(offer.slot).saturating_sub(1),
            }
        };
        let view = |(seat, guest): (&Seat, &Guest)| {
            let namespace = guest.key.namespace().unwrap_or_default();
            let offered = self.book.offers_of(*seat).count();
            let shown = self.book.offers_of(*seat).filter(|_| depth == Depth::Offers);
            let mut offers: Vec<OfferView> = shown.map(offer_view).collect();
            offers.sort_by(|a, b| {
                let key = |o: &OfferView| o.score.unwrap_or(f64::INFINITY);
                key(a).total_cmp(&key(b)).then_with(|| a.node.cmp(&b.node))
            });
            View {
                uid: Arc::clone(&guest.uid),
                namespace: namespace.to_owned(),
                name: guest.key.name.to_string(),
                connected: guest.outlet.is_some(),
                suppressed: self.book.is_suppressed(*seat),
                share: accounts.share(cluster, namespace),
                offered,
                offers,
            }
        };
        self.guests.iter().map(view).collect()
    }

    fn why(&self, cluster: &Cluster, uid: &FrameworkUid) -> Option<Vec<NodeRefusal>> {
        let seat = *self.seats.get(uid)?;
        let reasons = self.book.explain(cluster, seat, self.now());
        let refusal = |(node, why): (NodeName, _)| {
            let why: muster_controller_core::offer::explain::NotOffered = why;
            NodeRefusal {
                node: node.to_string(),
                reason: why.reason().to_owned(),
                message: why.to_string(),
            }
        };
        Some(reasons.into_iter().map(refusal).collect())
    }
}

fn release<'a>(cluster: &mut Cluster, binds: impl Iterator<Item = &'a Bind>) {
    for bind in binds {
        cluster.withdraw(&bind.uid);
    }
}

/// Everything of an Accept is written.
fn launched_all(context: &Context, outlet: Option<&Outlet>, pending: Pending, binds: &[Bind]) {
    metrics::counter!("muster_framework_launches_total").increment(binds.len() as u64);
    let named = |prepared: &Prepared| Named {
        kind: Some("Task".to_owned()),
        namespace: prepared.key.namespace().map(str::to_owned),
        name: Some(prepared.key.name.to_string()),
        uid: Some(prepared.uid.to_string()),
    };
    let line = Line {
        time: context.clock.now(),
        objects: pending.launches.iter().map(named).collect(),
        code: Some(201),
        ..Line::of(&pending.by, Verb::Create, "tasks")
    };
    if !pending.launches.is_empty() {
        // A framework that were told that it failed would launch everything twice. The log counts what it lacks, and the
        // next Accept waits until it can be written. Nor does the scheduler wait for a disk.
        context.audit.post(line);
    }
    let launched = pending.launches.iter().zip(binds).map(launched).collect();
    answer(outlet, wire::Answer { id: pending.call, refusal: None, launched });
}

fn launched((prepared, bind): (&Prepared, &Bind)) -> wire::Launched {
    wire::Launched {
        name: prepared.key.name.to_string(),
        task: prepared.uid.to_string(),
        node: bind.node.to_string(),
    }
}

fn answer(outlet: Option<&Outlet>, answer: wire::Answer) {
    if let Some(outlet) = outlet.filter(|_| convert::is_wanted(&answer)) {
        outlet.say(wire::event::Event::Answer(answer));
    }
}

fn refuse(outlet: Option<&Outlet>, call: String, refusal: wire::Refusal) {
    answer(outlet, wire::Answer { id: call, refusal: Some(refusal), launched: Vec::new() });
}

fn tell(guest: &Guest, cluster: &Cluster, now: jiff::Timestamp, notice: &Notice) {
    let Some(outlet) = &guest.outlet else { return };
    let mut ended: BTreeMap<_, Vec<String>> = BTreeMap::new();
    for (id, why) in &notice.rescinded {
        ended.entry(*why).or_default().push(id.to_string());
    }
    for (why, offers) in ended {
        rescind(outlet, offers, why);
    }
    let offers = notice.offered.iter().map(|o| convert::offer((&guest.uid, o), cluster, now));
    for offers in convert::parts(offers, prost::Message::encoded_len) {
        outlet.say(wire::event::Event::Offers(wire::Offers { offers }));
    }
}

fn rescind(outlet: &Outlet, offers: Vec<String>, why: Rescinded) {
    let reason = convert::rescinded(why).into();
    for offers in convert::parts(offers, String::len) {
        outlet.say(wire::event::Event::Rescind(wire::Rescind { offers, reason }));
    }
}

/// What tells the offers of this life of the controller from those of others.
fn a_life() -> u32 {
    uuid::Uuid::new_v4().as_fields().0
}

/// Why a granted Accept is not stored after all.
fn not_written(launches: &[Prepared], error: &StoreError) -> wire::Refusal {
    if let StoreError::AlreadyExists { key, .. } = error
        && let Some(i) = launches.iter().position(|l| l.key == *key)
    {
        return convert::invalid(vec![wire::Cause {
            field: format!("launches[{i}].name"),
            message: format!("a task {} exists already", key.name),
        }]);
    }
    tracing::warn!(error = crate::app::chain(error), "an Accept is not written");
    convert::unavailable()
}

#[cfg(test)]
mod tests;
