//! Whether the newest place counts: `PoseFresh` and `Localized`, each with why not.

use std::time::Duration;

use muster_api::pose::{Pose, PoseRef};

use super::frame;
use super::tracker::{Clocks, Place, Tracker};

/// Odometry and transforms come at 10 Hz or faster.
pub const MAX_AGE: Duration = Duration::from_secs(2);
/// Localisation like AMCL publishes when the robot has moved ("every 20 cm or so"): one that stands hears nothing.
pub const MAX_AGE_OF_LOCALISATION: Duration = Duration::from_secs(60);
/// Of the position, in its worst direction, metres: by then another robot may well be nearer.
pub const MAX_DEVIATION: f64 = 1.0;
/// The correction `map` → `odom` may be older than the rest by this many times the limit: it changes slowly.
const CORRECTION: u32 = 5;

/// What a pose must be to count.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Not older than this.
    pub max_age: Duration,
    /// Not surer than this, metres.
    pub max_deviation: f64,
}

/// How it stands with the source.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// Somebody who publishes the topic is connected.
    Connected,
    /// The master does not answer.
    NoMaster {
        /// Where it should be, and why not.
        why: String,
    },
    /// Nobody publishes the topic, as far as the master knows.
    NoPublisher {
        /// Which.
        topic: String,
    },
    /// Somebody does, and cannot be reached or read.
    Unreachable {
        /// Which.
        topic: String,
        /// Why.
        why: String,
    },
    /// The topic has a type that tells no place.
    OtherType {
        /// Which.
        topic: String,
        /// Its type.
        kind: String,
    },
    /// The agent's own part in ROS does not run.
    Down {
        /// Why.
        why: String,
    },
}

impl Source {
    /// In one word, and in a sentence.
    fn trouble(&self) -> Option<(&'static str, String)> {
        Some(match self {
            Source::Connected => return None,
            Source::NoMaster { why } => {
                ("NoMaster", format!("the ROS master does not answer: {why}"))
            }
            Source::NoPublisher { topic } => ("NoPublisher", format!("nobody publishes {topic}")),
            Source::Unreachable { topic, why } => {
                ("PublisherUnreachable", format!("the publisher of {topic} cannot be read: {why}"))
            }
            Source::OtherType { topic, kind } => {
                let known = "nav_msgs/Odometry, geometry_msgs/PoseWithCovarianceStamped, geometry_msgs/PoseStamped or \
                             tf2_msgs/TFMessage";
                (
                    "UnknownType",
                    format!("{topic} is of type {kind}, which tells no place; name one of {known}"),
                )
            }
            Source::Down { why } => ("NotRunning", why.clone()),
        })
    }
}

/// A condition: whether it holds, in one word why, and in a sentence. The sentence does not change while the reason stays.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// Whether it holds.
    pub holds: bool,
    /// CamelCase.
    pub reason: &'static str,
    /// For people.
    pub message: String,
}

impl Verdict {
    /// It holds.
    #[must_use]
    pub fn yes(reason: &'static str) -> Self {
        Verdict { holds: true, reason, message: String::new() }
    }

    /// It does not.
    #[must_use]
    pub fn no(reason: &'static str, message: impl Into<String>) -> Self {
        Verdict { holds: false, reason, message: message.into() }
    }
}

/// What is told of the robot's place.
#[derive(Debug, Clone, PartialEq)]
pub struct Standing {
    /// Where it is, or was when it was last known; `None`: never.
    pub pose: Option<Pose>,
    /// The condition `PoseFresh`.
    pub fresh: Verdict,
    /// The condition `Localized`: false whenever `fresh` is.
    pub localized: Verdict,
}

/// Judges what is known, for the map called `map`, from the source called `source_name`.
#[must_use]
pub fn judge(
    tracker: &Tracker,
    source: &Source,
    clocks: &Clocks,
    limits: &Limits,
    (map, name): (&str, &str),
) -> Standing {
    let place = tracker.place();
    let fresh = match place {
        None => never(tracker, source),
        Some(place) => freshness(place, source, clocks, limits),
    };
    let localized = localization(tracker, &fresh, limits);
    let pose = place.map(|place| told(place, (map, name), localized.holds));
    Standing { pose, fresh, localized }
}

fn never(tracker: &Tracker, source: &Source) -> Verdict {
    let (reason, message) = source.trouble().unwrap_or_else(|| match tracker.trouble() {
        Some(trouble) => ("NoPlace", trouble.to_string()),
        None => ("NoPose", "no pose has come yet".to_owned()),
    });
    Verdict::no(reason, message)
}

/// How old a place is. What came long ago is old, whatever its stamp says; what was measured long ago is so too.
fn age(place: &Place, clocks: &Clocks) -> Age {
    let silent = clocks.monotonic.saturating_sub(place.received);
    let Some((now, stamp)) = clocks.ros.zip(place.stamp) else { return Age::Of(silent) };
    match u64::try_from(now.saturating_sub(stamp)) {
        Ok(nanos) => Age::Of(silent.max(Duration::from_nanos(nanos))),
        Err(_) => Age::Ahead { by: Duration::from_nanos(stamp.abs_diff(now)), silent },
    }
}

enum Age {
    Of(Duration),
    /// Of the clock.
    Ahead {
        by: Duration,
        silent: Duration,
    },
}

fn freshness(place: &Place, source: &Source, clocks: &Clocks, limits: &Limits) -> Verdict {
    let limit = limits.max_age;
    // Localisation that is silent because the robot stands is still there; one that is gone gets the shorter time.
    let limit = if *source == Source::Connected { limit } else { limit.min(MAX_AGE) };
    let old = match age(place, clocks) {
        Age::Ahead { by, .. } if by > limits.max_age.min(MAX_AGE) => {
            let text = "the pose's stamps are ahead of this machine's clock; synchronise the clocks, or set /use_sim_time";
            return Verdict::no("ClockAhead", text);
        }
        Age::Ahead { silent, .. } => silent > limit,
        Age::Of(age) => age > limit,
    };
    if !old {
        return Verdict::yes("Fresh");
    }
    let silent = clocks.monotonic.saturating_sub(place.received) > limit;
    let (reason, message) = source.trouble().unwrap_or_else(|| match silent {
        true => ("Stale", format!("nothing new has come for more than {} s", limit.as_secs_f64())),
        false => {
            ("StampOld", format!("what comes is stamped more than {} s ago", limit.as_secs_f64()))
        }
    });
    Verdict::no(reason, message)
}

fn localization(tracker: &Tracker, fresh: &Verdict, limits: &Limits) -> Verdict {
    if let (Some(trouble), true) = (tracker.trouble(), tracker.place().is_some()) {
        return Verdict::no("NoPlace", trouble.to_string());
    }
    let Some(place) = tracker.place().filter(|_| fresh.holds) else {
        let reason = if tracker.place().is_none() { "NoPose" } else { "PoseNotFresh" };
        return Verdict::no(reason, fresh.message.clone());
    };
    let limit = limits.max_age * CORRECTION;
    if place
        .correction
        .is_some_and(|age| u64::try_from(age).is_ok_and(|age| Duration::from_nanos(age) > limit))
    {
        let text = format!(
            "the transform from map to odom is more than {} s older than the odometry",
            limit.as_secs_f64()
        );
        return Verdict::no("CorrectionOld", text);
    }
    match &place.covariance {
        Some(covariance) if covariance.deviation() > limits.max_deviation => {
            let text =
                format!("the position's standard deviation is above {} m", limits.max_deviation);
            Verdict::no("TooUncertain", text)
        }
        _ => Verdict::yes("Localized"),
    }
}

/// The place as the controller is told.
fn told(place: &Place, (map, source): (&str, &str), localized: bool) -> Pose {
    let at = &place.pose.translation;
    let yaw = frame::yaw(&place.pose);
    let stamp = jiff::Timestamp::from_microsecond(place.measured / 1_000).ok();
    let covariance = place.covariance;
    PoseRef { map, x: at.x, y: at.y, z: at.z, yaw, stamp, source, localized, covariance }.into()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::tracker::{Frames, Kind, Said, Told};
    use super::*;

    const S: i64 = 1_000_000_000;
    const LIMITS: Limits = Limits { max_age: MAX_AGE, max_deviation: MAX_DEVIATION };

    /// A second is a thousand after the machine began, and a million after the epoch.
    fn clocks(second: u64) -> Clocks {
        let wall = i64::try_from(second).unwrap() * S + 1_000_000 * S;
        Clocks { monotonic: Duration::from_secs(1_000 + second), ros: Some(wall), wall }
    }

    fn said(stamp: Option<i64>, variance: f64) -> Said {
        let mut covariance = [0.0; 36];
        (covariance[0], covariance[7]) = (variance, variance);
        let pose = frame::transform([1.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]);
        Said { frame: "odom".to_owned(), stamp, pose, covariance }
    }

    fn tracker(said: &Said, at: &Clocks) -> Tracker {
        let mut tracker = Tracker::new(Frames::default(), None);
        tracker.say(Kind::Odometry, said, at);
        tracker
    }

    fn reasons(
        tracker: &Tracker,
        source: &Source,
        clocks: &Clocks,
    ) -> (bool, &'static str, bool, &'static str) {
        let standing = judge(tracker, source, clocks, &LIMITS, ("lab", "ros1:/odom"));
        if let Some(pose) = &standing.pose {
            assert_eq!(pose.localized, standing.localized.holds);
        }
        (
            standing.fresh.holds,
            standing.fresh.reason,
            standing.localized.holds,
            standing.localized.reason,
        )
    }

    #[test]
    fn a_pose_grows_old_and_says_whose_fault_it_is() {
        let tracker = tracker(&said(clocks(5).ros, 0.1), &clocks(5));
        let at = |second, source: &Source| reasons(&tracker, source, &clocks(second));
        assert_eq!(at(7, &Source::Connected), (true, "Fresh", true, "Localized"));
        assert_eq!(at(8, &Source::Connected), (false, "Stale", false, "PoseNotFresh"));
        let gone = Source::NoPublisher { topic: "/odom".to_owned() };
        // What came is still true for as long as it would have been.
        assert_eq!(at(7, &gone), (true, "Fresh", true, "Localized"));
        assert_eq!(at(8, &gone), (false, "NoPublisher", false, "PoseNotFresh"));
        let standing = judge(&tracker, &gone, &clocks(8), &LIMITS, ("lab", "ros1:/odom"));
        let pose = standing.pose.expect("where it was");
        assert_eq!((pose.x, pose.y, pose.map.as_str(), pose.localized), (1.0, 2.0, "lab", false));
        assert_eq!(pose.stamp.expect("it was stamped").0.as_second(), 1_000_005);
        assert_eq!(standing.localized.message, "nobody publishes /odom");
    }

    #[test]
    fn stamps_count_and_not_only_arrivals() {
        // It comes now, and was measured long ago.
        let late = tracker(&said(clocks(1).ros, 0.1), &clocks(9));
        assert_eq!(reasons(&late, &Source::Connected, &clocks(9)).1, "StampOld");
        let ahead = tracker(&said(clocks(60).ros, 0.1), &clocks(9));
        assert_eq!(reasons(&ahead, &Source::Connected, &clocks(9)).1, "ClockAhead");
        let little = tracker(&said(clocks(10).ros, 0.1), &clocks(9));
        assert_eq!(reasons(&little, &Source::Connected, &clocks(9)).1, "Fresh");
        assert_eq!(
            reasons(&little, &Source::Connected, &clocks(12)).1,
            "Stale",
            "silence ages what is dated ahead"
        );
        let unstamped = tracker(&said(None, 0.1), &clocks(9));
        assert_eq!(reasons(&unstamped, &Source::Connected, &clocks(10)).1, "Fresh");
    }

    /// 3 s into a simulation, on a machine of this century.
    #[test]
    fn a_simulations_time_is_its_own() {
        let at = |second, ros| Clocks { ros, ..clocks(second) };
        let tracker = tracker(&said(Some(3 * S), 0.1), &at(5, Some(3 * S + S / 2)));
        assert_eq!(reasons(&tracker, &Source::Connected, &at(6, Some(4 * S))).1, "Fresh");
        assert_eq!(reasons(&tracker, &Source::Connected, &at(6, Some(9 * S))).1, "StampOld");
        assert_eq!(
            reasons(&tracker, &Source::Connected, &at(9, Some(3 * S))).1,
            "Stale",
            "it stands still"
        );
        assert_eq!(
            reasons(&tracker, &Source::Connected, &clocks(6)).1,
            "StampOld",
            "by the wrong clock"
        );
        let pose = judge(&tracker, &Source::Connected, &at(6, Some(4 * S)), &LIMITS, ("lab", "x"))
            .pose
            .unwrap();
        assert_eq!(
            pose.stamp.unwrap().0.as_millisecond(),
            1_000_004_500,
            "half a second before it came"
        );
    }

    #[test]
    fn who_is_not_sure_is_not_localized() {
        let tracker = tracker(&said(clocks(5).ros, 1.21), &clocks(5));
        assert_eq!(
            reasons(&tracker, &Source::Connected, &clocks(5)),
            (true, "Fresh", false, "TooUncertain")
        );
    }

    #[test]
    fn nothing_yet_says_why() {
        let tracker = Tracker::new(Frames::default(), None);
        assert_eq!(
            reasons(&tracker, &Source::Connected, &clocks(5)),
            (false, "NoPose", false, "NoPose")
        );
        let master = Source::NoMaster { why: "refused".to_owned() };
        assert_eq!(reasons(&tracker, &master, &clocks(5)), (false, "NoMaster", false, "NoPose"));
        let kind = Source::OtherType { topic: "/x".to_owned(), kind: "std_msgs/String".to_owned() };
        let standing = judge(&tracker, &kind, &clocks(5), &LIMITS, ("map", "x"));
        assert!(
            standing.fresh.message.starts_with("/x is of type std_msgs/String"),
            "{}",
            standing.fresh.message
        );
    }

    #[test]
    fn a_correction_that_nobody_repeats_is_old() {
        let told = |parent: &str, child: &str, stamp| Told {
            parent: parent.to_owned(),
            child: child.to_owned(),
            stamp,
            transform: Some(frame::Transform::identity()),
        };
        let mut tracker = Tracker::new(Frames::default(), None);
        let then = |second: u64| clocks(second).wall;
        tracker.tell(
            &[told("map", "odom", then(1)), told("odom", "base_link", then(2))],
            false,
            &clocks(2),
        );
        assert_eq!(reasons(&tracker, &Source::Connected, &clocks(2)).3, "Localized");
        tracker.tell(&[told("odom", "base_link", then(30))], false, &clocks(30));
        assert_eq!(
            reasons(&tracker, &Source::Connected, &clocks(30)),
            (true, "Fresh", false, "CorrectionOld")
        );
    }

    proptest! {
        /// A pose that is not fresh is never localized, and none turns fresh by waiting.
        #[test]
        fn time_only_makes_it_worse(stamp in 0u64..20, came in 0u64..20, waits in prop::collection::vec(0u64..3, 1..9)) {
            let tracker = tracker(&said(clocks(stamp).ros, 0.1), &clocks(came));
            let (mut now, mut old) = (came, false);
            for wait in waits {
                now += wait;
                let (fresh, reason, localized, _) = reasons(&tracker, &Source::Connected, &clocks(now));
                prop_assert!(fresh || !localized);
                // A stamp ahead of the clock is caught up with.
                if reason != "ClockAhead" {
                    prop_assert!(!(old && fresh), "{reason}");
                    old = !fresh;
                }
            }
        }
    }
}
