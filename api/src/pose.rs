//! Where a robot is: position and heading in a named map, metres and radians, REP 105's `map` frame.

use std::fmt;
use std::str::FromStr;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use k8s_openapi::jiff::Timestamp;
use nalgebra::Point3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The map of a pose or an operation position that names none.
pub const DEFAULT_MAP: &str = "map";

fn default_map() -> String {
    DEFAULT_MAP.to_owned()
}

fn yes() -> bool {
    true
}

/// A robot's position and heading in the frame of `map`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Pose {
    /// The map whose frame the numbers are in. Different maps are out of each other's reach.
    #[serde(default = "default_map")]
    pub map: String,
    /// East of the map's origin, metres.
    pub x: f64,
    /// North of the map's origin, metres.
    pub y: f64,
    /// Above the map's origin, metres.
    #[serde(default)]
    pub z: f64,
    /// Heading, radians counter-clockwise from the x axis, (−π, π].
    #[serde(default)]
    pub yaw: f64,
    /// When the robot was there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stamp: Option<MicroTime>,
    /// Where the agent has it from, `static`, `ros1:/odom`.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub source: String,
    /// False: the robot does not know where it is, and location-based placement leaves it out.
    #[serde(default = "yes")]
    pub localized: bool,
    /// How sure it is; absent: its source does not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariance: Option<Covariance>,
}

/// The part of a pose's covariance that matters on a floor, in the frame of the pose's map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Covariance {
    /// Variance of x, m².
    pub xx: f64,
    /// Covariance of x and y, m².
    pub xy: f64,
    /// Variance of y, m².
    pub yy: f64,
    /// Variance of the heading, rad².
    pub yaw: f64,
}

impl Covariance {
    /// The standard deviation of the position in the direction in which it is worst, metres: the root of the larger
    /// eigenvalue.
    #[must_use]
    pub fn deviation(&self) -> f64 {
        let (mean, half) = ((self.xx + self.yy) / 2.0, (self.xx - self.yy) / 2.0);
        (mean + half.hypot(self.xy)).max(0.0).sqrt()
    }
}

impl Pose {
    /// The position, metres in the frame of `map`.
    #[must_use]
    pub fn position(&self) -> Point3<f64> {
        Point3::new(self.x, self.y, self.z)
    }

    /// The same, borrowed.
    #[must_use]
    pub fn view(&self) -> PoseRef<'_> {
        PoseRef {
            map: &self.map,
            x: self.x,
            y: self.y,
            z: self.z,
            yaw: self.yaw,
            stamp: self.stamp.as_ref().map(|s| s.0),
            source: &self.source,
            localized: self.localized,
            covariance: self.covariance,
        }
    }

    /// Becomes `new`. Texts that stay the same are not allocated again: poses come a hundred thousand times a second.
    pub fn set(&mut self, new: PoseRef<'_>) {
        let keep = |old: &mut String, new: &str| {
            if old != new {
                new.clone_into(old);
            }
        };
        keep(&mut self.map, new.map);
        keep(&mut self.source, new.source);
        (self.x, self.y, self.z, self.yaw) = (new.x, new.y, new.z, new.yaw);
        (self.stamp, self.localized) = (new.stamp.map(MicroTime), new.localized);
        self.covariance = new.covariance;
    }
}

/// A [`Pose`] whose texts are somebody else's; the fields are the same.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseRef<'a> {
    /// The map whose frame the numbers are in.
    pub map: &'a str,
    /// East, metres.
    pub x: f64,
    /// North, metres.
    pub y: f64,
    /// Up, metres.
    pub z: f64,
    /// Heading, radians.
    pub yaw: f64,
    /// When the robot was there.
    pub stamp: Option<Timestamp>,
    /// What measured it.
    pub source: &'a str,
    /// False: the robot is not where this says.
    pub localized: bool,
    /// How sure it is.
    pub covariance: Option<Covariance>,
}

impl PoseRef<'_> {
    /// The same place in the same map, localized or not; who says so and when may differ.
    #[must_use]
    pub fn is_at(&self, other: &PoseRef<'_>) -> bool {
        let place = |p: &PoseRef<'_>| (p.x, p.y, p.z, p.yaw, p.localized);
        place(self) == place(other) && self.map == other.map
    }
}

impl From<PoseRef<'_>> for Pose {
    fn from(pose: PoseRef<'_>) -> Self {
        Pose {
            map: pose.map.to_owned(),
            x: pose.x,
            y: pose.y,
            z: pose.z,
            yaw: pose.yaw,
            stamp: pose.stamp.map(MicroTime),
            source: pose.source.to_owned(),
            localized: pose.localized,
            covariance: pose.covariance,
        }
    }
}

/// Where the work is (Avalon, III-C: the operation position).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct OperationPosition {
    /// The map whose frame the numbers are in.
    #[serde(default = "default_map")]
    pub map: String,
    /// East of the map's origin, metres.
    pub x: f64,
    /// North of the map's origin, metres.
    pub y: f64,
    /// Above the map's origin, metres.
    #[serde(default)]
    pub z: f64,
}

impl OperationPosition {
    /// The position, metres in the frame of `map`.
    #[must_use]
    pub fn position(&self) -> Point3<f64> {
        Point3::new(self.x, self.y, self.z)
    }

    /// Euclidean distance to a robot, metres; none when the robot is in another map (Avalon, Alg. 1,
    /// in three dimensions).
    #[must_use]
    pub fn distance_to(&self, pose: &Pose) -> Option<f64> {
        (self.map == pose.map).then(|| nalgebra::distance(&self.position(), &pose.position()))
    }
}

/// A fixed position as agents take it on the command line, `X,Y[,YAW]`: metres and radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FixedPosition {
    /// East, metres.
    pub x: f64,
    /// North, metres.
    pub y: f64,
    /// Heading, radians.
    pub yaw: f64,
}

/// Why a text is not a [`FixedPosition`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is not a position: write X,Y or X,Y,YAW (metres, radians), as in 3.0,4.5,1.57")]
pub struct FixedPositionError {
    text: String,
}

impl FromStr for FixedPosition {
    type Err = FixedPositionError;

    fn from_str(text: &str) -> Result<Self, FixedPositionError> {
        let bad = || FixedPositionError { text: text.to_owned() };
        let numbers: Vec<f64> = text
            .split(',')
            .map(|part| part.trim().parse::<f64>().ok().filter(|n| n.is_finite()))
            .collect::<Option<_>>()
            .ok_or_else(bad)?;
        match numbers[..] {
            [x, y] => Ok(FixedPosition { x, y, yaw: 0.0 }),
            [x, y, yaw] => Ok(FixedPosition { x, y, yaw }),
            _ => Err(bad()),
        }
    }
}

impl fmt::Display for Pose {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.2},{:.2}", self.x, self.y)?;
        if self.z != 0.0 {
            write!(f, ",{:.2}", self.z)?;
        }
        if self.map != DEFAULT_MAP {
            write!(f, " in {}", self.map)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(map: &str, x: f64, y: f64, z: f64) -> Pose {
        Pose {
            map: map.to_owned(),
            x,
            y,
            z,
            yaw: 0.0,
            stamp: None,
            source: String::new(),
            localized: true,
            covariance: None,
        }
    }

    #[test]
    fn the_deviation_is_that_of_the_worst_direction() {
        let of = |xx, xy, yy| Covariance { xx, xy, yy, yaw: 0.0 }.deviation();
        assert_eq!((of(0.25, 0.0, 0.0), of(0.0, 0.0, 4.0)), (0.5, 2.0));
        // Along the diagonal: variance 2, and none across it.
        assert!((of(1.0, 1.0, 1.0) - 2.0_f64.sqrt()).abs() < 1e-12);
        assert_eq!(of(-1.0, 0.0, -1.0), 0.0);
    }

    #[test]
    fn distance_is_euclidean_in_three_dimensions_and_only_within_one_map() {
        let at = OperationPosition { map: "lab".to_owned(), x: 1.0, y: 2.0, z: 3.0 };
        assert_eq!(at.distance_to(&pose("lab", 3.0, 5.0, 9.0)), Some(7.0));
        assert_eq!(at.distance_to(&pose("hall", 1.0, 2.0, 3.0)), None);
    }

    #[test]
    fn fixed_positions_are_two_or_three_finite_numbers() {
        assert_eq!("1, -2.5".parse(), Ok(FixedPosition { x: 1.0, y: -2.5, yaw: 0.0 }));
        assert_eq!("1,2,3.5".parse(), Ok(FixedPosition { x: 1.0, y: 2.0, yaw: 3.5 }));
        for bad in ["", "1", "1,2,3,4", "a,b", "1,inf", "nan,0"] {
            assert!(bad.parse::<FixedPosition>().is_err(), "{bad}");
        }
    }
}
