//! The simulated robot's place, as its simulator says.

use jiff::Timestamp;
use muster_agent_core::pose::judge::Verdict;
use muster_api::pose::{Pose, PoseRef};
use tokio::sync::watch;
use tokio_util::task::AbortOnDropHandle;

use super::{Position, Seen};
use crate::sim::keeper::Simulator;

pub(super) fn open(simulator: &Simulator, map: &str) -> Position {
    let (say, newest) = watch::channel(Seen::default());
    let (map, mut said) = (map.to_owned(), simulator.said());
    let source = tokio::spawn(async move {
        loop {
            let place = said.borrow_and_update().as_ref().map(|said| (said.x, said.y, said.yaw));
            say.send_if_modified(|seen| {
                let new = follows(seen, place, &map);
                let changes = new != *seen;
                *seen = new;
                changes
            });
            if said.changed().await.is_err() {
                return;
            }
        }
    });
    Position { newest, _source: Some(AbortOnDropHandle::new(source)) }
}

/// What is seen after the simulator spoke, or went.
fn follows(before: &Seen, place: Option<(f64, f64, f64)>, map: &str) -> Seen {
    match (place, &before.pose) {
        (Some((x, y, yaw)), Some(pose))
            if before.localized.holds && (pose.x, pose.y, pose.yaw) == (x, y, yaw) =>
        {
            before.clone()
        }
        (Some((x, y, yaw)), _) => {
            let stamp = Some(Timestamp::now());
            let pose = PoseRef {
                map,
                x,
                y,
                z: 0.0,
                yaw,
                stamp,
                source: "sim",
                localized: true,
                covariance: None,
            };
            Seen::of(Some(pose.into()))
        }
        (None, pose) => Seen {
            pose: pose.clone().map(|pose| Pose { localized: false, ..pose }),
            fresh: None,
            localized: Verdict::no("SimulatorDown", "the simulator is being started".to_owned()),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_that_stands_says_so_once_and_one_without_a_simulator_is_lost() {
        let first = follows(&Seen::default(), Some((1.0, 2.0, 0.5)), "lab");
        let pose = first.pose.clone().unwrap();
        assert_eq!((pose.x, pose.map.as_str(), pose.localized), (1.0, "lab", true));
        assert_eq!(follows(&first, Some((1.0, 2.0, 0.5)), "lab"), first);
        let lost = follows(&first, None, "lab");
        assert!(!lost.localized.holds && !lost.pose.as_ref().unwrap().localized);
        assert!(follows(&lost, Some((1.0, 2.0, 0.5)), "lab").localized.holds);
    }
}
