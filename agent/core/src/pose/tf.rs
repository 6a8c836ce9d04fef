//! The tree of frames: each frame's transform to its parent, over time.
//!
//! Whoever reaches the topic may say anything, so frames and samples are bounded, and a loop ends a lookup.

use std::collections::{BTreeMap, VecDeque};

use super::frame::Transform;

/// Frames of a robot with two arms are a few hundred.
const FRAMES: usize = 2048;
/// Samples of one frame: ten seconds at 100 Hz.
const SAMPLES: usize = 1024;
/// How far back samples are kept, nanoseconds: as long as tf's own buffer.
const KEPT: i64 = 10_000_000_000;
/// Frames between two others.
const DEEPEST: usize = 64;

/// Nanoseconds of ROS time.
pub type Nanos = i64;

/// Why two frames are not connected.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoWay {
    /// Nobody told of the frame.
    #[error("nobody publishes a transform of the frame {0:?}")]
    Unknown(String),
    /// They are in two trees.
    #[error("no transforms lead from {from:?} to {to:?}")]
    Apart {
        /// Upwards from here.
        from: String,
        /// This was not met.
        to: String,
    },
}

#[derive(Debug, Clone)]
enum Link {
    /// It holds at all times.
    Static(Transform),
    /// Oldest first.
    Moving(VecDeque<(Nanos, Transform)>),
}

#[derive(Debug, Clone)]
struct Edge {
    parent: String,
    link: Link,
}

/// A way from a frame up to one of its ancestors.
#[derive(Debug, Clone, PartialEq)]
pub struct Way {
    /// Coordinates in the lower frame become ones in the upper.
    pub transform: Transform,
    /// The newest stamp of each moving link, from the lower end; static ones have none.
    pub stamps: Vec<Nanos>,
}

/// Every frame that was told of.
#[derive(Debug, Clone, Default)]
pub struct Tree(BTreeMap<String, Edge>);

/// tf2 has no leading slashes; publishers of tf's time do.
fn plain(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

impl Tree {
    /// `parent_from_child` at `stamp`. What is told of a frame last says who its parent is.
    pub fn tell(&mut self, parent: &str, child: &str, stamp: Nanos, parent_from_child: Transform) {
        let Some(edge) = self.edge(parent, child) else { return };
        let Link::Moving(samples) = &mut edge.link else {
            edge.link = Link::Moving([(stamp, parent_from_child)].into());
            return;
        };
        // A clock that goes back (a bag played again, a simulation begun anew) makes the future past.
        if samples.back().is_some_and(|(newest, _)| stamp < newest - KEPT) {
            samples.clear();
        }
        let at = samples.partition_point(|(other, _)| *other < stamp);
        match samples.get_mut(at) {
            Some((same, transform)) if *same == stamp => *transform = parent_from_child,
            _ => samples.insert(at, (stamp, parent_from_child)),
        }
        let newest = samples.back().map_or(stamp, |(newest, _)| *newest);
        while samples.len() > SAMPLES
            || samples.front().is_some_and(|(oldest, _)| newest - oldest > KEPT)
        {
            samples.pop_front();
        }
    }

    /// `parent_from_child` for ever.
    pub fn tell_static(&mut self, parent: &str, child: &str, parent_from_child: Transform) {
        if let Some(edge) = self.edge(parent, child) {
            edge.link = Link::Static(parent_from_child);
        }
    }

    fn edge(&mut self, parent: &str, child: &str) -> Option<&mut Edge> {
        let (parent, child) = (plain(parent), plain(child));
        let full = self.0.len() >= FRAMES && !self.0.contains_key(child);
        if parent == child || child.is_empty() || parent.is_empty() || full {
            return None;
        }
        let new = || Edge { parent: parent.to_owned(), link: Link::Moving(VecDeque::new()) };
        let edge = self.0.entry(child.to_owned()).or_insert_with(new);
        if edge.parent != parent {
            *edge = new();
        }
        Some(edge)
    }

    /// From `from` up to `to`, each link as it was told last: localisation says the correction `map` → `odom` rarely, and
    /// means it to hold until it says the next.
    ///
    /// # Errors
    ///
    /// There is no way up.
    pub fn latest(&self, from: &str, to: &str) -> Result<Way, NoWay> {
        self.climb(from, to, |samples| samples.back().copied())
    }

    /// The same at a time: between two samples interpolated, before the first and after the last held.
    ///
    /// # Errors
    ///
    /// There is no way up.
    pub fn at(&self, from: &str, to: &str, time: Nanos) -> Result<Way, NoWay> {
        self.climb(from, to, |samples| interpolate(samples, time))
    }

    fn climb(
        &self,
        from: &str,
        to: &str,
        pick: impl Fn(&VecDeque<(Nanos, Transform)>) -> Option<(Nanos, Transform)>,
    ) -> Result<Way, NoWay> {
        let (from, to) = (plain(from), plain(to));
        let mut way = Way { transform: Transform::identity(), stamps: Vec::new() };
        let mut frame = from;
        for _ in 0..DEEPEST {
            if frame == to {
                return Ok(way);
            }
            let Some(edge) = self.0.get(frame) else { break };
            let step = match &edge.link {
                Link::Static(transform) => *transform,
                Link::Moving(samples) => {
                    let Some((stamp, transform)) = pick(samples) else { break };
                    way.stamps.push(stamp);
                    transform
                }
            };
            way.transform = step * way.transform;
            frame = &edge.parent;
        }
        match self.0.contains_key(from) {
            true => Err(NoWay::Apart { from: from.to_owned(), to: to.to_owned() }),
            false => Err(NoWay::Unknown(from.to_owned())),
        }
    }
}

fn interpolate(samples: &VecDeque<(Nanos, Transform)>, time: Nanos) -> Option<(Nanos, Transform)> {
    let after = samples.partition_point(|(stamp, _)| *stamp < time);
    let (Some(before), Some((later, end))) = (after.checked_sub(1), samples.get(after)) else {
        // Before the first, or after the last.
        return samples.get(after).or_else(|| samples.back()).copied();
    };
    let (earlier, begin) = &samples[before];
    #[expect(clippy::cast_precision_loss, reason = "spans of seconds, in nanoseconds")]
    let share = (time - earlier) as f64 / (later - earlier) as f64;
    // Half a turn has two ways round; any sample is as right as another then.
    let between = begin.try_lerp_slerp(end, share, 1e-9).unwrap_or(*end);
    Some((time, between))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Vector3};
    use proptest::prelude::*;

    use super::*;

    fn at(x: f64, y: f64, yaw: f64) -> Transform {
        Isometry3::new(Vector3::new(x, y, 0.0), Vector3::z() * yaw)
    }

    fn is(one: &Transform, other: &Transform) -> bool {
        (one.translation.vector - other.translation.vector).norm() < 1e-9
            && one.rotation.angle_to(&other.rotation) < 1e-9
    }

    #[test]
    fn a_chain_is_composed_with_static_links() {
        let mut tree = Tree::default();
        tree.tell("map", "/odom", 5, at(10.0, 0.0, std::f64::consts::FRAC_PI_2));
        tree.tell("odom", "base_footprint", 7, at(2.0, 0.0, 0.0));
        tree.tell_static("base_footprint", "base_link", at(0.0, 0.0, 0.0));
        let way = tree.latest("base_link", "map").unwrap();
        assert!(is(&way.transform, &at(10.0, 2.0, std::f64::consts::FRAC_PI_2)));
        assert_eq!(way.stamps, [7, 5]);
        assert_eq!(tree.latest("wheel", "map"), Err(NoWay::Unknown("wheel".to_owned())));
        let apart = NoWay::Apart { from: "base_link".to_owned(), to: "world".to_owned() };
        assert_eq!(tree.latest("base_link", "world"), Err(apart));
    }

    #[test]
    fn a_loop_ends() {
        let mut tree = Tree::default();
        tree.tell("a", "b", 1, at(1.0, 0.0, 0.0));
        tree.tell("b", "a", 1, at(1.0, 0.0, 0.0));
        tree.tell("a", "a", 1, at(1.0, 0.0, 0.0));
        assert!(tree.latest("a", "map").is_err());
    }

    #[test]
    fn between_samples_it_is_interpolated_and_outside_held() {
        let mut tree = Tree::default();
        tree.tell("odom", "base", 200, at(4.0, 0.0, 1.0));
        tree.tell("odom", "base", 100, at(2.0, 0.0, 0.0));
        let then = |time| tree.at("base", "odom", time).unwrap().transform;
        assert!(is(&then(150), &at(3.0, 0.0, 0.5)));
        assert!(is(&then(50), &at(2.0, 0.0, 0.0)) && is(&then(500), &at(4.0, 0.0, 1.0)));
        assert!(is(&tree.latest("base", "odom").unwrap().transform, &at(4.0, 0.0, 1.0)));
    }

    #[test]
    fn a_simulation_that_begins_anew_counts() {
        let mut tree = Tree::default();
        tree.tell("odom", "base", 100 * KEPT, at(9.0, 0.0, 0.0));
        tree.tell("odom", "base", 1, at(1.0, 0.0, 0.0));
        assert!(is(&tree.latest("base", "odom").unwrap().transform, &at(1.0, 0.0, 0.0)));
    }

    proptest! {
        /// However many are told, in whatever order: bounded, and the newest is the newest.
        #[test]
        fn samples_are_bounded_and_in_order(stamps in prop::collection::vec(0i64..KEPT * 2, 1..3000)) {
            let mut tree = Tree::default();
            for (n, stamp) in stamps.iter().enumerate() {
                tree.tell("odom", "base", *stamp, at(n as f64, 0.0, 0.0));
            }
            let Link::Moving(samples) = &tree.0["base"].link else { unreachable!() };
            prop_assert!(samples.len() <= SAMPLES);
            prop_assert!(samples.iter().zip(samples.iter().skip(1)).all(|((a, _), (b, _))| a < b));
        }
    }

    #[test]
    fn frames_are_bounded() {
        let mut tree = Tree::default();
        (0..FRAMES + 10).for_each(|n| tree.tell("map", &format!("f{n}"), 1, at(0.0, 0.0, 0.0)));
        assert_eq!(tree.0.len(), FRAMES);
    }
}
