//! Avalon's SLAM task (AR-CR-SR): maps rooms by laser while it drives, as gmapping does (Grisetti,
//! Stachniss, Burgard 2007).
//!
//! ```text
//!   world (walls) ─ray cast, noise─▶ scan ──▶ filter: particles, each a pose and a map
//!   robot (drives by the scan) ─noisy odometry─▶ ┘      move, match, weigh, resample, draw
//! ```
//!
//! With `--sensor` it is a robot's own laser that it maps by, and the robot's base that it drives, through the gate: see
//! [`live`].
//!
//! Frames: the map frame has its origin where the robot starts; poses are in it, metres and radians.
//! A scan's beams are in the robot's frame. Simulated time passes by frames, so that a run depends on
//! the seed alone and not on the machine.

mod filter;
mod grid;
mod live;
mod robot;
mod world;

use serde_json::{Map, Value, json};

use super::rng::Rng;
use super::run::{self, Pacing, Work, rounded};
use filter::Filter;
use robot::Robot;
use world::World;

/// The fastest of the usual small lasers.
const LASER_HZ: f64 = 40.0;

/// Flags of `muster workload gmapping`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    pacing: Pacing,
    /// Particles of a unit of work
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    particles: u32,
    /// Beams of a scan, over all directions
    #[arg(long, value_name = "N", default_value_t = 180, value_parser = clap::value_parser!(u32).range(12..=3600))]
    beams: u32,
    /// Map by this laser of the robot's and drive its base; the task asks for both
    #[arg(long, value_name = "FUNCTION", conflicts_with_all = ["load", "rate", "units_per_frame", "beams"])]
    sensor: Option<String>,
    /// The base that is driven with --sensor
    #[arg(long, value_name = "FUNCTION", default_value = "base:Drive")]
    actuator: String,
    /// Metres around the start that the map has, with --sensor
    #[arg(long, value_name = "M", default_value = "12", value_parser = run::positive)]
    extent: f64,
    /// Metres across a cell of the map
    #[arg(long, value_name = "M", default_value = "0.1", value_parser = run::positive)]
    resolution: f64,
}

pub(super) fn run(args: &Args) -> u8 {
    match &args.sensor {
        Some(sensor) => live::run(sensor, args),
        None => run::run(Gmapping::new(args), &args.pacing, Some(LASER_HZ)),
    }
}

/// A place and a direction in the map frame: metres, radians.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Pose {
    x: f64,
    y: f64,
    yaw: f64,
}

impl Pose {
    /// Where a step, given in the frame of `self`, leads.
    fn step(&self, step: &Pose) -> Pose {
        let (sin, cos) = self.yaw.sin_cos();
        Pose {
            x: self.x + cos * step.x - sin * step.y,
            y: self.y + sin * step.x + cos * step.y,
            yaw: self.yaw + step.yaw,
        }
    }

    /// Metres between two places.
    fn distance(&self, other: &Pose) -> f64 {
        (self.x - other.x).hypot(self.y - other.y)
    }
}

/// What the laser saw at once.
#[derive(Debug, Clone)]
struct Scan {
    /// Metres by beam; at [`world::MAX_RANGE`] nothing was hit. Beam i looks in the direction
    /// 2 π i / n of the robot's frame.
    ranges: Vec<f64>,
}

impl Scan {
    /// Direction of a beam in the robot's frame, radians.
    fn direction(&self, beam: usize) -> f64 {
        std::f64::consts::TAU * beam as f64 / self.ranges.len() as f64
    }
}

/// A unit is a batch of particles that take in a scan.
struct Gmapping {
    world: World,
    robot: Robot,
    filter: Filter,
    /// Where the wheels alone would have the robot.
    odometry: Pose,
    rng: Rng,
    batch: usize,
    beams: usize,
    scans: u64,
}

impl Gmapping {
    fn new(args: &Args) -> Self {
        let world = World::rooms();
        let batch = args.particles as usize;
        Gmapping {
            filter: Filter::new(batch, world.bounds(), args.resolution, args.pacing.seed),
            world,
            robot: Robot::default(),
            odometry: Pose::default(),
            rng: Rng::new(args.pacing.seed ^ 0x6c61_7365_7220),
            batch,
            beams: args.beams as usize,
            scans: 0,
        }
    }

    fn take_scan(&mut self) {
        let scan = self.world.scan(&self.robot.pose(), self.beams, &mut self.rng);
        let moved = self.robot.drive(&scan, &self.world, &mut self.rng);
        // The scan was taken before the robot moved on.
        self.filter.take(&scan);
        self.filter.moved(&moved);
        self.odometry = self.odometry.step(&moved);
        self.scans += 1;
    }
}

impl Work for Gmapping {
    fn name(&self) -> &'static str {
        "gmapping"
    }

    fn set_units(&mut self, units: u32) {
        self.filter.resize(self.batch * units as usize);
    }

    fn frame(&mut self) {
        self.take_scan();
    }

    fn findings(&mut self) -> Map<String, Value> {
        let truth = self.robot.pose();
        let estimate = self.filter.best_pose();
        let mut found = Map::new();
        found.insert("scans".into(), json!(self.scans));
        found.insert("particles".into(), json!(self.filter.particles()));
        found.insert("map_coverage".into(), json!(rounded(self.filter.coverage(&self.world), 3)));
        found.insert("pose_error_m".into(), json!(rounded(estimate.distance(&truth), 3)));
        found.insert("odometry_error_m".into(), json!(rounded(self.odometry.distance(&truth), 3)));
        found.insert("driven_m".into(), json!(rounded(self.robot.driven(), 1)));
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, clap::Parser)]
    struct Flags {
        #[command(flatten)]
        args: Args,
    }

    fn mapped(flags: &[&str], scans: usize) -> Map<String, Value> {
        let all = ["gmapping"].iter().chain(flags);
        let mut work = Gmapping::new(&<Flags as clap::Parser>::parse_from(all).args);
        for _ in 0..scans {
            work.frame();
        }
        work.findings()
    }

    #[test]
    fn the_filter_finds_its_way_where_odometry_loses_it() {
        let found = mapped(&["--particles", "12", "--beams", "60", "--seed", "2"], 400);
        let number = |name: &str| found[name].as_f64().unwrap();
        assert!(number("driven_m") > 5.0, "{found:?}");
        assert!(number("map_coverage") > 0.3, "{found:?}");
        assert!(number("pose_error_m") < 0.25, "{found:?}");
        assert!(number("pose_error_m") < number("odometry_error_m"), "{found:?}");
    }

    #[test]
    fn a_seed_is_a_run() {
        let run = |seed| mapped(&["--particles", "3", "--beams", "24", "--seed", seed], 15);
        assert_eq!(run("5"), run("5"));
        assert_ne!(run("5"), run("6"));
    }

    #[test]
    fn steps_are_in_the_frame_of_the_pose() {
        let start = Pose { x: 1.0, y: 2.0, yaw: std::f64::consts::FRAC_PI_2 };
        let end = start.step(&Pose { x: 3.0, y: 0.0, yaw: 0.5 });
        assert!(end.distance(&Pose { x: 1.0, y: 5.0, yaw: 0.0 }) < 1e-9, "{end:?}");
    }
}
