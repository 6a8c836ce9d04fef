//! The best mapping by another method than the solver's, to measure and to test it by: dynamic programming over sets.
//!
//! What a scale's parts need of it, and what they are worth there, follows from the set of them alone: a connection that
//! leaves the set loads the scale's link wherever its other end is. So `best(k, U)`, the most that the parts `U` are worth
//! on the first k remote scales, is the maximum over the sets `T ⊆ U` that scale k takes, of `best(k−1, U∖T) + worth(k, T)`,
//! and home has the rest. It takes up to 3^M steps a scale; M ≤ 12 is fast, 18 takes seconds.

use crate::offload::constraint::exceeds;
use crate::offload::problem::{HOME, Problem};

/// More parts need more memory than there is reason for.
pub const MOST_PARTS: usize = 20;

/// What the best correct mapping is worth. None: no mapping is correct, or there are more than [`MOST_PARTS`].
#[must_use]
pub fn best_value(problem: &Problem) -> Option<f64> {
    let parts = problem.items.len();
    if parts > MOST_PARTS {
        return None;
    }
    let sets = 1_usize << parts;
    let mut best = vec![f64::NEG_INFINITY; sets];
    best[0] = 0.0;
    for scale in 1..problem.scales.len() {
        let taken: Vec<(usize, f64)> =
            (1..sets).filter_map(|set| Some((set, worth(problem, scale, set)?))).collect();
        let before = best.clone();
        for (set, worth) in taken {
            let others = (sets - 1) & !set;
            let mut rest = others;
            loop {
                let with = before[rest] + worth;
                if with > best[rest | set] {
                    best[rest | set] = with;
                }
                if rest == 0 {
                    break;
                }
                rest = (rest - 1) & others;
            }
        }
    }
    let whole = |away: usize| Some(best[away] + worth(problem, HOME, (sets - 1) & !away)?);
    let most = (0..sets).filter(|away| best[*away].is_finite()).filter_map(whole);
    most.reduce(f64::max)
}

/// What a set of parts is worth on a scale; none when it does not take them.
fn worth(problem: &Problem, scale: usize, set: usize) -> Option<f64> {
    let there = |item: usize| set >> item & 1 == 1;
    let capacity = &problem.scales[scale];
    let (mut cpu, mut memory, mut link, mut worth) = (0.0, 0.0, 0.0, 0.0);
    for (i, item) in problem.items.iter().enumerate() {
        if there(i) {
            if !item.allowed[scale] {
                return None;
            }
            cpu += item.cpu[scale];
            memory += item.memory;
            worth += item.value[scale];
        }
        // Home's link carries what parts elsewhere exchange with those that are pinned here.
        if there(i) != (scale == HOME) {
            link += item.traffic;
        }
    }
    for edge in problem.edges.iter().filter(|e| there(e.a) != there(e.b)) {
        link += edge.traffic;
        worth -= capacity.latency_cost + edge.traffic * capacity.traffic_cost;
    }
    let full = scale != HOME && (exceeds(cpu, capacity.cpu) || exceeds(memory, capacity.memory));
    (!full && !exceeds(link, capacity.bandwidth)).then_some(worth)
}
