//! Whatever happens to robots, tasks, locks, templates and numbers: it converges, and the rules hold on the way.

use muster_api::phase::TaskPhase;
use proptest::prelude::*;
use serde_json::json;

use super::world::{World, is_bad};

/// What happens to the world.
#[derive(Debug, Clone)]
enum Event {
    Template(u32),
    Replicas(u32),
    Lock(usize, bool),
    Lose(usize),
    Find(usize),
    Join,
    Cordon(usize, bool),
    Pause(bool),
    /// A task ends for good, as one does that was without contact for too long.
    End(usize),
    /// Somebody deletes a task.
    Delete(usize),
    Reboot(usize),
    /// Images can be pulled, or not.
    Registry(bool),
    Pass(usize),
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        3 => (0..4_u32).prop_map(Event::Template),
        1 => (0..6_u32).prop_map(Event::Replicas),
        2 => (0..6_usize, any::<bool>()).prop_map(|(n, on)| Event::Lock(n, on)),
        1 => (0..6_usize).prop_map(Event::Lose),
        2 => (0..6_usize).prop_map(Event::Find),
        1 => Just(Event::Join),
        1 => (0..6_usize, any::<bool>()).prop_map(|(n, on)| Event::Cordon(n, on)),
        1 => any::<bool>().prop_map(Event::Pause),
        1 => (0..6_usize).prop_map(Event::End),
        1 => (0..6_usize).prop_map(Event::Delete),
        1 => (0..6_usize).prop_map(Event::Reboot),
        1 => any::<bool>().prop_map(Event::Registry),
        4 => (1..8_usize).prop_map(Event::Pass),
    ]
}

fn apply(world: &mut World, event: &Event) {
    let names: Vec<String> = world.nodes.keys().cloned().collect();
    let node = |n: &usize| names[n % names.len()].clone();
    match event {
        Event::Template(number) => world.set_template(*number),
        Event::Replicas(n) if world.spec.replicas.is_some() => world.spec.replicas = Some(*n),
        Event::Replicas(_) => {}
        Event::Lock(n, on) => world.lock(&node(n), *on),
        Event::Lose(n) => world.lose(&node(n)),
        Event::Find(n) => world.find(&node(n)),
        Event::Join if names.len() < 8 => world.join(&format!("r{}", names.len())),
        Event::Join => {}
        Event::Cordon(n, on) => world.node(&node(n)).facts.unschedulable = *on,
        Event::Pause(on) => world.spec.rollout.paused = *on,
        Event::End(n) | Event::Delete(n) | Event::Reboot(n) if !world.tasks.is_empty() => {
            let (now, at) = (world.now, n % world.tasks.len());
            let task = &mut world.tasks[at];
            match event {
                Event::Delete(_) => task.ending = true,
                Event::End(_) if task.is_placed() && !task.ending => {
                    task.phase = TaskPhase::Failed;
                    "Disconnected".clone_into(&mut task.reason);
                    task.finished = Some(now);
                }
                Event::Reboot(_) if task.phase == TaskPhase::Running => {
                    task.attempt += 1;
                    task.started = Some(now);
                }
                _ => {}
            }
        }
        Event::End(_) | Event::Delete(_) | Event::Reboot(_) => {}
        Event::Registry(on) => world.no_registry = !on,
        Event::Pass(steps) => world.steps(*steps),
    }
}

/// Everything that keeps tasks from running is over.
fn heal(world: &mut World) {
    let names: Vec<String> = world.nodes.keys().cloned().collect();
    for name in names {
        world.lock(&name, false);
        world.find(&name);
        world.node(&name).facts.unschedulable = false;
    }
    world.spec.rollout.paused = false;
    world.no_registry = false;
}

/// Per place: an end and a beginning for the new template, the same back, and one for what was in between.
fn bound(world: &World) -> usize {
    let places = world.nodes.len().max(6);
    12 + 8 * places
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn it_converges_from_anywhere(
        every_node in any::<bool>(),
        replace in any::<bool>(),
        (auto, containers) in (any::<bool>(), any::<bool>()),
        (canary, most) in (0..3_u32, 1..4_u32),
        events in proptest::collection::vec(event(), 0..40),
    ) {
        let mut spec = json!({"rollout": {
            "canary": canary, "maxUnavailable": most, "autoRollback": auto, "progressDeadlineSeconds": 30,
        }});
        if every_node {
            spec["everyNode"] = true.into();
        } else {
            spec["replicas"] = 3.into();
            if replace {
                spec["onUnreachable"] = json!({"policy": "Replace", "after": "10s"});
            }
        }
        let mut world = World::new(spec, 4);
        if containers {
            world.use_containers();
        }
        for event in &events {
            apply(&mut world, event);
            world.decide();
        }
        // Whatever is locked, lost or paused stays so: it comes to rest.
        let actions = world.settle();
        prop_assert!(actions <= bound(&world), "{actions} actions: {:#?}", world.actions);

        heal(&mut world);
        let actions = world.settle();
        prop_assert!(actions <= bound(&world), "{actions} actions: {:#?}", world.actions);
        let wanted = match world.spec.replicas {
            Some(n) => n as usize,
            None => world.nodes.len(),
        };
        let there = world.tasks.len();
        prop_assert_eq!(there, wanted);
        let bad = is_bad(&world.spec.template);
        let good = world.revisions.iter().find(|r| r.name == world.status.current_revision);
        // While images could not be pulled, a good template was given up as well, and stays so.
        let back = world.status.rolled_back_from.as_ref();
        let unhad = back.is_some_and(|back| back.reason == "ImagePullFailed");
        if let (true, true, Some(good)) = (bad || unhad, auto, good) {
            let number = good.template.metadata.annotations["number"].clone();
            prop_assert!(!is_bad(&good.template), "a bad template was called good");
            prop_assert!(world.templates().iter().all(|t| *t == number), "{:?}", world.templates());
        }
        if !bad && !unhad {
            let number = &world.spec.template.metadata.annotations["number"];
            prop_assert!(world.templates().iter().all(|t| t == number), "{:?}: {:#?}", world.templates(), world.status);
            let placed = wanted.min(world.nodes.len());
            let available = world.tasks.iter().filter(|t| world.is_available(t)).count();
            prop_assert_eq!(available, placed);
        }
    }
}
