mod world;

use muster_api::kind::application::{ApplicationPhase, CutOff, MoveStage, PartClass};
use muster_api::kind::node::MissionLock;
use muster_api::phase::TaskPhase;

use super::{Abort, Action, Ending, News};
use crate::simulation::numbers::Numbers;
use world::{World, task_json};

/// Everything runs, and what is worth more elsewhere is there.
fn settled() -> World {
    let mut world = World::new();
    world.run(6.0);
    assert_eq!(world.mapping(), ["robot", "near", "near"]);
    world
}

#[test]
fn parts_begin_at_home_and_move_to_where_they_are_worth_most() {
    let mut world = World::new();
    world.step();
    assert_eq!(world.mapping(), ["robot", "robot", "robot"]);
    assert_eq!(world.status.phase, ApplicationPhase::Pending);
    world.run(0.5);
    assert_eq!(world.status.phase, ApplicationPhase::Running);
    world.run(6.0);
    assert_eq!(world.mapping(), ["robot", "near", "near"]);
    // One each, and one that stands by for each that is away.
    assert_eq!(world.tasks.len(), 5);
    let amcl = world.part("amcl");
    assert_eq!((amcl.class, amcl.stage), (PartClass::Migratable, Some(MoveStage::Settled)));
    let task = amcl.task.clone().expect("it has a task");
    assert_eq!((&*task.name, &*task.uid, task.number), ("app-amcl-2", "uid-app-amcl-2", 2));
    assert_eq!(task.message, "moves to near, for 1.000 more");
    let away: Vec<_> = world.status.timeline.iter().map(|m| (&*m.part, m.away.len())).collect();
    assert_eq!(away, [("amcl", 2), ("solo", 2)]);
    assert_eq!(world.condition("Ready"), (true, "AllServe", String::new()));
    assert_eq!(world.condition("Degraded").1, "AsItShouldBe");
    // An unchanged world gives the same plan, and one without actions.
    let again = world.decide();
    assert_eq!((again.actions, again.status == world.status), (vec![], true));
}

#[test]
fn the_task_before_is_told_to_end_only_when_the_next_one_is_written_to_serve() {
    let mut world = World::new();
    let mut stages = Vec::new();
    while world.part_stage("amcl") != Some(MoveStage::Breaking) {
        world.step();
        let ends = world.last.as_ref().is_some_and(|plan| {
            plan.actions
                .iter()
                .any(|a| matches!(a, Action::Delete { why: Ending::Moved { .. }, .. }))
        });
        if ends {
            assert_eq!(stages.last(), Some(&Some(MoveStage::Switching)));
        }
        stages.push(world.part_stage("amcl"));
        assert!(stages.len() < 100, "it never moves: {stages:?}");
    }
    stages.dedup();
    let all = [MoveStage::Settled, MoveStage::Making, MoveStage::Switching, MoveStage::Breaking];
    assert_eq!(stages, all.map(Some));
}

#[test]
fn what_is_on_a_node_that_is_drained_comes_home() {
    let mut world = settled();
    world.cordon("near", true);
    world.evict("amcl");
    world.step();
    assert_eq!(world.part_stage("amcl"), Some(MoveStage::Making));
    world.run(2.0);
    assert_eq!(world.mapping(), ["robot", "robot", "robot"]);
    let why = world.part("solo").task.clone().expect("a task").message;
    assert_eq!(why, "comes home: nothing can run on near: it is cordoned");
    // Not before the cool-down is over, and then to the other one.
    world.run(10.0);
    assert_eq!(world.mapping(), ["robot", "far", "far"]);
}

#[test]
fn what_is_on_a_node_that_dies_comes_home_in_time_and_what_may_live_there_is_said() {
    let mut world = settled();
    world.hear("near", false);
    world.run(2.4);
    assert_eq!(world.mapping(), ["robot", "near", "near"], "3 s are tolerated, home takes 0.5 s");
    world.run(0.7);
    assert_eq!(world.mapping(), ["robot", "robot", "near"]);
    assert_eq!(world.part_stage("amcl"), Some(MoveStage::Breaking));
    // Nobody waits for what solo says: it is given up when the cool-down is over.
    world.run(2.5);
    assert_eq!(world.mapping(), ["robot", "robot", "robot"]);
    let (_, reason, message) = world.condition("Degraded");
    assert_eq!(reason, "TaskUnreachable");
    assert_eq!(message, "task app-amcl-2 on near cannot be reached, and may still run there");
    world.hear("near", true);
    world.run(0.5);
    assert_eq!(world.part_stage("amcl"), Some(MoveStage::Settled));
    assert_eq!(world.tasks.len(), 3, "nothing stands by for what is at home");
}

#[test]
fn a_part_whose_task_is_gone_is_begun_again_at_home() {
    let mut world = settled();
    // By itself, away: at once.
    world.fail("amcl");
    world.run(1.0);
    assert_eq!(world.mapping(), ["robot", "robot", "near"]);
    // At home: with a pause, so that what ends at once is not started as fast as the disk writes.
    world.fail("camera");
    world.run(4.0);
    assert_eq!(world.status.phase, ApplicationPhase::Degraded);
    assert_eq!(world.part("camera").message, "its task is Failed: exited with code 7");
    assert_eq!(world.part("camera").attempts, 1);
    world.run(2.0);
    assert_eq!((world.part("camera").attempts, world.part("camera").ready), (2, true));
    assert_eq!(world.status.phase, ApplicationPhase::Running);
}

#[test]
fn a_next_task_that_fails_or_finds_no_room_is_given_up_and_the_one_before_goes_on() {
    let mut world = World::new();
    world.run(0.9);
    while world.part_stage("amcl") != Some(MoveStage::Making) {
        world.step();
    }
    let next = world.part("amcl").other.clone().expect("one is made").name;
    world.fail_task(&next);
    world.step();
    assert_eq!(world.part_stage("amcl"), Some(MoveStage::Settled));
    assert_eq!(world.mapping()[1], "robot");
    let given_up = |news: &News| match news {
        News::Aborted { part, why, .. } => Some((part.clone(), why.to_string())),
        _ => None,
    };
    let said: Vec<_> = world.news.iter().filter_map(given_up).collect();
    let why = "its task crashed: exited with code 7".to_owned();
    assert_eq!(said, [("amcl".to_owned(), why)]);
    world.run(3.0);
    assert_eq!(world.mapping()[1], "robot", "it cools down");
    world.run(4.0);
    assert_eq!(world.mapping()[1], "near");

    let mut world = World::new();
    world.cordon("far", true);
    while world.part_stage("amcl") != Some(MoveStage::Making) {
        world.step();
    }
    world.cordon("near", true);
    world.step();
    assert_eq!(world.part_stage("amcl"), Some(MoveStage::Aborting));
    let scale = |n: &News| matches!(n, News::Aborted { why: Abort::Scale { .. }, .. });
    assert!(world.news.iter().any(scale), "{:?}", world.news);
}

#[test]
fn a_changed_template_is_a_new_task_but_not_while_a_mission_holds_its_node() {
    let mut world = settled();
    let changed = serde_json::from_value(task_json("camera2")).expect("a template");
    world.spec.parts[0].template = changed;
    let lock = MissionLock { holder: "ada".to_owned(), reason: String::new() };
    world.nodes.get_mut("robot").expect("a node").view.lock = Some(lock);
    world.run(2.0);
    assert_eq!(world.part("camera").attempts, 1);
    world.nodes.get_mut("robot").expect("a node").view.lock = None;
    world.run(2.0);
    assert_eq!((world.part("camera").attempts, world.part("camera").ready), (2, true));
}

#[test]
fn a_part_that_is_taken_out_ends_and_is_forgotten() {
    let mut world = settled();
    world.spec.parts.remove(2);
    world.step();
    assert_eq!(world.part("solo").reason, "NoSuchPart");
    world.run(1.0);
    assert_eq!(world.status.parts.len(), 2);
    assert_eq!(world.tasks.len(), 3);
}

#[test]
fn a_refused_task_is_said_and_the_others_go_on() {
    let mut world = World::new();
    world.refused.insert("app-solo-1".to_owned(), "the quota leaves no cpu".to_owned());
    world.run(6.0);
    assert_eq!(world.mapping(), ["robot", "near", "-"]);
    assert_eq!(world.part("solo").message, "the quota leaves no cpu");
    let (degraded, reason, message) = world.condition("Degraded");
    assert_eq!((degraded, reason), (true, "FailedCreate"));
    assert_eq!(message, "part solo: the quota leaves no cpu");
    assert_eq!(world.condition("Ready").2, "not serving: solo");
    world.refused.clear();
    world.run(6.0);
    assert_eq!(world.mapping(), ["robot", "near", "near"]);
}

#[test]
fn while_the_robot_cannot_be_reached_nothing_is_decided_about_its_application() {
    let mut world = settled();
    world.hear("robot", false);
    world.run(4.5);
    assert_eq!(world.mapping(), ["robot", "near", "near"]);
    assert_eq!(world.condition("Degraded").1, "HomeNotReady");
    world.hear("robot", true);
    world.run(1.0);
    assert_eq!(world.mapping(), ["robot", "near", "near"]);
    assert_eq!(world.status.phase, ApplicationPhase::Running);
}

#[test]
fn what_is_away_ends_before_its_robot_cut_off_begins_the_part_by_itself() {
    // Cut off alone, or the server as well, a little later than what the controller can know.
    for server in [None, Some(0.0), Some(3.0), Some(4.9)] {
        let mut world = settled();
        world.hear("robot", false);
        if let Some(later) = server {
            world.run(later);
            world.hear("near", false);
        }
        let before = world.live("amcl");
        assert_eq!(before, ["app-amcl-2"]);
        let mut seen = vec![before];
        for _ in 0..200 {
            world.step();
            seen.push(world.live("amcl"));
        }
        seen.dedup();
        let none: Vec<String> = Vec::new();
        let (first, last) = (vec!["app-amcl-2".to_owned()], vec!["app-amcl-3".to_owned()]);
        assert_eq!(seen, [first, none, last], "{server:?}");
        world.hear("robot", true);
        world.hear("near", true);
        world.step();
        world.step();
        assert_eq!(world.mapping()[1], "robot");
        let serves = world.part("amcl").task.as_ref().map(|task| task.name.as_str());
        assert_eq!(serves, Some("app-amcl-3"), "{server:?}");
        world.run(8.0);
        assert_eq!(world.mapping(), ["robot", "near", "near"]);
    }
}

#[test]
fn what_is_away_ends_at_once_when_nobody_knows_for_how_long_its_robot_has_been_silent() {
    let mut world = settled();
    world.nodes.get_mut("robot").expect("a node").unheard = true;
    world.run(1.0);
    assert_eq!(world.live("amcl"), ["app-amcl-2"], "it counts as there so far");
    world.hear("robot", false);
    world.run(3.5);
    assert_eq!(world.live("amcl"), [""; 0]);
}

#[test]
fn a_robot_that_is_cut_off_begins_in_time_and_what_is_away_ends_when_that_is_known() {
    for server in [None, Some(0.0), Some(4.0)] {
        let mut world = World::new();
        world.spec.parts[1].when_cut_off = CutOff::InTime;
        world.run(6.0);
        assert_eq!(world.mapping(), ["robot", "near", "near"]);
        world.hear("robot", false);
        if let Some(later) = server {
            world.run(later);
            world.hear("near", false);
        }
        world.run(4.8 - server.unwrap_or_default());
        assert_eq!(world.live("amcl"), ["app-amcl-2"], "a controller may be starting again");
        world.run(0.6);
        assert!(world.live("amcl").contains(&"app-amcl-3".to_owned()), "{server:?}");
        if server.is_none() {
            assert_eq!(world.live("amcl"), ["app-amcl-3"]);
        }
        world.run(8.0);
        assert_eq!(world.live("amcl"), ["app-amcl-3"], "{server:?}");
        world.hear("robot", true);
        world.hear("near", true);
        world.run(0.3);
        let serves = world.part("amcl").task.as_ref().map(|task| task.name.as_str());
        assert_eq!(serves, Some("app-amcl-3"), "{server:?}");
        world.run(8.0);
        assert_eq!(world.mapping(), ["robot", "near", "near"]);
    }
}

#[test]
fn what_stands_by_waits_long_enough_for_what_is_away_whatever_became_of_the_spec() {
    let mut world = settled();
    let begins = |world: &World| {
        let standby = world.part("amcl").standby.clone().expect("one stands by").name;
        world.tasks[&standby].standby.expect("it stands by").as_secs()
    };
    assert_eq!(begins(&world), 19);
    // It is patient for longer: the robot waits for longer, and what is away ends as it was told.
    world.spec.connections[0].tolerance = muster_api::duration::Span::from_secs(40);
    world.run(2.0);
    assert_eq!(begins(&world), 39);
    assert_eq!(world.part("amcl").attempts, 4);
    world.hear("robot", false);
    world.run(6.0);
    assert_eq!(world.live("amcl"), [""; 0]);
}

#[test]
fn a_robot_that_is_back_before_it_began_alone_is_told_to_begin() {
    let mut world = settled();
    world.hear("robot", false);
    world.run(6.0);
    assert_eq!(world.live("amcl"), [""; 0]);
    world.hear("robot", true);
    world.run(1.0);
    assert_eq!((world.mapping()[1], world.live("amcl").len()), ("robot", 1));
}

#[test]
fn a_slow_topic_and_a_signal_outside_its_limits_bring_home_what_they_are_about() {
    let mut world = settled();
    world.task_of("amcl").tells = vec![("/image".to_owned(), 5.0), ("turning".to_owned(), 1.0)];
    world.run(4.0);
    assert_eq!(world.status.connections[0].hz, Some(5.0));
    assert_eq!(world.mapping(), ["robot", "near", "near"]);
    world.task_of("amcl").tells = vec![("/image".to_owned(), 1.0)];
    world.run(2.4);
    assert_eq!(world.mapping(), ["robot", "near", "near"]);
    world.run(1.0);
    assert_eq!(world.mapping(), ["robot", "robot", "near"]);
    assert_eq!(world.part("amcl").task.as_ref().expect("a task").reason, "Frequency");

    let mut world = settled();
    world.task_of("solo").tells = vec![("turning".to_owned(), 4.5)];
    world.run(0.5);
    assert_eq!(world.status.signals[0].value, Some(4.5));
    world.run(1.0);
    assert_eq!(world.mapping(), ["robot", "robot", "near"]);
    assert_eq!(world.part("amcl").task.as_ref().expect("a task").reason, "Signal");
}

#[test]
fn measured_cpu_counts_where_none_is_declared_and_noise_is_not_written() {
    let mut world = World::new();
    world.spec.parts[1].cpu = None;
    world.run(0.4);
    assert_eq!(world.mapping()[1], "robot", "nothing is known of it");
    world.run(4.0);
    assert_eq!(world.mapping()[1], "robot");
    world.task_of("amcl").used = Some(0.4);
    world.run(6.0);
    assert_eq!(world.mapping()[1], "near");
    assert_eq!(world.part("amcl").learned["robot"].0, 400);
    world.task_of("amcl").used = Some(0.4);
    world.step();
    world.task_of("amcl").used = Some(0.41);
    world.step();
    assert_eq!(world.part("amcl").learned["near"].0, 400);
}

#[test]
fn a_home_that_is_not_there_or_too_small_is_said() {
    let mut world = World::new();
    world.spec.parts[1].cpu = Some("5".parse().expect("cpu"));
    world.step();
    let (fits, reason, message) = world.condition("FitsHome");
    assert_eq!((fits, reason), (false, "HomeTooSmall"));
    assert_eq!(
        message,
        "all parts together need 5300m cpu, robot has 4 cpu: they could not all come home"
    );
    assert_eq!((&*world.status.mappings, &*world.status.allowed_mappings), ("27", "9"));
    world.nodes.remove("robot");
    let plan = world.decide();
    let fits = plan.conditions.iter().find(|c| c.condition == "FitsHome").expect("it is said");
    assert_eq!((fits.holds, fits.reason), (false, "NoSuchNode"));
}

#[test]
fn scales_are_what_the_spec_names_with_their_worth_room_and_link() {
    let mut world = settled();
    let near = world.nodes.get_mut("near").expect("a node");
    (near.free, near.allocatable) = ((1.0, 1e9), (8.0, 8e9));
    near.link.bandwidth = Some(2e6);
    near.link.round_trip = Some(std::time::Duration::from_millis(30));
    world.task_of("amcl").reserves = (0.5, 5e8);
    world.spec.scales.gains.clear();
    let snapshot = world.snapshot();
    let scales = super::scales::Scales::of(&snapshot, world.now);
    let names: Vec<&str> = scales.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!((names, scales.named), (vec!["robot", "far", "near"], 3));
    let near = &scales.views[2];
    assert_eq!((near.gain, near.cpu, near.memory), (2.0, 1.5, 1.5e9));
    assert_eq!((near.link.bandwidth, near.link.latency, near.link.up), (2e6, 0.015, true));
    assert_eq!(scales.views[1].link.bandwidth, f64::INFINITY, "nobody knows");
    // What is not named any more is left, and nothing comes.
    world.spec.scales.nodes = vec!["far".to_owned()];
    let snapshot = world.snapshot();
    let scales = super::scales::Scales::of(&snapshot, world.now);
    assert_eq!(scales.named, 2);
    let unfit = scales.views[2].unfit.as_deref();
    assert_eq!(unfit, Some("it is none of the application's scales"));
    world.run(4.0);
    assert_eq!(world.mapping(), ["robot", "robot", "robot"]);
}

#[test]
fn over_random_traces_no_part_is_lost_twice_or_moved_to_and_fro() {
    let mut moves = 0;
    for seed in 0..150 {
        let mut numbers = Numbers::new(seed);
        let mut world = World::new();
        if seed % 2 == 0 {
            world.spec.parts[1].when_cut_off = CutOff::InTime;
        }
        for _ in 0..300 {
            world.step();
            match numbers.below(120) {
                0 => world.hear("near", false),
                1 => world.hear("far", false),
                2 => world.hear("robot", false),
                3..=5 => world.hear("near", true),
                6..=8 => world.hear("far", true),
                9..=12 => world.hear("robot", true),
                13 => world.cordon("near", true),
                14 => world.cordon("near", false),
                15 if world.is_there("amcl") => world.evict("amcl"),
                16 if world.is_there("solo") => world.fail("solo"),
                17 if world.is_there("camera") => world.fail("camera"),
                _ => {}
            }
        }
        ["robot", "near", "far"].iter().for_each(|node| world.hear(node, true));
        world.cordon("near", false);
        world.run(20.0);
        assert_eq!(world.mapping(), ["robot", "near", "near"], "seed {seed}");
        assert_eq!(world.tasks.len(), 5, "seed {seed}");
        moves += world.news.iter().filter(|n| matches!(n, News::Moved { .. })).count();
    }
    // Otherwise it would prove nothing.
    assert!(moves > 750, "{moves}");
}

impl World {
    /// Tasks of a part of which something runs.
    fn live(&self, part: &str) -> Vec<String> {
        self.live_of(&format!("app-{part}-"))
    }

    fn part_stage(&self, name: &str) -> Option<MoveStage> {
        self.status.part(name).and_then(|part| part.stage)
    }

    /// The part's task is one that can still end.
    fn is_there(&self, part: &str) -> bool {
        let task = self.status.part(part).and_then(|part| part.task.as_ref());
        let task = task.and_then(|task| self.tasks.get(&task.name));
        task.is_some_and(|task| !task.view.ending && task.view.phase == TaskPhase::Running)
    }
}
