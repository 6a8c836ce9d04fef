//! Another task that wants the base (AR): follows a path of waypoints by pure pursuit (Coulter 1992)
//! with a simulated differential-drive robot.

use std::f64::consts::{PI, TAU};

use serde_json::{Map, Value, json};

use super::rng::Rng;
use super::run::{self, Pacing, Work, rounded};

/// How often a base wants a velocity.
const COMMAND_HZ: f64 = 20.0;
/// Seconds that a command holds.
const PERIOD: f64 = 1.0 / COMMAND_HZ;
/// The point that is steered for is this far ahead on the path, m.
const LOOK_AHEAD: f64 = 0.4;
/// A TurtleBot 2's limits, m/s and rad/s.
const MAX_SPEED: f64 = 0.5;
const MAX_TURN: f64 = 1.8;
/// Slip of the wheels, part of what was commanded.
const SLIP: f64 = 0.05;

/// Corners of the path, m.
const PATH: [[f64; 2]; 6] =
    [[0.0, 0.0], [4.0, 0.0], [4.0, 2.5], [2.0, 3.5], [0.0, 2.5], [-1.0, 1.0]];

/// Flags of `muster workload drive`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    pacing: Pacing,
    /// Most metres per second
    #[arg(long, value_name = "M/S", default_value_t = MAX_SPEED, value_parser = run::positive)]
    speed: f64,
}

pub(super) fn run(args: &Args) -> u8 {
    run::run(Drive::new(args.speed, args.pacing.seed), &args.pacing, Some(COMMAND_HZ))
}

/// A unit is one command.
struct Drive {
    rng: Rng,
    speed: f64,
    units: u32,
    at: [f64; 2],
    heading: f64,
    /// The corner that is driven to.
    next: usize,
    laps: u64,
    distance: f64,
    worst_error: f64,
}

impl Drive {
    fn new(speed: f64, seed: u64) -> Self {
        Drive {
            rng: Rng::new(seed),
            speed,
            units: 1,
            at: PATH[0],
            heading: 0.0,
            next: 1,
            laps: 0,
            distance: 0.0,
            worst_error: 0.0,
        }
    }

    fn command(&mut self) {
        let from = PATH[(self.next + PATH.len() - 1) % PATH.len()];
        let to = PATH[self.next];
        let leg = [to[0] - from[0], to[1] - from[1]];
        let length = leg[0].hypot(leg[1]);
        let along = [leg[0] / length, leg[1] / length];
        let offset = [self.at[0] - from[0], self.at[1] - from[1]];
        let done = offset[0] * along[0] + offset[1] * along[1];
        let aside = (offset[0] * along[1] - offset[1] * along[0]).abs();
        self.worst_error = self.worst_error.max(aside);
        if done + LOOK_AHEAD >= length {
            self.next = (self.next + 1) % PATH.len();
            self.laps += u64::from(self.next == 0);
        }
        let goal = (done + LOOK_AHEAD).clamp(0.0, length);
        let target = [from[0] + along[0] * goal, from[1] + along[1] * goal];
        let bearing = (target[1] - self.at[1]).atan2(target[0] - self.at[0]);
        let off = turned(bearing - self.heading);
        // It turns before it drives when the path bends sharply.
        let speed = self.speed * off.cos().max(0.1);
        self.drive(speed, (2.5 * off).clamp(-MAX_TURN, MAX_TURN));
    }

    fn drive(&mut self, speed: f64, turn: f64) {
        let speed = speed * (1.0 + self.rng.normal(SLIP));
        let turn = turn * (1.0 + self.rng.normal(SLIP));
        self.heading = turned(self.heading + turn * PERIOD);
        self.at[0] += speed * PERIOD * self.heading.cos();
        self.at[1] += speed * PERIOD * self.heading.sin();
        self.distance += speed.abs() * PERIOD;
    }
}

/// An angle within ±π.
fn turned(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

impl Work for Drive {
    fn name(&self) -> &'static str {
        "drive"
    }

    fn set_units(&mut self, units: u32) {
        self.units = units;
    }

    fn frame(&mut self) {
        for _ in 0..self.units {
            self.command();
        }
    }

    fn findings(&mut self) -> Map<String, Value> {
        let mut found = Map::new();
        found.insert("x".into(), json!(rounded(self.at[0], 2)));
        found.insert("y".into(), json!(rounded(self.at[1], 2)));
        found.insert("heading".into(), json!(rounded(self.heading, 3)));
        found.insert("laps".into(), json!(self.laps));
        found.insert("distance_m".into(), json!(rounded(self.distance, 2)));
        found.insert("worst_path_error_m".into(), json!(rounded(self.worst_error, 3)));
        if let Ok(lease) = std::env::var("MUSTER_LEASE") {
            found.insert("lease".into(), json!(lease));
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_goes_round_and_stays_near_the_path() {
        let mut drive = Drive::new(MAX_SPEED, 1);
        for _ in 0..4000 {
            drive.command();
        }
        assert!(drive.laps >= 4, "{} laps", drive.laps);
        assert!(drive.worst_error < 0.5, "{} m", drive.worst_error);
    }

    #[test]
    fn angles_stay_within_half_a_turn() {
        for (angle, expected) in [(3.5 * PI, -0.5 * PI), (-1.25 * PI, 0.75 * PI), (1.0, 1.0)] {
            assert!((turned(angle) - expected).abs() < 1e-9);
        }
    }
}
