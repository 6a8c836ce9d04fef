//! An upper bound on what any mapping is worth: Lagrangian relaxation.
//!
//! Every resource gets a price λ ≥ 0 for its whole capacity. When parts pay for what they use instead of being limited by
//! it, the best places follow exactly ([`super::forest`]), and what they are worth + Σ λ is at least what the best correct
//! mapping is worth, for any prices. Subgradient steps look for the prices with the least such sum (Held and Karp; for
//! assignments to limited machines: Fisher, Jaikumar and Van Wassenhove 1986).

use super::super::problem::{Capacity, HOME, Problem};
use super::Options;
use super::forest::{Forest, Marginals};

/// Prices of the whole capacity of each resource, by scale.
#[derive(Debug, Clone)]
struct Prices {
    cpu: Vec<f64>,
    memory: Vec<f64>,
    link: Vec<f64>,
}

/// What parts are worth after they have paid, and the bound that follows.
#[derive(Debug, Clone)]
pub(super) struct Dual {
    prices: Prices,
    /// By part and scale, rows of as many as there are scales; −∞: not considered.
    pub(super) worth: Vec<f64>,
    /// What a bit a second over the link of a scale pays.
    pub(super) link: Vec<f64>,
    /// By part and scale: what the connection of a part with the one above it in its tree costs at an end there.
    pub(super) ends: Vec<f64>,
    /// The price of all there is.
    pub(super) paid: f64,
    pub(super) marginals: Marginals,
    pub(super) bound: f64,
}

/// Steps without a better bound before they are made smaller.
const PATIENCE: usize = 10;

impl Prices {
    fn zero(scales: usize) -> Self {
        let zero = vec![0.0; scales];
        Prices { cpu: zero.clone(), memory: zero.clone(), link: zero }
    }

    fn all(&self) -> impl Iterator<Item = &f64> {
        [&self.cpu, &self.memory, &self.link].into_iter().flatten()
    }

    fn go(&mut self, over: &Prices, step: f64) {
        let go = |prices: &mut [f64], over: &[f64]| {
            for (p, o) in prices.iter_mut().zip(over) {
                *p = (*p + step * o).max(0.0);
            }
        };
        go(&mut self.cpu, &over.cpu);
        go(&mut self.memory, &over.memory);
        go(&mut self.link, &over.link);
    }
}

fn per_unit(price: f64, capacity: f64) -> f64 {
    if capacity > 0.0 && capacity.is_finite() { price / capacity } else { 0.0 }
}

/// What the end of a connection on a scale costs: its latency, its traffic, and the price of its link.
pub(super) fn end(problem: &Problem, link: &[f64], traffic: f64, scale: usize) -> f64 {
    let capacity = &problem.scales[scale];
    capacity.latency_cost + traffic * (capacity.traffic_cost + link[scale])
}

impl Dual {
    fn at(problem: &Problem, forest: &Forest, options: &Options, prices: Prices) -> Self {
        let (parts, scales) = (problem.items.len(), problem.scales.len());
        let mut dual = Dual {
            prices,
            worth: vec![f64::NEG_INFINITY; parts * scales],
            link: vec![0.0; scales],
            ends: vec![0.0; parts * scales],
            paid: 0.0,
            marginals: Marginals::new(parts, scales),
            bound: 0.0,
        };
        dual.reduce(problem, forest, options);
        dual
    }

    /// Each part's worth at these prices, and the bound.
    fn reduce(&mut self, problem: &Problem, forest: &Forest, options: &Options) {
        let scales = problem.scales.len();
        let unit = |of: &[f64], capacity: fn(&Capacity) -> f64| -> Vec<f64> {
            of.iter().zip(&problem.scales).map(|(p, s)| per_unit(*p, capacity(s))).collect()
        };
        let cpu = unit(&self.prices.cpu, |s| s.cpu);
        let memory = unit(&self.prices.memory, |s| s.memory);
        self.link = unit(&self.prices.link, |s| s.bandwidth);
        self.paid = self.prices.all().sum();
        for (i, (item, options)) in problem.items.iter().zip(options).enumerate() {
            for &k in options {
                let pays = if k == HOME {
                    0.0
                } else {
                    let link = self.link[k] + self.link[HOME];
                    item.cpu[k] * cpu[k] + item.memory * memory[k] + item.traffic * link
                };
                self.worth[i * scales + k] = item.value[k] - pays;
            }
        }
        for (part, _, traffic) in Marginals::tree_edges(forest) {
            for k in 0..scales {
                self.ends[part * scales + k] = end(problem, &self.link, traffic, k);
            }
        }
        self.marginals.pass_up(forest, &self.worth, &self.ends);
        self.bound = self.paid + self.marginals.most;
    }

    /// By how much of its capacity each resource is over-used when every part goes where all together are worth most.
    fn excess(&self, problem: &Problem, forest: &Forest, places: &mut [usize]) -> Prices {
        self.marginals.places(forest, &self.ends, places);
        let mut over = Prices::zero(problem.scales.len());
        let bandwidth = |k: usize| problem.scales[k].bandwidth;
        for (item, &k) in problem.items.iter().zip(&*places) {
            if k == HOME {
                continue;
            }
            over.cpu[k] += per_unit(item.cpu[k], problem.scales[k].cpu);
            over.memory[k] += per_unit(item.memory, problem.scales[k].memory);
            over.link[k] += per_unit(item.traffic, bandwidth(k));
            over.link[HOME] += per_unit(item.traffic, bandwidth(HOME));
        }
        for (part, other, traffic) in Marginals::tree_edges(forest) {
            let (a, b) = (places[part], places[other]);
            if a != b {
                over.link[a] += per_unit(traffic, bandwidth(a));
                over.link[b] += per_unit(traffic, bandwidth(b));
            }
        }
        for (k, scale) in problem.scales.iter().enumerate() {
            let less =
                |o: &mut f64, capacity: f64| *o = if capacity.is_finite() { *o - 1.0 } else { 0.0 };
            less(&mut over.cpu[k], scale.cpu);
            less(&mut over.memory[k], scale.memory);
            less(&mut over.link[k], scale.bandwidth);
        }
        (over.cpu[HOME], over.memory[HOME]) = (0.0, 0.0);
        over
    }

    /// The best prices that `steps` steps find, when a mapping worth `known` is known. `begin`: from these.
    pub(super) fn solve(
        problem: &Problem,
        forest: &Forest,
        options: &Options,
        (known, steps): (f64, usize),
        begin: Option<&Dual>,
    ) -> Self {
        let zero = || Prices::zero(problem.scales.len());
        let prices = begin.map_or_else(zero, |dual| dual.prices.clone());
        let mut now = Dual::at(problem, forest, options, prices);
        let mut best = now.clone();
        let mut places = vec![HOME; problem.items.len()];
        let (mut pace, mut patience) = (1.0, PATIENCE);
        for _ in 0..steps {
            let over = now.excess(problem, forest, &mut places);
            let norm: f64 = over
                .all()
                .zip(now.prices.all())
                .filter(|(o, p)| **o > 0.0 || **p > 0.0)
                .map(|(o, _)| o * o)
                .sum();
            let gap = now.bound - known;
            if norm == 0.0 || gap <= 1e-12 * known.abs() || pace < 1e-3 {
                break;
            }
            now.prices.go(&over, pace * gap / norm);
            now.reduce(problem, forest, options);
            if now.bound < best.bound {
                best.clone_from(&now);
                patience = PATIENCE;
            } else if patience == 0 {
                (pace, patience) = (pace / 2.0, PATIENCE);
                now.clone_from(&best);
            } else {
                patience -= 1;
            }
        }
        best.marginals.pass_down(forest, &best.ends);
        best
    }
}
