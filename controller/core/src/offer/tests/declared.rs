//! Frameworks beside declared tasks: who has less is not passed by, and nobody waits for longer than it says.

use super::*;
use crate::offer::courtesy::SILENT_FOR;

/// One robot, a framework of `lab` and declared tasks of `batch`, all of which want to drive.
struct Hall {
    world: World,
    lab: Seat,
}

fn drive() -> serde_json::Value {
    json!({"resources": {"actuators": ["base:Drive"]}})
}

impl Hall {
    /// `batch` drives, and has more that waits.
    fn new() -> Self {
        let mut world = World::new(&[("r1", robot(1000, 0.0))]);
        let mut wants = wish("lab", None, 0.0);
        wants.filter.any_actuator = true;
        let lab = world.register(wants);
        for _ in 0..9 {
            world.declare("batch", &drive());
        }
        world.refresh();
        let mut hall = Hall { world, lab };
        assert_eq!(hall.driver(), "batch", "nobody has anything: who is there first");
        hall.world.now += Duration::from_secs(1);
        hall
    }

    fn driver(&self) -> &'static str {
        let reservation = self.world.cluster.at(0).ledger.reservations().next();
        match reservation.map(|(_, r)| namespace_of(&r.title).to_owned()).as_deref() {
            None => "nobody",
            Some("lab") => "lab",
            Some(_) => "batch",
        }
    }

    /// The present driver ends.
    fn release(&mut self) {
        let ended = self.world.running.pop().expect("somebody drives");
        assert!(self.world.cluster.release(&ended).is_some());
        self.world.refresh();
        self.world.check();
    }

    fn pass(&mut self, after: Duration) {
        self.world.now += after;
        self.world.refresh();
        self.world.check();
    }

    fn offer(&self) -> OfferId {
        *self.world.believed[&self.lab].keys().next().expect("it is offered the robot")
    }
}

const MOMENT: Duration = Duration::from_millis(1);

#[test]
fn a_freed_robot_is_left_for_a_moment_to_a_framework_that_was_served_less() {
    let mut hall = Hall::new();
    hall.release();
    assert_eq!(hall.driver(), "nobody", "it is left");
    let why = explain(&hall.world.cluster, &hall.world.waiting[0]);
    assert!(matches!(&why[0].1, Refusal::Left { namespace } if namespace == "lab"), "{why:?}");
    hall.pass(Duration::from_millis(80));
    let task = hall.world.accept(hall.lab, &[hall.offer()], &[drive()]);
    assert!(hall.world.verdicts[&task].is_ok(), "nobody else is shown it: at once");
    hall.pass(MOMENT);
    assert_eq!(hall.driver(), "lab");

    // Both were served once: batch waits for longer, and is not asked to wait.
    hall.release();
    assert_eq!(hall.driver(), "batch");
}

#[test]
fn what_is_left_is_taken_at_once_when_it_is_declined_or_refused() {
    let mut hall = Hall::new();
    hall.release();
    hall.pass(MOMENT);
    let (lab, offer) = (hall.lab, hall.offer());
    hall.world.decline(lab, offer, 0);
    hall.pass(MOMENT);
    assert_eq!(hall.driver(), "batch");

    hall.pass(Duration::from_secs(1));
    hall.release();
    assert_eq!(hall.driver(), "nobody", "it is freed again, and left again");
    let hopeless = json!({"resources": {"cpu": "64"}});
    let task = hall.world.accept(hall.lab, &[hall.offer()], &[hopeless]);
    assert!(matches!(hall.world.verdicts[&task], Err(Denied::Exceeds { .. })));
    hall.pass(MOMENT);
    assert_eq!(hall.driver(), "batch", "it had its turn");
}

#[test]
fn who_says_nothing_is_waited_for_once_in_a_while() {
    let mut hall = Hall::new();
    hall.release();
    hall.pass(COURTESY - MOMENT);
    assert_eq!(hall.driver(), "nobody");
    hall.pass(MOMENT);
    assert_eq!(hall.driver(), "batch", "nobody waits longer");
    hall.pass(GATHER);
    for _ in 0..2 {
        hall.pass(Duration::from_secs(1));
        hall.release();
        assert_eq!(hall.driver(), "batch", "it is silent");
    }
    hall.pass(SILENT_FOR);
    hall.release();
    assert_eq!(hall.driver(), "nobody", "it may have work by now");
    let task = hall.world.accept(hall.lab, &[hall.offer()], &[drive()]);
    assert!(hall.world.verdicts[&task].is_ok());
}

#[test]
fn nothing_is_left_to_who_could_not_take_it() {
    for case in ["away", "suppressed", "elsewhere", "declined", "over its quota"] {
        let mut hall = Hall::new();
        let (book, lab) = (&mut hall.world.book, hall.lab);
        match case {
            "away" => {
                book.disconnect(lab);
                hall.world.away.insert(lab);
            }
            "suppressed" => book.suppress(lab),
            "elsewhere" => {
                let mut elsewhere = wish("lab", Some((50.0, 0.0)), 5.0);
                elsewhere.filter.any_actuator = true;
                book.set_wish(lab, elsewhere);
            }
            "declined" => {
                hall.release();
                let offer = hall.offer();
                hall.world.decline(lab, offer, 1000);
                hall.pass(MOMENT);
                assert_eq!(hall.driver(), "batch");
                hall.pass(Duration::from_secs(1));
            }
            _ => {
                let hard = serde_json::from_value(json!({"hard": {"leases": 0}}));
                hall.world.cluster.set_quota("lab", Some(hard.expect("a quota")));
                hall.world.book.look_at_all();
            }
        }
        hall.release();
        assert_eq!(hall.driver(), "batch", "{case}");
    }
}

#[test]
fn priorities_come_before_shares() {
    let mut hall = Hall::new();
    let mut urgent = drive();
    urgent["priority"] = json!(1);
    hall.world.waiting.clear();
    hall.world.declare("batch", &urgent);
    hall.release();
    assert_eq!(hall.driver(), "batch", "it leaves nothing");
}

/// Who has most does not get what the second leaves to the third.
#[test]
fn an_accept_does_not_pass_by_who_waits_with_less() {
    let mut world = World::new(&[("r1", robot(1000, 0.0)), ("r2", robot(4000, 9.0))]);
    let seats = ["least", "most"].map(|namespace| world.register(wish(namespace, None, 0.0)));
    world.refresh();
    let reserve = |world: &mut World, namespace: &str, cpu: &str| {
        let pinned = json!({"placement": {"node": "r2"}, "resources": {"cpu": cpu}});
        world.declare(namespace, &pinned);
        world.refresh();
    };
    reserve(&mut world, "most", "2");
    reserve(&mut world, "middle", "1");
    let whole = json!({"placement": {"node": "r1"}, "resources": {"cpu": "1"}});
    let first = world.declare("other", &whole);
    world.refresh();
    let claims = world.declare("middle", &whole);
    world.refresh();
    world.now += Duration::from_secs(1);
    world.cluster.release(&first);
    world.refresh();
    let of_r1 = |world: &World, seat: Seat| {
        let offers = &world.believed[&seat];
        *offers.iter().find(|(_, slot)| **slot == 0).expect("an offer of r1").0
    };
    let cpu = json!({"resources": {"cpu": "1"}});
    let rich = world.accept(seats[1], &[of_r1(&world, seats[1])], &[cpu]);
    for _ in 0..3 {
        world.now += GATHER;
        world.refresh();
        assert!(!world.verdicts.contains_key(&rich), "middle waits for least, and most for middle");
    }
    let offer = of_r1(&world, seats[0]);
    world.decline(seats[0], offer, 1);
    world.refresh();
    assert!(world.running.contains(&claims), "it has less than who accepted first");
    assert!(matches!(world.verdicts[&rich], Err(Denied::Refused { .. })));
}

/// Which part of all that each had over time, in a race with queues of declared tasks.
fn parts(
    race: &mut Race,
    namespaces: &[&'static str],
    rounds: usize,
) -> BTreeMap<&'static str, f64> {
    let mut held: BTreeMap<&str, f64> = BTreeMap::new();
    race.run(None);
    for round in 0..rounds {
        let i = round * 7919 % race.world.running.len();
        let ended = race.world.running.swap_remove(i);
        race.world.cluster.release(&ended);
        race.world.now += Duration::from_secs(1);
        race.run(None);
        if round >= rounds / 3 {
            for namespace in namespaces {
                let account = race.world.cluster.accounts().account(namespace);
                *held.entry(namespace).or_default() += account.tasks as f64;
            }
        }
    }
    race.world.check();
    let all: f64 = held.values().sum();
    held.into_iter().map(|(namespace, has)| (namespace, has / all)).collect()
}

const USERS: [(&str, f64); 5] =
    [("near", 1.0), ("far", 2.0), ("farther", 4.0), ("batch", 1.0), ("night", 2.0)];

/// Frameworks near and far and queues of declared tasks that never end: each has what its weight is worth, by cpu and by robots'
/// leases. What a task waits is checked in every pass.
#[test]
fn shares_converge_to_the_weights_of_frameworks_and_of_declared_tasks() {
    for wants in [json!({"cpu": "500m"}), json!({"actuators": ["base:Drive"]})] {
        let mut race = Race::new(&[("near", 1.0, 0), ("far", 2.0, 30), ("farther", 4.0, 80)]);
        race.want(&wants);
        for i in 0..30 {
            race.world.cluster.upsert_node(&name(&format!("more-{i}")), &robot(500, 0.0));
        }
        for (namespace, weight) in [("batch", 1.0), ("night", 2.0)] {
            let quota = QuotaSpec { weight, ..QuotaSpec::default() };
            race.world.cluster.set_quota(namespace, Some(quota));
            race.queue(namespace);
        }
        let parts = parts(&mut race, &USERS.map(|(namespace, _)| namespace), 600);
        for (namespace, weight) in USERS {
            let (part, fair) = (parts[namespace], weight / 10.0);
            assert!(
                (part / fair - 1.0).abs() <= 0.03,
                "{namespace} has {part:.3}, fair is {fair:.3} of {wants}"
            );
        }
    }
}

/// One robot, and a namespace whose declared tasks always want it: how often each has it follows the weights, too.
#[test]
fn turns_at_one_robot_follow_the_weights() {
    let mut race = Race::with(1, &[("lab", 3.0, 30)]);
    race.want(&drive()["resources"]);
    race.queue("batch");
    race.run(None);
    let mut turns: BTreeMap<String, u32> = BTreeMap::new();
    for _ in 0..400 {
        let reservation = race.world.cluster.at(0).ledger.reservations().next();
        let title = &reservation.expect("somebody always drives").1.title;
        *turns.entry(namespace_of(title).to_owned()).or_default() += 1;
        let ended = race.world.running.pop().expect("it drives");
        race.world.cluster.release(&ended);
        race.world.now += Duration::from_secs(1);
        race.run(None);
    }
    assert!((290..=310).contains(&turns["lab"]), "{turns:?}");
}

/// A framework that freezes holds declared tasks up for a moment, once in a while.
#[test]
fn who_freezes_holds_declared_tasks_up_for_a_moment() {
    let mut race = Race::with(4, &[("lab", 4.0, 30)]);
    race.queue("batch");
    race.run(None);
    let mut waited = Vec::new();
    for _ in 0..60 {
        let ended = race.world.running.remove(0);
        race.world.cluster.release(&ended);
        race.world.now += Duration::from_millis(100);
        let before = race.world.now;
        race.run(Some("lab"));
        waited.push(race.world.now - before);
    }
    assert!(waited.iter().all(|wait| *wait <= COURTESY + GATHER), "{waited:?}");
    let long = waited.iter().filter(|wait| **wait >= COURTESY).count();
    assert!((1..=2).contains(&long), "6 s pass: {long} of {waited:?}");
    assert!(race.has("batch") > 0.0);
}
