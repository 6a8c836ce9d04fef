//! What is shown to whom: filters, costs, limits, and what was declined.

use std::collections::BTreeMap as Map;

use muster_api::kind::framework::OfferFilter;
use muster_api::kind::node::NodeKind::{Cloud, Robot};
use muster_api::kind::task::{Cost, NodeChoice};
use muster_api::selector::LabelSelector;

use super::*;

fn fleet() -> World {
    let labelled = |mut node: Node, lab: &str| {
        node.metadata.labels = Some([("lab".to_owned(), lab.to_owned())].into());
        node
    };
    let mut blind = robot(1000, 1.0);
    let mut strong = node(Cloud, 8000, None);
    if let Some(status) = &mut blind.status {
        (status.sensors, status.actuators) = (Vec::new(), Vec::new());
    }
    if let Some(status) = &mut strong.status {
        status.allocatable.extended.insert("gpu".to_owned(), 2);
        status.allocatable.memory = Bytes(16 << 30);
    }
    World::new(&[
        ("blind", labelled(blind, "east")),
        ("sees", labelled(robot(500, 2.0), "west")),
        ("strong", labelled(strong, "west")),
        ("weak", node(Cloud, 200, None)),
    ])
}

/// Every part of a filter leaves out what lacks it, and nothing else, at run time as at first.
#[test]
fn each_part_of_a_filter_is_what_it_says() {
    let mut world = fleet();
    let seat = world.register(wish("ns", None, 0.0));
    let functions = |text| {
        let functions = muster_api::resource::parse_function_list(text).expect("functions");
        functions.into_iter().collect::<Vec<_>>()
    };
    let memory = |bytes| Compute::new(MilliCpu(0), Bytes(bytes));
    let gpu = |count| Compute { extended: [("gpu".to_owned(), count)].into(), ..memory(0) };
    let plain = || wish("ns", None, 0.0).filter;
    let selector = |key: &str, value: &str| LabelSelector {
        match_labels: Map::from([(key.to_owned(), value.to_owned())]),
        ..LabelSelector::default()
    };
    let cases = [
        (plain(), vec!["blind", "sees", "strong", "weak"]),
        (OfferFilter { on: NodeChoice::Cloud, ..plain() }, vec!["strong", "weak"]),
        (OfferFilter { on: NodeChoice::Robot, ..plain() }, vec!["blind", "sees"]),
        (OfferFilter { selector: selector("lab", "west"), ..plain() }, vec!["sees", "strong"]),
        (OfferFilter { sensors: functions("kinect:ImageGen"), ..plain() }, vec!["sees"]),
        (OfferFilter { sensors: functions("sonar:Range"), ..plain() }, vec![]),
        (OfferFilter { actuators: functions("arm:Grasp"), ..plain() }, vec!["sees"]),
        (OfferFilter { any_actuator: true, ..plain() }, vec!["sees"]),
        (
            OfferFilter { minimum: Compute::new(MilliCpu(600), Bytes(0)), ..plain() },
            vec!["blind", "strong"],
        ),
        (OfferFilter { minimum: memory(2 << 30), ..plain() }, vec!["strong"]),
        (OfferFilter { minimum: gpu(2), ..plain() }, vec!["strong"]),
        (OfferFilter { minimum: gpu(3), ..plain() }, vec![]),
    ];
    for (filter, expected) in cases {
        let what = format!("{filter:?}");
        world.book.set_wish(seat, Wish { filter: filter.clone(), ..wish("ns", None, 0.0) });
        world.refresh();
        world.check();
        let mut offered = world.offers(seat);
        offered.sort_unstable();
        assert_eq!(offered, expected, "{what}");
        let first = world.register(Wish { filter, ..wish("ns", None, 0.0) });
        world.refresh();
        let mut offered = world.offers(first);
        offered.sort_unstable();
        assert_eq!(offered, expected, "from the first: {what}");
        world.book.remove(first);
        world.believed.remove(&first);
    }
}

/// Seconds, not metres: a fast robot that is farther away comes first, one without a speed not at all.
#[test]
fn travel_time_offers_the_one_that_is_there_first() {
    let with = |x: f64, speed: Option<f64>| {
        let mut node = robot(1000, x);
        node.spec.speed = speed;
        node
    };
    let mut world = World::new(&[
        ("slow", with(4.0, Some(0.5))),
        ("fast", with(9.0, Some(3.0))),
        ("parked", with(1.0, None)),
        ("cloud", node(Cloud, 1000, None)),
    ]);
    let mut wants = wish("ns", Some((0.0, 0.0)), 10.0);
    wants.cost = Cost::TravelTime;
    let seat = world.register(wants.clone());
    world.refresh();
    world.check();
    assert_eq!(world.offers(seat), ["fast", "slow", "cloud"]);
    let scores: Map<&str, Option<f64>> = world
        .book
        .offers_of(seat)
        .map(|offer| (world.cluster.at(offer.slot).name.as_str(), offer.score))
        .collect();
    assert_eq!(scores["fast"], Some(3.0), "seconds");
    assert_eq!(scores["slow"], Some(8.0));
    assert_eq!(scores["cloud"], None);
    let why = world.book.explain(&world.cluster, seat, world.now);
    assert_eq!(why, [(name("parked"), NotOffered::Refusal(Refusal::NoSpeed))]);

    // The radius is in metres all the same, and one robot at a time is the fastest one.
    wants.filter.most = 1;
    world.book.set_wish(seat, wants.clone());
    world.refresh();
    assert_eq!(world.offers(seat), ["fast", "cloud"]);
    world.book.set_wish(seat, Wish { radius: 5.0, ..wants });
    world.refresh();
    world.check();
    let mut offered = world.offers(seat);
    offered.sort_unstable();
    assert_eq!(offered, ["cloud", "slow"]);
}

/// Without a position there is no score, and what is too many goes all the same.
#[test]
fn fewer_at_once_are_fewer_also_without_a_position() {
    for kind in [Robot, Cloud] {
        let nodes: Vec<(String, Node)> =
            (0..5).map(|i| (format!("n{i}"), node(kind, 1000 + i, None))).collect();
        let nodes: Vec<(&str, Node)> =
            nodes.iter().map(|(name, node)| (name.as_str(), node.clone())).collect();
        let mut world = World::new(&nodes);
        let mut wants = wish("ns", None, 0.0);
        wants.filter.most = 5;
        let seat = world.register(wants.clone());
        world.refresh();
        assert_eq!(world.offers(seat).len(), 5);
        wants.filter.most = 1;
        world.book.set_wish(seat, wants);
        world.refresh();
        world.check();
        assert_eq!(world.offers(seat), ["n4"], "the one with the most left");
    }
}

/// A node that has gained since it was declined, and is not among the closest, is not called declined.
#[test]
fn what_was_declined_and_has_gained_is_only_farther_away() {
    let mut world = World::new(&[("near", robot(1000, 1.0)), ("far", robot(1000, 9.0))]);
    let mut wants = wish("ns", Some((0.0, 0.0)), 20.0);
    wants.filter.most = 1;
    let seat = world.register(wants);
    world.refresh();
    let why = |world: &World| {
        let all = world.book.explain(&world.cluster, seat, world.now);
        all.into_iter().find(|(node, _)| node.as_str() == "near").map(|(_, why)| why)
    };
    let offer = *world.believed[&seat].keys().next().expect("near");
    world.decline(seat, offer, 1000);
    world.refresh();
    world.check();
    assert_eq!(world.offers(seat), ["far"]);
    assert!(matches!(why(&world), Some(NotOffered::Declined { .. })));
    // More of it, and away from there: `far` keeps its place.
    world.cluster.upsert_node(&name("near"), &robot(2000, 15.0));
    world.refresh();
    world.check();
    assert_eq!(world.offers(seat), ["far"]);
    assert_eq!(why(&world), Some(NotOffered::NotAmongTheClosest { limit: 1 }));
}

/// A cluster that is made anew forgets no decline, but for what is another node now.
#[test]
fn what_is_declined_outlasts_the_cluster() {
    let mut world = World::new(&[("r1", robot(1000, 1.0)), ("r2", robot(1000, 2.0))]);
    let seat = world.register(wish("ns", None, 0.0));
    world.refresh();
    for offer in world.believed[&seat].keys().copied().collect::<Vec<_>>() {
        world.decline(seat, offer, 40);
    }
    world.refresh();
    // r2 is another robot by now, and they come in another order.
    let next =
        World::new(&[("r0", robot(1000, 0.0)), ("r2", robot(3000, 2.0)), ("r1", robot(1000, 5.0))]);
    let before = std::mem::replace(&mut world.cluster, next.cluster);
    let old = std::mem::replace(&mut world.book, next.book);
    let anew = world.book.register(wish("ns", None, 0.0));
    world.book.refuse_still(&world.cluster, anew, old.refusals(&before, seat));
    world.believed = [(anew, Map::new())].into();
    world.ever_offered.clear();
    world.refresh();
    let mut offered = world.offers(anew);
    offered.sort_unstable();
    assert_eq!(offered, ["r0", "r2"]);
    world.now += Duration::from_secs(40);
    world.refresh();
    assert_eq!(world.offers(anew).len(), 3, "for as long as was said");
}
