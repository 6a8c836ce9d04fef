//! Tests of the table of poses.

use std::collections::BTreeMap;
use std::time::Duration;

use muster_api::kind::node::NodeKind;
use muster_api::name::NodeName;
use muster_api::pose::{Pose, PoseRef};
use proptest::prelude::*;
use serde_json::json;

use super::checkpoint::{Due, SETTLE, due};
use super::{Cursor, HOLDS_FOR, NotTaken, Poses};

const NOW: Duration = Duration::from_secs(100);

fn name(i: usize) -> NodeName {
    NodeName::new(format!("robot-{i}")).expect("a name")
}

fn pose(x: f64) -> PoseRef<'static> {
    PoseRef {
        map: "map",
        x,
        y: 0.0,
        z: 0.0,
        yaw: 0.0,
        stamp: None,
        source: "mocap",
        localized: true,
        covariance: None,
    }
}

fn stamped(second: u8) -> PoseRef<'static> {
    let stamp = format!("2026-01-01T00:00:{second:02}.000000Z");
    let with: Pose =
        serde_json::from_value(json!({"x": 0.0, "y": 0.0, "stamp": stamp})).expect("a pose");
    PoseRef { stamp: with.view().stamp, ..pose(f64::from(second)) }
}

fn table() -> Poses {
    let mut poses = Poses::default();
    poses.set_node(&name(0), NodeKind::Robot, None, NOW);
    poses.set_node(&name(1), NodeKind::Robot, None, NOW);
    poses.set_node(&NodeName::new("cloud").expect("a name"), NodeKind::Cloud, None, NOW);
    poses
}

fn x_of(poses: &Poses, node: usize) -> Option<f64> {
    poses.get(name(node).as_str())?.pose.map(|p| p.x)
}

#[test]
fn unknown_nodes_and_clouds_have_no_pose() {
    let mut poses = table();
    assert_eq!(poses.put("nobody", pose(1.0), NOW), Err(NotTaken::UnknownNode));
    assert_eq!(poses.put("cloud", pose(1.0), NOW), Err(NotTaken::NotARobot));
    poses.put("robot-0", pose(1.0), NOW).expect("taken");
    poses.remove_node(&name(0));
    assert_eq!(poses.put("robot-0", pose(1.0), NOW), Err(NotTaken::UnknownNode));
    assert!(poses.get("robot-0").is_none());
}

#[test]
fn an_older_stamp_of_the_same_source_is_refused_and_not_for_ever() {
    let mut poses = table();
    poses.put("robot-0", stamped(20), NOW).expect("the first");
    let older = NotTaken::Older { by: Duration::from_secs(5) };
    assert_eq!(poses.put("robot-0", stamped(15), NOW), Err(older));
    poses.put("robot-0", stamped(20), NOW).expect("the same moment is not older");
    poses.put("robot-0", stamped(21), NOW).expect("newer");
    // Its clock was set back.
    poses.put("robot-0", stamped(3), NOW + HOLDS_FOR).expect("nothing newer came for long");
    assert_eq!(x_of(&poses, 0), Some(3.0));
}

#[test]
fn the_building_goes_before_the_agent_and_one_source_before_the_next() {
    let mut poses = table();
    let own = PoseRef { source: "static", ..pose(7.0) };
    poses.put_own(&name(0), own, NOW).expect("nobody else says anything");
    poses.put("robot-0", pose(1.0), NOW).expect("the building goes before");
    let other = Err(NotTaken::OtherSource { source_name: "mocap".to_owned() });
    assert_eq!(poses.put_own(&name(0), own, NOW), other);
    assert_eq!(poses.put("robot-0", PoseRef { source: "uwb", ..pose(2.0) }, NOW), other);
    poses.put("robot-0", pose(3.0), NOW).expect("another stream of the same source");
    poses.put_own(&name(0), own, NOW + HOLDS_FOR).expect("the building is silent");
    assert_eq!(x_of(&poses, 0), Some(7.0));
}

#[test]
fn an_agent_may_speak_before_its_object_is_seen_and_is_shown_afterwards() {
    let mut poses = Poses::default();
    poses.put_own(&name(5), pose(1.0), NOW).expect("taken");
    assert!(poses.get("robot-5").is_none() && poses.live(&name(5)).is_some());
    let mut cursor = Cursor::default();
    poses.read(&mut cursor, usize::MAX, |known| assert!(known.pose.is_none()));
    poses.set_node(&name(5), NodeKind::Robot, None, NOW);
    let mut seen = Vec::new();
    poses.read(&mut cursor, usize::MAX, |known| seen.extend(known.pose.map(|p| p.x)));
    assert_eq!(seen, [1.0]);
}

#[test]
fn a_checkpoint_counts_until_something_is_heard() {
    let mut poses = table();
    let at = |x: f64| Some(Pose::from(pose(x)));
    poses.set_node(&name(0), NodeKind::Robot, at(1.0), NOW);
    assert_eq!(x_of(&poses, 0), Some(1.0));
    assert!(poses.live(&name(0)).is_none());
    poses.put("robot-0", pose(2.0), NOW).expect("taken");
    poses.set_node(&name(0), NodeKind::Robot, at(1.0), NOW);
    assert_eq!(x_of(&poses, 0), Some(2.0), "an object that changes does not move the robot back");
}

#[test]
fn a_robot_that_stands_still_is_not_shown_again() {
    let mut poses = table();
    let mut cursor = Cursor::default();
    poses.put("robot-0", stamped(20), NOW).expect("taken");
    poses.read(&mut cursor, usize::MAX, |_| ());
    let later = PoseRef { stamp: stamped(21).stamp, ..stamped(20) };
    poses.put("robot-0", later, NOW + SETTLE).expect("taken");
    assert!(!poses.read(&mut cursor, usize::MAX, |known| panic!("{known:?}")));
    assert_eq!(poses.get("robot-0").and_then(|k| k.heard), Some(NOW + SETTLE), "it is heard");
}

#[test]
fn checkpoints_are_due_after_a_step_or_a_while() {
    let at = |x: f64| Pose::from(pose(x));
    let soon = Duration::ZERO;
    assert_eq!(due(None, &at(0.0), soon), Due::Now);
    assert_eq!(due(Some(&at(0.0)), &at(0.0), SETTLE * 9), Due::Never);
    assert_eq!(due(Some(&at(0.0)), &at(0.009), SETTLE * 9), Due::Never, "noise");
    assert_eq!(due(Some(&at(0.0)), &at(0.5), soon), Due::Later);
    assert_eq!(due(Some(&at(0.0)), &at(0.5), SETTLE), Due::Now);
    assert_eq!(due(Some(&at(0.0)), &at(1.0), soon), Due::Now);
    assert_eq!(due(Some(&at(0.0)), &Pose { yaw: 1.0, ..at(0.0) }, soon), Due::Later);
    assert_eq!(due(Some(&at(0.0)), &Pose { map: "lab".into(), ..at(0.0) }, soon), Due::Now);
    assert_eq!(due(Some(&at(0.0)), &Pose { localized: false, ..at(0.0) }, soon), Due::Now);
}

#[test]
fn every_robot_has_its_turn_and_a_failed_write_is_due_again() {
    let mut poses = table();
    let walk = |poses: &mut Poses, x: f64| {
        for node in ["robot-0", "robot-1"] {
            poses.put(node, pose(x), NOW).expect("taken");
        }
    };
    let mut written = Vec::new();
    for step in 0..4 {
        walk(&mut poses, f64::from(step) * 10.0);
        let (due, more) = poses.take_due(1, NOW);
        assert!(more, "the other one waits");
        written.extend(due.into_iter().map(|(node, _)| node));
    }
    assert_eq!(written, [name(0), name(1), name(0), name(1)]);
    while !poses.take_due(1, NOW).0.is_empty() {}
    poses.not_written(&name(1));
    assert_eq!(poses.take_due(9, NOW).0, [(name(1), Pose::from(pose(30.0)))]);
    poses.put("robot-0", pose(30.5), NOW).expect("taken");
    assert_eq!(poses.take_due(9, NOW), (Vec::new(), true), "half a metre waits");
    assert_eq!(poses.take_due(9, NOW + SETTLE).0.len(), 1);
}

proptest! {
    /// A reader that takes what it is shown has, whenever a round ends, everything as it was when the round began or
    /// later; after the last round it has everything as it is.
    #[test]
    fn readers_miss_nothing(
        steps in proptest::collection::vec((0..6_usize, 0..9_u8, 1..4_usize), 1..150),
    ) {
        let mut poses = Poses::default();
        let (mut cursor, mut picture) = (Cursor::default(), BTreeMap::new());
        for (i, what, most) in steps {
            match what {
                0 => poses.remove_node(&name(i)),
                1 => poses.set_node(&name(i), NodeKind::Robot, None, NOW),
                2 => poses.set_node(&name(i), NodeKind::Robot, Some(pose(0.5).into()), NOW),
                3 => drop(poses.put_own(&name(i), pose(1.0), NOW + HOLDS_FOR)),
                4..=6 => drop(poses.put(name(i).as_str(), pose(f64::from(what)), NOW)),
                _ => { poses.read(&mut cursor, most, |k| note(&mut picture, k)); }
            }
        }
        while poses.read(&mut cursor, 2, |k| note(&mut picture, k)) {}
        poses.read(&mut cursor, usize::MAX, |k| note(&mut picture, k));
        prop_assert_eq!(cursor.seen(), poses.revision());
        let truth: BTreeMap<String, f64> =
            (0..6).filter_map(|i| Some((name(i).to_string(), x_of(&poses, i)?))).collect();
        prop_assert_eq!(picture, truth);
    }
}

fn note(picture: &mut BTreeMap<String, f64>, known: super::Known<'_>) {
    match known.pose {
        Some(pose) => drop(picture.insert(known.name.to_string(), pose.x)),
        None => drop(picture.remove(known.name.as_str())),
    }
}
