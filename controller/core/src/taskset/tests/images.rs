//! Images come first, and tasks are ended afterwards.

use std::collections::BTreeSet;

use serde_json::json;

use super::world::World;
use crate::taskset::{Action, Ending};

/// Three tasks of containers on five robots, and nothing done yet.
fn three(rollout: serde_json::Value) -> World {
    let mut world = World::new(json!({"replicas": 3, "rollout": rollout}), 5);
    world.use_containers();
    world.settle();
    world.actions.clear();
    world
}

fn ended(world: &World) -> Vec<&str> {
    let outdated = |action| match action {
        &Action::Delete { ref task, why: Ending::Outdated { .. } } => Some(task.as_str()),
        _ => None,
    };
    world.actions.iter().filter_map(outdated).collect()
}

fn asked(world: &World) -> Vec<&str> {
    world.status.image_pulls.iter().map(|pull| pull.node.as_str()).collect()
}

#[test]
fn the_canarys_image_comes_before_its_end_and_the_next_batchs_while_it_proves_itself() {
    let mut world = three(json!({}));
    let node = |world: &mut World, task: &str| world.task(task).node.clone().expect("placed");
    let (first, second) = (node(&mut world, "set-0"), node(&mut world, "set-1"));
    world.set_template(1);
    world.step();
    assert_eq!((asked(&world), ended(&world)), (vec![first.as_str()], vec![]));
    let (reason, message) = world.progressing();
    assert_eq!(reason, "Canary");
    assert!(message.ends_with(&format!("; {first} pulls img:1")), "{message}");
    world.step();
    assert_eq!(ended(&world), [""; 0], "it is being pulled");
    world.step();
    assert_eq!(ended(&world), ["set-0"], "it is there");
    world.step();
    assert_eq!((asked(&world), ended(&world)), (vec![second.as_str()], vec!["set-0"]));
    world.settle();
    assert_eq!(world.templates(), ["1", "1", "1"]);
    assert_eq!(world.status.image_pulls, [], "nobody needs them any more");
}

#[test]
fn an_image_that_cannot_be_had_ends_no_task_says_why_and_ends_the_rollout() {
    let mut world = three(json!({"progressDeadlineSeconds": 30}));
    world.no_registry = true;
    world.set_template(1);
    world.steps(4);
    let (reason, message) = world.progressing();
    assert_eq!(reason, "ImagePullBackOff");
    assert!(message.ends_with("cannot have img:1: no route to the registry"), "{message}");
    world.settle();
    assert_eq!(ended(&world), [""; 0]);
    assert_eq!(world.templates(), ["0", "0", "0"]);
    let back = world.status.rolled_back_from.clone().expect("given up");
    assert_eq!(back.reason, "ImagePullFailed");
    let said = "did not have img:1 within 30 s: no route to the registry";
    assert!(back.message.ends_with(said), "{}", back.message);
    assert_eq!(world.status.image_pulls, []);
}

#[test]
fn without_auto_rollback_it_goes_on_when_the_image_is_there_after_all() {
    let mut world = three(json!({"progressDeadlineSeconds": 30, "autoRollback": false}));
    world.no_registry = true;
    world.set_template(1);
    world.settle();
    assert_eq!((world.progressing().0, ended(&world).len()), ("ImagePullFailed", 0));
    world.no_registry = false;
    world.settle();
    assert_eq!(world.templates(), ["1", "1", "1"]);
}

#[test]
fn nothing_is_asked_of_a_robot_on_a_mission_nor_while_the_set_is_paused() {
    let mut world = three(json!({"paused": true}));
    world.set_template(1);
    world.settle();
    assert_eq!(asked(&world), [""; 0]);
    let node = world.task("set-0").node.clone().expect("placed");
    world.lock(&node, true);
    world.spec.rollout.paused = false;
    let mut seen = BTreeSet::new();
    for _ in 0..100 {
        world.step();
        seen.extend(world.status.image_pulls.iter().map(|pull| pull.node.clone()));
    }
    assert_eq!((seen.len(), seen.contains(&node)), (2, false), "{seen:?}");
    assert_eq!(world.templates(), ["0", "1", "1"]);
}

#[test]
fn the_same_image_is_asked_for_only_when_it_is_always_pulled() {
    for (policy, asks) in [("IfNotPresent", false), ("Always", true)] {
        let mut world = three(json!({}));
        let template = &mut world.spec.template;
        let container = template.spec.run.container.as_mut().expect("a container");
        container.pull_policy = serde_json::from_value(json!(policy)).expect("a policy");
        world.settle();
        let restarted = ("again".to_owned(), "yes".to_owned());
        world.spec.template.metadata.annotations.extend([restarted]);
        world.step();
        assert_eq!(!asked(&world).is_empty(), asks, "{policy}");
        world.settle();
        assert_eq!(world.status.current_revision, world.status.update_revision, "{policy}");
    }
}

#[test]
fn several_at_once_are_asked_for_at_once_and_no_more() {
    let mut world =
        World::new(json!({"replicas": 12, "rollout": {"canary": 2, "maxUnavailable": 10}}), 12);
    world.use_containers();
    world.settle();
    world.set_template(1);
    let mut most = 0;
    world.step();
    assert_eq!(asked(&world).len(), 2, "the canaries");
    for _ in 0..60 {
        world.step();
        most = most.max(asked(&world).len());
    }
    assert!((3..=10).contains(&most), "{most}");
    assert!(world.templates().iter().all(|t| t == "1"));
}
