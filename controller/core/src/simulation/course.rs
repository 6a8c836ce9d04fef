//! AnyScale's test bed (V): a course of 115 m, driven at 0.4 m/s while amcl runs away from the robot and its data come
//! through, else at 0.2 m/s.
//!
//! With a share f of the way covered, nothing can be faster than 575·(1 − f/2) s: 575 s is the way at 0.2 m/s, and a
//! covered metre takes half as long at best.

use std::time::Duration;

use jiff::Timestamp;

use super::numbers::Numbers;
use super::trace::Trace;
use super::world::{Pace, Record, STEP, World, roomy};
use crate::offload::model::Model;
use crate::offload::problem::HOME;

/// Metres.
pub const LENGTH: f64 = 115.0;
const FAST: f64 = 0.4;
const SLOW: f64 = 0.2;

/// One drive.
#[derive(Debug, Clone, PartialEq)]
pub struct Drive {
    /// The share of the way with a link.
    pub coverage: f64,
    /// Seconds.
    pub time: f64,
    /// What no drive over this coverage can be below, seconds.
    pub bound: f64,
    /// What happened on the way.
    pub record: Record,
}

impl Drive {
    /// What is saved of what could be.
    #[must_use]
    pub fn saving(&self) -> f64 {
        let slow = LENGTH / SLOW;
        (slow - self.time) / (slow - self.bound)
    }
}

/// Drives the course once: `model` is AnyScale's application, `fast` the part that must be away to drive fast.
#[must_use]
pub fn drive(model: &Model, fast: usize, seed: u64) -> Drive {
    let mut numbers = Numbers::new(seed);
    let share = numbers.between(0.45, 0.65);
    let trace = Trace::coverage(&mut numbers, LENGTH, share);
    drive_over(model, fast, &trace)
}

/// Drives the course over this coverage, given by metres.
#[must_use]
pub fn drive_over(model: &Model, fast: usize, trace: &Trace) -> Drive {
    let now = Timestamp::UNIX_EPOCH;
    let scales = vec![roomy("youbot", 1.0, now), roomy("laptop", 3.5, now)];
    let mut world = World::new(model, scales, Pace::default(), now);
    let (mut place, mut time) = (0.0, 0.0);
    let step = STEP.as_secs_f64();
    // A course that does not end is a fault of the simulation.
    let longest = Duration::from_secs(3600).as_secs_f64();
    while place < LENGTH && time < longest {
        // The access point is on the robot: the link to the laptop is that of both.
        let carries = trace.at(place);
        world.step(&[carries, carries]);
        let (scale, serves) = world.serves(fast);
        place += step * if scale != HOME && serves { FAST } else { SLOW };
        time += step;
    }
    let coverage = trace.share(LENGTH);
    let bound = LENGTH / SLOW * (1.0 - coverage / 2.0);
    Drive { coverage, time, bound, record: world.record }
}
