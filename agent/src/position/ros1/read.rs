//! Messages as the core takes them.

use std::time::Duration;

use muster_agent_core::pose::frame::{self, Transform};
use muster_agent_core::pose::judge::{MAX_AGE, MAX_AGE_OF_LOCALISATION};
use muster_agent_core::pose::tracker::{Kind, Said, Told};
use muster_ros1::Message;
use muster_ros1::geometry_msgs::{Pose, PoseStamped, PoseWithCovarianceStamped};
use muster_ros1::nav_msgs::Odometry;
use muster_ros1::node::Incoming;
use muster_ros1::std_msgs::Header;
use muster_ros1::tf2_msgs::TFMessage;
use muster_ros1::time::Time;
use muster_ros1::wire::DecodeError;

/// tf's own type of the time before tf2: the same layout and checksum.
const TF: &str = "tf/tfMessage";

/// What a message says.
#[derive(Debug)]
pub(super) enum Read {
    Said(Kind, Box<Said>),
    Told(Vec<Told>),
}

/// Why a message says nothing.
#[derive(Debug, thiserror::Error)]
pub(super) enum ReadError {
    #[error("its type tells no place")]
    Type,
    #[error("its type {name} is of another version: checksum {theirs}, not {ours}")]
    Version { name: String, theirs: String, ours: &'static str },
    #[error(transparent)]
    Decode(#[from] DecodeError),
}

impl Read {
    /// How old such a pose may be when nobody says.
    pub(super) fn max_age(&self) -> Duration {
        match self {
            Read::Said(Kind::Pose, said) if said.covariance.iter().any(|n| *n != 0.0) => {
                MAX_AGE_OF_LOCALISATION
            }
            _ => MAX_AGE,
        }
    }
}

pub(super) fn read(incoming: &Incoming) -> Result<Read, ReadError> {
    match &*incoming.from.kind {
        Odometry::TYPE => {
            let Odometry { header, pose, .. } = decode(incoming)?;
            Ok(Read::Said(Kind::Odometry, said(header, &pose.pose, pose.covariance)))
        }
        PoseWithCovarianceStamped::TYPE => {
            let PoseWithCovarianceStamped { header, pose } = decode(incoming)?;
            Ok(Read::Said(Kind::Pose, said(header, &pose.pose, pose.covariance)))
        }
        PoseStamped::TYPE => {
            let PoseStamped { header, pose } = decode(incoming)?;
            Ok(Read::Said(Kind::Pose, said(header, &pose, [0.0; 36])))
        }
        TFMessage::TYPE | TF => {
            let TFMessage { transforms } = decode(incoming)?;
            Ok(Read::Told(transforms.into_iter().map(told).collect()))
        }
        _ => Err(ReadError::Type),
    }
}

fn decode<M: Message>(incoming: &Incoming) -> Result<M, ReadError> {
    if incoming.from.md5 != M::MD5 {
        let (name, theirs) = (incoming.from.kind.clone(), incoming.from.md5.clone());
        return Err(ReadError::Version { name, theirs, ours: M::MD5 });
    }
    Ok(M::decode(incoming.body.clone())?)
}

fn stamp(time: Time) -> Option<i64> {
    (!time.is_zero()).then(|| time.nanos())
}

fn said(header: Header, pose: &Pose, covariance: [f64; 36]) -> Box<Said> {
    Box::new(Said {
        frame: header.frame_id,
        stamp: stamp(header.stamp),
        pose: transform(pose),
        covariance,
    })
}

fn transform(pose: &Pose) -> Option<Transform> {
    let (at, turn) = (&pose.position, &pose.orientation);
    frame::transform([at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w])
}

fn told(one: muster_ros1::geometry_msgs::TransformStamped) -> Told {
    let (at, turn) = (&one.transform.translation, &one.transform.rotation);
    Told {
        parent: one.header.frame_id,
        child: one.child_frame_id,
        stamp: one.header.stamp.nanos(),
        transform: frame::transform([at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w]),
    }
}
