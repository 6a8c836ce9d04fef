//! The connections between parts that may move, as trees, and the most that all parts together are worth on them.
//!
//! On trees the best places of parts that pay for what they use, and for each connection over links, follow exactly by
//! two passes (max-sum), whatever their number. Applications are mostly chains and trees; connections that close a ring are
//! left out of the trees (those of least traffic), which only raises the bound.

use super::super::problem::Problem;

/// Trees over the parts.
#[derive(Debug)]
pub(super) struct Forest {
    /// Every part after its parent.
    order: Vec<usize>,
    /// The part above, and the traffic with it.
    parent: Vec<Option<(usize, f64)>>,
    root: Vec<usize>,
    /// Connections that are in no tree, by part.
    pub(super) rings: Vec<Vec<(usize, f64)>>,
}

/// The most that everything is worth together, for each place of each part.
#[derive(Debug, Clone)]
pub(super) struct Marginals {
    scales: usize,
    /// With the part there; by part and scale. While the passes run: of what is below, and of everything.
    with: Vec<f64>,
    up: Vec<f64>,
    /// What the part below says to the one above.
    message: Vec<f64>,
    /// The most, by tree; at its root.
    tree: Vec<f64>,
    /// The most of all.
    pub(super) most: f64,
}

impl Forest {
    pub(super) fn of(problem: &Problem) -> Self {
        let parts = problem.items.len();
        let mut edges: Vec<_> = problem.edges.iter().filter(|e| e.a != e.b).collect();
        edges.sort_by(|x, y| y.traffic.total_cmp(&x.traffic).then((x.a, x.b).cmp(&(y.a, y.b))));
        let mut group: Vec<usize> = (0..parts).collect();
        let (mut trees, mut rings) = (vec![Vec::new(); parts], vec![Vec::new(); parts]);
        for edge in edges {
            let (a, b) = (group[edge.a], group[edge.b]);
            let into = if a == b { &mut rings } else { &mut trees };
            into[edge.a].push((edge.b, edge.traffic));
            into[edge.b].push((edge.a, edge.traffic));
            group.iter_mut().filter(|g| **g == a).for_each(|g| *g = b);
        }
        let mut forest = Forest {
            order: Vec::with_capacity(parts),
            parent: vec![None; parts],
            root: (0..parts).collect(),
            rings,
        };
        let mut seen = vec![false; parts];
        for start in 0..parts {
            let mut stack = if seen[start] { Vec::new() } else { vec![start] };
            seen[start] = true;
            while let Some(part) = stack.pop() {
                forest.order.push(part);
                forest.root[part] = start;
                for &(next, traffic) in trees[part].iter().filter(|(n, _)| !seen[*n]) {
                    forest.parent[next] = Some((part, traffic));
                    stack.push(next);
                }
                trees[part].iter().for_each(|(n, _)| seen[*n] = true);
            }
        }
        forest
    }
}

impl Marginals {
    pub(super) fn new(parts: usize, scales: usize) -> Self {
        let zero = vec![0.0; parts * scales];
        Marginals {
            scales,
            with: zero.clone(),
            up: zero.clone(),
            message: zero,
            tree: vec![0.0; parts],
            most: 0.0,
        }
    }

    /// The most that everything is worth with the part there.
    pub(super) fn with(&self, forest: &Forest, part: usize, scale: usize) -> f64 {
        self.most - self.tree[forest.root[part]] + self.with[part * self.scales + scale]
    }

    /// The first pass: from the leaves up. Enough for [`Marginals::most`]. `worth` is by part and scale, −∞ where a part
    /// cannot be; `ends`, as large: what the connection of a part with the one above it costs at an end on a scale.
    pub(super) fn pass_up(&mut self, forest: &Forest, worth: &[f64], ends: &[f64]) {
        let n = self.scales;
        self.up.copy_from_slice(worth);
        self.most = 0.0;
        for &part in forest.order.iter().rev() {
            let row = part * n..part * n + n;
            let Some((parent, _)) = forest.parent[part] else {
                self.tree[part] = largest(self.up[row].iter().copied());
                self.most += self.tree[part];
                continue;
            };
            let ends = &ends[row.clone()];
            let apart = largest(self.up[row.clone()].iter().zip(ends).map(|(up, end)| up - end));
            for (k, end) in ends.iter().enumerate() {
                let message = larger(self.up[part * n + k], apart - end);
                self.message[part * n + k] = message;
                self.up[parent * n + k] += message;
            }
        }
    }

    /// The second pass, after the first: from the roots down.
    pub(super) fn pass_down(&mut self, forest: &Forest, ends: &[f64]) {
        let n = self.scales;
        for &part in &forest.order {
            let row = part * n..part * n + n;
            let Some((parent, _)) = forest.parent[part] else {
                self.with[row.clone()].copy_from_slice(&self.up[row]);
                continue;
            };
            let ends = &ends[row.clone()];
            // What is above without what came from here; −∞ less −∞ is where nothing can be.
            let above = |this: &Self, k: usize| {
                let with = this.with[parent * n + k];
                if with == f64::NEG_INFINITY { with } else { with - this.message[part * n + k] }
            };
            let apart = largest((0..n).map(|k| above(self, k) - ends[k]));
            for (k, end) in ends.iter().enumerate() {
                self.with[part * n + k] =
                    self.up[part * n + k] + larger(above(self, k), apart - end);
            }
        }
    }

    /// One choice of places that is worth the most: each part's, in `places`. After the first pass.
    pub(super) fn places(&self, forest: &Forest, ends: &[f64], places: &mut [usize]) {
        let n = self.scales;
        for &part in &forest.order {
            let up = |k: usize| self.up[part * n + k];
            let value = |k: usize| match forest.parent[part] {
                Some((parent, _)) if places[parent] != k => {
                    up(k) - ends[part * n + k] - ends[part * n + places[parent]]
                }
                _ => up(k),
            };
            let mut best = 0;
            for k in 1..n {
                if value(k) > value(best) {
                    best = k;
                }
            }
            places[part] = best;
        }
    }

    /// The part above each part and their traffic, of connections in trees.
    pub(super) fn tree_edges(forest: &Forest) -> impl Iterator<Item = (usize, usize, f64)> + '_ {
        let of = |(part, parent): (usize, &Option<(usize, f64)>)| {
            parent.map(|(other, traffic)| (part, other, traffic))
        };
        forest.parent.iter().enumerate().filter_map(of)
    }
}

/// `f64::max` minds NaN, which costs more than all else here.
fn larger(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

fn largest(of: impl Iterator<Item = f64>) -> f64 {
    of.fold(f64::NEG_INFINITY, larger)
}
