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

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use futures::future::join_all;
use muster_api::id::TaskUid;
use muster_api::kind::framework::FrameworkSpec;
use muster_api::kind::task::{NodeRefusal, TaskSpec};
use muster_api::wire::framework::v1 as wire;
use muster_controller_core::cluster::Cluster;
use muster_controller_core::fairness::Accounts;
use muster_controller_core::node_health::Monotonic;
use muster_controller_core::offer::allocator::Closest;
use muster_controller_core::offer::book::Book;
use muster_controller_core::offer::settle::{Denied, Launch, Order, Verdict};
use muster_controller_core::offer::{Notice, OfferId, Seat, Wish};
use muster_controller_core::schedule::Bind;
use serde_json::Value;
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::bind;
use crate::context::Context;
use crate::quota::Pass;
use crate::session::frameworks::convert;
use crate::store::{Key, Op, Precondition, StoreError};

/// Uid of a Framework object: the id of the framework.
pub type FrameworkUid = Arc<str>;

/// Where what a framework is told goes.
#[derive(Debug, Clone)]
pub struct Outlet {
    /// Tells this session from a later one of the same framework.
    session: u64,
    events: mpsc::Sender<wire::Event>,
    /// Cancelled when the framework does not read what it is told.
    cut: CancellationToken,
}

impl Outlet {
    /// An outlet of a session into `events`; `cut` ends the session.
    #[must_use]
    pub fn new(session: u64, events: mpsc::Sender<wire::Event>, cut: CancellationToken) -> Self {
        Outlet { session, events, cut }
    }

    /// The session's number.
    #[must_use]
    pub fn session(&self) -> u64 {
        self.session
    }

    /// Says it, or cuts the session off when it does not read. Never waits.
    pub fn say(&self, event: wire::event::Event) {
        let event = wire::Event { event: Some(event) };
        if let Err(mpsc::error::TrySendError::Full(_)) = self.events.try_send(event) {
            self.cut.cancel();
        }
    }
}

/// What a session asks of the desk.
#[derive(Debug)]
pub enum Request {
    /// A framework is there.
    Subscribe {
        /// Who.
        uid: FrameworkUid,
        /// Its namespace and name.
        key: Key,
        /// What it wants.
        spec: Box<FrameworkSpec>,
        /// Where it hears.
        outlet: Outlet,
    },
    /// It wants something else.
    Wish {
        /// Who.
        uid: FrameworkUid,
        /// What.
        spec: Box<FrameworkSpec>,
        /// Told after what was offered for the old wish is rescinded.
        done: oneshot::Sender<()>,
    },
    /// Offers of everything, again.
    Revive {
        /// Who.
        uid: FrameworkUid,
    },
    /// No offers.
    Suppress {
        /// Who.
        uid: FrameworkUid,
    },
    /// Not these.
    Decline {
        /// Who.
        uid: FrameworkUid,
        /// Which.
        offers: Vec<OfferId>,
        /// For how long.
        refuse: Duration,
    },
    /// Launches.
    Accept {
        /// Who.
        uid: FrameworkUid,
        /// The call's own id, for the Answer.
        call: String,
        /// Which offers it answers.
        offers: Vec<OfferId>,
        /// What is to run.
        launches: Vec<Prepared>,
        /// For how long the rest of the nodes is not wanted.
        refuse: Duration,
        /// That the namespace is still there when it is written.
        guard: Option<Op>,
    },
    /// Its session ended. Ignored when a newer one has subscribed.
    Leave {
        /// Who.
        uid: FrameworkUid,
        /// The session's number.
        session: u64,
    },
    /// It is gone for good.
    Remove {
        /// Who.
        uid: FrameworkUid,
    },
    /// What is offered to whom.
    Look {
        /// Where the answer goes.
        answer: oneshot::Sender<Vec<View>>,
    },
    /// Why each node is not offered to a framework.
    Why {
        /// Who.
        uid: FrameworkUid,
        /// Where the answer goes; none: it is not at the desk.
        answer: oneshot::Sender<Option<Vec<NodeRefusal>>>,
    },
}

/// A task that only needs its node.
#[derive(Debug)]
pub struct Prepared {
    /// Its key.
    pub key: Key,
    /// The whole object, admitted and stamped, without a status.
    pub object: Value,
    /// Its spec.
    pub spec: TaskSpec,
    /// Its uid.
    pub uid: TaskUid,
    /// The offer it uses.
    pub offer: OfferId,
    /// Through its namespace's quota; kept until it is written or refused.
    pub(crate) _pass: Option<Pass>,
}

/// One framework as the desk sees it.
#[derive(Debug, Clone, serde::Serialize)]
#[serde(rename_all = "camelCase")]
pub struct View {
    /// Its object's uid.
    #[serde(serialize_with = "text")]
    pub uid: FrameworkUid,
    /// Its namespace.
    pub namespace: String,
    /// Its name.
    pub name: String,
    /// A session is open.
    pub connected: bool,
    /// It wants no offers.
    pub suppressed: bool,
    /// Weighted dominant share of its namespace.
    pub share: f64,
    /// What it is offered.
    pub offers: Vec<OfferView>,
}

fn text<S: serde::Serializer>(uid: &FrameworkUid, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(uid)
}

/// One offer.
#[derive(Debug, Clone, serde::Serialize)]
#[serde(rename_all = "camelCase")]
pub struct OfferView {
    /// Its number.
    pub id: String,
    /// The node.
    pub node: String,
    /// Metres or seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub score: Option<f64>,
    /// Milliseconds since it was made.
    pub age_ms: u64,
    /// Free CR that it shows.
    pub free: muster_api::resource::Compute,
    /// The robot's actuators are free.
    pub actuators: bool,
    /// How many other frameworks are shown the node.
    pub shared_with: usize,
}

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
    started: Instant,
}

impl Desk {
    pub(super) fn new(context: Arc<Context>) -> Self {
        Desk {
            context,
            book: Book::new(Box::new(Closest)),
            guests: BTreeMap::new(),
            seats: HashMap::new(),
            pending: HashMap::new(),
            verdicts: Vec::new(),
            next_ticket: 1,
            told: Vec::new(),
            started: Instant::now(),
        }
    }

    fn now(&self) -> Monotonic {
        self.started.elapsed()
    }

    /// The cluster was made anew, and its nodes have other numbers: every offer ends, and fresh ones follow.
    pub(super) fn begin_anew(&mut self) {
        let old = std::mem::replace(&mut self.book, Book::new(Box::new(Closest)));
        let guests = std::mem::take(&mut self.guests);
        self.seats.clear();
        for (_, pending) in self.pending.drain() {
            let outlet =
                guests.values().find(|g| g.uid == pending.uid).and_then(|g| g.outlet.as_ref());
            refuse(outlet, pending.call, convert::unavailable());
        }
        for (seat, guest) in guests {
            let Some(wish) = old.wish(seat) else { continue };
            let offers: Vec<String> = old.offers_of(seat).map(|o| o.id.to_string()).collect();
            if let Some(outlet) = guest.outlet.as_ref().filter(|_| !offers.is_empty()) {
                let reason = wire::RescindReason::Changed.into();
                outlet.say(wire::event::Event::Rescind(wire::Rescind { offers, reason }));
            }
            let anew = self.book.register(wish.clone());
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

    /// What namespaces may have has changed.
    pub(super) fn quotas_changed(&mut self) {
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
            Request::Accept { uid, call, offers, launches, refuse, guard } => {
                self.accept(cluster, Pending { uid, call, launches, guard }, (offers, refuse));
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
            Request::Look { answer } => drop(answer.send(self.look(cluster))),
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
            })
            .collect();
        let ticket = self.next_ticket;
        self.next_ticket += 1;
        self.pending.insert(ticket, pending);
        let order = Order { seat, ticket, offers, launches, refuse: refuse_for };
        let now = self.now();
        self.verdicts.extend(self.book.submit(cluster, order, now));
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
        self.book.next_deadline().map(|at| self.started + at)
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
            if ops.is_empty() { Ok(Vec::new()) } else { store.apply(ops).await }
        }))
        .await;
        for ((seat, pending, binds), result) in passed.into_iter().zip(results) {
            let outlet = self.guests.get(&seat).and_then(|g| g.outlet.as_ref());
            match result {
                Ok(_) => {
                    metrics::counter!("muster_framework_launches_total")
                        .increment(binds.len() as u64);
                    let launched = pending.launches.iter().zip(&binds).map(launched).collect();
                    answer(outlet, wire::Answer { id: pending.call, refusal: None, launched });
                }
                Err(error) => {
                    release(cluster, binds.iter());
                    refuse(outlet, pending.call, not_written(&pending.launches, &error));
                }
            }
        }
    }

    fn deny(&self, seat: Seat, pending: Pending, denied: &Denied) {
        metrics::counter!("muster_framework_refusals_total").increment(1);
        let outlet = self.guests.get(&seat).and_then(|g| g.outlet.as_ref());
        refuse(outlet, pending.call, convert::denied(denied));
    }

    /// Tasks and leases of an Accept, as one transaction.
    fn launch_ops(&self, pending: &Pending, binds: &[Bind]) -> Vec<Op> {
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
            ops.extend(bind::grants(&self.context, bound, &prepared.key, now));
        }
        ops
    }

    fn look(&self, cluster: &Cluster) -> Vec<View> {
        if self.guests.is_empty() {
            return Vec::new();
        }
        let (accounts, now) = (Accounts::of(cluster), self.now());
        let offer_view = |seat: Seat, offer: &muster_controller_core::offer::Offer| {
            let member = cluster.at(offer.slot);
            let others = self.seats.values().filter(|s| **s != seat);
            OfferView {
                id: offer.id.to_string(),
                node: member.name.to_string(),
                score: offer.score,
                age_ms: u64::try_from(now.saturating_sub(offer.made_at).as_millis())
                    .unwrap_or(u64::MAX),
                free: member.ledger.open(),
                actuators: muster_controller_core::offer::allocator::actuators_free(member),
                shared_with: others
                    .filter(|s| self.book.offers_of(**s).any(|o| o.slot == offer.slot))
                    .count(),
            }
        };
        let view = |(seat, guest): (&Seat, &Guest)| {
            let namespace = guest.key.namespace().unwrap_or_default();
            let mut offers: Vec<OfferView> =
                self.book.offers_of(*seat).map(|o| offer_view(*seat, o)).collect();
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
                offers,
            }
        };
        self.guests.iter().map(view).collect()
    }

    fn why(&self, cluster: &Cluster, uid: &FrameworkUid) -> Option<Vec<NodeRefusal>> {
        let seat = *self.seats.get(uid)?;
        let reasons = self.book.explain(cluster, seat, self.now());
        let refusal = |(node, why): (muster_api::name::NodeName, _)| {
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
        cluster.release(&bind.uid);
    }
}

fn launched((prepared, bind): (&Prepared, &Bind)) -> wire::Launched {
    wire::Launched {
        name: prepared.key.name.to_string(),
        task: prepared.uid.to_string(),
        node: bind.node.to_string(),
    }
}

fn answer(outlet: Option<&Outlet>, answer: wire::Answer) {
    // A call without an id wants no answer.
    if let Some(outlet) = outlet.filter(|_| !answer.id.is_empty()) {
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
        let reason = convert::rescinded(why).into();
        outlet.say(wire::event::Event::Rescind(wire::Rescind { offers, reason }));
    }
    if !notice.offered.is_empty() {
        let offer = |o| convert::offer((&guest.uid, o), cluster, now);
        let offers = notice.offered.iter().map(offer).collect();
        outlet.say(wire::event::Event::Offers(wire::Offers { offers }));
    }
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
