use super::super::constraint::check;
use super::super::greedy;
use super::super::problem::{Capacity, HOME, Item, Problem};
use super::{Effort, solve};
use crate::simulation::exact;
use crate::simulation::instance::{Size, Supply, draw};

/// The best by looking at every mapping there is.
fn exhaustive(problem: &Problem) -> f64 {
    let (parts, scales) = (problem.items.len(), problem.scales.len());
    let mut mapping = vec![HOME; parts];
    let mut best = f64::NEG_INFINITY;
    loop {
        if check(problem, &mapping).is_empty() {
            best = best.max(problem.value(&mapping));
        }
        let Some(next) = mapping.iter().position(|k| k + 1 < scales) else { return best };
        mapping[next] += 1;
        mapping[..next].fill(HOME);
    }
}

/// Costs of the network besides, which the sweep's cases have not.
fn with_costs(mut problem: Problem) -> Problem {
    for (k, scale) in problem.scales.iter_mut().enumerate() {
        scale.latency_cost = 0.01 * k as f64;
        scale.traffic_cost = if k == HOME { 2e-8 } else { 0.0 };
    }
    problem
}

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-7 * b.abs().max(1.0)
}

#[test]
fn small_decisions_are_the_best_of_all_mappings() {
    for seed in 0..300 {
        for supply in Supply::ALL {
            let seed_of = |n: u64| seed * 10 + n;
            for (n, (parts, scales)) in [(3, 4), (5, 3), (6, 3), (4, 5)].into_iter().enumerate() {
                let size = Size { parts, migratable: parts, scales };
                let mut problem = draw(size, supply, seed_of(n as u64));
                if seed % 2 == 1 {
                    problem = with_costs(problem);
                }
                let best = exhaustive(&problem);
                let found = solve(&problem, &problem.all_home(), Effort::UNLIMITED)
                    .expect("everything at home is correct");
                assert_eq!(check(&problem, &found.mapping), [], "{size:?} {seed}");
                assert!(found.is_proven(), "{size:?} {seed}: {found:?}");
                assert!(close(found.value, best), "{size:?} {supply:?} {seed}: {found:?} {best}");
                let other = exact::best_value(&problem).expect("everything at home is correct");
                assert!(close(other, best), "{size:?} {supply:?} {seed}: {other} {best}");
            }
        }
    }
}

#[test]
fn rings_of_connections_are_decided_as_well_as_trees() {
    for seed in 0..100 {
        let size = Size { parts: 6, migratable: 6, scales: 3 };
        let mut problem = draw(size, Supply::Tight, seed);
        for (a, b) in [(0, 1), (1, 2), (2, 0), (3, 5), (0, 4), (1, 4), (0, 1)] {
            problem.edges.push(super::super::problem::Edge { a, b, traffic: 4e5 });
        }
        let problem = with_costs(problem);
        let found = solve(&problem, &problem.all_home(), Effort::UNLIMITED).expect("home");
        let best = exhaustive(&problem);
        assert!(found.is_proven() && close(found.value, best), "{seed}: {found:?} {best}");
    }
}

#[test]
fn a_bound_is_never_below_the_best_however_little_is_looked_at() {
    for seed in 0..200 {
        let size = Size { parts: 8, migratable: 8, scales: 5 };
        let problem = draw(size, Supply::ALL[seed as usize % 2], seed);
        let best = exact::best_value(&problem).expect("home");
        for search in [0, 4_000, 40_000] {
            let effort = Effort { search, prepare: 2_000 };
            let found = solve(&problem, &problem.all_home(), effort).expect("home");
            assert!(found.bound >= best - 1e-7, "{seed}: {found:?} {best}");
            assert!(found.value <= best + 1e-7, "{seed}: {found:?} {best}");
            assert_eq!(check(&problem, &found.mapping), []);
        }
    }
}

#[test]
fn a_mapping_that_may_not_change_stays() {
    let size = Size { parts: 4, migratable: 4, scales: 3 };
    let mut problem = draw(size, Supply::Loose, 3);
    for item in &mut problem.items {
        item.allowed = vec![false, true, false];
    }
    problem.scales[1] = Capacity::unlimited(1.0);
    problem.scales[HOME].bandwidth = f64::INFINITY;
    let found = solve(&problem, &[1; 4], Effort::ONLINE).expect("the start is correct");
    assert_eq!(found.mapping, [1; 4]);
}

#[test]
fn algorithm_1_takes_the_hungriest_part_to_the_strongest_scale() {
    let item = |cpu: f64, traffic: f64| Item {
        value: vec![cpu, 2.0 * cpu, 3.0 * cpu],
        cpu: vec![cpu; 3],
        allowed: vec![true; 3],
        memory: 0.0,
        traffic,
    };
    let mut scales =
        vec![Capacity::unlimited(1.0), Capacity::unlimited(2.0), Capacity::unlimited(3.0)];
    scales[2].cpu = 0.6;
    scales[0].bandwidth = 10.0;
    let problem = Problem {
        items: vec![item(0.2, 1.0), item(0.5, 1.0), item(0.4, 9.0)],
        scales,
        edges: vec![],
    };
    assert_eq!(greedy::step(&problem, &[0, 0, 0], |_| true), Some((1, 2)));
    // The strongest has no room for the next one; then the radio has none for the last.
    assert_eq!(greedy::step(&problem, &[0, 2, 0], |_| true), Some((2, 1)));
    assert_eq!(greedy::settle(&problem), [0, 2, 1]);
    assert_eq!(greedy::step(&problem, &[0, 2, 0], |item| item != 2), Some((0, 1)));
    // The one that moved last comes home first.
    let mut narrow = problem;
    narrow.scales[0].bandwidth = 5.0;
    assert_eq!(greedy::bring_home(&narrow, &[0, 2, 1], &[1, 2]), [0, 2, 0]);
}
