//! The robot: what it is told, what it says, what its sensors see. Time passes for it when somebody looks; how often changes
//! nothing (see the core).

use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use muster_agent_core::sim::base::{Base, Place, Velocity};
use muster_agent_core::sim::camera::Camera;
use muster_agent_core::sim::laser::Laser;
use muster_agent_core::sim::world::World;
use muster_failpoint::Failpoint;
use muster_ros1::proto::{sensor_msgs, std_msgs};
use nalgebra::Point2;
use prost::Message as _;
use serde::{Deserialize, Serialize};

use super::settings::Settings;
use super::{SimError, WORLD};
use crate::clock;
use crate::companion;
use crate::durable::{self, FileError, Keep};

/// Where the robot was.
const KEPT: &str = "kept.json";

/// What the simulator says of its robot, a line of JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Said {
    /// Digest of its world.
    pub(super) world: String,
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) yaw: f64,
    /// Of a full battery.
    pub(crate) percent: Option<f64>,
    pub(crate) charging: bool,
    /// A wall keeps it from going on.
    blocked: bool,
}

/// What a command is.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Command {
    #[serde(default)]
    linear: f64,
    #[serde(default)]
    angular: f64,
}

/// What the next life of the simulator must know.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Kept {
    /// Another world begins anew.
    world: String,
    place: [f64; 3],
    energy: Option<f64>,
}

/// One robot in its world.
#[derive(Debug)]
pub(super) struct Robot {
    digest: String,
    world: World,
    laser: Laser,
    camera: Camera,
    /// Seconds of a revolution of the laser.
    revolution: f64,
    base: Mutex<Base>,
    kept: PathBuf,
}

impl Robot {
    /// The robot of `dir`, where it was left.
    pub(super) fn open(dir: &Path, settings: &Settings) -> Result<Robot, SimError> {
        let path = dir.join(WORLD);
        let digest =
            companion::digest(&std::fs::read(&path).map_err(FileError::at("read", &path))?);
        let (world, kept, now) = (settings.world(), dir.join(KEPT), clock::boot());
        let left: Option<Kept> = durable::read_json(&kept)?;
        let left = left.filter(|left| left.world == digest);
        let resumed = left.and_then(|Kept { place: [x, y, yaw], energy, .. }| {
            let mut base = settings.base_at(&world, Place { at: Point2::new(x, y), yaw }, now)?;
            energy.into_iter().for_each(|joules| base.set_energy(joules));
            Some(base)
        });
        let base = resumed.or_else(|| settings.base(&world, now)).ok_or(SimError::InWall)?;
        Ok(Robot {
            digest,
            world,
            laser: settings.laser(),
            camera: settings.camera(),
            revolution: settings.laser.hz.recip(),
            base: Mutex::new(base),
            kept,
        })
    }

    /// The base as it is now.
    fn base(&self) -> MutexGuard<'_, Base> {
        let mut base = self.base.lock().unwrap_or_else(PoisonError::into_inner);
        base.advance(&self.world, clock::boot());
        base
    }

    /// Takes a command, a line of JSON.
    pub(super) fn command(&self, line: &[u8]) -> Result<(), String> {
        let read = serde_json::from_slice::<Command>(line);
        let Command { linear, angular } = read.map_err(|error| error.to_string())?;
        self.base().command(Velocity { linear, angular }, &self.world, clock::boot());
        Ok(())
    }

    /// Nobody tells it anything any more.
    pub(super) fn stop(&self) {
        self.base().command(Velocity::ZERO, &self.world, clock::boot());
    }

    pub(super) fn say(&self) -> Said {
        let base = self.base();
        let Place { at, yaw } = base.place();
        Said {
            world: self.digest.clone(),
            x: at.x,
            y: at.y,
            yaw,
            percent: base.percent(),
            charging: base.is_charging(),
            blocked: base.is_blocked(),
        }
    }

    /// The `number`th scan, as a serialised LaserScan in the frame `laser`, which is the robot's.
    #[expect(clippy::cast_possible_truncation, reason = "a LaserScan's numbers are float32")]
    pub(super) fn scan(&self, number: u64) -> Vec<u8> {
        let place = self.base().place();
        let laser = &self.laser;
        let scan = sensor_msgs::LaserScan {
            header: Some(header(number, "laser")),
            angle_min: laser.from as f32,
            angle_max: laser.to as f32,
            angle_increment: laser.increment() as f32,
            // All rays are of one moment.
            time_increment: 0.0,
            scan_time: self.revolution as f32,
            range_min: laser.nearest as f32,
            range_max: laser.farthest as f32,
            ranges: laser.scan(&self.world, place, number),
            intensities: Vec::new(),
        };
        scan.encode_to_vec()
    }

    /// The `number`th picture, as a serialised Image.
    pub(super) fn picture(&self, number: u64) -> Vec<u8> {
        let place = self.base().place();
        let picture = sensor_msgs::Image {
            header: Some(header(number, "camera")),
            height: self.camera.height,
            width: self.camera.width,
            encoding: "rgb8".to_owned(),
            is_bigendian: 0,
            step: self.camera.width * 3,
            data: self.camera.picture(&self.world, place).into(),
        };
        picture.encode_to_vec()
    }

    /// Writes down where it is, when that is not written. Blocks.
    pub(super) fn keep(&self) -> Result<(), FileError> {
        let kept = {
            let base = self.base();
            let Place { at, yaw } = base.place();
            Kept { world: self.digest.clone(), place: [at.x, at.y, yaw], energy: base.energy() }
        };
        durable::write_json(Failpoint::SimRobot, &self.kept, &kept, Keep::Crash)
    }
}

fn header(number: u64, frame: &str) -> std_msgs::Header {
    let (stamp_ns, _) = clock::stamp();
    let nanos = stamp_ns.unsigned_abs();
    // ROS's numbers begin again after 2^32.
    #[expect(clippy::cast_possible_truncation, reason = "modulo 2^32, and below 10^9")]
    let (seq, sec, nsec) =
        (number as u32, (nanos / 1_000_000_000) as u32, (nanos % 1_000_000_000) as u32);
    std_msgs::Header {
        seq,
        stamp: Some(std_msgs::Instant { sec, nsec }),
        frame_id: frame.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_stays_where_it_was_left_while_its_world_is_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let world = |text: &str| {
            let settings: Settings = serde_saphyr::from_str(text).unwrap();
            durable::write_json(
                Failpoint::SimWorld,
                &dir.path().join(WORLD),
                &settings,
                Keep::Crash,
            )
            .unwrap();
            Robot::open(dir.path(), &settings).unwrap()
        };
        let first = world("battery: {charge: 50}");
        assert!(first.command(b"{\"linear\": 0.3, \"angel\": 1}").is_err());
        first.command(b"{\"linear\": 0.5, \"angular\": 0.1}").unwrap();
        std::thread::sleep(std::time::Duration::from_millis(60));
        // It drives on meanwhile, however long that takes; and what is kept goes through text.
        let before = first.say();
        first.keep().unwrap();
        let after = first.say();
        assert!(before.x > 0.0, "{before:?}");
        let second = world("battery: {charge: 50}").say();
        let left = before.x - 1e-9..=after.x + 1e-9;
        assert!(left.contains(&second.x), "{before:?} {second:?} {after:?}");
        assert_eq!(world("battery: {charge: 60}").say().x, 0.0);
    }

    #[test]
    fn frames_are_ros_messages() {
        let dir = tempfile::tempdir().unwrap();
        let settings: Settings = serde_saphyr::from_str(
            "walls: [{line: [[2, -9], [2, 9]]}]\nlaser: {from: 0, to: 0.1, rays: 2, deviation: 0}",
        )
        .unwrap();
        durable::write_json(Failpoint::SimWorld, &dir.path().join(WORLD), &settings, Keep::Crash)
            .unwrap();
        let robot = Robot::open(dir.path(), &settings).unwrap();
        let scan = sensor_msgs::LaserScan::decode(robot.scan(3).as_slice()).unwrap();
        assert_eq!((scan.ranges.len(), scan.ranges[0], scan.header.unwrap().seq), (2, 2.0, 3));
        let picture = sensor_msgs::Image::decode(robot.picture(0).as_slice()).unwrap();
        assert_eq!(picture.data.len() as u32, picture.step * picture.height);
    }
}
