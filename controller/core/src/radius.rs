//! When a robot has left the radius of a task that runs on it (`placement.onOutOfRange: Reschedule`).
//!
//! The live pose decides, as in placement. Localisation is noisy and robots turn around at the rim, so a robot has left
//! only when it was outside by a margin, at every look, for some time. A pose that is old, unlocalized or missing says
//! nothing: a robot is not out of range because nobody knows where it is.

use std::fmt;
use std::time::Duration;

use muster_api::pose::{OperationPosition, Pose};

use crate::node_health::Monotonic;
use crate::poses::HOLDS_FOR;

/// How far beyond the radius a robot must be, metres: twice the 0.25 m by which `amcl` moves a robot that stands still.
pub const MARGIN: f64 = 0.5;
/// For how long. A robot that swings out around an obstacle at 0.5 m/s is back in it.
pub const OUTSIDE_FOR: Duration = Duration::from_secs(5);
/// How old a pose may be to say something. Agents tell theirs with every heartbeat, trackers at 1 Hz or faster.
pub const FRESH_FOR: Duration = HOLDS_FOR;
/// How often robots are looked at.
pub const LOOK_EVERY: Duration = Duration::from_millis(500);

/// A radius.
#[derive(Debug, Clone, PartialEq)]
pub struct Radius {
    /// Its middle.
    pub at: OperationPosition,
    /// Metres.
    pub within: f64,
}

/// Where a robot is.
#[derive(Debug, Clone, Copy)]
pub struct Seen<'a> {
    /// Its newest pose.
    pub pose: &'a Pose,
    /// When that came.
    pub heard: Monotonic,
}

/// A robot that has left.
#[derive(Debug, Clone, PartialEq)]
pub struct Left {
    /// How far it is from the middle, metres; none: it is in another map.
    pub distance: Option<f64>,
    /// How far it may be.
    pub within: f64,
}

impl fmt::Display for Left {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = OUTSIDE_FOR.as_secs();
        match self.distance {
            Some(distance) => write!(
                f,
                "is {distance:.1} m from the operation position and was outside of its radius of {} m for {seconds} s",
                self.within
            ),
            None => write!(f, "was in another map than the operation position for {seconds} s"),
        }
    }
}

/// One task's robot, over time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Rim {
    /// Since when every look has found it outside.
    outside_since: Option<Monotonic>,
}

impl Rim {
    /// Takes a look as of `now`. Some: it has left.
    pub fn look(
        &mut self,
        radius: &Radius,
        seen: Option<Seen<'_>>,
        now: Monotonic,
    ) -> Option<Left> {
        let fresh =
            seen.filter(|seen| seen.pose.localized && now.saturating_sub(seen.heard) <= FRESH_FOR);
        let distance = fresh.map(|seen| radius.at.distance_to(seen.pose));
        let outside = distance.is_some_and(|d| d.is_none_or(|d| d > radius.within + MARGIN));
        let Some(distance) = distance.filter(|_| outside) else {
            self.outside_since = None;
            return None;
        };
        let since = *self.outside_since.get_or_insert(now);
        (now.saturating_sub(since) >= OUTSIDE_FOR)
            .then_some(Left { distance, within: radius.within })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn pose(x: f64, localized: bool, map: &str) -> Pose {
        let text =
            format!("{{\"x\": {x}, \"y\": 0.0, \"localized\": {localized}, \"map\": \"{map}\"}}");
        serde_json::from_str(&text).expect("a pose")
    }

    fn radius(within: f64) -> Radius {
        let at = serde_json::from_str("{\"x\": 0.0, \"y\": 0.0}").expect("a position");
        Radius { at, within }
    }

    fn seconds(s: f64) -> Monotonic {
        Duration::from_secs_f64(s)
    }

    /// What comes of looks at (second, pose, how old it is).
    fn looks(within: f64, looks: &[(f64, Pose, f64)]) -> Vec<bool> {
        let mut rim = Rim::default();
        let look = |(at, pose, age): &(f64, Pose, f64)| {
            let heard = seconds(at - age);
            rim.look(&radius(within), Some(Seen { pose, heard }), seconds(*at)).is_some()
        };
        looks.iter().map(look).collect()
    }

    #[test]
    fn a_robot_has_left_when_it_was_outside_by_the_margin_for_long_enough() {
        let out = || pose(5.6, true, "map");
        let rim = || pose(5.4, true, "map");
        let at = |second: f64, pose: Pose| (100.0 + second, pose, 0.0);
        assert_eq!(
            looks(5.0, &[at(0.0, out()), at(4.9, out()), at(5.0, out())]),
            [false, false, true]
        );
        assert_eq!(
            looks(5.0, &[at(0.0, rim()), at(9.0, rim())]),
            [false, false],
            "within the margin"
        );
        assert_eq!(
            looks(5.0, &[at(0.0, out()), at(3.0, rim()), at(6.0, out()), at(11.0, out())]),
            [false, false, false, true],
            "the time begins anew"
        );
        let lost = || pose(50.0, false, "map");
        assert_eq!(
            looks(5.0, &[at(0.0, lost()), at(9.0, lost())]),
            [false, false],
            "not localized"
        );
        let old = |second: f64| (100.0 + second, pose(50.0, true, "map"), 2.1);
        assert_eq!(looks(5.0, &[old(0.0), old(9.0)]), [false, false], "stale");
        let other = || pose(0.0, true, "upstairs");
        assert_eq!(looks(5.0, &[at(0.0, other()), at(5.0, other())]), [false, true], "another map");
    }

    #[test]
    fn what_is_said_names_the_distance() {
        let left = |distance| Left { distance, within: 5.0 }.to_string();
        assert_eq!(
            left(Some(7.25)),
            "is 7.2 m from the operation position and was outside of its radius of 5 m for 5 s"
        );
        assert_eq!(left(None), "was in another map than the operation position for 5 s");
    }

    proptest! {
        /// However it moves, is lost and found: it has left at a look exactly when all looks of the last seconds, at least
        /// two, found it surely outside.
        #[test]
        fn it_has_left_exactly_when_it_was_surely_outside_all_the_time(
            steps in proptest::collection::vec((1..12_u32, 0..80_u32, any::<bool>(), 0..40_u32), 1..60),
            within in 0..6_u32,
        ) {
            let within = f64::from(within);
            let mut rim = Rim::default();
            let (mut now, mut history) = (1000.0, Vec::new());
            for (tenths, x, localized, age) in steps {
                now += f64::from(tenths) / 2.0;
                // Most are well, so that some leave.
                let (localized, age) = (localized || x % 3 > 0, f64::from(age % 25) / 10.0);
                let pose = pose(f64::from(x) / 10.0, localized, "map");
                let seen = Seen { pose: &pose, heard: seconds(now - age) };
                let left = rim.look(&radius(within), Some(seen), seconds(now)).is_some();
                let surely = localized && age <= 2.0 && f64::from(x) / 10.0 > within + MARGIN;
                history.push((now, surely));
                let run = history.iter().rev().take_while(|(_, outside)| *outside).last();
                let expected = run.is_some_and(|(since, _)| now - since >= 5.0);
                prop_assert_eq!(left, expected);
            }
        }

        /// Noise of less than the margin at the rim never moves a task.
        #[test]
        fn noise_at_the_rim_does_nothing(noise in proptest::collection::vec(-49..49_i32, 1..100)) {
            let mut rim = Rim::default();
            for (i, noise) in noise.into_iter().enumerate() {
                let now = seconds(10.0 + i as f64);
                let pose = pose(5.0 + f64::from(noise) / 100.0, true, "map");
                prop_assert_eq!(rim.look(&radius(5.0), Some(Seen { pose: &pose, heard: now }), now), None);
            }
        }
    }
}
