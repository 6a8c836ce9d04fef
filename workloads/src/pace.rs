//! How often a frame must come so that the work uses its share of a core. Pure.
//!
//! The work of one frame is fixed by flags (resolution, particles, layers); the rate is what a sensor
//! would give. [`choose`] settles rate and units from the measured cost of a frame; [`Governor`]
//! corrects the rate slowly, from cpu time that the kernel counted.

/// What is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Target {
    /// Share of one core, 0.153; none: the rate is fixed.
    pub(super) load: Option<f64>,
    /// Slowest sensor that makes sense, Hz.
    pub(super) min_rate: f64,
    /// Fastest sensor, Hz, and the rate when there is no load; none: as fast as the cpu allows.
    pub(super) max_rate: Option<f64>,
    /// Work per frame; none: as little as keeps the rate below the fastest.
    pub(super) units: Option<u32>,
}

/// What is done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Choice {
    /// Frames per second; none: one after the other.
    pub(super) rate: Option<f64>,
    /// Units of work in each frame.
    pub(super) units: u32,
    /// False: the share cannot be reached between the two rates.
    pub(super) reachable: bool,
}

/// Most units that are chosen without being asked for: beyond it the figures describe a benchmark,
/// not a robot.
const MAX_UNITS: f64 = 64.0;

/// Settles rate and units. `unit_cost`: cpu seconds of a frame of one unit.
pub(super) fn choose(target: &Target, unit_cost: f64) -> Choice {
    let Some(load) = target.load else {
        return Choice { rate: target.max_rate, units: target.units.unwrap_or(1), reachable: true };
    };
    let max = target.max_rate.unwrap_or(f64::INFINITY);
    let unit_cost = unit_cost.max(1e-7);
    let least = (load / (HEADROOM * max * unit_cost)).ceil().clamp(1.0, MAX_UNITS);
    let units = target.units.unwrap_or(least as u32).max(1);
    let wanted = load / (unit_cost * f64::from(units));
    let rate = wanted.max(target.min_rate).min(max);
    // A few percent off can be corrected later, and will be.
    let reachable = (rate / wanted - 1.0).abs() < 0.05;
    Choice { rate: Some(rate), units, reachable }
}

/// Part of a new measurement of the cost that is believed. A correction comes five times a second, so
/// a change of the cost (a bigger map, a colder cache) is followed within a second, and one frame that
/// the machine interrupted is not.
const BELIEF: f64 = 0.2;
/// Part of the cpu time owed that is made good in a second. The sum of what is owed is exact, so a mean
/// over a few seconds is right however noisy single frames are.
const REPAY: f64 = 1.0;
/// Most that is ever owed, as seconds of the share: after a long starvation nobody wants the frames
/// that were missed.
const MOST_OWED: f64 = 0.25;
/// Part of the fastest rate that is planned with; the rest is room for corrections.
const HEADROOM: f64 = 0.8;

/// Holds the share of a core.
#[derive(Debug, Clone)]
pub(super) struct Governor {
    load: f64,
    min_rate: f64,
    max_rate: f64,
    /// Cpu seconds of a frame, as believed.
    cost: f64,
    /// Cpu seconds that should have been used and were not; negative: too much was used.
    owed: f64,
}

impl Governor {
    /// `cost`: cpu seconds of a frame as measured at the start. None: there is no share to hold.
    pub(super) fn new(target: &Target, cost: f64) -> Option<Self> {
        Some(Governor {
            load: target.load?,
            min_rate: target.min_rate,
            max_rate: target.max_rate.unwrap_or(f64::INFINITY),
            cost: cost.max(1e-7),
            owed: 0.0,
        })
    }

    /// The rate after a window of `wall` seconds in which `frames` used `cpu` seconds.
    pub(super) fn after(&mut self, wall: f64, cpu: f64, frames: u64) -> f64 {
        if frames > 0 {
            self.cost += BELIEF * (cpu / frames as f64 - self.cost);
        }
        let most = MOST_OWED * self.load;
        self.owed = (self.owed + self.load * wall - cpu).clamp(-most, most);
        let share = (self.load + REPAY * self.owed).max(0.0);
        (share / self.cost).max(self.min_rate).min(self.max_rate)
    }

    /// Cpu seconds of a frame, as believed.
    pub(super) fn cost(&self) -> f64 {
        self.cost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LASER: Target =
        Target { load: Some(0.153), min_rate: 1.0, max_rate: Some(40.0), units: None };

    #[test]
    fn the_rate_makes_the_share() {
        assert_eq!(choose(&LASER, 0.0153), Choice { rate: Some(10.0), units: 1, reachable: true });
        let fast = choose(&LASER, 0.001);
        assert_eq!(fast.units, 5, "a fast machine gets more work a frame, not a faster laser");
        assert!((fast.rate.unwrap() * 5.0 * 0.001 - 0.153).abs() < 1e-12);
    }

    #[test]
    fn what_cannot_be_reached_is_said() {
        let slow = choose(&LASER, 0.5);
        assert_eq!((slow.rate, slow.reachable), (Some(1.0), false));
        let fixed = choose(&Target { units: Some(2), ..LASER }, 0.000_1);
        assert_eq!((fixed.rate, fixed.units, fixed.reachable), (Some(40.0), 2, false));
    }

    #[test]
    fn without_a_share_the_rate_is_the_sensors() {
        let plain = Target { load: None, ..LASER };
        assert_eq!(choose(&plain, 0.1), Choice { rate: Some(40.0), units: 1, reachable: true });
        let free = Target { max_rate: None, ..plain };
        assert_eq!(choose(&free, 0.1).rate, None);
        assert!(Governor::new(&plain, 0.1).is_none());
    }

    /// A machine whose frames become dearer over time, and are noisy.
    #[test]
    fn the_share_is_held_while_the_cost_drifts() {
        let mut governor = Governor::new(&LASER, 0.010).expect("a share");
        let mut rate = 15.3;
        let mut shares = Vec::new();
        for second in 0..120_u32 {
            let noise = if second % 2 == 0 { 1.08 } else { 0.92 };
            let cost = 0.010 * (1.0 + f64::from(second) / 120.0) * noise;
            let frames = f64::round(rate) as u64;
            let cpu = frames as f64 * cost;
            shares.push(cpu);
            rate = governor.after(1.0, cpu, frames);
        }
        let mean = shares[20..].iter().sum::<f64>() / 100.0;
        assert!((mean - 0.153).abs() < 0.002, "{mean}");
    }

    #[test]
    fn starvation_is_not_followed_by_a_burst() {
        let mut governor = Governor::new(&LASER, 0.01).expect("a share");
        for _ in 0..60 {
            governor.after(1.0, 0.01, 1);
        }
        let rate = governor.after(1.0, 0.01, 1);
        assert!(rate <= 1.26 * 15.3, "{rate}");
    }
}
