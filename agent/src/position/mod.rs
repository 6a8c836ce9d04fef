//! Where the robot is. A source is named by a scheme, `static:X,Y[,YAW]`; others follow.

mod fixed;

use std::str::FromStr;

use muster_api::pose::{FixedPosition, FixedPositionError, Pose};

/// Tells where the robot is.
pub(crate) trait Position: Send + Sync + std::fmt::Debug {
    /// In the map frame; `None`: not known now.
    fn current(&self) -> Option<Pose>;
}

/// A source, as it is written in the configuration.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum PositionSource {
    /// A robot that does not move, or whose place is good enough.
    Static(FixedPosition),
}

/// Why a text names no source.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum PositionSourceError {
    #[error("{0:?} names no position source; write static:X,Y[,YAW]")]
    Scheme(String),
    #[error("in static:")]
    Static(#[source] FixedPositionError),
}

impl FromStr for PositionSource {
    type Err = PositionSourceError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.split_once(':') {
            Some(("static", place)) => {
                place.parse().map(PositionSource::Static).map_err(PositionSourceError::Static)
            }
            _ => Err(PositionSourceError::Scheme(text.to_owned())),
        }
    }
}

impl PositionSource {
    /// Starts the source; its poses are in `map`.
    pub(crate) fn open(&self, map: &str) -> Box<dyn Position> {
        match self {
            PositionSource::Static(place) => Box::new(fixed::Fixed::new(*place, map)),
        }
    }
}
