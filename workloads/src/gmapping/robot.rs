//! The robot as it is: a differential drive that explores by its laser alone.

use super::world::World;
use super::{Pose, Scan};
use crate::rng::Rng;

/// Seconds between two scans of simulated time.
const PERIOD: f64 = 0.1;
/// m/s and rad/s of a TurtleBot that maps.
const SPEED: f64 = 0.35;
const TURN: f64 = 1.0;
/// It turns away from what is nearer than this ahead of it, m.
const CLEARANCE: f64 = 0.6;
/// Its body's radius, m: it does not go nearer than this to anything.
const RADIUS: f64 = 0.2;
/// Deviation of what the wheels report, part of the way and of the turn, and per step.
const WAY_NOISE: f64 = 0.05;
const TURN_NOISE: f64 = 0.05;
const YAW_NOISE: f64 = 0.004;
/// One wheel is a little larger than the other: what the wheels report bends, rad/m.
const YAW_BIAS: f64 = 0.03;
/// Beams within this angle of ahead are ahead, radians.
const AHEAD: f64 = 0.5;

/// The true robot.
#[derive(Debug, Default)]
pub(super) struct Robot {
    pose: Pose,
    driven: f64,
    steering: Steering,
}

/// Where to go by what the laser sees: ahead while nothing is near, else away from it.
#[derive(Debug, Default)]
pub(super) struct Steering {
    /// Steps for which it goes on turning, and where to: a choice is kept, or it would tremble.
    turning: u32,
    turn: f64,
    /// Where it tends to while nothing is near, rad/s.
    drift: f64,
}

impl Robot {
    pub(super) fn pose(&self) -> Pose {
        self.pose
    }

    /// Metres.
    pub(super) fn driven(&self) -> f64 {
        self.driven
    }

    /// Drives for a period as the scan suggests. Returns what the wheels say of it: a step in the
    /// frame of the pose before, with the wheels' errors.
    pub(super) fn drive(&mut self, scan: &Scan, world: &World, rng: &mut Rng) -> Pose {
        let (speed, turn) = self.steering.decide(scan, rng);
        let yaw = turn * PERIOD;
        let room = world.cast(self.pose.x, self.pose.y, self.pose.yaw, 10.0) - RADIUS;
        let way = (speed * PERIOD).min(room).max(0.0);
        self.pose = self.pose.step(&Pose { x: way, y: 0.0, yaw });
        self.driven += way;
        Pose {
            x: way * (1.0 + rng.normal(WAY_NOISE)),
            y: 0.0,
            yaw: yaw * (1.0 + rng.normal(TURN_NOISE)) + way * YAW_BIAS + rng.normal(YAW_NOISE),
        }
    }
}

impl Steering {
    /// Speed, m/s, and turn, rad/s.
    pub(super) fn decide(&mut self, scan: &Scan, rng: &mut Rng) -> (f64, f64) {
        if self.turning > 0 {
            self.turning -= 1;
            return (0.0, self.turn);
        }
        let nearest = |low: f64, high: f64| {
            let n = scan.ranges.len();
            let within = (0..n).filter(|&beam| {
                let direction = scan.direction(beam);
                let signed = if direction > std::f64::consts::PI {
                    direction - std::f64::consts::TAU
                } else {
                    direction
                };
                (low..=high).contains(&signed)
            });
            within.map(|beam| scan.ranges[beam]).fold(f64::INFINITY, f64::min)
        };
        let (left, right) = (nearest(AHEAD, 2.0), nearest(-2.0, -AHEAD));
        if nearest(-AHEAD, AHEAD) < CLEARANCE {
            self.turn = if left > right { TURN } else { -TURN };
            self.turning = 6 + rng.below(12) as u32;
            return (0.0, self.turn);
        }
        if rng.below(40) == 0 {
            self.drift = rng.between(-0.5, 0.5);
        }
        // Away from a wall that is beside it.
        let push =
            if left < CLEARANCE { -0.4 } else { 0.0 } + if right < CLEARANCE { 0.4 } else { 0.0 };
        (SPEED, self.drift + push)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_drives_far_and_through_no_wall() {
        let (world, mut rng) = (World::rooms(), Rng::new(3));
        let mut robot = Robot::default();
        let mut seen = [f64::INFINITY, f64::NEG_INFINITY];
        for _ in 0..3000 {
            let scan = world.scan(&robot.pose(), 36, &mut rng);
            robot.drive(&scan, &world, &mut rng);
            let pose = robot.pose();
            assert!(world.is_floor(pose.x, pose.y), "{pose:?}");
            seen = [seen[0].min(pose.x), seen[1].max(pose.x)];
        }
        assert!(robot.driven() > 30.0, "{} m", robot.driven());
        assert!(seen[1] - seen[0] > 3.0, "it leaves its room: {seen:?}");
    }
}
