//! Conversions of what agents and controller say of images.

use super::WireError;
use super::agent::v1 as proto;
use super::agent_session::{timestamp_from_wire, timestamp_to_wire};
use crate::kind::node::image::{ImagePhase, ImageStatus, ImageWish};
use crate::kind::task::PullPolicy;

impl From<&ImageWish> for proto::ImageWish {
    fn from(wish: &ImageWish) -> Self {
        let policy = match wish.pull_policy {
            PullPolicy::IfNotPresent => proto::PullPolicy::IfNotPresent,
            PullPolicy::Always => proto::PullPolicy::Always,
            PullPolicy::Never => proto::PullPolicy::Never,
        };
        proto::ImageWish {
            image: wish.image.clone(),
            pull_policy: policy.into(),
            since: Some(timestamp_to_wire(&wish.since)),
        }
    }
}

impl TryFrom<&proto::ImageWish> for ImageWish {
    type Error = WireError;

    fn try_from(wish: &proto::ImageWish) -> Result<Self, WireError> {
        if wish.image.is_empty() {
            return Err(WireError::Missing("image.image"));
        }
        let pull_policy = match proto::PullPolicy::try_from(wish.pull_policy) {
            Ok(proto::PullPolicy::IfNotPresent) => PullPolicy::IfNotPresent,
            Ok(proto::PullPolicy::Always) => PullPolicy::Always,
            Ok(proto::PullPolicy::Never) => PullPolicy::Never,
            Ok(proto::PullPolicy::Unspecified) | Err(_) => {
                let (field, value) = ("image.pull_policy", wish.pull_policy);
                return Err(WireError::UnknownEnum { field, value });
            }
        };
        let since = wish.since.as_ref().ok_or(WireError::Missing("image.since"))?;
        let since = timestamp_from_wire("image.since", since)?;
        Ok(ImageWish { image: wish.image.clone(), pull_policy, since })
    }
}

impl From<&ImageStatus> for proto::ImageState {
    fn from(status: &ImageStatus) -> Self {
        let phase = match status.phase {
            ImagePhase::Waiting => proto::ImagePhase::Waiting,
            ImagePhase::Pulling => proto::ImagePhase::Pulling,
            ImagePhase::Pulled => proto::ImagePhase::Pulled,
            ImagePhase::BackOff => proto::ImagePhase::BackOff,
        };
        proto::ImageState {
            wish: Some((&status.wish).into()),
            phase: phase.into(),
            reason: status.reason.clone(),
            message: status.message.clone(),
            failures: status.failures,
        }
    }
}

impl TryFrom<&proto::ImageState> for ImageStatus {
    type Error = WireError;

    fn try_from(state: &proto::ImageState) -> Result<Self, WireError> {
        let wish = state.wish.as_ref().ok_or(WireError::Missing("image.wish"))?;
        let phase = match proto::ImagePhase::try_from(state.phase) {
            Ok(proto::ImagePhase::Waiting) => ImagePhase::Waiting,
            Ok(proto::ImagePhase::Pulling) => ImagePhase::Pulling,
            Ok(proto::ImagePhase::Pulled) => ImagePhase::Pulled,
            Ok(proto::ImagePhase::BackOff) => ImagePhase::BackOff,
            Ok(proto::ImagePhase::Unspecified) | Err(_) => {
                return Err(WireError::UnknownEnum { field: "image.phase", value: state.phase });
            }
        };
        Ok(ImageStatus {
            wish: wish.try_into()?,
            phase,
            reason: state.reason.clone(),
            message: state.message.clone(),
            failures: state.failures,
        })
    }
}
