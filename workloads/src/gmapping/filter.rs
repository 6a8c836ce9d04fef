//! The Rao-Blackwellized particle filter: each particle is a way that the robot may have come, and the
//! map that follows from it.

use std::sync::Arc;

use super::grid::Grid;
use super::world::{Bounds, World};
use super::{Pose, Scan};
use crate::rng::Rng;

/// Deviation of a step that the wheels report: part of the way, of the turn, and in any case.
const WAY_DEVIATION: f64 = 0.08;
const TURN_DEVIATION: f64 = 0.08;
const LEAST_WAY: f64 = 0.004;
const LEAST_TURN: f64 = 0.006;
/// First steps of the search for the best match, m and rad; each round halves them.
const SEARCH: (f64, f64) = (0.04, 0.03);
const ROUNDS: u32 = 3;
/// Moves of a round at most, so that a frame's cost has a bound.
const MOVES: u32 = 6;
/// Beams of a scan are not independent of each other: each counts as this part of one.
const BEAM_WEIGHT: f64 = 0.08;
/// Every second beam is enough to match by.
const STRIDE: usize = 2;

/// One way that things may be.
#[derive(Debug, Clone)]
struct Particle {
    pose: Pose,
    /// Shared by particles that descend from one, until they draw.
    map: Arc<Grid>,
    /// Log-likelihood of all scans since the last resampling.
    weight: f64,
}

/// The filter.
#[derive(Debug)]
pub(super) struct Filter {
    particles: Vec<Particle>,
    rng: Rng,
    scans: u64,
}

impl Filter {
    pub(super) fn new(particles: usize, bounds: Bounds, resolution: f64, seed: u64) -> Self {
        let map = Arc::new(Grid::new(bounds, resolution));
        let first = Particle { pose: Pose::default(), map, weight: 0.0 };
        Filter { particles: vec![first; particles.max(1)], rng: Rng::new(seed), scans: 0 }
    }

    /// Square metres that the likeliest map says something of.
    pub(super) fn mapped(&self) -> f64 {
        self.best().map_or(0.0, |p| p.map.known())
    }

    pub(super) fn particles(&self) -> usize {
        self.particles.len()
    }

    /// More particles are copies of those there are; fewer are the first.
    pub(super) fn resize(&mut self, count: usize) {
        let count = count.max(1);
        let present = self.particles.len();
        for i in present..count {
            self.particles.push(self.particles[i % present].clone());
        }
        self.particles.truncate(count);
    }

    /// The wheels say that the robot made a step.
    pub(super) fn moved(&mut self, step: &Pose) {
        let way = WAY_DEVIATION * step.x.abs() + LEAST_WAY;
        let turn = TURN_DEVIATION * step.yaw.abs() + LEAST_TURN;
        for particle in &mut self.particles {
            let guess = Pose {
                x: step.x + self.rng.normal(way),
                y: step.y + self.rng.normal(LEAST_WAY),
                yaw: step.yaw + self.rng.normal(turn),
            };
            particle.pose = particle.pose.step(&guess);
        }
    }

    /// Takes a scan in: each particle looks for the pose near its own that fits its map best, is
    /// weighed by the fit, and draws the scan into its map.
    pub(super) fn take(&mut self, scan: &Scan) {
        // The first scan makes the map that others are matched with.
        if self.scans > 0 {
            for particle in &mut self.particles {
                let (pose, likelihood) = best_match(&particle.map, particle.pose, scan);
                particle.pose = pose;
                particle.weight += BEAM_WEIGHT * likelihood;
            }
            self.resample();
        }
        for particle in &mut self.particles {
            Arc::make_mut(&mut particle.map).draw(&particle.pose, scan);
        }
        self.scans += 1;
    }

    /// Weights that sum to 1.
    fn weights(&self) -> Vec<f64> {
        let most = self.particles.iter().map(|p| p.weight).fold(f64::NEG_INFINITY, f64::max);
        let mut weights: Vec<f64> =
            self.particles.iter().map(|p| (p.weight - most).exp()).collect();
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|w| *w /= sum);
        weights
    }

    /// Particles that fit live on in proportion, when fewer than half of them matter (low-variance
    /// sampling: one draw for all).
    fn resample(&mut self) {
        let weights = self.weights();
        let effective = 1.0 / weights.iter().map(|w| w * w).sum::<f64>();
        let count = self.particles.len();
        if effective > count as f64 / 2.0 {
            return;
        }
        let mut mark = self.rng.unit() / count as f64;
        let mut next = Vec::with_capacity(count);
        let mut passed = 0.0;
        for (particle, weight) in self.particles.iter().zip(weights) {
            passed += weight;
            while mark < passed && next.len() < count {
                next.push(Particle { weight: 0.0, ..particle.clone() });
                mark += 1.0 / count as f64;
            }
        }
        // Rounding may leave the last mark beyond the last weight.
        while let Some(last) = next.last().cloned()
            && next.len() < count
        {
            next.push(last);
        }
        self.particles = next;
    }

    fn best(&self) -> Option<&Particle> {
        self.particles.iter().max_by(|a, b| a.weight.total_cmp(&b.weight))
    }

    /// Of the particle that fits best.
    pub(super) fn best_pose(&self) -> Pose {
        self.best().map(|p| p.pose).unwrap_or_default()
    }

    /// Part of the world's floor that the best map knows.
    pub(super) fn coverage(&self, world: &World) -> f64 {
        self.best().map_or(0.0, |p| p.map.coverage(|x, y| world.is_floor(x, y)))
    }
}

/// Climbs from a pose to one that fits better, by steps that become finer.
fn best_match(map: &Grid, start: Pose, scan: &Scan) -> (Pose, f64) {
    let mut best = (start, map.likelihood(&start, scan, STRIDE));
    let (mut way, mut turn) = SEARCH;
    for _ in 0..ROUNDS {
        for _ in 0..MOVES {
            let moves = [
                Pose { x: way, ..Pose::default() },
                Pose { x: -way, ..Pose::default() },
                Pose { y: way, ..Pose::default() },
                Pose { y: -way, ..Pose::default() },
                Pose { yaw: turn, ..Pose::default() },
                Pose { yaw: -turn, ..Pose::default() },
            ];
            let from = best;
            for step in moves {
                let pose = from.0.step(&step);
                let likelihood = map.likelihood(&pose, scan, STRIDE);
                if likelihood > best.1 {
                    best = (pose, likelihood);
                }
            }
            if best.1 <= from.1 {
                break;
            }
        }
        way /= 2.0;
        turn /= 2.0;
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    fn filter(particles: usize) -> (World, Filter) {
        let world = World::rooms();
        let filter = Filter::new(particles, world.bounds(), 0.1, 1);
        (world, filter)
    }

    #[test]
    fn a_match_corrects_a_wrong_pose() {
        let (world, mut filter) = filter(1);
        let mut rng = Rng::new(2);
        for _ in 0..5 {
            let scan = world.scan(&Pose::default(), 90, &mut rng);
            filter.particles[0].pose = Pose::default();
            filter.take(&scan);
        }
        let scan = world.scan(&Pose::default(), 90, &mut rng);
        let start = Pose { x: 0.08, y: -0.06, yaw: 0.05 };
        let (found, _) = best_match(&filter.particles[0].map, start, &scan);
        assert!(found.distance(&Pose::default()) < 0.05 && found.yaw.abs() < 0.02, "{found:?}");
    }

    #[test]
    fn those_that_fit_live_on() {
        let (_, mut filter) = filter(20);
        for (i, particle) in filter.particles.iter_mut().enumerate() {
            particle.pose.x = i as f64;
            particle.weight = if i == 7 { 0.0 } else { -20.0 };
        }
        filter.resample();
        assert_eq!(filter.particles(), 20);
        assert!(filter.particles.iter().all(|p| p.pose.x == 7.0 && p.weight == 0.0));
    }

    #[test]
    fn equals_are_not_drawn_anew() {
        let (_, mut filter) = filter(4);
        filter.resample();
        filter.resize(9);
        assert_eq!(filter.particles(), 9);
        filter.resize(2);
        assert_eq!(filter.particles(), 2);
    }
}
