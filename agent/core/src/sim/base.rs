//! A differential drive: what it was told to do, how fast it may become that, where it is, what is left in its battery.
//!
//! The robot is a disc. It never comes nearer to a wall than its radius (less [`SLACK`]): a step that would is taken as far as
//! it goes, and the robot stands. It turns on the spot wherever it is. What it was told counts for [`Limits::watchdog_ms`]; then it
//! brakes. Energy falls with time and motion, and rises only at a dock.

use nalgebra::{Point2, Vector2};

use super::world::World;
use crate::time::Boot;

/// Length of a step, ms: at 2 m/s the robot moves 2 cm in it.
pub const STEP_MS: u64 = 10;

/// How much nearer to a wall than its radius a robot may be found, metres: what rounding does.
pub const SLACK: f64 = 1e-6;

/// Halvings of a step that ends at a wall: 2 cm become less than [`SLACK`].
const HALVINGS: u32 = 20;

/// Slower than this is standing, m/s and rad/s.
const STANDS: f64 = 1e-6;

/// What the base can do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Metres per second, forwards and backwards.
    pub speed: f64,
    /// Radians per second.
    pub turn: f64,
    /// m/s² when it becomes faster.
    pub acceleration: f64,
    /// m/s² when it becomes slower.
    pub braking: f64,
    /// rad/s², to either.
    pub turn_acceleration: f64,
    /// Of the disc, metres.
    pub radius: f64,
    /// How long a command counts, ms.
    pub watchdog_ms: u64,
}

/// What the battery holds, and what takes it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Battery {
    /// Joules when it is full.
    pub capacity: f64,
    /// Joules at the beginning.
    pub charge: f64,
    /// Watts that the robot takes while it stands.
    pub idle: f64,
    /// Joules a metre.
    pub per_metre: f64,
    /// Joules a radian.
    pub per_radian: f64,
    /// Watts that a dock gives.
    pub charging: f64,
}

/// A place at which a robot that stands is charged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dock {
    /// Its middle.
    pub at: Point2<f64>,
    /// How near the robot's middle has to be, metres.
    pub within: f64,
}

/// What it is told, and what it does.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Velocity {
    /// Metres per second, ahead.
    pub linear: f64,
    /// Radians per second, counter-clockwise.
    pub angular: f64,
}

impl Velocity {
    /// It stands.
    pub const ZERO: Velocity = Velocity { linear: 0.0, angular: 0.0 };

    fn is_zero(self) -> bool {
        self.linear.abs() < STANDS && self.angular.abs() < STANDS
    }
}

/// Where it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Its middle, metres in the map frame.
    pub at: Point2<f64>,
    /// Its heading, radians in (−π, π].
    pub yaw: f64,
}

/// A robot's base at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct Base {
    limits: Limits,
    battery: Option<Battery>,
    docks: Vec<Dock>,
    place: Place,
    velocity: Velocity,
    target: Velocity,
    /// When it was told its target.
    told: Boot,
    now: Boot,
    blocked: bool,
}

impl Base {
    /// A base that stands at `place`; none, when a wall is nearer than its radius.
    #[must_use]
    pub fn new(
        limits: Limits,
        battery: Option<Battery>,
        docks: Vec<Dock>,
        place: Place,
        world: &World,
        now: Boot,
    ) -> Option<Base> {
        let free = world.clearance(place.at, place.at, limits.radius) >= limits.radius;
        free.then_some(Base {
            limits,
            battery,
            docks,
            place,
            velocity: Velocity::ZERO,
            target: Velocity::ZERO,
            told: now,
            now,
            blocked: false,
        })
    }

    /// Where it is.
    #[must_use]
    pub fn place(&self) -> Place {
        self.place
    }

    /// What it does.
    #[must_use]
    pub fn velocity(&self) -> Velocity {
        self.velocity
    }

    /// Joules that are left; none: it has no battery.
    #[must_use]
    pub fn energy(&self) -> Option<f64> {
        self.battery.map(|battery| battery.charge)
    }

    /// Percent of a full battery.
    #[must_use]
    pub fn percent(&self) -> Option<f64> {
        self.battery.map(|battery| 100.0 * battery.charge / battery.capacity)
    }

    /// Whether a dock charges it.
    #[must_use]
    pub fn is_charging(&self) -> bool {
        let near = |dock: &Dock| (dock.at - self.place.at).norm() <= dock.within;
        self.battery.is_some() && self.velocity.is_zero() && self.docks.iter().any(near)
    }

    /// Whether a wall keeps it from going where it is told to.
    #[must_use]
    pub fn is_blocked(&self) -> bool {
        self.blocked
    }

    /// Takes up what is left in the battery, joules: of an earlier life of the same robot.
    pub fn set_energy(&mut self, joules: f64) {
        if let Some(battery) = &mut self.battery {
            battery.charge = joules.clamp(0.0, battery.capacity);
        }
    }

    /// It is told a velocity; what it cannot do it does as well as it can. Not a number is standing.
    pub fn command(&mut self, wanted: Velocity, world: &World, now: Boot) {
        self.advance(world, now);
        let within =
            |wanted: f64, most: f64| if wanted.is_nan() { 0.0 } else { wanted.clamp(-most, most) };
        self.target = Velocity {
            linear: within(wanted.linear, self.limits.speed),
            angular: within(wanted.angular, self.limits.turn),
        };
        self.told = now;
        self.blocked = false;
    }

    /// Time passes, to `now` or less than a step before it.
    pub fn advance(&mut self, world: &World, now: Boot) {
        while now.0.saturating_sub(self.now.0) >= STEP_MS {
            let steps = (now.0 - self.now.0) / STEP_MS;
            // Nothing but the battery changes while it stands: hours need no steps.
            let at_once = if self.rests() { steps } else { 1 };
            self.step(world);
            self.now = self.now.plus(STEP_MS * at_once);
            self.drain(seconds(STEP_MS * at_once));
        }
    }

    fn rests(&self) -> bool {
        self.velocity.is_zero() && self.wanted().is_zero()
    }

    /// What it is to do: nothing when it was not told for too long, or has no energy.
    fn wanted(&self) -> Velocity {
        let stale = self.now.0.saturating_sub(self.told.0) >= self.limits.watchdog_ms;
        let empty = self.battery.is_some_and(|battery| battery.charge <= 0.0);
        if stale || empty { Velocity::ZERO } else { self.target }
    }

    fn step(&mut self, world: &World) {
        let (wanted, dt, limits) = (self.wanted(), seconds(STEP_MS), self.limits);
        let linear = approach(
            self.velocity.linear,
            wanted.linear,
            limits.acceleration * dt,
            limits.braking * dt,
        );
        let turns = limits.turn_acceleration * dt;
        let angular = approach(self.velocity.angular, wanted.angular, turns, turns);
        self.velocity = Velocity { linear, angular };
        // The chord of the arc.
        let heading = self.place.yaw + angular * dt / 2.0;
        let moves = Vector2::new(heading.cos(), heading.sin()) * (linear * dt);
        let (from, goes) = (self.place.at, self.free(world, moves));
        self.place = Place { at: from + moves * goes, yaw: wrapped(self.place.yaw + angular * dt) };
        if goes < 1.0 {
            self.velocity.linear = 0.0;
            self.blocked = true;
        }
        if let Some(battery) = &mut self.battery {
            let takes = battery.per_metre * (self.place.at - from).norm()
                + battery.per_radian * (angular * dt).abs();
            battery.charge = (battery.charge - takes).max(0.0);
        }
    }

    /// How much of a move is free of walls: the way swept grows with the part that is taken, so halving finds it.
    fn free(&self, world: &World, moves: Vector2<f64>) -> f64 {
        let (at, least) = (self.place.at, self.limits.radius - SLACK);
        let is_free =
            |part: f64| world.clearance(at, at + moves * part, self.limits.radius) >= least;
        if moves == Vector2::zeros() || is_free(1.0) {
            return 1.0;
        }
        let (mut free, mut not) = (0.0, 1.0);
        for _ in 0..HALVINGS {
            let middle = f64::midpoint(free, not);
            if is_free(middle) { free = middle } else { not = middle }
        }
        free
    }

    fn drain(&mut self, dt: f64) {
        let charging = self.is_charging();
        let Some(battery) = &mut self.battery else { return };
        let gains = if charging { battery.charging } else { 0.0 };
        battery.charge =
            (battery.charge + (gains - battery.idle) * dt).clamp(0.0, battery.capacity);
    }
}

/// `from` on its way to `to`: faster by `up` at most, slower by `down`.
fn approach(from: f64, to: f64, up: f64, down: f64) -> f64 {
    // Through a stand first, where the direction changes.
    let goal = if from * to < 0.0 { 0.0 } else { to };
    let most = if goal.abs() > from.abs() { up } else { down };
    from + (goal - from).clamp(-most, most)
}

fn wrapped(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    let turned = angle.rem_euclid(TAU);
    if turned > PI { turned - TAU } else { turned }
}

#[expect(clippy::cast_precision_loss, reason = "a robot does not stand for 2^53 ms")]
fn seconds(ms: u64) -> f64 {
    ms as f64 / 1_000.0
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::world::tests::{room, wall, walls};
    use super::*;

    const LIMITS: Limits = Limits {
        speed: 1.0,
        turn: 2.0,
        acceleration: 1.0,
        braking: 2.0,
        turn_acceleration: 6.0,
        radius: 0.2,
        watchdog_ms: 500,
    };

    const BATTERY: Battery = Battery {
        capacity: 1_000.0,
        charge: 500.0,
        idle: 1.0,
        per_metre: 20.0,
        per_radian: 2.0,
        charging: 50.0,
    };

    fn ahead(linear: f64) -> Velocity {
        Velocity { linear, angular: 0.0 }
    }

    fn at(x: f64, y: f64, yaw: f64) -> Place {
        Place { at: Point2::new(x, y), yaw }
    }

    fn base(world: &World, place: Place) -> Base {
        Base::new(LIMITS, Some(BATTERY), Vec::new(), place, world, Boot(0)).expect("it is free")
    }

    /// Told so every 100 ms.
    fn drive(base: &mut Base, world: &World, velocity: Velocity, from: u64, to: u64) {
        for now in (from..to).step_by(100) {
            base.command(velocity, world, Boot(now));
        }
        base.advance(world, Boot(to));
    }

    #[test]
    fn it_keeps_to_its_limits_and_stops_at_walls() {
        let world = World::new(room(0.0, 0.0, 10.0, 4.0));
        let mut base = base(&world, at(1.0, 2.0, 0.0));
        drive(&mut base, &world, ahead(5.0), 0, 500);
        assert!((base.velocity().linear - 0.5).abs() < 1e-9, "1 m/s²: {:?}", base.velocity());
        drive(&mut base, &world, ahead(5.0), 500, 3_000);
        assert!((base.velocity().linear - 1.0).abs() < 1e-9, "not faster than it can");
        drive(&mut base, &world, ahead(5.0), 3_000, 20_000);
        assert!((base.place().at.x - 9.8).abs() < 1e-4, "{:?}", base.place());
        assert!(base.is_blocked() && base.velocity() == Velocity::ZERO);
        drive(&mut base, &world, ahead(-1.0), 20_000, 22_000);
        assert!(base.place().at.x < 9.0 && !base.is_blocked(), "and away from it");
    }

    #[test]
    fn it_brakes_when_it_is_told_to_and_when_nobody_says_anything() {
        let world = World::new(Vec::new());
        let mut told = base(&world, at(0.0, 0.0, 0.0));
        drive(&mut told, &world, ahead(1.0), 0, 2_000);
        let mut silent = told.clone();
        told.command(Velocity::ZERO, &world, Boot(2_000));
        told.advance(&world, Boot(2_500));
        assert_eq!(told.velocity(), Velocity::ZERO);
        // Told last at 1 900.
        silent.advance(&world, Boot(2_390));
        assert!((silent.velocity().linear - 1.0).abs() < 1e-9);
        silent.advance(&world, Boot(2_950));
        assert_eq!(silent.velocity(), Velocity::ZERO);
    }

    #[test]
    fn a_robot_without_energy_stands_until_a_dock_charges_it() {
        let world = World::new(Vec::new());
        let docks = vec![Dock { at: Point2::new(0.0, 0.0), within: 0.3 }];
        let battery = Battery { charge: 10.0, ..BATTERY };
        let mut base =
            Base::new(LIMITS, Some(battery), docks, at(0.0, 1.0, 0.0), &world, Boot(0)).unwrap();
        drive(&mut base, &world, ahead(1.0), 0, 10_000);
        assert_eq!((base.velocity(), base.energy()), (Velocity::ZERO, Some(0.0)));
        assert!(!base.is_charging());
        base.place = at(0.1, 0.0, 0.0);
        base.advance(&world, Boot(12_000));
        assert!(base.is_charging());
        let percent = base.percent().unwrap();
        assert!((percent - 2.0 * 49.0 / 10.0).abs() < 0.1, "{percent}");
        base.advance(&world, Boot(1_000_000));
        assert_eq!(base.percent(), Some(100.0));
    }

    #[test]
    fn nobody_begins_in_a_wall() {
        let world = World::new(vec![wall(0.0, -1.0, 0.0, 1.0)]);
        assert_eq!(Base::new(LIMITS, None, Vec::new(), at(0.1, 0.0, 0.0), &world, Boot(0)), None);
    }

    fn commands() -> impl Strategy<Value = Vec<(Velocity, u64)>> {
        let velocity =
            (-2.0..2.0, -3.0..3.0_f64).prop_map(|(linear, angular)| Velocity { linear, angular });
        proptest::collection::vec((velocity, 1..900_u64), 1..12)
    }

    proptest! {
        // Each looks at every step; what is not optimised takes its time.
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn it_is_never_in_a_wall_and_energy_only_falls(walls in walls(), orders in commands()) {
            let alone: Vec<World> = walls.iter().map(|wall| World::new(vec![*wall])).collect();
            let world = World::new(walls);
            let start = at(0.3, 0.3, 0.0);
            let Some(mut base) = Base::new(LIMITS, Some(BATTERY), Vec::new(), start, &world, Boot(0)) else {
                return Ok(());
            };
            let (mut now, mut energy) = (0, base.energy());
            for (order, lasts) in orders {
                base.command(order, &world, Boot(now));
                for _ in 0..lasts.div_ceil(STEP_MS) {
                    let from = base.place().at;
                    now += STEP_MS;
                    base.advance(&world, Boot(now));
                    // Against every wall, one by one: neither the place nor the way to it.
                    let clear = |wall: &World| wall.clearance(from, base.place().at, 1.0);
                    let nearest = alone.iter().map(clear).fold(f64::INFINITY, f64::min);
                    prop_assert!(nearest >= LIMITS.radius - 2.0 * SLACK, "{nearest}");
                    prop_assert!(base.energy() <= energy);
                    energy = base.energy();
                    let v = base.velocity();
                    prop_assert!(v.linear.abs() <= LIMITS.speed + 1e-9 && v.angular.abs() <= LIMITS.turn + 1e-9);
                }
            }
        }

        #[test]
        fn how_often_it_is_looked_at_changes_nothing(orders in commands(), looks in proptest::collection::vec(1..400_u64, 1..60)) {
            let world = World::new(room(-3.0, -3.0, 3.0, 3.0));
            let (mut one, mut other) = (base(&world, at(0.0, 0.0, 0.0)), base(&world, at(0.0, 0.0, 0.0)));
            let (mut now, mut looks) = (0, looks.into_iter().cycle());
            for (order, lasts) in orders {
                one.command(order, &world, Boot(now));
                other.command(order, &world, Boot(now));
                let end = now + lasts;
                while now < end {
                    now = (now + looks.next().unwrap_or(1)).min(end);
                    other.advance(&world, Boot(now));
                }
            }
            one.advance(&world, Boot(now));
            prop_assert!((one.place().at - other.place().at).norm() < 1e-9);
            prop_assert_eq!(one.velocity(), other.velocity());
            let (a, b) = (one.energy().unwrap(), other.energy().unwrap());
            prop_assert!((a - b).abs() < 1e-6, "{} {}", a, b);
        }
    }
}
