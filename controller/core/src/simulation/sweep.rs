//! Single decisions of every size beside their optimum, and Algorithm 1 beside both.

use super::exact;
use super::instance::{Size, Supply, draw};
use crate::offload::constraint::check;
use crate::offload::greedy;
use crate::offload::problem::Problem;
use crate::offload::solver::{Effort, Solution, solve};

/// One decision.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Case {
    /// By how much less than the best it is worth, as a share of the best.
    pub deviation: f64,
    /// The same of Algorithm 1.
    pub greedy: f64,
    /// It was proven best within the effort of a decision.
    pub proven: bool,
}

/// When the best is looked for by search before it is by [`exact`]: that takes seconds for 18 parts.
const PROOF: Effort = Effort { search: 20_000_000, prepare: 1_000_000 };

/// A decision as production makes it. `None`: no mapping is correct.
///
/// # Panics
///
/// When the solver's mapping breaks a constraint: that is what a sweep is there to find.
#[must_use]
pub fn decide(problem: &Problem) -> Option<Solution> {
    let found = solve(problem, &problem.all_home(), Effort::ONLINE)?;
    let broken = check(problem, &found.mapping);
    assert!(broken.is_empty(), "the mapping breaks {broken:?}");
    Some(found)
}

/// Holds a decision against the optimum.
///
/// # Panics
///
/// When something better than a proven optimum is known.
#[must_use]
pub fn judge(problem: &Problem, found: &Solution) -> Case {
    let best = optimum(problem, found);
    let value = problem.value(&found.mapping);
    assert!(value <= best * (1.0 + 1e-6), "{value} is more than the optimum, {best}");
    assert!(found.bound >= best * (1.0 - 1e-6), "the bound {} is below {best}", found.bound);
    let deviation = |value: f64| ((best - value) / best).max(0.0);
    Case {
        deviation: deviation(value),
        greedy: deviation(problem.value(&greedy::settle(problem))),
        proven: found.is_proven(),
    }
}

fn optimum(problem: &Problem, found: &Solution) -> f64 {
    if found.is_proven() {
        return found.value;
    }
    let again = solve(problem, &found.mapping, PROOF);
    let proven = again.filter(Solution::is_proven).map(|s| s.value);
    proven.or_else(|| exact::best_value(problem)).unwrap_or(found.bound)
}

/// A decision of this size, by its seed.
#[must_use]
pub fn case(size: Size, supply: Supply, seed: u64) -> Problem {
    // Sizes with the same seed are different cases.
    let salt = ((size.parts * 64 + size.migratable) * 64 + size.scales) as u64;
    draw(size, supply, seed.wrapping_mul(1_000_003).wrapping_add(salt * 2 + supply as u64))
}

/// The mean, and what a share of the values does not pass; of sorted values.
#[must_use]
pub fn spread(values: &mut [f64], shares: &[f64]) -> (f64, Vec<f64>) {
    values.sort_by(f64::total_cmp);
    let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
    let at = |share: f64| {
        let index = (share * values.len() as f64).ceil() as usize;
        values.get(index.saturating_sub(1)).copied().unwrap_or_default()
    };
    (mean, shares.iter().map(|share| at(*share)).collect())
}
