//! What ROS told last of the robot's place, in the map frame.
//!
//! Which message means what:
//!
//! | message | its frame | in the map by |
//! |---|---|---|
//! | `nav_msgs/Odometry` | the map's: taken as it is; any other is the odometry frame | `map` → `odom` of the settings |
//! | `PoseStamped`, `PoseWithCovarianceStamped` | the map's, or none named; the odometry frame | as above |
//! | `tf2_msgs/TFMessage` | the tree | the tree; where it has no `map` → `odom`, that of the settings |

use std::time::Duration;

use muster_api::pose::Covariance;

use super::frame::{self, Transform};
use super::tf::{Nanos, NoWay, Tree};

/// The names of REP 105's frames on this robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frames {
    /// The map's.
    pub map: String,
    /// That of odometry: continuous, and drifting.
    pub odom: String,
    /// The robot's own.
    pub base: String,
}

impl Default for Frames {
    fn default() -> Self {
        Frames { map: "map".to_owned(), odom: "odom".to_owned(), base: "base_link".to_owned() }
    }
}

/// A pose as a message says it.
#[derive(Debug, Clone, PartialEq)]
pub struct Said {
    /// `header.frame_id`.
    pub frame: String,
    /// `header.stamp`; `None`: zero, which means that nobody set it.
    pub stamp: Option<Nanos>,
    /// That frame from the robot's; `None`: the numbers are no pose.
    pub pose: Option<Transform>,
    /// Row-major, all zero when the message has none.
    pub covariance: [f64; 36],
}

/// What kind of message it is, as far as its frame goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Its frame is the odometry frame, however it is called, unless it is the map's.
    Odometry,
    /// It may be in either.
    Pose,
}

/// A transform of a `TFMessage`.
#[derive(Debug, Clone, PartialEq)]
pub struct Told {
    /// `header.frame_id`.
    pub parent: String,
    /// `child_frame_id`.
    pub child: String,
    /// `header.stamp`.
    pub stamp: Nanos,
    /// `None`: the numbers are no transform.
    pub transform: Option<Transform>,
}

/// What time it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Clocks {
    /// Monotonic, as places are received by.
    pub monotonic: Duration,
    /// ROS's: this machine's, or the simulation's. `None`: a simulation that has not said.
    pub ros: Option<Nanos>,
    /// This machine's, nanoseconds since the epoch.
    pub wall: Nanos,
}

impl Clocks {
    /// What ROS stamped so, by this machine's clock; without a stamp, now.
    fn measured(&self, stamp: Option<Nanos>) -> Nanos {
        let ago = self.ros.zip(stamp).map_or(0, |(now, stamp)| now.saturating_sub(stamp));
        self.wall.saturating_sub(ago)
    }
}

/// Where the robot was.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// The map frame from the robot's.
    pub pose: Transform,
    /// ROS time of it; `None`: nobody said.
    pub stamp: Option<Nanos>,
    /// When that was learnt, on a monotonic clock.
    pub received: Duration,
    /// When it was so by this machine's clock, simulation or not: nanoseconds since the epoch.
    pub measured: Nanos,
    /// How sure it is.
    pub covariance: Option<Covariance>,
    /// How old the correction `map` → `odom` is against the rest, of a tree that has one.
    pub correction: Option<Nanos>,
}

/// Why what was said is no place in the map.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoPlace {
    /// The message's numbers are no pose.
    #[error("the message's numbers are no pose: not finite, or a quaternion of zero")]
    Numbers,
    /// It is in a frame that means nothing here.
    #[error(
        "the pose is in the frame {found:?}, which is neither {map:?} nor {odom:?}; name them with --ros-frames"
    )]
    OtherFrame {
        /// Of the message.
        found: String,
        /// Of the settings.
        map: String,
        /// Of the settings.
        odom: String,
    },
    /// The tree does not reach that far.
    #[error(transparent)]
    NoWay(#[from] NoWay),
}

/// Follows what is told.
#[derive(Debug, Clone)]
pub struct Tracker {
    frames: Frames,
    /// Of the settings.
    map_from_odom: Option<Transform>,
    tree: Tree,
    place: Option<Place>,
    trouble: Option<NoPlace>,
}

fn plain(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

impl Tracker {
    /// Nothing is known yet.
    #[must_use]
    pub fn new(frames: Frames, map_from_odom: Option<Transform>) -> Self {
        Tracker { frames, map_from_odom, tree: Tree::default(), place: None, trouble: None }
    }

    /// The newest place.
    #[must_use]
    pub fn place(&self) -> Option<&Place> {
        self.place.as_ref()
    }

    /// Why what came last is no place.
    #[must_use]
    pub fn trouble(&self) -> Option<&NoPlace> {
        self.trouble.as_ref()
    }

    fn set(&mut self, place: Result<Place, NoPlace>) {
        match place {
            Ok(place) => (self.place, self.trouble) = (Some(place), None),
            Err(trouble) => self.trouble = Some(trouble),
        }
    }

    /// A message with a pose came.
    pub fn say(&mut self, kind: Kind, said: &Said, now: &Clocks) {
        let place = self.map_from(kind, &said.frame).and_then(|map_from_frame| {
            let pose = map_from_frame * said.pose.ok_or(NoPlace::Numbers)?;
            let covariance = frame::covariance(&said.covariance, &map_from_frame);
            Ok(Place {
                pose,
                stamp: said.stamp,
                received: now.monotonic,
                measured: now.measured(said.stamp),
                covariance,
                correction: None,
            })
        });
        self.set(place);
    }

    /// The map's frame from that of a message.
    fn map_from(&self, kind: Kind, frame: &str) -> Result<Transform, NoPlace> {
        let (frame, map, odom) = (plain(frame), plain(&self.frames.map), plain(&self.frames.odom));
        let correction = self.map_from_odom.unwrap_or_else(Transform::identity);
        match kind {
            _ if frame == map => Ok(Transform::identity()),
            Kind::Odometry => Ok(correction),
            Kind::Pose if frame.is_empty() => Ok(Transform::identity()),
            Kind::Pose if frame == odom => Ok(correction),
            Kind::Pose => Err(NoPlace::OtherFrame {
                found: frame.to_owned(),
                map: map.to_owned(),
                odom: odom.to_owned(),
            }),
        }
    }

    /// Transforms came.
    pub fn tell(&mut self, told: &[Told], are_static: bool, now: &Clocks) {
        for one in told {
            let Some(transform) = one.transform else { continue };
            match are_static {
                true => self.tree.tell_static(&one.parent, &one.child, transform),
                false => self.tree.tell(&one.parent, &one.child, one.stamp, transform),
            }
        }
        let before = self.place.as_ref().and_then(|place| place.stamp);
        let place = self.look_up(now);
        // Wheels and cameras move without telling more of the robot's place: that is as old as it was.
        let news = match &place {
            Ok(place) => place.stamp.is_none() || place.stamp != before,
            Err(_) => true,
        };
        if news {
            self.set(place);
        } else if let (Some(old), Ok(new)) = (&mut self.place, place) {
            (old.pose, old.correction) = (new.pose, new.correction);
            self.trouble = None;
        }
    }

    fn look_up(&self, now: &Clocks) -> Result<Place, NoPlace> {
        let Frames { map, odom, base } = &self.frames;
        let local = self.tree.latest(base, odom)?;
        // The odometry's own age counts: corrections are dated into the future, so that they hold until the next.
        let stamp = local.stamps.iter().min().copied();
        let (map_from_odom, correction) = match (self.tree.latest(odom, map), self.map_from_odom) {
            (Ok(way), _) => (way.transform, way.stamps.iter().min().zip(stamp).map(|(c, s)| s - c)),
            (Err(_), Some(fixed)) => (fixed, None),
            (Err(error), None) => return Err(error.into()),
        };
        Ok(Place {
            pose: map_from_odom * local.transform,
            stamp,
            received: now.monotonic,
            measured: now.measured(stamp),
            covariance: None,
            correction,
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;
    use proptest::prelude::*;

    use super::super::frame::Offset;
    use super::super::frame::tests::any_transform;
    use super::*;

    const NOW: Clocks = Clocks { monotonic: Duration::from_secs(9), ros: Some(9), wall: 9 };

    fn offset(text: &str) -> Transform {
        text.parse::<Offset>().unwrap().0
    }

    fn said(frame: &str, pose: &str) -> Said {
        Said {
            frame: frame.to_owned(),
            stamp: Some(1),
            pose: Some(offset(pose)),
            covariance: [0.0; 36],
        }
    }

    fn told(parent: &str, child: &str, stamp: Nanos, transform: Transform) -> Told {
        Told {
            parent: parent.to_owned(),
            child: child.to_owned(),
            stamp,
            transform: Some(transform),
        }
    }

    fn flat(tracker: &Tracker) -> (f64, f64) {
        let at = tracker.place().expect("a place").pose.translation;
        ((at.x * 1e6).round() / 1e6, (at.y * 1e6).round() / 1e6)
    }

    #[test]
    fn odometry_is_put_into_the_map_by_the_settings() {
        let quarter = offset("10,20,1.5707963267948966");
        let mut tracker = Tracker::new(Frames::default(), Some(quarter));
        tracker.say(Kind::Odometry, &said("r1/odom", "2,1,0"), &NOW);
        assert_eq!(flat(&tracker), (9.0, 22.0));
        // A pose that is in the map already stays as it is.
        tracker.say(Kind::Pose, &said("/map", "2,1,0"), &NOW);
        assert_eq!(flat(&tracker), (2.0, 1.0));
        tracker.say(Kind::Pose, &said("odom", "2,1,0"), &NOW);
        assert_eq!(flat(&tracker), (9.0, 22.0));
        tracker.say(Kind::Pose, &said("camera", "0,0,0"), &NOW);
        assert!(matches!(tracker.trouble(), Some(NoPlace::OtherFrame { .. })));
        assert_eq!(flat(&tracker), (9.0, 22.0), "where it was last");
    }

    #[test]
    fn other_frames_do_not_make_the_place_new() {
        let mut tracker = Tracker::new(Frames::default(), None);
        let at = |x: f64| offset(&format!("{x},0,0"));
        tracker.tell(&[told("odom", "base_link", 5, at(1.0))], false, &NOW);
        assert!(matches!(tracker.trouble(), Some(NoPlace::NoWay(_))), "there is no map yet");
        tracker.tell(&[told("map", "odom", 4, at(10.0))], false, &NOW);
        assert_eq!((flat(&tracker), tracker.place().unwrap().correction), ((11.0, 0.0), Some(1)));
        let later = Clocks { monotonic: NOW.monotonic * 2, ..NOW };
        tracker.tell(
            &[told("base_link", "wheel", 99, at(0.5)), told("map", "odom", 6, at(20.0))],
            false,
            &later,
        );
        let place = tracker.place().unwrap();
        assert_eq!(
            (flat(&tracker), place.stamp, place.received),
            ((21.0, 0.0), Some(5), NOW.monotonic)
        );
        tracker.tell(&[told("odom", "base_link", 7, at(2.0))], false, &later);
        assert_eq!(tracker.place().unwrap().received, later.monotonic);
    }

    #[test]
    fn a_tree_without_a_map_is_helped_by_the_settings() {
        let mut tracker = Tracker::new(Frames::default(), Some(offset("5,5,0")));
        tracker.tell(&[told("odom", "base_footprint", 3, offset("1,0,0"))], false, &NOW);
        tracker.tell(&[told("base_footprint", "base_link", 0, offset("0,0,0"))], true, &NOW);
        assert_eq!(flat(&tracker), (6.0, 5.0));
    }

    proptest! {
        /// The same motion, as odometry with an offset and as a tree, is the same place.
        #[test]
        fn odometry_and_tree_agree(map_from_odom in any_transform(), odom_from_base in any_transform()) {
            let mut by_topic = Tracker::new(Frames::default(), Some(map_from_odom));
            let pose = Some(odom_from_base);
            by_topic.say(Kind::Odometry, &Said { pose, ..said("odom", "0,0,0") }, &NOW);
            let mut by_tree = Tracker::new(Frames::default(), None);
            by_tree.tell(&[told("map", "odom", 1, map_from_odom)], true, &NOW);
            by_tree.tell(&[told("odom", "base_link", 1, odom_from_base)], false, &NOW);
            let point = Point3::new(0.2, 0.3, 0.4);
            let (one, other) = (by_topic.place().unwrap().pose * point, by_tree.place().unwrap().pose * point);
            prop_assert!(nalgebra::distance(&one, &other) < 1e-9);
        }
    }
}
