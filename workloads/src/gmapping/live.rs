//! The same on a robot: its laser's scans, commands for its base through the gate.
//!
//! ```text
//!   sensor socket ── LaserScan ──▶ filter: move by what was commanded since, match, weigh, resample, draw
//!                        └──▶ steering ── {"linear", "angular"} ──▶ gate
//! ```
//!
//! What was commanded stands in for the wheels' word; the scans correct it. A command follows each scan: a laser that falls silent
//! stops the robot, by the gate's ladder.

use std::io::Write as _;
use std::time::{Duration, Instant};

use muster_ros1::proto::sensor_msgs::LaserScan;
use muster_sdk::gate::{Gate, GateError, Verdict};
use muster_sdk::sensor::{Mode, Sensor, SensorError};
use prost::Message as _;
use serde_json::json;

use super::filter::Filter;
use super::robot::Steering;
use super::world::MAX_RANGE;
use super::{Args, Pose, Scan};
use crate::clock::Stop;
use crate::exit;
use crate::rng::Rng;
use crate::run::rounded;

/// Beams of a scan that are looked at, over all directions: what is matched costs by the beam.
const BEAMS: usize = 180;

/// Between two lines of progress.
const SAY_EVERY: Duration = Duration::from_secs(1);

/// Without a scan for this long, nothing is known of the way in between, seconds.
const LONGEST_STEP: f64 = 0.5;

/// Why it cannot map.
#[derive(Debug)]
enum LiveError {
    Sensor(SensorError),
    Gate(GateError),
    /// What comes is no scan.
    Scan(String),
    Io(std::io::Error),
}

impl std::fmt::Display for LiveError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            LiveError::Sensor(error) => write!(f, "the laser: {error}"),
            LiveError::Gate(error) => write!(f, "the base: {error}"),
            LiveError::Scan(why) => write!(f, "the laser's frames are no LaserScan: {why}"),
            LiveError::Io(error) => error.fmt(f),
        }
    }
}

pub(super) fn run(sensor: &str, args: &Args) -> u8 {
    let stop = Stop::on_signals();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let done = runtime
        .map_err(LiveError::Io)
        .and_then(|runtime| runtime.block_on(explore(sensor, args, &stop)));
    match done {
        Ok(()) => exit::OK,
        Err(error) => {
            eprintln!("error: {error}");
            exit::FAILURE
        }
    }
}

async fn explore(sensor: &str, args: &Args, stop: &Stop) -> Result<(), LiveError> {
    let mut laser = Sensor::open(sensor, Mode::Latest).await.map_err(LiveError::Sensor)?;
    let mut gate = Gate::from_env().await.map_err(LiveError::Gate)?;
    let end = args.pacing.duration.map(|s| Instant::now() + Duration::from_secs_f64(s));
    let mut explorer = Explorer::new(args);
    let mut said = Instant::now();
    while !stop.is_set() && end.is_none_or(|end| Instant::now() < end) {
        let frame = laser.next().await.map_err(LiveError::Sensor)?;
        let scan =
            LaserScan::decode(frame.data).map_err(|error| LiveError::Scan(error.to_string()))?;
        let (linear, angular) = explorer.take(&scan, frame.boot)?;
        let command = json!({"linear": linear, "angular": angular}).to_string();
        let answer =
            gate.command(&args.actuator, command.into_bytes()).await.map_err(LiveError::Gate)?;
        if answer.verdict() == Verdict::Revoked {
            break;
        }
        if answer.verdict() != Verdict::Ok {
            // It stands; what was commanded is not what it did.
            explorer.commanded = (0.0, 0.0);
        }
        if said.elapsed() >= SAY_EVERY {
            said = Instant::now();
            let line = explorer.findings();
            writeln!(std::io::stdout(), "{line}").map_err(LiveError::Io)?;
        }
    }
    Ok(())
}

/// The filter and what drives by it.
struct Explorer {
    filter: Filter,
    steering: Steering,
    rng: Rng,
    /// m/s and rad/s since the last scan.
    commanded: (f64, f64),
    last: Option<Duration>,
    driven: f64,
    scans: u64,
}

impl Explorer {
    fn new(args: &Args) -> Explorer {
        let extent = args.extent;
        let bounds = [-extent, -extent, extent, extent];
        let particles = args.particles as usize;
        Explorer {
            filter: Filter::new(particles, bounds, args.resolution, args.pacing.seed),
            steering: Steering::default(),
            rng: Rng::new(args.pacing.seed),
            commanded: (0.0, 0.0),
            last: None,
            driven: 0.0,
            scans: 0,
        }
    }

    /// Takes in a scan of a time since boot; what to command.
    fn take(&mut self, scan: &LaserScan, boot: Duration) -> Result<(f64, f64), LiveError> {
        let scan = beams(scan)?;
        let passed = self.last.map_or(0.0, |last| boot.saturating_sub(last).as_secs_f64());
        self.last = Some(boot);
        let (linear, angular) = self.commanded;
        let time = passed.min(LONGEST_STEP);
        self.filter.moved(&Pose { x: linear * time, y: 0.0, yaw: angular * time });
        self.filter.take(&scan);
        self.driven += linear * time;
        self.scans += 1;
        self.commanded = self.steering.decide(&scan, &mut self.rng);
        Ok(self.commanded)
    }

    fn findings(&self) -> serde_json::Value {
        let pose = self.filter.best_pose();
        json!({
            "workload": "gmapping",
            "scans": self.scans,
            "particles": self.filter.particles(),
            "mapped_m2": rounded(self.filter.mapped(), 1),
            "x": rounded(pose.x, 3),
            "y": rounded(pose.y, 3),
            "yaw": rounded(pose.yaw, 3),
            "driven_m": rounded(self.driven, 1),
        })
    }
}

/// A scan by directions from ahead, as the filter takes it; where the laser does not look, nothing is seen.
fn beams(scan: &LaserScan) -> Result<Scan, LiveError> {
    let (from, increment) = (f64::from(scan.angle_min), f64::from(scan.angle_increment));
    if !(increment.is_finite() && increment != 0.0) || scan.ranges.is_empty() {
        return Err(LiveError::Scan("it has no rays".to_owned()));
    }
    let mut beams = Scan { ranges: vec![MAX_RANGE; BEAMS] };
    for beam in 0..BEAMS {
        let direction = beams.direction(beam);
        let turned = (direction - from).rem_euclid(std::f64::consts::TAU);
        let ray = (turned / increment).round() as usize;
        let range = scan.ranges.get(ray).map_or(MAX_RANGE, |range| f64::from(*range));
        // REP 117: infinite is nothing, negative infinity too near to measure.
        let seen = if range.is_nan() { MAX_RANGE } else { range };
        beams.ranges[beam] = seen.clamp(0.0, MAX_RANGE);
    }
    Ok(beams)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_are_found_by_their_directions() {
        use std::f32::consts::PI;
        let ranges = (0..361).map(|i| if i == 180 { 2.0 } else { f32::INFINITY }).collect();
        let scan = LaserScan {
            angle_min: -PI,
            angle_max: PI,
            angle_increment: PI / 180.0,
            ranges,
            ..LaserScan::default()
        };
        let seen = beams(&scan).unwrap();
        assert_eq!((seen.ranges[0], seen.ranges[1]), (2.0, MAX_RANGE), "ahead is in the middle");
        let half = LaserScan { angle_min: 0.0, ranges: vec![1.0; 91], ..scan };
        let seen = beams(&half).unwrap();
        assert_eq!((seen.ranges[45], seen.ranges[90]), (1.0, MAX_RANGE), "it does not look behind");
        assert!(beams(&LaserScan::default()).is_err());
    }
}
