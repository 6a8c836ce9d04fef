use muster_api::kind::application::Application;

use super::instance::{Size, Supply};
use super::sweep::{case, decide, judge, spread};
use super::{course, world};
use crate::offload::model::Model;

/// AnyScale's application, as `manifests/examples` has it.
pub(crate) fn corridor() -> Model {
    let text = include_str!("../../../../manifests/examples/application.yaml");
    let documents = muster_api::manifest::parse("application.yaml", text).expect("it parses");
    let object = documents[0].admit().expect("it is admitted");
    let application: Application = serde_json::from_value(object).expect("an Application");
    Model::of(&application.spec)
}

fn part(model: &Model, name: &str) -> usize {
    model.parts.iter().position(|p| p.name == name).expect("a part")
}

/// A seeded part of what `muster simulate offload --sweep` does in full.
#[test]
fn decisions_are_near_to_the_proven_optimum() {
    for supply in Supply::ALL {
        let (mut ours, mut greedy) = (Vec::new(), Vec::new());
        for (parts, migratable) in [(6, 3), (6, 6), (12, 4), (12, 9), (12, 12), (18, 6), (18, 11)] {
            for scales in 2..=8 {
                for seed in 0..4 {
                    let problem = case(Size { parts, migratable, scales }, supply, seed);
                    let found = decide(&problem).expect("everything at home is correct");
                    let case = judge(&problem, &found);
                    ours.push(case.deviation);
                    greedy.push(case.greedy);
                }
            }
        }
        let (mean, worst) = spread(&mut ours, &[1.0]);
        let (greedy, _) = spread(&mut greedy, &[1.0]);
        assert!(mean <= 0.005, "{supply:?}: {mean} on average");
        assert!(worst[0] <= 0.05, "{supply:?}: {} at worst", worst[0]);
        assert!(greedy > mean, "{supply:?}: Algorithm 1 is {greedy} off, the solver {mean}");
    }
}

#[test]
fn over_ten_thousand_link_traces_nothing_flaps_is_lost_runs_twice_or_is_late() {
    let model = corridor();
    let mut moves = 0;
    for seed in 0..10_000 {
        let record = world::restless(&model, 16.0, seed);
        let wrong = (record.flaps, record.lost, record.twice, record.violated);
        assert_eq!(wrong, (0, 0, 0, 0.0), "seed {seed}: {record:?}");
        moves += record.out + record.returned + record.alone;
    }
    // Otherwise it would prove nothing.
    assert!(moves > 20_000, "{moves}");
}

#[test]
fn the_paper_s_course_takes_hardly_longer_than_it_must() {
    let model = corridor();
    let amcl = part(&model, "amcl");
    for seed in 0..60 {
        let drive = course::drive(&model, amcl, seed);
        assert!((0.449..0.651).contains(&drive.coverage), "seed {seed}: {drive:?}");
        assert!(drive.saving() >= 0.97, "seed {seed}: {} {drive:?}", drive.saving());
        assert!(drive.saving() <= 1.0, "the bound is none, seed {seed}: {drive:?}");
        assert_eq!(drive.record.violated, 0.0, "seed {seed}: {drive:?}");
        assert_eq!((drive.record.lost, drive.record.twice, drive.record.flaps), (0, 0, 0));
    }
}

#[test]
fn a_seed_is_a_world() {
    let model = corridor();
    assert_eq!(world::restless(&model, 10.0, 7), world::restless(&model, 10.0, 7));
    assert_ne!(world::restless(&model, 10.0, 7), world::restless(&model, 10.0, 8));
}
