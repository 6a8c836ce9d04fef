//! A laser scanner: rays at even angles, each with noise of its own.

use super::base::Place;
use super::noise::normal;
use super::world::World;

/// What the scanner is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Laser {
    /// Of the first ray, radians from ahead.
    pub from: f64,
    /// Of the last.
    pub to: f64,
    /// How many; two at least.
    pub rays: u32,
    /// Metres below which it sees nothing.
    pub nearest: f64,
    /// Metres beyond which it sees nothing.
    pub farthest: f64,
    /// Standard deviation of a range, metres.
    pub deviation: f64,
    /// Of the noise.
    pub seed: u64,
}

impl Laser {
    /// Between two rays, radians.
    #[must_use]
    pub fn increment(&self) -> f64 {
        (self.to - self.from) / f64::from(self.rays.saturating_sub(1).max(1))
    }

    /// The `number`th scan, from the middle of a robot at `place`: metres, infinite where nothing is seen (REP 117).
    #[must_use]
    pub fn scan(&self, world: &World, place: Place, number: u64) -> Vec<f32> {
        let range = |ray: u32| {
            let angle = place.yaw + self.from + f64::from(ray) * self.increment();
            let Some(hit) = world.cast(place.at, angle, self.farthest) else {
                return f32::INFINITY;
            };
            let index = number.wrapping_mul(u64::from(self.rays)).wrapping_add(u64::from(ray));
            let seen = hit.distance + self.deviation * normal(self.seed, index);
            // REP 117: too near is negative infinity, too far infinity.
            #[expect(clippy::cast_possible_truncation, reason = "a LaserScan's ranges are float32")]
            match seen {
                near if near < self.nearest => f32::NEG_INFINITY,
                far if far > self.farthest => f32::INFINITY,
                seen => seen as f32,
            }
        };
        (0..self.rays).map(range).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use nalgebra::Point2;

    use super::super::world::tests::room;
    use super::*;

    const LASER: Laser = Laser {
        from: -FRAC_PI_2,
        to: FRAC_PI_2,
        rays: 3,
        nearest: 0.1,
        farthest: 6.0,
        deviation: 0.0,
        seed: 1,
    };

    #[test]
    fn rays_are_where_they_are_said_to_be() {
        let world = World::new(room(0.0, 0.0, 10.0, 4.0));
        let place = Place { at: Point2::new(2.0, 1.0), yaw: PI };
        // Right of who looks west is north.
        let near = |scan: &[f32], wanted: [f32; 3]| {
            scan.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-4)
        };
        let scan = LASER.scan(&world, place, 0);
        assert!(near(&scan, [3.0, 2.0, 1.0]), "{scan:?}");
        let ahead = LASER.scan(&world, Place { yaw: 0.0, ..place }, 0);
        assert_eq!(ahead[1], f32::INFINITY, "8 m are beyond its 6 m");
        let close = LASER.scan(&world, Place { at: Point2::new(0.05, 1.0), yaw: PI }, 0);
        assert_eq!(close[1], f32::NEG_INFINITY);
    }

    #[test]
    fn noise_is_the_seed_s_and_as_large_as_it_is_said_to_be() {
        let world = World::new(room(0.0, 0.0, 10.0, 4.0));
        let place = Place { at: Point2::new(5.0, 2.0), yaw: 0.0 };
        let laser = Laser { rays: 2_001, deviation: 0.02, farthest: 30.0, ..LASER };
        let (clean, noisy) = (
            Laser { deviation: 0.0, ..laser }.scan(&world, place, 4),
            laser.scan(&world, place, 4),
        );
        let squares: f32 = clean.iter().zip(&noisy).map(|(a, b)| (a - b).powi(2)).sum();
        let deviation = (squares / 2_001.0).sqrt();
        assert!((0.018..0.022).contains(&deviation), "{deviation}");
        assert_eq!(noisy, laser.scan(&world, place, 4));
        assert!(
            noisy != laser.scan(&world, place, 5)
                && noisy != Laser { seed: 2, ..laser }.scan(&world, place, 4)
        );
    }
}
