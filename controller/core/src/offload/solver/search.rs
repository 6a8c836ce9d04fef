//! Branch and bound, depth first.
//!
//! A look at a partial mapping asks the trees what everything is worth with each part on each scale that still has room for
//! it, placed parts where they are. The part that would lose most by its second choice is placed next, first where all
//! together are worth most. Connections that are in no tree pay as soon as both ends are placed.

use super::super::problem::{Mapping, Problem};
use super::dual::{Dual, end};
use super::forest::{Forest, Marginals};
use super::local::BETTER;
use super::state::{NOWHERE, State};
use super::{Budget, Options};

/// A search.
#[derive(Debug)]
pub(super) struct Search<'p> {
    problem: &'p Problem,
    forest: &'p Forest,
    dual: &'p Dual,
    options: &'p Options,
    budget: Budget,
    given: u64,
    best: Option<Mapping>,
    best_value: f64,
    /// The most that something not looked at could be worth.
    open: f64,
    worth: Vec<f64>,
    marginals: Marginals,
}

impl<'p> Search<'p> {
    pub(super) fn new(
        problem: &'p Problem,
        forest: &'p Forest,
        (dual, options): (&'p Dual, &'p Options),
        budget: u64,
    ) -> Self {
        Search {
            problem,
            forest,
            dual,
            options,
            budget: Budget { left: budget },
            given: budget,
            best: None,
            best_value: f64::NEG_INFINITY,
            open: f64::NEG_INFINITY,
            worth: vec![f64::NEG_INFINITY; dual.worth.len()],
            marginals: dual.marginals.clone(),
        }
    }

    pub(super) fn run(&mut self, empty: &State<'_>, known: Option<&State<'_>>) {
        self.best_value = known.map_or(f64::NEG_INFINITY, |s| s.value);
        self.descend(&mut empty.clone());
    }

    /// Options looked at.
    pub(super) fn looked_at(&self) -> u64 {
        self.given - self.budget.left
    }

    /// What nothing is worth more than, when `root` was known before.
    pub(super) fn bound(&self, root: f64) -> f64 {
        self.open.max(self.best_value).min(root)
    }

    pub(super) fn into_best(self) -> Option<Mapping> {
        self.best
    }

    /// Nothing with this bound is worth looking at.
    fn is_hopeless(&self, bound: f64) -> bool {
        bound <= self.best_value + BETTER * self.best_value.abs()
    }

    fn descend(&mut self, state: &mut State<'_>) {
        let charged = self.look(state);
        let bound = self.dual.paid + self.marginals.most - charged;
        if self.is_hopeless(bound) {
            return;
        }
        self.marginals.pass_down(self.forest, &self.dual.ends);
        if self.budget.is_spent() {
            self.open = self.open.max(bound);
            return;
        }
        let Some(item) = self.next(state) else {
            if state.value > self.best_value {
                self.best_value = state.value;
                self.best = Some(state.mapping.clone());
            }
            return;
        };
        let with = |k: usize| self.dual.paid + self.marginals.with(self.forest, item, k) - charged;
        let mut choices: Vec<(f64, usize)> =
            self.options[item].iter().map(|k| (with(*k), *k)).collect();
        choices.sort_by(|a, b| b.0.total_cmp(&a.0));
        for (bound, scale) in choices {
            if self.is_hopeless(bound) {
                return;
            }
            if state.try_put(item, scale) {
                self.descend(state);
                state.take(item);
            }
        }
    }

    /// Asks the trees for the most; gives what connections in no tree have charged between placed parts.
    fn look(&mut self, state: &State<'_>) -> f64 {
        let n = self.problem.scales.len();
        let mut charged = 0.0;
        self.budget.spend(self.worth.len() as u64);
        for (item, options) in self.options.iter().enumerate() {
            let row = item * n;
            let placed = state.mapping[item];
            if placed != NOWHERE {
                self.worth[row..row + n].fill(f64::NEG_INFINITY);
                self.worth[row + placed] = self.dual.worth[row + placed];
                // Each such connection is met from both ends.
                charged += self.ring(state, item, placed) / 2.0;
                continue;
            }
            for &k in options {
                self.worth[row + k] = if state.may_fit(item, k) {
                    self.dual.worth[row + k] - self.ring(state, item, k)
                } else {
                    f64::NEG_INFINITY
                };
            }
        }
        self.marginals.pass_up(self.forest, &self.worth, &self.dual.ends);
        charged
    }

    /// What a part's connections in no tree charge, with it there.
    fn ring(&self, state: &State<'_>, item: usize, scale: usize) -> f64 {
        let rings = &self.forest.rings[item];
        if rings.is_empty() {
            return 0.0;
        }
        let apart = rings.iter().map(|(other, traffic)| (state.mapping[*other], *traffic));
        apart
            .filter(|(there, _)| *there != NOWHERE && *there != scale)
            .map(|(there, t)| {
                end(self.problem, &self.dual.link, t, scale)
                    + end(self.problem, &self.dual.link, t, there)
            })
            .sum()
    }

    /// The part to place next: none when all are.
    fn next(&self, state: &State<'_>) -> Option<usize> {
        let mut next = None;
        let mut most = f64::NEG_INFINITY;
        for (item, options) in self.options.iter().enumerate() {
            if state.mapping[item] != NOWHERE {
                continue;
            }
            let mut best = [f64::NEG_INFINITY; 2];
            for &k in options {
                let with = self.marginals.with(self.forest, item, k);
                if with > best[0] {
                    best = [with, best[0]];
                } else if with > best[1] {
                    best[1] = with;
                }
            }
            let regret = best[0] - best[1];
            if next.is_none() || regret > most {
                (next, most) = (Some(item), regret);
            }
        }
        next
    }
}
