//! Messages as protobuf (`muster.ros.v1`) and back: `From` to protobuf, which has room for all of it; `TryFrom` back,
//! which names the field that has none.

use crate::{proto, time};

/// Why a protobuf message is none of ROS's.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ConvertError {
    /// A part of it is not there.
    #[error("{field} is missing")]
    Missing {
        /// `geometry_msgs/Pose.position`.
        field: &'static str,
    },
    /// A number does not fit.
    #[error("{field} is out of the range of its ROS type")]
    Range {
        /// Which.
        field: &'static str,
    },
    /// An array of a fixed length has another one.
    #[error("{field} has {length} elements, not {wanted}")]
    Length {
        /// Which.
        field: &'static str,
        /// How many there are.
        length: usize,
        /// How many there must be.
        wanted: usize,
    },
}

impl From<&time::Time> for proto::std_msgs::Instant {
    fn from(time: &time::Time) -> Self {
        proto::std_msgs::Instant { sec: time.sec, nsec: time.nsec }
    }
}

impl TryFrom<&proto::std_msgs::Instant> for time::Time {
    type Error = ConvertError;

    fn try_from(time: &proto::std_msgs::Instant) -> Result<Self, ConvertError> {
        Ok(time::Time { sec: time.sec, nsec: time.nsec })
    }
}

impl From<&time::Duration> for proto::std_msgs::Span {
    fn from(span: &time::Duration) -> Self {
        proto::std_msgs::Span { sec: span.sec, nsec: span.nsec }
    }
}

impl TryFrom<&proto::std_msgs::Span> for time::Duration {
    type Error = ConvertError;

    fn try_from(span: &proto::std_msgs::Span) -> Result<Self, ConvertError> {
        Ok(time::Duration { sec: span.sec, nsec: span.nsec })
    }
}

#[allow(
    clippy::all,
    clippy::allow_attributes,
    clippy::allow_attributes_without_reason,
    reason = "generated"
)]
mod made {
    use super::ConvertError;

    include!(concat!(env!("OUT_DIR"), "/convert.rs"));
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::message::Message;
    use crate::wire::sample::{Entropy, Sample};
    use crate::{geometry_msgs as geo, nav_msgs, std_msgs};

    const FILES: &[(&str, &str, &str)] = include!(concat!(env!("OUT_DIR"), "/protos.rs"));

    #[test]
    fn the_protobuf_files_say_what_the_definitions_say() {
        for (package, expected, kept) in FILES {
            assert_eq!(kept, expected, "api/proto/muster/ros/v1/{package}.proto");
        }
    }

    /// Over the wire of both.
    fn there_and_back<M, P>(entropy: &[u8])
    where
        M: Message + Sample + for<'a> TryFrom<&'a P, Error = ConvertError>,
        P: prost::Message + Default + for<'a> From<&'a M>,
    {
        let ours = M::sample(&mut Entropy::new(entropy.to_vec()));
        let theirs = P::from(&ours).encode_to_vec();
        let theirs = P::decode(&*theirs).expect("what was written is a message");
        let again = M::try_from(&theirs).expect("what was converted can be converted back");
        assert_eq!(again.encode(), ours.encode(), "{}", M::TYPE);
    }

    macro_rules! all {
        ($entropy:expr; $($package:ident: $($name:ident)*;)*) => {
            $($( there_and_back::<crate::$package::$name, proto::$package::$name>($entropy); )*)*
        };
    }

    proptest! {
        #[test]
        fn conversions_lose_nothing(entropy in prop::collection::vec(any::<u8>(), 0..900)) {
            all!(&entropy;
                std_msgs: Bool Byte Char ColorRGBA Duration Empty Float32 Float64 Header Int8 Int16 Int32 Int64 String
                    Time UInt8 UInt16 UInt32 UInt64;
                geometry_msgs: Accel AccelStamped AccelWithCovariance AccelWithCovarianceStamped Point Point32
                    PointStamped Polygon PolygonStamped Pose Pose2D PoseArray PoseStamped PoseWithCovariance
                    PoseWithCovarianceStamped Quaternion QuaternionStamped Transform TransformStamped Twist TwistStamped
                    TwistWithCovariance TwistWithCovarianceStamped Vector3 Vector3Stamped Wrench WrenchStamped;
                nav_msgs: MapMetaData OccupancyGrid Odometry Path;
                sensor_msgs: BatteryState CameraInfo CompressedImage Image Imu JointState LaserScan NavSatFix NavSatStatus
                    PointCloud2 PointField Range RegionOfInterest;
                tf2_msgs: TFMessage;
            );
        }
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let missing = geo::Pose::try_from(&proto::geometry_msgs::Pose::default());
        assert_eq!(missing, Err(ConvertError::Missing { field: "geometry_msgs/Pose.position" }));
        let range = std_msgs::Int8::try_from(&proto::std_msgs::Int8 { data: 200 });
        assert_eq!(range, Err(ConvertError::Range { field: "std_msgs/Int8.data" }));
        let mut odometry = proto::nav_msgs::Odometry::from(&nav_msgs::Odometry::default());
        let pose = odometry.pose.as_mut().expect("it was converted");
        pose.covariance.pop();
        let short = nav_msgs::Odometry::try_from(&odometry).unwrap_err();
        let field = "geometry_msgs/PoseWithCovariance.covariance";
        assert_eq!(short, ConvertError::Length { field, length: 35, wanted: 36 });
    }
}
