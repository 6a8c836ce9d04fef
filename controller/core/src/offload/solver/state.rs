//! A mapping that is being made or changed, with its loads and its worth kept up to date.

use super::super::constraint::exceeds;
use super::super::problem::{HOME, Load, Mapping, Problem};

/// Where a part is that was not placed yet.
pub(super) const NOWHERE: usize = usize::MAX;

/// A partial mapping.
#[derive(Debug, Clone)]
pub(super) struct State<'a> {
    problem: &'a Problem,
    neighbours: &'a [Vec<(usize, f64)>],
    pub(super) mapping: Mapping,
    load: Load,
    /// What the placed parts are worth, connections between them paid.
    pub(super) value: f64,
}

impl<'a> State<'a> {
    pub(super) fn empty(problem: &'a Problem, neighbours: &'a [Vec<(usize, f64)>]) -> Self {
        let zero = vec![0.0; problem.scales.len()];
        State {
            problem,
            neighbours,
            mapping: vec![NOWHERE; problem.items.len()],
            load: Load { cpu: zero.clone(), memory: zero.clone(), link: zero },
            value: 0.0,
        }
    }

    /// The state of a whole mapping, whether it keeps the constraints or not.
    pub(super) fn of(
        problem: &'a Problem,
        neighbours: &'a [Vec<(usize, f64)>],
        mapping: &[usize],
    ) -> Self {
        let mut state = State::empty(problem, neighbours);
        for (item, scale) in mapping.iter().enumerate() {
            state.put(item, *scale);
        }
        state
    }

    /// Places a part; the links are loaded by its connections with those that are placed.
    pub(super) fn put(&mut self, item: usize, scale: usize) {
        self.add(item, scale, 1.0);
        self.mapping[item] = scale;
    }

    /// Takes a part away.
    pub(super) fn take(&mut self, item: usize) {
        let scale = std::mem::replace(&mut self.mapping[item], NOWHERE);
        self.add(item, scale, -1.0);
    }

    fn add(&mut self, item: usize, scale: usize, sign: f64) {
        let part = &self.problem.items[item];
        self.load.cpu[scale] += sign * part.cpu[scale];
        self.load.memory[scale] += sign * part.memory;
        self.value += sign * part.value[scale];
        if scale != HOME {
            self.load.link[scale] += sign * part.traffic;
            self.load.link[HOME] += sign * part.traffic;
        }
        for (other, traffic) in &self.neighbours[item] {
            let there = self.mapping[*other];
            if there != NOWHERE && there != scale {
                self.load.link[scale] += sign * traffic;
                self.load.link[there] += sign * traffic;
                self.value -= sign * self.problem.edge_cost(*traffic, scale, there);
            }
        }
    }

    /// The part would fit, as far as its connections with parts that are not placed yet say nothing else.
    pub(super) fn may_fit(&self, item: usize, scale: usize) -> bool {
        if scale == HOME {
            return true;
        }
        let (part, capacity) = (&self.problem.items[item], &self.problem.scales[scale]);
        let link = self.load.link[scale] + part.traffic;
        !exceeds(self.load.cpu[scale] + part.cpu[scale], capacity.cpu)
            && !exceeds(self.load.memory[scale] + part.memory, capacity.memory)
            && !exceeds(link, capacity.bandwidth)
            && !exceeds(self.load.link[HOME] + part.traffic, self.problem.scales[HOME].bandwidth)
    }

    /// Places a part if everything placed keeps the constraints then; else nothing changes.
    pub(super) fn try_put(&mut self, item: usize, scale: usize) -> bool {
        if !self.may_fit(item, scale) {
            return false;
        }
        self.put(item, scale);
        if self.neighbours[item].is_empty() || self.links_hold() {
            return true;
        }
        self.take(item);
        false
    }

    /// No link carries more than it can.
    pub(super) fn links_hold(&self) -> bool {
        let capacities = self.problem.scales.iter().map(|s| s.bandwidth);
        self.load.link.iter().zip(capacities).all(|(need, have)| !exceeds(*need, have))
    }

    /// The problem.
    pub(super) fn problem(&self) -> &'a Problem {
        self.problem
    }

    /// For each part those that it is connected with, and the traffic.
    pub(super) fn all_neighbours(&self) -> &'a [Vec<(usize, f64)>] {
        self.neighbours
    }
}
