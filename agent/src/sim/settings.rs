//! The world of a simulated robot, `position: sim:world.yaml`:
//!
//! ```yaml
//! walls:                                       # each a line of points, metres in the map frame
//!   - {line: [[0, 0], [10, 0], [10, 8], [0, 8], [0, 0]]}
//!   - {line: [[5, 0], [5, 5]], color: [200, 40, 40]}
//! map: lab.yaml                                # a map_server map beside this file; what is occupied is a wall
//! robot: {start: [2, 2, 0], radius: 0.2, speed: 0.5, turn: 1.5, acceleration: 0.5, braking: 1.0,
//!         turnAcceleration: 3.0, watchdog: 500ms}
//! laser: {from: -2.36, to: 2.36, rays: 271, nearest: 0.05, farthest: 10, deviation: 0.01, hz: 10}
//! camera: {width: 160, height: 120, view: 1.05, above: 0.3, hz: 10}
//! battery: {capacity: 40, charge: 80, idle: 8, perMetre: 30, perRadian: 6, charging: 60}
//! docks: [{at: [1, 1], within: 0.3}]
//! seed: 1
//! ```
//!
//! All of it has defaults but for the walls. Lengths are metres, angles radians; the battery's `capacity` is in Wh, its `charge` in
//! percent, `idle` and `charging` in W, `perMetre` and `perRadian` in J.

use std::path::{Path, PathBuf};

use muster_agent_core::sim::base::{Base, Battery, Dock, Limits, Place};
use muster_agent_core::sim::camera::Camera;
use muster_agent_core::sim::laser::Laser;
use muster_agent_core::sim::outline::outline;
use muster_agent_core::sim::world::{Wall, World};
use muster_agent_core::time::Boot;
use muster_api::duration::Span;
use muster_api::map::{Cell, Gray, Grid, MapError, MapFile};
use nalgebra::Point2;
use serde::{Deserialize, Serialize};

use crate::durable::FileError;

/// Joules of a watt-hour.
const WATT_HOUR: f64 = 3_600.0;

/// The color of walls that have none, of a map's too.
const PLASTER: [u8; 3] = [190, 184, 172];

/// Pixels of a camera at most: three bytes each.
const MOST_PIXELS: u64 = 4_000_000;

/// Metres from the middle of a world to its end.
const FARTHEST: f64 = 1e6;

/// `world.yaml`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct Settings {
    walls: Vec<Line>,
    /// Beside the world's file; its walls are among `walls` once it is read.
    #[serde(skip_serializing_if = "Option::is_none")]
    map: Option<PathBuf>,
    robot: Robot,
    pub(super) laser: Scanner,
    pub(super) camera: Eye,
    battery: Option<Cells>,
    docks: Vec<Bay>,
    seed: u64,
}

/// Walls along a line of points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Line {
    line: Vec<[f64; 2]>,
    #[serde(default = "plaster")]
    color: [u8; 3],
}

fn plaster() -> [u8; 3] {
    PLASTER
}

/// The base: a TurtleBot's, unless it is said otherwise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
struct Robot {
    start: [f64; 3],
    radius: f64,
    speed: f64,
    turn: f64,
    acceleration: f64,
    braking: f64,
    turn_acceleration: f64,
    watchdog: Span,
}

impl Default for Robot {
    fn default() -> Self {
        Robot {
            start: [0.0; 3],
            radius: 0.18,
            speed: 0.65,
            turn: 3.1,
            acceleration: 1.0,
            braking: 2.0,
            turn_acceleration: 6.0,
            watchdog: Span::from_millis(500),
        }
    }
}

/// The laser.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(super) struct Scanner {
    from: f64,
    to: f64,
    rays: u32,
    nearest: f64,
    farthest: f64,
    deviation: f64,
    pub(super) hz: f64,
}

impl Default for Scanner {
    fn default() -> Self {
        use std::f64::consts::PI;
        Scanner {
            from: -PI,
            to: PI,
            rays: 361,
            nearest: 0.05,
            farthest: 10.0,
            deviation: 0.01,
            hz: 10.0,
        }
    }
}

/// The camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(super) struct Eye {
    width: u32,
    height: u32,
    view: f64,
    above: f64,
    walls: f64,
    farthest: f64,
    pub(super) hz: f64,
}

impl Default for Eye {
    fn default() -> Self {
        Eye {
            width: 160,
            height: 120,
            view: 1.05,
            above: 0.3,
            walls: 2.5,
            farthest: 30.0,
            hz: 10.0,
        }
    }
}

/// The battery.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
struct Cells {
    capacity: f64,
    charge: f64,
    idle: f64,
    per_metre: f64,
    per_radian: f64,
    charging: f64,
}

impl Default for Cells {
    fn default() -> Self {
        Cells {
            capacity: 40.0,
            charge: 100.0,
            idle: 8.0,
            per_metre: 30.0,
            per_radian: 6.0,
            charging: 60.0,
        }
    }
}

/// A place to charge.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Bay {
    at: [f64; 2],
    #[serde(default = "near")]
    within: f64,
}

fn near() -> f64 {
    0.3
}

/// Why a world makes no sense.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SettingsError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{path}: is no world: {reason}")]
    Yaml { path: PathBuf, reason: String },
    #[error("{path}: {reason}")]
    Map { path: PathBuf, reason: MapError },
    #[error("{path}: {field}: {reason}")]
    Field { path: PathBuf, field: String, reason: String },
}

impl Settings {
    /// Reads a world and its map.
    pub(crate) fn read(path: &Path) -> Result<Settings, SettingsError> {
        let text = std::fs::read_to_string(path).map_err(FileError::at("read", path))?;
        let mut settings: Settings = serde_saphyr::from_str(&text).map_err(|error| {
            SettingsError::Yaml { path: path.to_owned(), reason: error.to_string() }
        })?;
        let map = match settings.map.take() {
            Some(map) => Some(read_map(&path.parent().unwrap_or_else(|| Path::new("")).join(map))?),
            None => None,
        };
        settings.walls.extend(map.iter().flat_map(|map| outline(map, PLASTER)).map(|wall| Line {
            line: vec![[wall.from.x, wall.from.y], [wall.to.x, wall.to.y]],
            color: wall.color,
        }));
        settings.check(map.as_ref()).map_err(|(field, reason)| SettingsError::Field {
            path: path.to_owned(),
            field,
            reason,
        })?;
        Ok(settings)
    }

    fn check(&self, map: Option<&Grid>) -> Result<(), (String, String)> {
        let robot = &self.robot;
        let positive = [
            ("robot.radius", robot.radius),
            ("robot.speed", robot.speed),
            ("robot.turn", robot.turn),
            ("robot.acceleration", robot.acceleration),
            ("robot.braking", robot.braking),
            ("robot.turnAcceleration", robot.turn_acceleration),
            ("robot.watchdog", robot.watchdog.as_duration().as_secs_f64()),
            ("laser.farthest", self.laser.farthest),
            ("laser.hz", self.laser.hz),
            ("camera.hz", self.camera.hz),
            ("camera.walls", self.camera.walls),
            ("camera.farthest", self.camera.farthest),
        ];
        let wrong = |field: &str, reason: String| Err((field.to_owned(), reason));
        if let Some((field, value)) =
            positive.into_iter().find(|(_, v)| !(v.is_finite() && *v > 0.0))
        {
            return wrong(field, format!("{value} is not a number above 0"));
        }
        for (number, wall) in self.walls.iter().enumerate() {
            let far = |at: &&f64| at.abs() > FARTHEST;
            if let Some(at) = wall.line.iter().flatten().find(far) {
                let reason =
                    format!("{at} is farther than {FARTHEST} m from the middle of the world");
                return wrong(&format!("walls[{number}].line"), reason);
            }
            let same = |pair: &[[f64; 2]]| pair[0] == pair[1];
            let finite = wall.line.iter().flatten().all(|at| at.is_finite());
            if wall.line.len() < 2 || !finite || wall.line.windows(2).any(same) {
                let reason = "a line of walls has two different points or more, [[0, 0], [4, 0]]";
                return wrong(&format!("walls[{number}].line"), reason.to_owned());
            }
        }
        self.check_sensors()?;
        if let Some(cells) = &self.battery {
            let numbers = [cells.idle, cells.per_metre, cells.per_radian, cells.charging];
            if numbers.into_iter().any(|v| !(v.is_finite() && v >= 0.0))
                || cells.capacity.is_nan()
                || cells.capacity <= 0.0
            {
                return wrong(
                    "battery",
                    "its numbers are not below 0, and its capacity is above".to_owned(),
                );
            }
            if !(0.0..=100.0).contains(&cells.charge) {
                return wrong(
                    "battery.charge",
                    format!("{} is not 0 to 100 percent", cells.charge),
                );
            }
        }
        let [x, y, _] = robot.start;
        let solid = map.is_some_and(|map| map.at(x, y) == Some(Cell::Occupied));
        let world = self.world();
        if solid
            || !robot.start.iter().all(|v| v.is_finite())
            || self.base(&world, Boot(0)).is_none()
        {
            let reason = format!(
                "({x}, {y}) is nearer to a wall than the robot's radius, {} m",
                robot.radius
            );
            return wrong("robot.start", reason);
        }
        Ok(())
    }

    fn check_sensors(&self) -> Result<(), (String, String)> {
        let (laser, camera) = (&self.laser, &self.camera);
        let wrong = |field: &str, reason: String| Err((field.to_owned(), reason));
        let angles = laser.to > laser.from && laser.to - laser.from <= std::f64::consts::TAU + 1e-6;
        if !angles {
            return wrong(
                "laser.to",
                format!("{} is not above `from`, {}, by 2π at most", laser.to, laser.from),
            );
        }
        if !(2..=20_000).contains(&laser.rays) {
            return wrong("laser.rays", format!("{} is not 2 to 20000", laser.rays));
        }
        if !(laser.nearest >= 0.0 && laser.nearest < laser.farthest && laser.deviation >= 0.0) {
            return wrong(
                "laser",
                "`nearest` is below `farthest`, and neither it nor `deviation` below 0".to_owned(),
            );
        }
        let pixels = u64::from(camera.width) * u64::from(camera.height);
        if !(1..=MOST_PIXELS).contains(&pixels) {
            return wrong(
                "camera.width",
                format!("{} x {} are not 1 to {MOST_PIXELS} pixels", camera.width, camera.height),
            );
        }
        if !(camera.view > 0.0 && camera.view < 3.0) {
            return wrong(
                "camera.view",
                format!("{} is no angle of view above 0 and below 3 radians", camera.view),
            );
        }
        if !(0.0..=camera.walls).contains(&camera.above) {
            return wrong(
                "camera.above",
                format!("{} is not between the floor and the walls' top", camera.above),
            );
        }
        Ok(())
    }

    /// Metres per second at most.
    pub(crate) fn speed(&self) -> f64 {
        self.robot.speed
    }

    /// Whether the robot has a battery.
    pub(crate) fn has_battery(&self) -> bool {
        self.battery.is_some()
    }

    pub(super) fn world(&self) -> World {
        let wall = |color: [u8; 3], pair: &[[f64; 2]]| Wall {
            from: pair[0].into(),
            to: pair[1].into(),
            color,
        };
        let walls = self
            .walls
            .iter()
            .flat_map(|line| line.line.windows(2).map(|pair| wall(line.color, pair)));
        World::new(walls.collect())
    }

    /// The robot at its start; none: it would be in a wall.
    pub(super) fn base(&self, world: &World, now: Boot) -> Option<Base> {
        let [x, y, yaw] = self.robot.start;
        self.base_at(world, Place { at: Point2::new(x, y), yaw }, now)
    }

    /// The same elsewhere.
    pub(super) fn base_at(&self, world: &World, place: Place, now: Boot) -> Option<Base> {
        let robot = &self.robot;
        let limits = Limits {
            speed: robot.speed,
            turn: robot.turn,
            acceleration: robot.acceleration,
            braking: robot.braking,
            turn_acceleration: robot.turn_acceleration,
            radius: robot.radius,
            watchdog_ms: u64::try_from(robot.watchdog.as_duration().as_millis())
                .unwrap_or(u64::MAX),
        };
        let battery = self.battery.as_ref().map(|cells| Battery {
            capacity: cells.capacity * WATT_HOUR,
            charge: cells.capacity * WATT_HOUR * cells.charge / 100.0,
            idle: cells.idle,
            per_metre: cells.per_metre,
            per_radian: cells.per_radian,
            charging: cells.charging,
        });
        let docks = self.docks.iter().map(|bay| Dock { at: bay.at.into(), within: bay.within });
        Base::new(limits, battery, docks.collect(), place, world, now)
    }

    pub(super) fn laser(&self) -> Laser {
        let Scanner { from, to, rays, nearest, farthest, deviation, .. } = self.laser;
        Laser { from, to, rays, nearest, farthest, deviation, seed: self.seed }
    }

    pub(super) fn camera(&self) -> Camera {
        let Eye { width, height, view, above, walls, farthest, .. } = self.camera;
        Camera { width, height, view, above, walls, farthest }
    }
}

fn read_map(path: &Path) -> Result<Grid, SettingsError> {
    let wrong = |path: &Path| {
        let path = path.to_owned();
        move |reason| SettingsError::Map { path, reason }
    };
    let text = std::fs::read_to_string(path).map_err(FileError::at("read", path))?;
    let file = MapFile::parse(&text).map_err(wrong(path))?;
    let image = path.parent().unwrap_or_else(|| Path::new("")).join(&file.image);
    let bytes = std::fs::read(&image).map_err(FileError::at("read", &image))?;
    Ok(file.grid(&Gray::pgm(&bytes).map_err(wrong(&image))?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Settings, String> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("world.yaml");
        std::fs::write(&path, text).unwrap();
        std::fs::write(dir.path().join("lab.yaml"), "image: lab.pgm\nresolution: 1\norigin: [0, 0, 0]\noccupied_thresh: 0.65\nfree_thresh: 0.196\n").unwrap();
        std::fs::write(dir.path().join("lab.pgm"), b"P5 3 1 255\n\xfe\xfe\x00").unwrap();
        Settings::read(&path).map_err(|error| error.to_string())
    }

    #[test]
    fn a_world_has_walls_of_its_own_and_of_its_map() {
        let settings = read("walls: [{line: [[0, 5], [3, 5], [3, 6]]}]\nmap: lab.yaml\nrobot: {start: [1, 0.5, 0]}\n").unwrap();
        assert_eq!(settings.world().walls().len(), 2 + 4);
        assert!(settings.map.is_none(), "the simulator needs no files of the user's");
    }

    #[test]
    fn what_makes_no_sense_is_named() {
        let cases = [
            ("wals: []", "wals"),
            ("walls: [{line: [[0, 0]]}]", "walls[0].line: a line of walls"),
            ("robot: {speed: 0}", "robot.speed: 0 is not"),
            ("laser: {rays: 1}", "laser.rays: 1 is not"),
            ("laser: {from: 1, to: 0}", "laser.to: 0 is not above"),
            ("camera: {width: 0}", "camera.width: 0 x 120"),
            ("camera: {above: 3}", "camera.above: 3 is not"),
            ("battery: {charge: 101}", "battery.charge: 101 is not"),
            ("battery: {idle: -1}", "battery: its numbers"),
            ("walls: [{line: [[0.1, -1], [0.1, 1]]}]", "robot.start: (0, 0) is nearer"),
            ("map: lab.yaml\nrobot: {start: [2.5, 0.5, 0], radius: 0.1}", "robot.start"),
            ("map: none.yaml", "none.yaml"),
        ];
        for (text, part) in cases {
            let refusal = read(text).unwrap_err();
            assert!(refusal.contains(part), "{text}: {refusal}");
        }
    }
}
