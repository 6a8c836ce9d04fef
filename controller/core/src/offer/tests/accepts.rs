//! Accepts that come late, twice, in vain, or while others are waited for.

use super::*;
use crate::offer::IN_FLIGHT;

fn cpu(millis: u64) -> serde_json::Value {
    json!({"resources": {"cpu": format!("{millis}m")}})
}

fn of(world: &World, seat: Seat, node: &str) -> OfferId {
    let is_it = |slot: &Slot| world.cluster.at(*slot).name.as_str() == node;
    *world.believed[&seat].iter().find(|(_, slot)| is_it(slot)).expect("an offer").0
}

/// Makes the offers of a node be rescinded and made anew.
fn change(world: &mut World, node_name: &str) {
    world.declare(
        "elsewhere",
        &json!({"placement": {"node": node_name}, "resources": {"cpu": "1m"}}),
    );
    world.refresh();
}

/// An Accept on its way is good; the same again, as after a timeout, is not.
#[test]
fn an_offer_that_ended_on_the_way_is_good_once() {
    let mut world = World::new(&[("r1", robot(1000, 1.0))]);
    let seat = world.register(wish("ns", None, 0.0));
    world.refresh();
    let offer = of(&world, seat, "r1");
    change(&mut world, "r1");
    assert_eq!(world.rescinded.last(), Some(&(offer, Rescinded::Changed)));
    world.refuse = Duration::from_secs(30);
    let once = world.accept(seat, &[offer], &[cpu(100)]);
    assert!(world.verdicts[&once].is_ok());
    let again = world.accept(seat, &[offer], &[cpu(100)]);
    assert_eq!(world.verdicts[&again], Err(Denied::OffersGone { offers: vec![offer] }));
    let slot = world.cluster.slot_of("r1").expect("r1");
    world.remember_declined(seat, slot);
    world.refresh();
    world.check();
    assert_eq!(world.offers(seat), [""; 0], "nor is the rest of it offered for so long");
    world.now += Duration::from_secs(30);
    world.refresh();
    assert_eq!(world.offers(seat), ["r1"]);
}

/// An Accept that came in time is good though its offer's time ends while it is gathered.
#[test]
fn an_accept_that_came_in_time_waits_for_its_window() {
    let mut world = World::new(&[("r1", robot(1000, 1.0))]);
    let [one, _] = ["a", "b"].map(|namespace| world.register(wish(namespace, None, 0.0)));
    world.refresh();
    let offer = of(&world, one, "r1");
    change(&mut world, "r1");
    world.now += IN_FLIGHT - Duration::from_millis(1);
    world.refresh();
    let task = world.accept(one, &[offer], &[cpu(100)]);
    assert!(!world.verdicts.contains_key(&task), "b is shown it, too");
    world.now += Duration::from_millis(2);
    world.refresh();
    world.now += GATHER;
    world.refresh();
    assert!(world.verdicts[&task].is_ok(), "{:?}", world.verdicts[&task]);
}

/// Who is refused for what it asks, and not for what others took, has lost no race.
#[test]
fn nobody_is_waited_for_who_asks_for_what_was_not_offered() {
    let mut world = World::new(&[("r1", robot(1000, 1.0)), ("r2", robot(1000, 2.0))]);
    let [rich, poor] = ["rich", "poor"].map(|namespace| world.register(wish(namespace, None, 0.0)));
    world.refresh();
    let settled = |world: &mut World, task: u64| {
        let before = world.now;
        while !world.verdicts.contains_key(&task) {
            world.now = world.book.next_look().expect("it is gathered");
            world.refresh();
        }
        world.now - before
    };
    let drive = json!({"resources": {"cpu": "100m", "actuators": ["base:Drive"]}});
    let task = world.accept(rich, &[of(&world, rich, "r1")], std::slice::from_ref(&drive));
    assert!(settled(&mut world, task) <= GATHER);
    // Its actuators are not shown; there is no such executor; it is no cloud.
    let hopeless = [
        drive,
        json!({"run": {"executor": {"task": "worker"}}}),
        json!({"placement": {"on": "Cloud"}}),
    ];
    for spec in hopeless {
        let offer = of(&world, poor, "r1");
        let refused = world.accept_as_is(poor, &[offer], &[spec]);
        assert!(settled(&mut world, refused) <= GATHER);
        assert!(matches!(world.verdicts[&refused], Err(Denied::Refused { .. })));
        let task = world.accept(rich, &[of(&world, rich, "r1")], &[cpu(10)]);
        assert!(settled(&mut world, task) <= GATHER, "nobody is waited for");
    }
}

/// The poorest does not wait with the richest for somebody between them.
#[test]
fn an_accept_waits_only_for_who_has_less() {
    let names = ["r1", "r2", "r3", "big"];
    let sizes = [1000, 1000, 1000, 7000];
    let nodes: Vec<(&str, Node)> =
        names.iter().zip(sizes).map(|(n, cpu)| (*n, robot(cpu, 0.0))).collect();
    let mut world = World::new(&nodes);
    let [least, between, most] = ["least", "between", "most"].map(|namespace| {
        let seat = world.register(wish(namespace, None, 0.0));
        (namespace, seat)
    });
    for ((namespace, _), share) in [(least, 500), (between, 1000), (most, 3000)] {
        let spec = json!({"placement": {"node": "big"}, "resources": {"cpu": format!("{share}m")}});
        world.declare(namespace, &spec);
    }
    world.refresh();
    // `between` loses a race.
    let [a, b] = [most, between].map(|(_, seat)| of(&world, seat, "r1"));
    let fast = world.accept(most.1, &[a], &[cpu(1000)]);
    world.now += GATHER;
    world.refresh();
    let slow = world.accept(between.1, &[b], &[cpu(1000)]);
    world.now += GATHER;
    world.refresh();
    assert!(world.verdicts[&fast].is_ok() && world.verdicts[&slow].is_err());
    // `least` and `most` want both of the others, and `between` is shown them.
    let poor = world.accept(least.1, &[of(&world, least.1, "r2")], &[cpu(1000)]);
    let offers = [of(&world, most.1, "r2"), of(&world, most.1, "r3")];
    let rich = world.accept(most.1, &offers, &[cpu(100), cpu(100)]);
    world.now += GATHER;
    world.refresh();
    assert!(world.verdicts.get(&poor).is_some_and(Result::is_ok), "who has more is not waited for");
    assert!(!world.verdicts.contains_key(&rich), "who has less is");
    world.now += COURTESY - GATHER;
    world.refresh();
    assert!(world.verdicts.contains_key(&rich));
}

/// An Accept of something else is an answer, too.
#[test]
fn who_accepts_anything_is_not_waited_for() {
    let mut world = World::new(&[("r1", robot(1000, 1.0)), ("r2", robot(1000, 2.0))]);
    let [rich, poor] = ["rich", "poor"].map(|namespace| world.register(wish(namespace, None, 0.0)));
    world.refresh();
    let late = of(&world, poor, "r1");
    let fast = world.accept(rich, &[of(&world, rich, "r1")], &[cpu(1000)]);
    world.now += GATHER;
    world.refresh();
    let lost = world.accept(poor, &[late], &[cpu(1000)]);
    world.now += GATHER;
    world.refresh();
    assert!(world.verdicts[&fast].is_ok() && world.verdicts[&lost].is_err());
    let task = world.accept(rich, &[of(&world, rich, "r2")], &[cpu(10)]);
    world.now += GATHER;
    world.refresh();
    assert!(!world.verdicts.contains_key(&task), "it lost, and is waited for");
    // Launches nothing: only an answer.
    world.accept(poor, &[of(&world, poor, "r1")], &[]);
    world.refresh();
    assert!(world.verdicts[&task].is_ok());
}
