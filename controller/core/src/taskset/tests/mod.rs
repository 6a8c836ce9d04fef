//! The rules one by one.

mod images;
mod model;
mod world;

use std::time::Duration;

use muster_api::condition::ConditionStatus;
use muster_api::phase::TaskPhase;
use serde_json::json;

use super::health::{Health, health};
use super::view::Claim;
use super::{Action, Ending, NewTask, Place};
use world::World;

fn created(world: &World) -> Vec<&str> {
    let name = |a: &'_ Action| match a {
        Action::Create(NewTask { name, .. }) => Some(name.clone()),
        _ => None,
    };
    let names: Vec<String> = world.actions.iter().filter_map(name).collect();
    world.tasks.iter().map(|t| t.name.as_str()).filter(|n| names.iter().any(|m| m == n)).collect()
}

/// A set of three that runs template 0 on five robots, and nothing done yet.
fn three() -> World {
    three_with(json!({}))
}

fn three_with(rollout: serde_json::Value) -> World {
    let mut world = World::new(json!({"replicas": 3, "rollout": rollout}), 5);
    world.settle();
    assert_eq!(world.templates(), ["0", "0", "0"]);
    assert_eq!(world.status.current_revision, world.status.update_revision);
    world.actions.clear();
    world
}

#[test]
fn a_new_set_is_filled_once_and_counted() {
    let mut world = World::new(json!({"replicas": 3}), 5);
    let actions = world.settle();
    assert_eq!(actions, 4, "a revision and three tasks: {:?}", world.actions);
    assert_eq!(created(&world), ["set-0", "set-1", "set-2"]);
    let status = &world.status;
    assert_eq!((status.desired_replicas, status.replicas, status.available_replicas), (3, 3, 3));
    assert_eq!(world.progressing().0, "Complete");
}

#[test]
fn fewer_replicas_end_what_serves_least_and_more_fill_the_gaps() {
    let mut world = three();
    world.task("set-1").score = Some(9.0);
    world.task("set-0").score = Some(2.0);
    world.task("set-2").score = Some(3.0);
    world.spec.replicas = Some(2);
    world.decide();
    assert_eq!(
        world.actions,
        [Action::Delete { task: "set-1".to_owned(), why: Ending::TooMany }],
        "the farthest"
    );
    world.spec.replicas = Some(3);
    assert_eq!(world.decide(), 0, "the one that ends has its place until it is gone");
    world.settle();
    assert_eq!(created(&world), ["set-1"]);
}

#[test]
fn every_node_that_matches_has_one_as_it_joins_and_none_when_it_no_longer_does() {
    let mut world = World::new(json!({"everyNode": true}), 2);
    world.spec.template.spec.placement.on = muster_api::kind::task::NodeChoice::Robot;
    world.settle();
    assert_eq!(created(&world), ["set-r0", "set-r1"]);
    world.join("r2");
    world.settle();
    assert_eq!(world.task("set-r2").pin.as_deref(), Some("r2"));
    world.node("r0").facts.kind = muster_api::kind::node::NodeKind::Cloud;
    world.settle();
    let names: Vec<&str> = world.tasks.iter().map(|t| t.name.as_str()).collect();
    assert_eq!(names, ["set-r1", "set-r2"]);
    assert_eq!(world.status.desired_replicas, 2);
}

#[test]
fn the_others_follow_when_the_canary_is_available_each_on_its_robot() {
    let mut world = three();
    let before: Vec<_> = world.tasks.iter().map(|t| (t.name.clone(), t.node.clone())).collect();
    world.set_template(1);
    world.decide();
    assert_eq!(world.status.replacing.len(), 1, "one robot first");
    let mut seen = Vec::new();
    while world.templates() != ["1", "1", "1"] {
        world.step();
        let new = world.templates().iter().filter(|t| *t == "1").count();
        let available = world.tasks.iter().filter(|t| world.is_available(t)).count();
        assert!(available >= 2, "one may be down");
        seen.push((new, world.progressing().0));
    }
    assert!(seen.contains(&(1, "Canary")), "{seen:?}");
    world.settle();
    let after: Vec<_> = world.tasks.iter().map(|t| (t.name.clone(), t.node.clone())).collect();
    assert_eq!(before, after);
    assert_eq!(world.status.current_revision, world.status.update_revision);
    assert_eq!(world.status.replacing, []);
}

#[test]
fn a_canary_that_crashes_brings_the_old_template_back_and_the_others_stay() {
    let mut world = three();
    let good = world.status.current_revision.clone();
    world.set_template(2);
    let actions = world.settle();
    assert_eq!(world.templates(), ["0", "0", "0"]);
    // Only the canary's place was touched: revision, its end, its successor's beginning and end, and back.
    assert_eq!(actions, 5, "{:?}", world.actions);
    let back = world.status.rolled_back_from.clone().expect("given up");
    assert_eq!((back.reason.as_str(), &back.to), ("Crashed", &good));
    assert_eq!(world.status.current_revision, good);
    let (reason, message) = world.progressing();
    assert_eq!(reason, "RolledBack");
    assert!(message.contains("set-0 crashed: exited with code 1"), "{message}");
    assert_eq!(world.last.as_ref().expect("decided").conditions[1].status, ConditionStatus::False);
    // The same once more is the same wish; another one is tried.
    world.generation += 1;
    assert_eq!(world.settle(), 0);
    world.set_template(1);
    world.settle();
    assert_eq!(world.templates(), ["1", "1", "1"]);
    assert_eq!(world.status.rolled_back_from, None);
}

#[test]
fn without_auto_rollback_a_failed_canary_is_as_far_as_it_goes() {
    let mut world = three_with(json!({"autoRollback": false}));
    world.set_template(2);
    world.settle();
    assert_eq!(world.templates(), ["2", "0", "0"]);
    assert_eq!(world.progressing().0, "Crashed");
}

#[test]
fn a_probe_that_never_says_ready_ends_the_rollout_at_the_deadline() {
    let mut world = three_with(json!({"progressDeadlineSeconds": 30}));
    world.set_template(1);
    world.steps(4);
    world.task("set-0").ready = Some(false);
    "its readiness probe failed: HTTP status 503".clone_into(&mut world.task("set-0").message);
    world.steps(4);
    assert_eq!(world.templates(), ["1", "0", "0"], "it has time");
    world.settle();
    assert_eq!(world.templates(), ["0", "0", "0"]);
    let why = world.status.rolled_back_from.as_ref().expect("given up");
    assert_eq!(why.reason, "ProbeFailed");
    let said = "was not ready within 30 s: its readiness probe failed: HTTP status 503";
    assert!(why.message.ends_with(said), "{}", why.message);
}

#[test]
fn a_task_is_available_when_it_has_been_ready_for_long_enough() {
    let mut world = three();
    let (now, min_ready) = (world.now, Duration::from_secs(5));
    let ago = |seconds| now - jiff::SignedDuration::from_secs(seconds);
    let task = world.task("set-0");
    task.started = Some(ago(100));
    assert_eq!(health(task, min_ready, now), Health::Available, "it has no probe");
    (task.ready, task.ready_since) = (Some(true), Some(ago(3)));
    let available_at = now + jiff::SignedDuration::from_secs(2);
    assert_eq!(health(task, min_ready, now), Health::Ready { available_at });
    assert_eq!(health(task, Duration::ZERO, now), Health::Available);
    task.ready_since = Some(ago(5));
    assert_eq!(health(task, min_ready, now), Health::Available);
    task.ready = Some(false);
    assert_eq!(health(task, Duration::ZERO, now), Health::NotReady);
}

#[test]
fn going_back_by_hand_is_a_rollout_of_the_old_revision() {
    let mut world = three();
    world.set_template(1);
    world.settle();
    world.set_template(0);
    world.settle();
    assert_eq!(world.templates(), ["0", "0", "0"]);
    let mut numbers: Vec<u64> = world.revisions.iter().map(|r| r.number).collect();
    numbers.sort_unstable();
    assert_eq!(numbers, [2, 3], "the old one is the newest wish");
}

#[test]
fn a_robot_on_a_mission_keeps_its_task_until_it_is_released() {
    let mut world = three();
    let node = world.task("set-0").node.clone().expect("placed");
    world.lock(&node, true);
    world.set_template(1);
    world.settle();
    assert_eq!(world.templates(), ["0", "1", "1"]);
    let held = world.status.held.clone();
    assert_eq!(held.len(), 1);
    assert_eq!((&held[0].node, held[0].holder.as_str()), (&node, "ada"));
    let (reason, message) = world.progressing();
    assert_eq!(reason, "MissionLock");
    assert!(message.contains("ada (carries a tray)"), "{message}");
    world.spec.replicas = Some(0);
    world.settle();
    assert_eq!(world.templates(), ["0"], "nor is it ended for a number");
    world.spec.replicas = Some(3);
    world.settle();
    world.lock(&node, false);
    world.settle();
    assert_eq!(world.templates(), ["1", "1", "1"]);
    assert_eq!(world.status.held, []);
}

#[test]
fn a_task_that_nobody_can_see_is_waited_for_or_replaced_as_the_set_says() {
    let mut world = three();
    let node = world.task("set-1").node.clone().expect("placed");
    world.lose(&node);
    world.steps(40);
    assert_eq!(world.actions, [], "it may run");
    world.find(&node);
    world.settle();

    world.spec.on_unreachable.policy = muster_api::kind::taskset::UnreachablePolicy::Replace;
    world.task("set-1").stop_after = Some(std::time::Duration::from_secs(60));
    world.lose(&node);
    world.steps(30);
    assert_eq!(world.actions, [], "it may still run");
    world.settle();
    assert_eq!(created(&world), ["set-3"], "beside it");
    world.find(&node);
    world.settle();
    assert_eq!(world.templates().len(), 3, "and one too many goes");
}

#[test]
fn a_lost_robot_is_no_reason_to_go_back() {
    let mut world = three_with(json!({"progressDeadlineSeconds": 20, "maxUnavailable": 2}));
    world.set_template(1);
    while !world
        .tasks
        .iter()
        .any(|t| t.phase == TaskPhase::Running && t.attempt == 1 && t.prefer.is_some())
    {
        world.step();
    }
    let node = world.task("set-0").node.clone().expect("placed");
    world.lose(&node);
    world.settle();
    assert_eq!(world.status.rolled_back_from, None);
    assert_eq!(world.templates(), ["1", "1", "1"], "another robot was the canary");
}

#[test]
fn paused_changes_nothing_and_still_counts() {
    let mut world = three_with(json!({"paused": true}));
    world.set_template(1);
    world.spec.replicas = Some(4);
    world.settle();
    assert_eq!(world.templates(), ["0", "0", "0", "0"], "the new one is of the good template");
    assert_eq!(world.progressing().0, "Paused");
    world.spec.rollout.paused = false;
    world.settle();
    assert_eq!(world.templates(), ["1", "1", "1", "1"]);
}

#[test]
fn a_task_of_nobody_is_taken_in_and_one_that_changed_its_labels_let_go() {
    let mut world = three();
    let stray = NewTask {
        name: "stray".to_owned(),
        revision: String::new(),
        place: Place::Anywhere,
        follows: false,
    };
    let mut stray = world.new_task(&stray);
    stray.claim = Claim::Nobodys;
    world.tasks.push(stray);
    world.task("set-2").claim = Claim::NoLongerMine;
    world.decide();
    assert_eq!(
        world.actions,
        [Action::Release { task: "set-2".to_owned() }, Action::Adopt { task: "stray".to_owned() },]
    );
    world.taken.insert("set-2".to_owned());
    world.settle();
    assert_eq!(
        created(&world),
        ["set-3"],
        "its own name is another's; the stray was of no revision"
    );
}

#[test]
fn a_task_that_ended_is_replaced_after_a_moment() {
    let mut world = three();
    let now = world.now;
    let task = world.task("set-0");
    task.phase = TaskPhase::Failed;
    "Disconnected".clone_into(&mut task.reason);
    task.finished = Some(now);
    assert_eq!(world.decide(), 0);
    assert!(world.last.as_ref().expect("decided").look_again.is_some());
    world.settle();
    assert_eq!(created(&world), ["set-0"]);
}

#[test]
fn old_templates_are_forgotten_beyond_the_limit() {
    let mut world = three_with(json!({"revisionHistoryLimit": 1}));
    for round in 0..4 {
        let annotations = &mut world.spec.template.metadata.annotations;
        annotations.insert("round".to_owned(), round.to_string());
        world.settle();
    }
    assert_eq!(world.revisions.len(), 2, "what is, and one before");
}

#[test]
fn a_first_rollout_counts_although_a_task_crashed_once() {
    let mut world = World::new(json!({"replicas": 1}), 2);
    world.steps(3);
    let task = world.task("set-0");
    (task.attempt, task.exited) = (2, Some("exited with code 1".to_owned()));
    world.settle();
    assert_eq!(world.progressing().0, "Complete");
    assert_eq!(world.status.current_revision, world.status.update_revision);
}

#[test]
fn a_node_that_takes_no_first_task_ends_no_rollout_and_a_taint_ends_no_task() {
    let mut world = World::new(
        json!({"everyNode": true, "rollout": {"progressDeadlineSeconds": 20, "maxUnavailable": 2}}),
        2,
    );
    world.settle();
    world.set_template(1);
    world.step();
    world.join("r9");
    world.node("r9").facts.unschedulable = true;
    world.steps(3);
    world.settle();
    assert_eq!(world.status.rolled_back_from, None);
    assert_eq!(world.status.current_revision, world.status.update_revision);
    let taint = json!([{"key": "busy", "effect": "NoSchedule"}]);
    world.node("r0").facts.taints = serde_json::from_value(taint).expect("taints");
    world.settle();
    assert_eq!(world.tasks.len(), 3, "nothing new, and nothing less");
}

#[test]
fn a_template_that_never_served_is_never_called_good() {
    let mut world = World::new(json!({"replicas": 0, "rollout": {"canary": 0}}), 4);
    world.decide();
    world.set_template(2);
    world.decide();
    world.spec.replicas = Some(1);
    world.decide();
    for _ in 0..90 {
        world.step();
        assert_eq!(world.status.current_revision, "", "{:#?} {:#?}", world.tasks, world.status);
    }
}

#[test]
fn a_template_that_its_robot_cannot_take_ends_the_rollout_and_a_robot_that_others_took_does_not() {
    for (refusal, ends) in [("TooSmall", true), ("LeaseHeld", false), ("Cordoned", false)] {
        let mut world = three_with(json!({"progressDeadlineSeconds": 20}));
        world.set_template(1);
        let names: Vec<String> = world.nodes.keys().cloned().collect();
        for name in names {
            world.node(&name).facts.unschedulable = true;
        }
        world.steps(4);
        let task = world.task("set-0");
        assert_eq!(task.phase, TaskPhase::Pending);
        task.refusal = Some(refusal.to_owned());
        world.now = super::after(world.now, std::time::Duration::from_secs(40));
        world.decide();
        assert_eq!(world.status.rolled_back_from.is_some(), ends, "{refusal}");
    }
}

#[test]
fn tasks_that_have_no_place_hold_no_rollout_up() {
    let mut world = World::new(json!({"replicas": 5}), 4);
    world.settle();
    for round in 0..3 {
        world.set_template((round + 1) % 2);
        world.settle();
        let number = ((round + 1) % 2).to_string();
        assert!(world.templates().iter().all(|t| *t == number), "{:?}", world.templates());
    }
}
