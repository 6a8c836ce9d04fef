//! The book against a scan over everything, under any interleaving of what frameworks and robots do.

mod accepts;
mod declared;
mod interleaved;
mod shown;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use muster_api::id::TaskUid;
use muster_api::kind::node::{Node, NodeKind};
use muster_api::kind::quota::QuotaSpec;
use muster_api::name::NodeName;
use muster_api::pose::OperationPosition;
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::Compute;
use serde_json::json;

use super::allocator::{self, Closest};
use super::book::Book;
use super::explain::NotOffered;
use super::settle::{Denied, Launch, Order, Verdict};
use super::{COURTESY, EXPIRE_AFTER, GATHER, Notice, OfferId, Rescinded, Seat, Wish};
use crate::cluster::{Cluster, Member};
use crate::fairness::{Spent, namespace_of};
use crate::fixtures::{name, node};
use crate::node_health::Monotonic;
use crate::report::Refusal;
use crate::schedule::{Demand, explain, filter, over_quota, schedule};
use crate::space::Slot;

fn wish(namespace: &str, at: Option<(f64, f64)>, radius: f64) -> Wish {
    Wish {
        namespace: namespace.into(),
        position: at.map(|(x, y)| OperationPosition { map: "map".to_owned(), x, y, z: 0.0 }),
        radius,
        cost: muster_api::kind::task::Cost::Distance,
        filter: muster_api::kind::framework::OfferFilter::default(),
        spent: Spent::default(),
    }
}

/// A cluster, a book, and what each framework believes from what it was told.
struct World {
    cluster: Cluster,
    book: Book,
    now: Monotonic,
    believed: BTreeMap<Seat, BTreeMap<OfferId, Slot>>,
    ever_offered: BTreeSet<OfferId>,
    rescinded: Vec<(OfferId, Rescinded)>,
    verdicts: BTreeMap<u64, Verdict>,
    running: Vec<TaskUid>,
    tickets: u64,
    /// Accepts without a verdict, and whose.
    asked: BTreeMap<u64, Seat>,
    /// Declared tasks without a place, and since when which node would take each.
    waiting: Vec<Demand>,
    takers_since: BTreeMap<(TaskUid, Slot), Monotonic>,
    declared: u64,
    /// What nodes had left when a framework declined them, or let an offer run out.
    declined: BTreeMap<(Seat, NodeName), Compute>,
    /// What nodes had left before the last pass.
    before: BTreeMap<NodeName, Compute>,
    away: BTreeSet<Seat>,
    /// Offers that were rescinded.
    lost: BTreeMap<Seat, Vec<OfferId>>,
    /// Offers with which something was launched: none is good twice.
    spent: BTreeSet<OfferId>,
    refuse: Duration,
}

impl World {
    fn new(nodes: &[(&str, Node)]) -> Self {
        let mut cluster = Cluster::new();
        for (node_name, node) in nodes {
            cluster.upsert_node(&name(node_name), node);
        }
        World {
            cluster,
            book: Book::new(Box::new(Closest), OfferId::first(1)),
            now: Duration::from_secs(1),
            believed: BTreeMap::new(),
            ever_offered: BTreeSet::new(),
            rescinded: Vec::new(),
            verdicts: BTreeMap::new(),
            running: Vec::new(),
            tickets: 0,
            asked: BTreeMap::new(),
            waiting: Vec::new(),
            takers_since: BTreeMap::new(),
            declared: 0,
            declined: BTreeMap::new(),
            before: BTreeMap::new(),
            away: BTreeSet::new(),
            lost: BTreeMap::new(),
            spent: BTreeSet::new(),
            refuse: Duration::ZERO,
        }
    }

    fn decline(&mut self, seat: Seat, offer: OfferId, seconds: u64) {
        let slot = self.believed.get_mut(&seat).and_then(|offers| offers.remove(&offer));
        self.remember_declined(seat, slot.expect("it is held"));
        let refuse = (Duration::from_secs(seconds), self.now);
        assert_eq!(self.book.decline(&self.cluster, seat, &[offer], refuse), []);
    }

    fn remember_declined(&mut self, seat: Seat, slot: Slot) {
        let member = self.cluster.at(slot);
        self.declined.insert((seat, member.name.clone()), member.ledger.open());
    }

    /// A task of no framework.
    fn declare(&mut self, namespace: &str, spec: &serde_json::Value) -> TaskUid {
        let mut spec = spec.clone();
        spec["run"] = json!({"process": {"command": ["true"]}});
        self.declared += 1;
        let uid = TaskUid::new(format!("declared-{}", self.declared));
        self.waiting.push(Demand {
            uid: uid.clone(),
            title: format!("{namespace}/{}", uid.as_str()).into(),
            spec: Arc::new(serde_json::from_value(spec).expect("a spec")),
            since: self.declared,
            avoid: Arc::default(),
            framework: None,
        });
        uid
    }

    /// Places what is declared, as the scheduler does; no task waits for longer than it may where a node takes it.
    fn place(&mut self) {
        let plan = schedule(&mut self.cluster, &mut self.waiting);
        self.book.claim(&plan.claims);
        for bind in plan.binds {
            self.waiting.retain(|demand| demand.uid != bind.uid);
            self.running.push(bind.uid);
        }
        let before = std::mem::take(&mut self.takers_since);
        for demand in &self.waiting {
            let takes = |(_, member): &(Slot, &Member)| {
                filter::refusal(self.cluster.sites(), member, demand).is_none()
            };
            let over = over_quota(&self.cluster, self.cluster.accounts(), demand).is_some();
            for (slot, _) in self.cluster.members().filter(|member| !over && takes(member)) {
                let key = (demand.uid.clone(), slot);
                let since = before.get(&key).copied().unwrap_or(self.now);
                let waited = self.now - since;
                assert!(waited < COURTESY + GATHER, "{} waits for {waited:?}", demand.title);
                self.takers_since.insert(key, since);
            }
        }
    }

    fn register(&mut self, wish: Wish) -> Seat {
        let seat = self.book.register(wish);
        self.believed.insert(seat, BTreeMap::new());
        seat
    }

    fn refresh(&mut self) {
        let somebody = !self.waiting.is_empty();
        let open = |(_, member): (Slot, &Member)| (member.name.clone(), member.ledger.open());
        self.before = self.cluster.members().map(open).collect();
        let settled = self.book.begin_pass(&mut self.cluster, somebody, self.now);
        for (order, verdict) in settled {
            self.take_verdict(&order, verdict);
        }
        if somebody {
            self.place();
        }
        let settled = self.book.settle_due(&mut self.cluster, self.now);
        for (order, verdict) in settled {
            self.take_verdict(&order, verdict);
        }
        for (seat, notice) in self.book.refresh(&mut self.cluster, self.now) {
            self.tell(seat, notice);
        }
    }

    fn tell(&mut self, seat: Seat, notice: Notice) {
        let believed = self.believed.get_mut(&seat).expect("only registered frameworks are told");
        let mut silent = Vec::new();
        for (id, why) in notice.rescinded {
            let slot = believed.remove(&id);
            let slot = slot.unwrap_or_else(|| panic!("{id} is rescinded and was not held"));
            self.rescinded.push((id, why));
            self.lost.entry(seat).or_default().push(id);
            if why == Rescinded::Expired {
                silent.push(slot);
            }
        }
        for offer in notice.offered {
            assert!(self.ever_offered.insert(offer.id), "{} is offered twice", offer.id);
            assert!(
                !believed.values().any(|s| *s == offer.slot),
                "a node is offered twice at once"
            );
            believed.insert(offer.id, offer.slot);
        }
        for slot in silent {
            // It ran out before anything was placed.
            let node = self.cluster.at(slot).name.clone();
            let open = self.before.get(&node).cloned().unwrap_or_default();
            self.declined.insert((seat, node), open);
        }
    }

    fn offers(&self, seat: Seat) -> Vec<&str> {
        let slots = self.believed[&seat].values();
        slots.map(|s| self.cluster.at(*s).name.as_str()).collect()
    }

    fn accept(&mut self, seat: Seat, offers: &[OfferId], specs: &[serde_json::Value]) -> u64 {
        let with = |spec: &serde_json::Value| {
            let mut spec = spec.clone();
            spec["run"] = json!({"process": {"command": ["true"]}});
            spec
        };
        self.accept_as_is(seat, offers, &specs.iter().map(with).collect::<Vec<_>>())
    }

    fn accept_as_is(&mut self, seat: Seat, offers: &[OfferId], specs: &[serde_json::Value]) -> u64 {
        self.tickets += 1;
        let namespace = self.book.wish(seat).expect("registered").namespace.clone();
        let launches = specs
            .iter()
            .enumerate()
            .map(|(i, spec)| {
                let mut spec = spec.clone();
                if spec.get("run").is_none() {
                    spec["run"] = json!({"process": {"command": ["true"]}});
                }
                let uid = format!("{}-{i}", self.tickets);
                Launch {
                    title: format!("{namespace}/{uid}").into(),
                    uid: TaskUid::new(uid),
                    spec: Arc::new(serde_json::from_value(spec).expect("a spec")),
                    offer: offers[i % offers.len()],
                    framework: "framework".into(),
                }
            })
            .collect();
        let order = Order {
            seat,
            ticket: self.tickets,
            offers: offers.to_vec(),
            launches,
            refuse: self.refuse,
        };
        self.asked.insert(self.tickets, seat);
        if let Some((order, verdict)) = self.book.submit(&mut self.cluster, order, self.now) {
            self.take_verdict(&order, verdict);
        }
        self.tickets
    }

    fn take_verdict(&mut self, order: &Order, verdict: Verdict) {
        assert!(self.asked.remove(&order.ticket).is_some(), "it waits for a verdict");
        if let Ok(binds) = &verdict {
            self.running.extend(binds.iter().map(|b| b.uid.clone()));
            let believed = self.believed.get_mut(&order.seat).expect("registered");
            believed.retain(|id, _| !order.offers.contains(id));
            for offer in &order.offers {
                assert!(self.spent.insert(*offer), "{offer} is accepted twice");
            }
        }
        assert!(self.verdicts.insert(order.ticket, verdict).is_none(), "settled twice");
    }

    /// What holds after every refresh.
    fn check(&self) {
        for (seat, believed) in &self.believed {
            let held: BTreeMap<OfferId, Slot> =
                self.book.offers_of(*seat).map(|o| (o.id, o.slot)).collect();
            assert_eq!(&held, believed, "{seat:?} believes what is so");
            self.check_nobody_is_left_out(*seat);
        }
        assert_eq!(self.cluster.accounts(), &crate::fairness::added_up(&self.cluster));
        for (_, member) in self.cluster.members() {
            assert!(member.ledger.allocatable().shortage_for(member.ledger.used()).is_none());
            let drivers = member.ledger.reservations().filter(|(_, r)| !r.groups.is_empty());
            assert!(drivers.count() <= 1, "one driver");
        }
    }

    /// Every node that is not offered has a reason that is true.
    fn check_nobody_is_left_out(&self, seat: Seat) {
        let wish = self.book.wish(seat).expect("registered");
        let kind = |slot: Slot| self.cluster.at(slot).facts.as_ref().map(|f| f.kind);
        let held =
            |k: NodeKind| self.book.offers_of(seat).filter(|o| kind(o.slot) == Some(k)).count();
        for offer in self.book.offers_of(seat) {
            let member = self.cluster.at(offer.slot);
            assert_eq!(
                allocator::refusal(self.cluster.sites(), member, wish),
                None,
                "what is offered fits"
            );
            assert!(!allocator::is_spent(member, wish), "and there is quota for something of it");
            assert_eq!(member.version, offer.version, "and is what the node has now");
        }
        assert!(held(NodeKind::Robot) <= wish.filter.limit());
        for (node_name, why) in self.book.explain(&self.cluster, seat, self.now) {
            let member = self.cluster.member(&node_name).expect("a member");
            match why {
                NotOffered::NotAmongTheClosest { limit } => {
                    let kind = member.facts.as_ref().expect("facts").kind;
                    assert_eq!(held(kind), limit, "{node_name} fits {seat:?}, and there is room");
                }
                NotOffered::Refusal(refusal) => {
                    assert_eq!(
                        allocator::refusal(self.cluster.sites(), member, wish),
                        Some(refusal)
                    );
                }
                NotOffered::Quota => {
                    let spent = self.cluster.accounts().spent(&self.cluster, &wish.namespace);
                    assert_eq!(wish.spent, spent);
                    assert!(allocator::is_spent(member, wish));
                }
                NotOffered::Declined { left } => {
                    let declined = self.declined.get(&(seat, node_name.clone()));
                    let declined =
                        declined.unwrap_or_else(|| panic!("{node_name} was not declined"));
                    assert!(!left.is_zero(), "its time is over");
                    let open = member.ledger.open();
                    assert!(declined.shortage_for(&open).is_none(), "{node_name} has gained");
                }
                NotOffered::Suppressed => assert!(self.book.is_suppressed(seat)),
                NotOffered::Disconnected => assert!(self.away.contains(&seat)),
            }
        }
    }
}

fn robot(cpu: u64, x: f64) -> Node {
    node(NodeKind::Robot, cpu, Some((x, 0.0)))
}

#[test]
fn the_closest_in_range_are_offered_and_cloud_nodes_whatever_the_range() {
    let mut world = World::new(&[
        ("r1", robot(1000, 5.0)),
        ("r2", robot(1000, 3.0)),
        ("r3", robot(1000, 5.1)),
        ("cloud", node(NodeKind::Cloud, 4000, None)),
    ]);
    let mut near = wish("a", Some((0.0, 0.0)), 5.0);
    near.filter.most = 2;
    let seat = world.register(near.clone());
    world.refresh();
    world.check();
    assert_eq!(world.offers(seat), ["r2", "r1", "cloud"], "the rim is inside, nearest first");

    near.filter.most = 1;
    world.book.set_wish(seat, near);
    world.refresh();
    world.check();
    assert_eq!(world.offers(seat), ["r2", "cloud"]);
    assert_eq!(world.rescinded.len(), 1);
}

#[test]
fn a_robot_that_drives_into_range_is_offered_at_once_and_a_closer_one_takes_the_place() {
    let mut world = World::new(&[("r1", robot(1000, 8.0)), ("r2", robot(1000, 30.0))]);
    let mut near = wish("a", Some((0.0, 0.0)), 10.0);
    near.filter.most = 1;
    let seat = world.register(near);
    world.refresh();
    assert_eq!(world.offers(seat), ["r1"]);
    for (x, offered) in [(9.0, "r1"), (7.9, "r1"), (2.0, "r2")] {
        world.cluster.upsert_node(&name("r2"), &robot(1000, x));
        world.refresh();
        world.check();
        assert_eq!(world.offers(seat), [offered], "r2 at {x} m");
    }
    world.cluster.upsert_node(&name("r2"), &robot(1000, 11.0));
    world.refresh();
    assert_eq!(world.offers(seat), ["r1"]);
    let whys: Vec<Rescinded> = world.rescinded.iter().map(|(_, why)| *why).collect();
    assert_eq!(whys, [Rescinded::Closer, Rescinded::OutOfRange]);
}

#[test]
fn what_is_declined_comes_back_when_it_has_more_or_the_time_is_up() {
    let mut world = World::new(&[("r1", robot(1000, 1.0))]);
    let (a, b) = (world.register(wish("ns", None, 0.0)), world.register(wish("ns", None, 0.0)));
    world.refresh();
    let offer = *world.believed[&a].keys().next().expect("an offer");
    let task = world.accept(a, &[offer], &[json!({"resources": {"cpu": "400m"}})]);
    assert!(world.verdicts[&task].is_ok());
    world.refresh();
    let fresh = *world.believed[&b].keys().next().expect("a fresh offer");
    let refuse = (Duration::from_secs(1000), world.now);
    assert_eq!(world.book.decline(&world.cluster, b, &[fresh], refuse), []);
    world.believed.get_mut(&b).expect("b").clear();
    world.refresh();
    assert_eq!(world.offers(b), [""; 0]);
    // Less of it is no news …
    let offer = *world.believed[&a].keys().next().expect("an offer");
    world.accept(a, &[offer], &[json!({"resources": {"cpu": "100m"}})]);
    world.refresh();
    assert_eq!(world.offers(b), [""; 0]);
    // … more is.
    world.cluster.release(&TaskUid::new("1-0"));
    world.refresh();
    world.check();
    assert_eq!(world.offers(b), ["r1"]);

    let again = *world.believed[&b].keys().next().expect("an offer");
    assert_eq!(
        world.book.decline(
            &world.cluster,
            b,
            &[again, OfferId(999)],
            (Duration::from_secs(5), world.now)
        ),
        [OfferId(999)]
    );
    world.believed.get_mut(&b).expect("b").clear();
    world.now += Duration::from_secs(5);
    assert!(world.book.next_deadline().is_some_and(|d| d <= world.now));
    world.refresh();
    assert_eq!(world.offers(b), ["r1"]);
}

#[test]
fn an_offer_that_nobody_answers_runs_out_and_comes_back_later() {
    let mut world = World::new(&[("r1", robot(1000, 1.0))]);
    let seat = world.register(wish("ns", None, 0.0));
    world.refresh();
    world.now += EXPIRE_AFTER;
    world.refresh();
    assert_eq!(world.rescinded.last().map(|r| r.1), Some(Rescinded::Expired));
    assert_eq!(world.offers(seat), [""; 0]);
    world.now = world.book.next_deadline().expect("the silence ends");
    world.refresh();
    assert_eq!(world.offers(seat), ["r1"]);
}

#[test]
fn one_of_two_who_want_the_same_gets_it_and_the_other_a_fresh_offer_of_the_rest() {
    let mut world = World::new(&[("r1", robot(1000, 1.0))]);
    let (rich, poor) =
        (world.register(wish("rich", None, 0.0)), world.register(wish("poor", None, 0.0)));
    world.refresh();
    let first = |world: &World, seat: Seat| *world.believed[&seat].keys().next().expect("an offer");
    let offer = first(&world, rich);
    let alone = world.accept(rich, &[offer], &[json!({"resources": {"cpu": "100m"}})]);
    assert!(!world.verdicts.contains_key(&alone), "poor is shown the node, too: it is gathered");
    world.now += GATHER;
    world.refresh();
    assert!(world.verdicts[&alone].is_ok());

    let drive = json!({"resources": {"cpu": "100m", "actuators": ["base:Drive"]}});
    let offer = first(&world, rich);
    let by_rich = world.accept(rich, &[offer], std::slice::from_ref(&drive));
    let offer = first(&world, poor);
    let by_poor = world.accept(poor, &[offer], std::slice::from_ref(&drive));
    world.now += GATHER;
    world.refresh();
    world.check();
    assert!(world.verdicts[&by_poor].is_ok(), "it came later and has less");
    assert!(matches!(world.verdicts[&by_rich], Err(Denied::Refused { launch: 0, .. })));
    assert_eq!(world.offers(rich), ["r1"], "what is left of it");
}

#[test]
fn an_accept_is_all_or_nothing() {
    let mut world = World::new(&[("r1", robot(1000, 1.0)), ("r2", robot(1000, 2.0))]);
    let seat = world.register(wish("ns", None, 0.0));
    world.refresh();
    let offers: Vec<OfferId> = world.believed[&seat].keys().copied().collect();
    let big = json!({"resources": {"cpu": "2"}});
    let small = json!({"resources": {"cpu": "500m"}});
    let refused = world.accept(seat, &offers, &[small.clone(), big]);
    assert!(matches!(world.verdicts[&refused], Err(Denied::Exceeds { launch: 1, .. })));
    assert!(world.cluster.members().all(|(_, m)| m.ledger.used().cpu == MilliCpu(0)));
    let both = world.accept(seat, &offers, &[small.clone(), small]);
    assert_eq!(world.verdicts[&both].as_ref().map(Vec::len), Ok(2));
    let again = world.accept(seat, &offers, &[json!({})]);
    assert_eq!(world.verdicts[&again], Err(Denied::OffersGone { offers }), "an offer is good once");
    world.refresh();
    world.check();
}

/// Another one's task in between is a conflict; more than the offer showed is not.
#[test]
fn who_wants_more_than_was_offered_is_told_so() {
    let mut world = World::new(&[("r1", robot(1000, 1.0))]);
    let seats = [world.register(wish("ns", None, 0.0)), world.register(wish("ns", None, 0.0))];
    world.refresh();
    let [one, two] = seats.map(|seat| *world.believed[&seat].keys().next().expect("an offer"));
    let spec = |cpu: &str| json!({"resources": {"cpu": cpu}});
    let whole = world.accept(seats[0], &[one], &[spec("600m"), spec("600m")]);
    assert!(
        matches!(world.verdicts[&whole], Err(Denied::Exceeds { launch: 1, .. })),
        "each fits: {:?}",
        world.verdicts[&whole]
    );
    let half = world.accept(seats[0], &[one], &[spec("600m")]);
    assert!(world.verdicts[&half].is_ok());
    let late = world.accept(seats[1], &[two], &[spec("600m")]);
    assert!(matches!(world.verdicts[&late], Err(Denied::Refused { launch: 0, .. })));
    let lacking = json!({"resources": {"sensors": ["sonar:Range"]}});
    world.refresh();
    let two = *world.believed[&seats[1]].keys().next().expect("a fresh offer");
    let lacking = world.accept(seats[1], &[two], &[lacking]);
    assert!(matches!(world.verdicts[&lacking], Err(Denied::Exceeds { launch: 0, .. })));
}

#[test]
fn an_offer_of_another_life_of_the_controller_is_none_of_this() {
    let first = OfferId::first(0xbeef);
    assert_eq!(first.to_string(), "beef-1");
    assert_eq!(first.next().to_string().parse(), Ok(first.next()));
    for text in ["3", "", "beef-", "-1", "beef-1-1", "beef--1", "1ffffffff-1", "beef-4294967296"] {
        assert_eq!(text.parse::<OfferId>(), Err(super::NoOfferId), "{text:?}");
    }
    let mut world = World::new(&[("r1", robot(1000, 1.0))]);
    let seat = world.register(wish("ns", None, 0.0));
    world.refresh();
    let offered = *world.believed[&seat].keys().next().expect("an offer");
    // The cluster is made anew, with other robots in the same places.
    let next = world.book.next_offer();
    world.book = Book::new(Box::new(Closest), next);
    world.cluster = World::new(&[("r7", robot(1000, 1.0))]).cluster;
    world.believed.clear();
    let seat = world.register(wish("ns", None, 0.0));
    world.refresh();
    assert_eq!(world.offers(seat), ["r7"]);
    let drive = json!({"resources": {"actuators": ["base:Drive"]}});
    let wrong = world.accept(seat, &[offered], &[drive]);
    assert_eq!(world.verdicts[&wrong], Err(Denied::OffersGone { offers: vec![offered] }));
}

/// What a quota leaves nothing of is not offered; the rest is.
#[test]
fn a_quota_hides_what_is_used_up_and_nothing_else() {
    let cloud = node(NodeKind::Cloud, 4000, None);
    let mut world = World::new(&[("r1", robot(1000, 1.0)), ("cloud", cloud)]);
    let hard =
        serde_json::from_value(json!({"hard": {"cpu": "300m", "leases": 1}})).expect("a quota");
    world.cluster.set_quota("ns", Some(hard));
    let mut driver = wish("ns", None, 0.0);
    driver.filter.any_actuator = true;
    let mut thinker = wish("ns", None, 0.0);
    thinker.filter.minimum.cpu = MilliCpu(10);
    let [plain, driver, thinker, other] =
        [wish("ns", None, 0.0), driver, thinker, wish("other", None, 0.0)]
            .map(|wish| world.register(wish));
    world.refresh();
    let offer = |world: &World, seat: Seat| {
        let offers = &world.believed[&seat];
        let is_r1 = |slot: &Slot| world.cluster.at(*slot).name.as_str() == "r1";
        *offers.iter().find(|(_, slot)| is_r1(slot)).expect("an offer of r1").0
    };
    let all_cpu =
        world.accept(plain, &[offer(&world, plain)], &[json!({"resources": {"cpu": "300m"}})]);
    world.now += GATHER;
    world.refresh();
    world.check();
    assert!(world.verdicts[&all_cpu].is_ok());
    assert_eq!(
        world.offers(plain),
        ["r1"],
        "its sensors and actuators; the cloud has nothing else"
    );
    assert_eq!(world.offers(driver), ["r1"]);
    assert_eq!(world.offers(thinker), [""; 0]);
    assert_eq!(world.offers(other).len(), 2, "it is another's quota");
    assert!(world.book.offers_of(plain).all(|offer| offer.spent.cpu && !offer.spent.leases));
    assert!(world.rescinded.iter().any(|(_, why)| *why == Rescinded::Quota));

    let drive = world.accept(
        driver,
        &[offer(&world, driver)],
        &[json!({"resources": {"actuators": ["base:Drive"]}})],
    );
    world.now += GATHER;
    world.refresh();
    assert!(world.verdicts[&drive].is_ok(), "it needs no cpu");
    // Of another robot, whose actuators nobody holds.
    world.cluster.upsert_node(&name("r2"), &robot(1000, 2.0));
    world.refresh();
    world.check();
    assert_eq!(world.offers(driver), [""; 0], "there is no lease left for it");
    assert_eq!(world.offers(plain).len(), 2, "sensors");
    assert!(world.book.offers_of(plain).all(|offer| offer.spent.leases));

    for task in world.running.clone() {
        world.cluster.release(&task);
    }
    world.refresh();
    world.check();
    assert_eq!(world.offers(driver).len(), 2);
    assert_eq!(world.offers(thinker).len(), 3);
}

#[test]
fn a_quota_stops_accepts_and_then_offers() {
    let mut world = World::new(&[("r1", robot(1000, 1.0))]);
    let hard =
        serde_json::from_value(json!({"hard": {"cpu": "300m", "leases": 0}})).expect("a quota");
    world.cluster.set_quota("ns", Some(hard));
    let mut computes = wish("ns", None, 0.0);
    computes.filter.minimum.cpu = MilliCpu(1);
    let seat = world.register(computes);
    world.refresh();
    let offers: Vec<OfferId> = world.believed[&seat].keys().copied().collect();
    for spec in
        [json!({"resources": {"cpu": "400m"}}), json!({"resources": {"actuators": ["base:Drive"]}})]
    {
        let over = world.accept(seat, &offers, &[spec]);
        assert!(matches!(world.verdicts[&over], Err(Denied::Quota { launch: 0, .. })));
    }
    let fits = world.accept(seat, &offers, &[json!({"resources": {"cpu": "300m"}})]);
    assert!(world.verdicts[&fits].is_ok());
    world.refresh();
    world.check();
    assert_eq!(world.offers(seat), [""; 0]);
    world.cluster.release(&world.running[0].clone());
    world.refresh();
    assert_eq!(world.offers(seat), ["r1"]);
}

/// Three namespaces with the weights 1, 2 and 4 always want more than there is. Tasks end at random; what each has, over
/// time, is its weight's part of the pool within 3 %.
#[test]
fn shares_converge_to_the_weights() {
    let nodes: Vec<(String, Node)> =
        (0..70).map(|i| (format!("r{i}"), robot(500, f64::from(i)))).collect();
    let nodes: Vec<(&str, Node)> =
        nodes.iter().map(|(n, node)| (n.as_str(), node.clone())).collect();
    let mut world = World::new(&nodes);
    let weights = [("a", 1.0), ("b", 2.0), ("c", 4.0)];
    let mut seats = Vec::new();
    for (namespace, weight) in weights {
        world.cluster.set_quota(namespace, Some(QuotaSpec { weight, ..QuotaSpec::default() }));
        let mut all = wish(namespace, None, 0.0);
        all.filter.most = 100;
        seats.push((namespace, world.register(all)));
    }
    let mut seed = 7_u64;
    let mut random = move |below: usize| {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as usize % below
    };
    let mut held: BTreeMap<&str, f64> = BTreeMap::new();
    let (rounds, warm) = (40, 10);
    for round in 0..rounds {
        // All want something of every node at once, until nothing is left; the first ones ask first, which must not
        // help them.
        loop {
            world.refresh();
            let before = world.running.len();
            for (_, seat) in &seats {
                let offers: Vec<OfferId> = world.believed[seat].keys().copied().collect();
                for offer in offers {
                    world.accept(*seat, &[offer], &[json!({"resources": {"cpu": "500m"}})]);
                }
            }
            world.now += GATHER;
            world.refresh();
            if world.running.len() == before {
                break;
            }
        }
        for _ in 0..world.running.len() / 10 {
            let ended = world.running.swap_remove(random(world.running.len()));
            world.cluster.release(&ended);
        }
        if round >= warm {
            let accounts = world.cluster.accounts();
            for (namespace, _) in weights {
                *held.entry(namespace).or_default() +=
                    accounts.account(namespace).compute.cpu.0 as f64;
            }
        }
    }
    world.refresh();
    world.check();
    let all: f64 = held.values().sum();
    for (namespace, weight) in weights {
        let (part, fair) = (held[namespace] / all, weight / 7.0);
        assert!((part / fair - 1.0).abs() <= 0.03, "{namespace} has {part:.3}, fair is {fair:.3}");
    }
}

/// Frameworks that all want every robot, each so many milliseconds away.
struct Race {
    world: World,
    seats: Vec<(&'static str, Seat, u64)>,
    /// Answers on their way: when they come, whose, to which offer.
    coming: BTreeMap<(Monotonic, OfferId), Seat>,
    answered: BTreeSet<OfferId>,
    /// Namespaces that always have declared tasks waiting.
    queues: Vec<&'static str>,
    /// What each task takes: all that there is of it on a robot.
    wants: serde_json::Value,
}

impl Race {
    /// Namespaces with their weights and distances, and one robot for each unit of weight, ten times.
    fn new(runners: &[(&'static str, f64, u64)]) -> Self {
        let robots: f64 = 10.0 * runners.iter().map(|(_, weight, _)| weight).sum::<f64>();
        Race::with(robots as u32, runners)
    }

    /// The same with so many robots.
    fn with(robots: u32, runners: &[(&'static str, f64, u64)]) -> Self {
        let names: Vec<String> = (0..robots).map(|i| format!("r{i}")).collect();
        let nodes: Vec<(&str, Node)> =
            names.iter().map(|name| (name.as_str(), robot(500, 0.0))).collect();
        let mut world = World::new(&nodes);
        let mut seats = Vec::new();
        for (namespace, weight, away) in runners {
            let quota = QuotaSpec { weight: *weight, ..QuotaSpec::default() };
            world.cluster.set_quota(namespace, Some(quota));
            seats.push((*namespace, world.register(wish(namespace, None, 0.0)), *away));
        }
        let (coming, answered) = (BTreeMap::new(), BTreeSet::new());
        let wants = json!(null);
        let mut race = Race { world, seats, coming, answered, queues: Vec::new(), wants };
        race.want(&json!({"cpu": "500m"}));
        race
    }

    /// What everybody wants of each robot, and nobody has use for less.
    fn want(&mut self, wants: &serde_json::Value) {
        self.wants = wants.clone();
        for (namespace, seat, _) in &self.seats {
            let mut all = wish(namespace, None, 0.0);
            all.filter.most = 1000;
            if wants["actuators"].is_array() {
                all.filter.any_actuator = true;
            } else {
                all.filter.minimum.cpu = MilliCpu(500);
            }
            self.world.book.set_wish(*seat, all);
        }
    }

    /// A namespace has declared tasks that wait, always.
    fn queue(&mut self, namespace: &'static str) {
        self.queues.push(namespace);
        for _ in 0..2 {
            self.world.declare(namespace, &json!({"resources": self.wants}));
        }
    }

    /// Says whether a queue was short.
    fn top_up(&mut self) -> bool {
        let waits = |world: &World, namespace: &str| {
            let own = world.waiting.iter().filter(|d| namespace_of(&d.title) == namespace);
            own.count() >= 2
        };
        let short: Vec<&'static str> =
            self.queues.iter().copied().filter(|queue| !waits(&self.world, queue)).collect();
        for namespace in &short {
            self.world.declare(namespace, &json!({"resources": self.wants}));
        }
        !short.is_empty()
    }

    /// Everybody reacts to everything until nothing is left to have; `frozen` hears and does not answer.
    fn run(&mut self, frozen: Option<&str>) {
        loop {
            self.world.refresh();
            while self.top_up() {
                self.world.refresh();
            }
            for (namespace, seat, away) in &self.seats {
                for offer in self.world.believed[seat].keys() {
                    if frozen != Some(namespace) && self.answered.insert(*offer) {
                        let at = self.world.now + Duration::from_millis(*away);
                        self.coming.insert((at, *offer), *seat);
                    }
                }
            }
            let due = [self.world.book.next_look(), self.world.book.next_end()];
            let due = due.into_iter().flatten();
            let Some(next) = self.coming.keys().map(|(at, _)| *at).chain(due).min() else { break };
            self.world.now = self.world.now.max(next);
            while let Some(entry) = self.coming.first_entry().filter(|e| e.key().0 <= next) {
                let ((_, offer), seat) = entry.remove_entry();
                self.world.accept(seat, &[offer], &[json!({"resources": self.wants})]);
            }
        }
    }

    fn has(&self, namespace: &str) -> f64 {
        self.world.cluster.accounts().account(namespace).compute.cpu.0 as f64
    }
}

/// Who is far away gets what its weight is worth, too.
#[test]
fn shares_converge_to_the_weights_whoever_is_nearer() {
    let mut race = Race::new(&[("near", 1.0, 0), ("far", 2.0, 30), ("farther", 4.0, 80)]);
    let mut held: BTreeMap<&str, f64> = BTreeMap::new();
    race.run(None);
    for round in 0..600 {
        // One robot after the other, at random, so that each is a race.
        let i = round * 7919 % race.world.running.len();
        let ended = race.world.running.swap_remove(i);
        race.world.cluster.release(&ended);
        race.world.now += Duration::from_secs(1);
        race.run(None);
        if round >= 200 {
            for namespace in ["near", "far", "farther"] {
                *held.entry(namespace).or_default() += race.has(namespace);
            }
        }
    }
    race.world.check();
    let all: f64 = held.values().sum();
    for (namespace, weight) in [("near", 1.0), ("far", 2.0), ("farther", 4.0)] {
        let (part, fair) = (held[namespace] / all, weight / 7.0);
        assert!((part / fair - 1.0).abs() <= 0.03, "{namespace} has {part:.3}, fair is {fair:.3}");
    }
}

/// One that has just lost and freezes holds others up once, for [`COURTESY`].
#[test]
fn who_freezes_is_waited_for_once() {
    let mut race = Race::new(&[("near", 1.0, 0), ("far", 4.0, 80)]);
    race.run(None);
    let mut waited = Vec::new();
    for i in 0..20 {
        let ended = race.world.running.swap_remove(i % race.world.running.len());
        race.world.cluster.release(&ended);
        // What the frozen one holds goes to the other; it has less than its weight is worth from then on.
        let before = race.world.now;
        race.run(Some("far"));
        waited.push(race.world.now - before);
    }
    assert!(waited.iter().filter(|wait| **wait > GATHER).count() <= 1, "{waited:?}");
    assert!(waited.iter().all(|wait| *wait <= COURTESY), "{waited:?}");
    assert!(race.has("near") > 10.0 * 500.0, "it takes what nobody else does");
}
