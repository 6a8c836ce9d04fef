//! The best mapping: branch and bound, exact when its budget lasts, else the best found with a proven gap.
//!
//! ```text
//!   start mapping ─┐
//!   prices (dual) ─┼─▶ construct, improve ──▶ incumbent ──▶ options that cannot be better are struck out ──▶ search
//!   all at home ───┘          (local)                              (bound − loss ≤ incumbent)
//! ```
//!
//! The budget counts looked-at options and not time, so that the same problem has the same answer on every machine.

mod dual;
mod forest;
mod local;
mod search;
mod state;
#[cfg(test)]
mod tests;

use super::constraint::check;
use super::problem::{HOME, Mapping, Problem};
use dual::Dual;
use forest::Forest;
use local::BETTER;
use state::State;

/// For each part the scales that are still considered.
type Options = Vec<Vec<usize>>;

/// How much a decision may look at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Effort {
    /// Places of parts that the search may look at; each look is at all of them.
    pub search: u64,
    /// Options that the prices may look at, and the improvements.
    pub prepare: u64,
}

impl Effort {
    /// For a decision that is made every period.
    pub const ONLINE: Effort = Effort { search: 400_000, prepare: 1_000_000 };
    /// Until it is proven.
    pub const UNLIMITED: Effort = Effort { search: u64::MAX, prepare: 20_000_000 };
}

/// What was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// The mapping; it keeps every constraint.
    pub mapping: Mapping,
    /// What it is worth.
    pub value: f64,
    /// No mapping is worth more.
    pub bound: f64,
    /// Options looked at by the search.
    pub looked_at: u64,
}

impl Solution {
    /// Nothing is better.
    #[must_use]
    pub fn is_proven(&self) -> bool {
        self.gap() <= 2.0 * BETTER
    }

    /// How much better a mapping could be at most, as a share of the bound.
    #[must_use]
    pub fn gap(&self) -> f64 {
        (self.bound - self.value).max(0.0) / self.bound.abs().max(f64::MIN_POSITIVE)
    }
}

/// What is left to look at.
#[derive(Debug, Clone, Copy)]
struct Budget {
    left: u64,
}

impl Budget {
    fn spend(&mut self, options: u64) {
        self.left = self.left.saturating_sub(options);
    }

    fn is_spent(&self) -> bool {
        self.left == 0
    }
}

/// The best mapping that `effort` finds. `start` is considered first, if it keeps the constraints. None: not even
/// everything at home does, and nothing else was found.
#[must_use]
pub fn solve(problem: &Problem, start: &[usize], effort: Effort) -> Option<Solution> {
    let neighbours = problem.neighbours();
    let empty = State::empty(problem, &neighbours);
    let mut options = options(problem, &empty);
    let mut preparing = Budget { left: effort.prepare / 2 };
    let mut best: Option<State<'_>> = None;
    for mapping in [start, &problem.all_home()] {
        if check(problem, mapping).is_empty() {
            let mut state = State::of(problem, &neighbours, mapping);
            keep_better(&mut best, state.clone());
            local::improve(&mut state, &options, &mut preparing);
            keep_better(&mut best, state);
        }
    }
    let values: Vec<f64> = problem.items.iter().flat_map(|item| item.value.clone()).collect();
    try_construct(&mut best, &empty, (&options, &values), &mut preparing);
    let forest = Forest::of(problem);
    let dual = prepare(&empty, &forest, &mut options, &mut best, effort);
    let mut bound = dual.bound;
    let mut looked_at = 0;
    let few = effort.search / LEAST_LOOKS < (problem.items.len() * problem.scales.len()) as u64;
    if !few && best.as_ref().is_none_or(|b| bound > b.value + BETTER * b.value.abs()) {
        let all = (&dual, &options);
        let mut search = search::Search::new(problem, &forest, all, effort.search / 2);
        search.run(&empty, best.as_ref());
        (looked_at, bound) = (search.looked_at(), search.bound(bound));
        if let Some(found) = search.into_best() {
            keep_better(&mut best, State::of(problem, &neighbours, &found));
        }
        if looked_at >= effort.search / 2 {
            let mut budget = Budget { left: effort.search / 2 };
            polish(&empty, &forest, all, &mut best, &mut budget);
            looked_at = effort.search - budget.left;
        }
    }
    let best = best?;
    let mapping = local::checked(problem, &best)?;
    let value = problem.value(&mapping);
    Some(Solution { bound: bound.max(value), mapping, value, looked_at })
}

/// Searches around the best mapping: the parts of two scales and of home anew, the others where they are; for each two
/// scales, again while that helps.
fn polish<'a>(
    empty: &State<'a>,
    forest: &Forest,
    (dual, options): (&Dual, &Options),
    best: &mut Option<State<'a>>,
    budget: &mut Budget,
) {
    let problem = empty.problem();
    let scales = problem.scales.len();
    let pairs = || (1..scales).flat_map(|i| (i + 1..scales).map(move |j| (i, j)));
    loop {
        let before = best.as_ref().map_or(f64::NEG_INFINITY, |b| b.value);
        for (i, j) in pairs() {
            let Some(mapping) = best.as_ref().map(|b| b.mapping.clone()) else { return };
            let free = |k: usize| k == HOME || k == i || k == j;
            let of = |(item, all): (usize, &Vec<usize>)| match mapping[item] {
                k if free(k) => all.iter().copied().filter(|k| free(*k)).collect(),
                k => vec![k],
            };
            let near: Options = options.iter().enumerate().map(of).collect();
            let mut search =
                search::Search::new(problem, forest, (dual, &near), budget.left.min(POLISH));
            search.run(empty, best.as_ref());
            budget.spend(search.looked_at());
            if let Some(found) = search.into_best() {
                keep_better(best, State::of(problem, empty.all_neighbours(), &found));
            }
            if budget.is_spent() {
                return;
            }
        }
        if best.as_ref().is_none_or(|b| b.value <= before + BETTER * before.abs()) {
            return;
        }
    }
}

/// The scales where each part may be and would fit by itself.
fn options(problem: &Problem, empty: &State<'_>) -> Options {
    let of = |(i, item): (usize, &super::problem::Item)| {
        (0..problem.scales.len()).filter(|k| item.allowed[*k] && empty.may_fit(i, *k)).collect()
    };
    problem.items.iter().enumerate().map(of).collect()
}

fn keep_better<'a>(best: &mut Option<State<'a>>, state: State<'a>) {
    if best.as_ref().is_none_or(|b| state.value > b.value) {
        *best = Some(state);
    }
}

fn try_construct<'a>(
    best: &mut Option<State<'a>>,
    empty: &State<'a>,
    (options, worth): (&Options, &[f64]),
    budget: &mut Budget,
) {
    if let Some(mut state) = local::construct(empty, options, worth) {
        local::improve(&mut state, options, budget);
        keep_better(best, state);
    }
}

/// Rounds of prices, each with a better mapping to aim at and fewer options than the one before. Each gives a mapping of
/// its own, too.
const ROUNDS: usize = 8;
/// Steps for the prices of one round, if the effort allows them.
const STEPS: usize = 40;
/// A search of fewer looks finds nothing that the preparation did not.
const LEAST_LOOKS: u64 = 100;
/// Places that one search around the best mapping may look at.
const POLISH: u64 = 40_000;

fn prepare<'a>(
    empty: &State<'a>,
    forest: &Forest,
    options: &mut Options,
    best: &mut Option<State<'a>>,
    effort: Effort,
) -> Dual {
    let problem = empty.problem();
    let size = (problem.items.len() * problem.scales.len()).max(1) as u64;
    let steps = (effort.prepare / (2 * size * ROUNDS as u64)).clamp(10, STEPS as u64);
    let steps = usize::try_from(steps).unwrap_or(STEPS);
    let mut dual: Option<Dual> = None;
    for _ in 0..ROUNDS {
        let known = best.as_ref().map_or(0.0, |b| b.value);
        let next = Dual::solve(problem, forest, options, (known, steps), dual.as_ref());
        let mut budget = Budget { left: effort.prepare / (4 * ROUNDS as u64) };
        try_construct(best, empty, (options, &next.worth), &mut budget);
        let known = best.as_ref().map_or(f64::NEG_INFINITY, |b| b.value);
        let proven = next.bound <= known + BETTER * known.abs();
        strike_out(options, forest, &next, known);
        dual = Some(next);
        if proven {
            break;
        }
    }
    dual.unwrap_or_else(|| Dual::solve(problem, forest, options, (0.0, 0), None))
}

/// Strikes out what cannot be part of anything better than `known`.
fn strike_out(options: &mut Options, forest: &Forest, dual: &Dual, known: f64) {
    let least = known + BETTER * known.abs();
    for (part, options) in options.iter_mut().enumerate() {
        let with = |k: usize| dual.paid + dual.marginals.with(forest, part, k);
        let best = options.iter().map(|k| with(*k)).fold(f64::NEG_INFINITY, f64::max);
        // The best one stays in any case: a part has to be somewhere.
        options.retain(|k| with(*k) >= best || with(*k) > least);
    }
}
