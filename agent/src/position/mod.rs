//! Where the robot is. A source is named by a scheme: `static:X,Y[,YAW]`, `file:PATH`.
//!
//! A source is a task that puts the newest pose into a watch channel at its own pace, and asks nobody. The session tells
//! the controller what is newest when it has told the last one; nothing queues up. A new scheme is a variant of
//! [`PositionSource`] and a module that gives a [`Position`].

mod file;
mod fixed;

use std::path::PathBuf;
use std::str::FromStr;

use muster_api::pose::{FixedPosition, FixedPositionError, Pose};
use tokio::sync::watch;
use tokio_util::task::AbortOnDropHandle;

/// Tells where the robot is; its source ends with it.
#[derive(Debug)]
pub(crate) struct Position {
    /// In the map frame; `None`: not known yet.
    newest: watch::Receiver<Option<Pose>>,
    _source: Option<AbortOnDropHandle<()>>,
}

impl Position {
    /// The newest pose; `None`: not known yet.
    pub(crate) fn current(&self) -> Option<Pose> {
        self.newest.borrow().clone()
    }

    /// Ready when the robot is known to be somewhere else than `told`, or later there. Cancel safe.
    pub(crate) async fn other_than(&mut self, told: Option<&Pose>) {
        if self.newest.wait_for(|pose| pose.as_ref() != told).await.is_err() {
            // The source has said all that it ever will.
            std::future::pending().await
        }
    }
}

/// A source, as it is written in the configuration.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum PositionSource {
    /// A robot that does not move, or whose place is good enough.
    Static(FixedPosition),
    /// Some program of the robot's keeps its pose in a file.
    File(PathBuf),
}

/// Why a text names no source.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum PositionSourceError {
    #[error("{0:?} names no position source; write static:X,Y[,YAW] or file:PATH")]
    Scheme(String),
    #[error("in static:")]
    Static(#[source] FixedPositionError),
    #[error("file:{0} is no absolute path; write file:/run/robot/pose")]
    File(String),
}

impl FromStr for PositionSource {
    type Err = PositionSourceError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.split_once(':') {
            Some(("static", place)) => {
                place.parse().map(PositionSource::Static).map_err(PositionSourceError::Static)
            }
            Some(("file", path)) if path.starts_with('/') => Ok(PositionSource::File(path.into())),
            Some(("file", path)) => Err(PositionSourceError::File(path.to_owned())),
            _ => Err(PositionSourceError::Scheme(text.to_owned())),
        }
    }
}

impl PositionSource {
    /// Starts the source; its poses are in `map`.
    pub(crate) fn open(&self, map: &str) -> Position {
        match self {
            PositionSource::Static(place) => fixed::open(*place, map),
            PositionSource::File(path) => file::open(path, map),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_is_named_by_its_scheme() {
        let file = PositionSource::File("/run/pose".into());
        assert_eq!("file:/run/pose".parse(), Ok(file));
        let bad = ["file:pose", "file:", "/run/pose", "ros9:/odom", "static:1"];
        for text in bad {
            assert!(text.parse::<PositionSource>().is_err(), "{text}");
        }
    }
}
