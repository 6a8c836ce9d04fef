//! A camera: a pinhole that looks ahead over a floor, at walls of one height. Each column is one ray.

use super::base::Place;
use super::world::{Hit, World};

/// Floor and ceiling, red, green and blue.
const FLOOR: [u8; 3] = [96, 88, 80];
const CEILING: [u8; 3] = [210, 214, 220];

/// Light is half as bright at this many metres.
const DIM_AT: f64 = 8.0;

/// What the camera is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// Horizontal angle of view, radians, below π.
    pub view: f64,
    /// Metres above the floor.
    pub above: f64,
    /// Metres of the walls.
    pub walls: f64,
    /// Metres beyond which it sees haze.
    pub farthest: f64,
}

impl Camera {
    /// What it sees from `place`: rows from above, pixels from the left, red, green and blue a byte each.
    #[must_use]
    pub fn picture(&self, world: &World, place: Place) -> Vec<u8> {
        let (width, height) = (self.width as usize, self.height as usize);
        // Pixels from the pinhole to the picture.
        let depth = f64::from(self.width) / 2.0 / (self.view / 2.0).tan();
        let mut pixels = vec![0; width * height * 3];
        for column in 0..width {
            let right = centred(column, width);
            let aside = (-right / depth).atan();
            let hit = world.cast(place.at, place.yaw + aside, self.farthest);
            let seen = hit.map(|hit| (hit, hit.distance * aside.cos()));
            for row in 0..height {
                let color = self.pixel(world, place, seen, aside, -centred(row, height) / depth);
                pixels[(row * width + column) * 3..][..3].copy_from_slice(&color);
            }
        }
        pixels
    }

    /// One pixel: what is met ahead and how deep in the picture it is, and how steeply the pixel looks up.
    fn pixel(
        &self,
        world: &World,
        place: Place,
        seen: Option<(Hit, f64)>,
        aside: f64,
        up: f64,
    ) -> [u8; 3] {
        if let Some((hit, deep)) = seen {
            let at = self.above + up * deep;
            if (0.0..=self.walls).contains(&at) {
                let wall = world.walls()[hit.wall];
                let side = wall.to - wall.from;
                // Straight on it is as bright as it is; along it, half.
                let heading = place.yaw + aside;
                let along = (side.x * heading.cos() + side.y * heading.sin()).abs()
                    / side.norm().max(f64::EPSILON);
                return lit(wall.color, hit.distance, 1.0 - 0.5 * along);
            }
        }
        let (plane, color) =
            if up < 0.0 { (self.above, FLOOR) } else { (self.walls - self.above, CEILING) };
        lit(color, (plane / up.abs().max(1e-6)).min(self.farthest), 1.0)
    }
}

/// Pixels from the middle.
#[expect(clippy::cast_precision_loss, reason = "pixels of a picture")]
fn centred(at: usize, size: usize) -> f64 {
    at as f64 + 0.5 - size as f64 / 2.0
}

fn lit(color: [u8; 3], distance: f64, light: f64) -> [u8; 3] {
    let light = light / (1.0 + distance / DIM_AT);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 255")]
    color.map(|part| (f64::from(part) * light) as u8)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::Point2;

    use super::super::world::Wall;
    use super::super::world::tests::room;
    use super::*;

    const CAMERA: Camera =
        Camera { width: 32, height: 24, view: 1.0, above: 0.3, walls: 2.0, farthest: 20.0 };

    #[test]
    fn the_wall_ahead_is_in_the_middle_and_grows_as_it_comes_nearer() {
        let mut walls = room(0.0, 0.0, 10.0, 4.0);
        walls[1] = Wall { color: [250, 0, 0], ..walls[1] };
        let world = World::new(walls);
        let rows_of_wall = |x: f64, yaw: f64| {
            let picture = CAMERA.picture(&world, Place { at: Point2::new(x, 2.0), yaw });
            assert_eq!(picture.len(), 32 * 24 * 3);
            let red = |row: usize| {
                let pixel = &picture[(row * 32 + 16) * 3..][..3];
                pixel[0] > 20 && pixel[1] == 0
            };
            (0..24).filter(|row| red(*row)).count()
        };
        let (far, near) = (rows_of_wall(3.0, 0.0), rows_of_wall(8.0, 0.0));
        assert!(0 < far && far < near, "{far} {near}");
        assert_eq!(rows_of_wall(3.0, PI), 0, "behind it");
    }
}
