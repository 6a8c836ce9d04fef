//! Whether a mapping keeps the constraints (AnyScale III-B4: ii cpu of each scale, iii bandwidth of each link; and memory).
//! The first one, frequency and tolerance, is about what is observed: [`super::violation`].
//!
//! Nothing here is shared with the solver's own bookkeeping, so that one checks the other.

use super::problem::{HOME, Problem};

/// Sums of as many numbers as there are parts differ by less than this, relatively.
const ROUNDING: f64 = 1e-9;

/// What of a scale is not enough.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Resource {
    /// Cpu.
    Cpu,
    /// Memory.
    Memory,
    /// Its link.
    Bandwidth,
}

/// A constraint that a mapping breaks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Broken {
    /// A scale has less than its parts need: cores, bytes, or bits a second.
    Exceeded {
        /// The scale.
        scale: usize,
        /// Of what.
        resource: Resource,
        /// Needed.
        need: f64,
        /// There.
        have: f64,
    },
    /// A part is where it may not be.
    NotAllowed {
        /// The part.
        item: usize,
        /// Where.
        scale: usize,
    },
}

/// `need` is more than `have`, and not only by rounding.
#[must_use]
pub fn exceeds(need: f64, have: f64) -> bool {
    need > have + ROUNDING * have.abs().max(1.0)
}

/// Everything that `mapping` breaks; nothing: it is correct.
#[must_use]
pub fn check(problem: &Problem, mapping: &[usize]) -> Vec<Broken> {
    let mut broken = Vec::new();
    for (item, scale) in mapping.iter().enumerate() {
        if !problem.items[item].allowed[*scale] {
            broken.push(Broken::NotAllowed { item, scale: *scale });
        }
    }
    let load = problem.load(mapping);
    for (scale, capacity) in problem.scales.iter().enumerate() {
        let mut hold = |resource, need: f64, have: f64| {
            if exceeds(need, have) {
                broken.push(Broken::Exceeded { scale, resource, need, have });
            }
        };
        if scale != HOME {
            hold(Resource::Cpu, load.cpu[scale], capacity.cpu);
            hold(Resource::Memory, load.memory[scale], capacity.memory);
        }
        hold(Resource::Bandwidth, load.link[scale], capacity.bandwidth);
    }
    broken
}
