//! Any interleaving of what frameworks, robots, users and quotas do.

use muster_api::condition::ConditionStatus;
use muster_api::kind::framework::OfferFilter;
use muster_api::kind::task::NodeChoice;
use proptest::prelude::*;

use super::*;

const NAMESPACES: [&str; 3] = ["a", "b", "c"];

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
    Late { framework: u8, which: u8, cpu: u16 },
    Filter { framework: u8, on: u8, cpu: u16, sees: bool, drives: bool, most: u8 },
    Remove { framework: u8 },
    Quota { namespace: u8, cpu: u16, leases: u8, weight: u8 },
    Unlimited { namespace: u8 },
    Declare { namespace: u8, cpu: u16, drive: bool, priority: i8 },
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
        2 => (any::<u8>(), 0..3_u8, 0..900_u16)
            .prop_map(|(framework, which, cpu)| Step::Late { framework, which, cpu }),
        1 => (any::<u8>(), 0..3_u8, 0..900_u16, any::<bool>(), any::<bool>(), 0..4_u8)
            .prop_map(|(framework, on, cpu, sees, drives, most)| Step::Filter { framework, on, cpu, sees, drives, most }),
        1 => any::<u8>().prop_map(|framework| Step::Remove { framework }),
        1 => (0..3_u8, 0..4000_u16, 0..3_u8, 1..5_u8)
            .prop_map(|(namespace, cpu, leases, weight)| Step::Quota { namespace, cpu, leases, weight }),
        1 => (0..3_u8).prop_map(|namespace| Step::Unlimited { namespace }),
        3 => (0..3_u8, 0..900_u16, any::<bool>(), -1..2_i8)
            .prop_map(|(namespace, cpu, drive, priority)| Step::Declare { namespace, cpu, drive, priority }),
        3 => prop_oneof![0..10_u32, 1_000..70_000_u32, 10..120_u32].prop_map(|millis| Step::Pass { millis }),
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
                let mut wish = wish(NAMESPACES[namespace as usize], at, f64::from(radius));
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
                self.decline(seat, offer, seconds.into());
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
                self.away.insert(seat);
            }
            Step::Back { framework } => {
                let seat = self.seat(framework)?;
                let wish = self.book.wish(seat)?.clone();
                self.book.reconnect(seat, wish);
                self.away.remove(&seat);
                self.believed.get_mut(&seat)?.clear();
            }
            Step::Position { framework, x, y, radius } => {
                let seat = self.seat(framework)?;
                let old = self.book.wish(seat)?.clone();
                let new = wish(&old.namespace, Some((x.into(), y.into())), radius.into());
                self.book.set_wish(seat, Wish { filter: old.filter, ..new });
            }
            Step::Late { framework, which, cpu } => {
                let seat = self.seat(framework)?;
                let lost = self.lost.get(&seat)?;
                let offer = *lost.get(lost.len().checked_sub(1 + usize::from(which))?)?;
                self.accept(seat, &[offer], &[json!({"resources": {"cpu": format!("{cpu}m")}})]);
            }
            Step::Filter { framework, on, cpu, sees, drives, most } => {
                let seat = self.seat(framework)?;
                let mut wish = self.book.wish(seat)?.clone();
                let camera = muster_api::resource::parse_function_list("kinect:ImageGen");
                let on = [NodeChoice::Any, NodeChoice::Robot, NodeChoice::Cloud][on as usize];
                wish.filter = OfferFilter {
                    on,
                    minimum: Compute::new(MilliCpu(cpu.into()), Bytes(0)),
                    sensors: camera.expect("functions").into_iter().filter(|_| sees).collect(),
                    any_actuator: drives,
                    most: most.into(),
                    ..OfferFilter::default()
                };
                self.book.set_wish(seat, wish);
            }
            Step::Remove { framework } => {
                let seat = self.seat(framework)?;
                self.book.remove(seat);
                self.believed.remove(&seat);
                self.asked.retain(|_, asking| *asking != seat);
            }
            Step::Quota { namespace, cpu, leases, weight } => {
                let hard = json!({"cpu": format!("{cpu}m"), "leases": leases});
                let quota = serde_json::from_value(json!({"hard": hard, "weight": weight}));
                let quota = Some(quota.expect("a quota"));
                self.cluster.set_quota(NAMESPACES[namespace as usize], quota);
                self.book.look_at_all();
            }
            Step::Unlimited { namespace } => {
                self.cluster.set_quota(NAMESPACES[namespace as usize], None);
                self.book.look_at_all();
            }
            Step::Declare { namespace, cpu, drive, priority } => {
                let mut spec = json!({"resources": {"cpu": format!("{}m", 10 + cpu)}});
                spec["priority"] = json!(priority);
                // Who makes room ends others: that is another test's.
                spec["preemption"] = json!("Never");
                if drive {
                    spec["resources"]["actuators"] = json!(["base:Drive"]);
                }
                self.declare(NAMESPACES[namespace as usize], &spec);
            }
            Step::Pass { millis } => {
                // Whoever waits is looked at when it is time, not when the next thing happens.
                let until = self.now + Duration::from_millis(millis.into());
                while let Some(next) = self.book.next_deadline().filter(|next| *next < until) {
                    assert!(next > self.now, "{next:?} is over, and would be looked at for ever");
                    self.now = next;
                    self.refresh();
                    self.check();
                }
                self.now = until;
            }
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
        let _ = world.play(Step::Pass { millis: 1000 });
        world.refresh();
        world.check();
        prop_assert_eq!(&world.asked, &BTreeMap::new(), "every Accept gets its verdict");
        for uid in std::mem::take(&mut world.running) {
            prop_assert!(world.cluster.release(&uid).is_some());
        }
        let free = |m: &crate::cluster::Member| m.ledger.used() == &Compute::new(MilliCpu(0), Bytes(0));
        prop_assert!(world.cluster.members().all(|(_, m)| free(m)), "nothing leaks");
    }
}
