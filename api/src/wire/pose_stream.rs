//! Conversions of a pose stream's messages.

use k8s_openapi::jiff::Timestamp;

use super::WireError;
use super::pose::v1 as proto;
use crate::pose::{DEFAULT_MAP, PoseRef};

/// One pose of a batch, without copying its texts.
///
/// # Errors
///
/// When a coordinate is not finite, or the stamp is no point in time.
pub fn pose_of<'a>(
    batch: &'a proto::PoseBatch,
    one: &'a proto::NodePose,
) -> Result<PoseRef<'a>, WireError> {
    if ![one.x, one.y, one.z, one.yaw].iter().all(|n| n.is_finite()) {
        return Err(WireError::invalid("pose", "a coordinate is not a finite number"));
    }
    let stamp = one.stamp.as_ref().map(|s| Timestamp::new(s.seconds, s.nanos)).transpose();
    Ok(PoseRef {
        map: if batch.map.is_empty() { DEFAULT_MAP } else { &batch.map },
        x: one.x,
        y: one.y,
        z: one.z,
        yaw: one.yaw,
        stamp: stamp.map_err(|e| WireError::invalid("pose.stamp", e))?,
        source: &batch.source,
        localized: !one.lost,
        covariance: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::Pose;

    #[test]
    fn a_pose_has_the_batchs_map_and_source() {
        let one = proto::NodePose { x: 1.0, z: 2.0, ..proto::NodePose::default() };
        let mut batch = proto::PoseBatch { source: "mocap".into(), ..Default::default() };
        let pose = Pose::from(pose_of(&batch, &one).expect("good"));
        assert_eq!((pose.map.as_str(), pose.source.as_str()), ("map", "mocap"));
        assert!(pose.localized && pose.x == 1.0 && pose.z == 2.0);
        batch.map = "lab".into();
        assert_eq!(pose_of(&batch, &one).expect("good").map, "lab");
    }

    #[test]
    fn numbers_that_are_none_are_named() {
        let batch = proto::PoseBatch::default();
        let bad = proto::NodePose { yaw: f64::INFINITY, ..proto::NodePose::default() };
        assert!(pose_of(&batch, &bad).expect_err("not finite").to_string().contains("finite"));
        let stamp = prost_types::Timestamp { seconds: i64::MAX, nanos: 0 };
        let bad = proto::NodePose { stamp: Some(stamp), ..proto::NodePose::default() };
        assert!(pose_of(&batch, &bad).expect_err("no time").to_string().contains("stamp"));
    }
}
