//! Rooms with walls, doors and pillars, and a laser in them.

use super::{Pose, Scan};
use crate::rng::Rng;

/// How far the laser sees, m.
pub(super) const MAX_RANGE: f64 = 6.0;
/// Deviation of a range, m.
const RANGE_NOISE: f64 = 0.015;
/// Part of the beams that return nothing, as from glass.
const LOST_BEAMS: f64 = 0.01;

/// Left, bottom, right, top, m.
pub(super) type Bounds = [f64; 4];

const OUTER: Bounds = [-2.0, -2.0, 10.0, 7.0];

/// Walls inside, from one point to another: four rooms around a corridor, with doors of a metre.
const WALLS: [[f64; 4]; 13] = [
    [-2.0, 2.0, -0.5, 2.0],
    [0.6, 2.0, 3.0, 2.0],
    [3.0, 2.0, 3.0, 0.5],
    [3.0, -0.6, 3.0, -2.0],
    [3.0, 2.0, 5.0, 2.0],
    [6.1, 2.0, 10.0, 2.0],
    [-2.0, 3.6, 1.0, 3.6],
    [2.1, 3.6, 4.5, 3.6],
    [4.5, 3.6, 4.5, 5.0],
    [4.5, 6.1, 4.5, 7.0],
    [4.5, 3.6, 7.0, 3.6],
    [8.1, 3.6, 10.0, 3.6],
    [7.0, -2.0, 7.0, -0.6],
];
/// Boxes that stand about.
const BOXES: [Bounds; 4] =
    [[-1.5, -1.6, -0.9, -1.0], [5.0, -0.5, 5.5, 0.1], [0.8, 5.2, 1.6, 5.8], [8.2, 5.0, 8.7, 5.9]];

/// A wall from one point to another.
#[derive(Debug, Clone, Copy)]
struct Wall {
    from: [f64; 2],
    along: [f64; 2],
}

/// The rooms.
#[derive(Debug)]
pub(super) struct World {
    walls: Vec<Wall>,
}

impl World {
    pub(super) fn rooms() -> Self {
        let sides = |[left, bottom, right, top]: Bounds| {
            [
                [left, bottom, right, bottom],
                [right, bottom, right, top],
                [right, top, left, top],
                [left, top, left, bottom],
            ]
        };
        let boxes = BOXES.into_iter().chain([OUTER]).flat_map(sides);
        let walls = WALLS.into_iter().chain(boxes);
        let wall = |[x1, y1, x2, y2]: [f64; 4]| Wall { from: [x1, y1], along: [x2 - x1, y2 - y1] };
        World { walls: walls.map(wall).collect() }
    }

    pub(super) fn bounds(&self) -> Bounds {
        OUTER
    }

    /// Metres to the nearest wall in a direction, at most `most`.
    pub(super) fn cast(&self, x: f64, y: f64, direction: f64, most: f64) -> f64 {
        let (dy, dx) = direction.sin_cos();
        let mut nearest = most;
        for wall in &self.walls {
            // x + r d = from + s along, by Cramer's rule.
            let [ax, ay] = wall.along;
            let cross = dx * ay - dy * ax;
            if cross.abs() < 1e-12 {
                continue;
            }
            let (fx, fy) = (wall.from[0] - x, wall.from[1] - y);
            let range = (fx * ay - fy * ax) / cross;
            let part = (fx * dy - fy * dx) / cross;
            if range > 0.0 && range < nearest && (0.0..=1.0).contains(&part) {
                nearest = range;
            }
        }
        nearest
    }

    /// What a laser at `pose` sees.
    pub(super) fn scan(&self, pose: &Pose, beams: usize, rng: &mut Rng) -> Scan {
        let mut scan = Scan { ranges: vec![MAX_RANGE; beams] };
        for beam in 0..beams {
            let range = self.cast(pose.x, pose.y, pose.yaw + scan.direction(beam), MAX_RANGE);
            let noise = rng.normal(RANGE_NOISE);
            if range < MAX_RANGE && rng.unit() > LOST_BEAMS {
                scan.ranges[beam] = (range + noise).clamp(0.0, MAX_RANGE);
            }
        }
        scan
    }

    /// A place is inside the rooms and not within a box.
    pub(super) fn is_floor(&self, x: f64, y: f64) -> bool {
        let within = |[left, bottom, right, top]: &Bounds| {
            (*left..=*right).contains(&x) && (*bottom..=*top).contains(&y)
        };
        within(&OUTER) && !BOXES.iter().any(within)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use super::*;

    #[test]
    fn the_laser_meets_the_nearest_wall() {
        let world = World::rooms();
        for (direction, range) in [(PI, 2.0), (-FRAC_PI_2, 2.0), (FRAC_PI_2, 3.6), (0.0, 5.0)] {
            let seen = world.cast(0.0, 0.0, direction, 9.0);
            assert!((seen - range).abs() < 1e-9, "{direction}: {seen}");
        }
        assert_eq!(world.cast(0.0, 0.0, 0.0, 1.0), 1.0, "not further than asked");
    }

    #[test]
    fn boxes_are_no_floor() {
        let world = World::rooms();
        assert!(world.is_floor(0.0, 0.0));
        assert!(!world.is_floor(5.2, 0.0) && !world.is_floor(20.0, 0.0));
    }
}
