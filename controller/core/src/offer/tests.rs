//! The book against a scan over everything, under any interleaving of what frameworks and robots do.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use muster_api::condition::ConditionStatus;
use muster_api::id::TaskUid;
use muster_api::kind::node::{Node, NodeKind};
use muster_api::kind::quota::QuotaSpec;
use muster_api::pose::OperationPosition;
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::Compute;
use proptest::prelude::*;
use serde_json::json;

use super::allocator::{self, Closest};
use super::book::Book;
use super::explain::NotOffered;
use super::settle::{Denied, Launch, Order, Verdict};
use super::{EXPIRE_AFTER, GATHER, Notice, OfferId, Rescinded, Seat, Wish};
use crate::cluster::Cluster;
use crate::fairness::Accounts;
use crate::fixtures::{name, node};
use crate::node_health::Monotonic;
use crate::space::Slot;

fn wish(namespace: &str, at: Option<(f64, f64)>, radius: f64) -> Wish {
    Wish {
        namespace: namespace.into(),
        position: at.map(|(x, y)| OperationPosition { map: "map".to_owned(), x, y, z: 0.0 }),
        radius,
        cost: muster_api::kind::task::Cost::Distance,
        filter: muster_api::kind::framework::OfferFilter::default(),
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
}

impl World {
    fn new(nodes: &[(&str, Node)]) -> Self {
        let mut cluster = Cluster::new();
        for (node_name, node) in nodes {
            cluster.upsert_node(&name(node_name), node);
        }
        World {
            cluster,
            book: Book::new(Box::new(Closest)),
            now: Duration::from_secs(1),
            believed: BTreeMap::new(),
            ever_offered: BTreeSet::new(),
            rescinded: Vec::new(),
            verdicts: BTreeMap::new(),
            running: Vec::new(),
            tickets: 0,
        }
    }

    fn register(&mut self, wish: Wish) -> Seat {
        let seat = self.book.register(wish);
        self.believed.insert(seat, BTreeMap::new());
        seat
    }

    fn refresh(&mut self) {
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
        for (id, why) in notice.rescinded {
            assert!(believed.remove(&id).is_some(), "{id} is rescinded and was not held");
            self.rescinded.push((id, why));
        }
        for offer in notice.offered {
            assert!(self.ever_offered.insert(offer.id), "{} is offered twice", offer.id);
            assert!(
                !believed.values().any(|s| *s == offer.slot),
                "a node is offered twice at once"
            );
            believed.insert(offer.id, offer.slot);
        }
    }

    fn offers(&self, seat: Seat) -> Vec<&str> {
        let slots = self.believed[&seat].values();
        slots.map(|s| self.cluster.at(*s).name.as_str()).collect()
    }

    fn accept(&mut self, seat: Seat, offers: &[OfferId], specs: &[serde_json::Value]) -> u64 {
        self.tickets += 1;
        let namespace = self.book.wish(seat).expect("registered").namespace.clone();
        let launches = specs
            .iter()
            .enumerate()
            .map(|(i, spec)| {
                let mut spec = spec.clone();
                spec["run"] = json!({"process": {"command": ["true"]}});
                let uid = format!("{}-{i}", self.tickets);
                Launch {
                    title: format!("{namespace}/{uid}").into(),
                    uid: TaskUid::new(uid),
                    spec: Arc::new(serde_json::from_value(spec).expect("a spec")),
                    offer: offers[i % offers.len()],
                }
            })
            .collect();
        let order = Order {
            seat,
            ticket: self.tickets,
            offers: offers.to_vec(),
            launches,
            refuse: Duration::ZERO,
        };
        if let Some((order, verdict)) = self.book.submit(&mut self.cluster, order, self.now) {
            self.take_verdict(&order, verdict);
        }
        self.tickets
    }

    fn take_verdict(&mut self, order: &Order, verdict: Verdict) {
        if let Ok(binds) = &verdict {
            self.running.extend(binds.iter().map(|b| b.uid.clone()));
            let believed = self.believed.get_mut(&order.seat).expect("registered");
            believed.retain(|id, _| !order.offers.contains(id));
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
            assert_eq!(allocator::refusal(member, wish), None, "what is offered fits");
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
                    assert_eq!(allocator::refusal(member, wish), Some(refusal));
                }
                NotOffered::Quota => {
                    assert!(
                        Accounts::of(&self.cluster).is_exhausted(&self.cluster, &wish.namespace)
                    );
                }
                NotOffered::Declined { .. } | NotOffered::Suppressed | NotOffered::Disconnected => {
                }
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
    assert!(matches!(world.verdicts[&refused], Err(Denied::Refused { launch: 1, .. })));
    assert!(world.cluster.members().all(|(_, m)| m.ledger.used().cpu == MilliCpu(0)));
    let both = world.accept(seat, &offers, &[small.clone(), small]);
    assert_eq!(world.verdicts[&both].as_ref().map(Vec::len), Ok(2));
    let again = world.accept(seat, &offers, &[json!({})]);
    assert_eq!(world.verdicts[&again], Err(Denied::OffersGone { offers }), "an offer is good once");
    world.refresh();
    world.check();
}

#[test]
fn a_quota_stops_accepts_and_then_offers() {
    let mut world = World::new(&[("r1", robot(1000, 1.0))]);
    let hard =
        serde_json::from_value(json!({"hard": {"cpu": "300m", "leases": 0}})).expect("a quota");
    world.cluster.set_quota("ns", Some(hard));
    let seat = world.register(wish("ns", None, 0.0));
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
            let accounts = Accounts::of(&world.cluster);
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

#[derive(Debug, Clone)]
enum Step {
    Register { namespace: u8, at: Option<(i8, i8)>, radius: u8, most: u8, driver: bool },
    Move { robot: u8, x: i8, y: i8 },
    Ready { robot: u8, ready: bool },
    Accept { framework: u8, offers: u8, cpu: u16, drive: bool },
    Decline { framework: u8, seconds: u8 },
    Finish { task: u8 },
    Suppress { framework: u8 },
    Revive { framework: u8 },
    Away { framework: u8 },
    Back { framework: u8 },
    Position { framework: u8, x: i8, y: i8, radius: u8 },
    Pass { millis: u32 },
}

fn step() -> impl Strategy<Value = Step> {
    let place = || (-20..20_i8, -20..20_i8);
    prop_oneof![
        2 => (0..3_u8, proptest::option::of(place()), 0..30_u8, 0..4_u8, any::<bool>())
            .prop_map(|(namespace, at, radius, most, driver)| Step::Register { namespace, at, radius, most, driver }),
        4 => (0..6_u8, place()).prop_map(|(robot, (x, y))| Step::Move { robot, x, y }),
        1 => (0..8_u8, any::<bool>()).prop_map(|(robot, ready)| Step::Ready { robot, ready }),
        6 => (any::<u8>(), 1..3_u8, 0..900_u16, any::<bool>())
            .prop_map(|(framework, offers, cpu, drive)| Step::Accept { framework, offers, cpu, drive }),
        2 => (any::<u8>(), 0..20_u8).prop_map(|(framework, seconds)| Step::Decline { framework, seconds }),
        3 => any::<u8>().prop_map(|task| Step::Finish { task }),
        1 => any::<u8>().prop_map(|framework| Step::Suppress { framework }),
        1 => any::<u8>().prop_map(|framework| Step::Revive { framework }),
        1 => any::<u8>().prop_map(|framework| Step::Away { framework }),
        1 => any::<u8>().prop_map(|framework| Step::Back { framework }),
        1 => (any::<u8>(), place(), 0..30_u8)
            .prop_map(|(framework, (x, y), radius)| Step::Position { framework, x, y, radius }),
        2 => prop_oneof![0..10_u32, 1_000..70_000_u32].prop_map(|millis| Step::Pass { millis }),
    ]
}

impl World {
    fn seat(&self, framework: u8) -> Option<Seat> {
        let seats: Vec<Seat> = self.believed.keys().copied().collect();
        (!seats.is_empty()).then(|| seats[framework as usize % seats.len()])
    }

    fn play(&mut self, step: Step) -> Option<()> {
        match step {
            Step::Register { namespace, at, radius, most, driver } => {
                let at = at.map(|(x, y)| (f64::from(x), f64::from(y)));
                let mut wish = wish(["a", "b", "c"][namespace as usize], at, f64::from(radius));
                wish.filter.most = most.into();
                wish.filter.any_actuator = driver;
                self.register(wish);
            }
            Step::Move { robot, x, y } => {
                let name = name(&format!("r{robot}"));
                let pose = muster_api::pose::Pose {
                    x: x.into(),
                    y: y.into(),
                    ..self.cluster.member(&name)?.facts.as_ref()?.pose.clone()?
                };
                self.cluster.set_pose(&name, &pose);
            }
            Step::Ready { robot: i, ready } => {
                let (node_name, mut node) = if i < 6 {
                    (format!("r{i}"), robot(1000, f64::from(i)))
                } else {
                    (format!("c{i}"), node(NodeKind::Cloud, 2000, None))
                };
                if let (false, Some(status)) = (ready, node.status.as_mut()) {
                    status.conditions[0].status = ConditionStatus::Unknown;
                }
                self.cluster.upsert_node(&name(&node_name), &node);
            }
            Step::Accept { framework, offers, cpu, drive } => {
                let seat = self.seat(framework)?;
                let held: Vec<OfferId> =
                    self.believed[&seat].keys().copied().take(offers.into()).collect();
                let mut spec = json!({"resources": {"cpu": format!("{}m", 10 + cpu)}});
                if drive {
                    spec["resources"]["actuators"] = json!(["base:Drive"]);
                }
                let specs = vec![spec; held.len()];
                if !held.is_empty() {
                    self.accept(seat, &held, &specs);
                }
            }
            Step::Decline { framework, seconds } => {
                let seat = self.seat(framework)?;
                let offer = *self.believed[&seat].keys().next()?;
                let refuse = (Duration::from_secs(seconds.into()), self.now);
                assert_eq!(self.book.decline(&self.cluster, seat, &[offer], refuse), []);
                self.believed.get_mut(&seat)?.remove(&offer);
            }
            Step::Finish { task } => {
                if !self.running.is_empty() {
                    let ended = self.running.swap_remove(task as usize % self.running.len());
                    assert!(self.cluster.release(&ended).is_some());
                }
            }
            Step::Suppress { framework } => self.book.suppress(self.seat(framework)?),
            Step::Revive { framework } => self.book.revive(self.seat(framework)?),
            Step::Away { framework } => {
                let seat = self.seat(framework)?;
                self.book.disconnect(seat);
                self.believed.get_mut(&seat)?.clear();
            }
            Step::Back { framework } => {
                let seat = self.seat(framework)?;
                let wish = self.book.wish(seat)?.clone();
                self.book.reconnect(seat, wish);
                self.believed.get_mut(&seat)?.clear();
            }
            Step::Position { framework, x, y, radius } => {
                let seat = self.seat(framework)?;
                let old = self.book.wish(seat)?.clone();
                let new = wish(&old.namespace, Some((x.into(), y.into())), radius.into());
                self.book.set_wish(seat, Wish { filter: old.filter, ..new });
            }
            Step::Pass { millis } => self.now += Duration::from_millis(millis.into()),
        }
        Some(())
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]

    #[test]
    fn no_offer_is_lost_or_doubled_and_nobody_starves(steps in proptest::collection::vec(step(), 1..120)) {
        let nodes: Vec<(String, Node)> = (0..6)
            .map(|i| (format!("r{i}"), robot(1000, f64::from(i))))
            .chain((6..8).map(|i| (format!("c{i}"), node(NodeKind::Cloud, 2000, None))))
            .collect();
        let nodes: Vec<(&str, Node)> = nodes.iter().map(|(n, node)| (n.as_str(), node.clone())).collect();
        let mut world = World::new(&nodes);
        for step in steps {
            // None: the step has nobody to act on.
            let _ = world.play(step);
            world.refresh();
            world.check();
        }
        world.now += GATHER;
        world.refresh();
        world.check();
        prop_assert_eq!(world.verdicts.len() as u64, world.tickets, "every Accept gets its verdict");
        for uid in std::mem::take(&mut world.running) {
            prop_assert!(world.cluster.release(&uid).is_some());
        }
        let free = |m: &crate::cluster::Member| m.ledger.used() == &Compute::new(MilliCpu(0), Bytes(0));
        prop_assert!(world.cluster.members().all(|(_, m)| free(m)), "nothing leaks");
    }
}
