//! Where the robot is. A source is named by a scheme: `static:X,Y[,YAW]`, `file:PATH`, `ros1:TOPIC`, `sim:WORLD`.
//!
//! A source is a task that puts the newest pose, and whether it counts, into a watch channel at its own pace, and asks nobody. The session tells
//! the controller what is newest when it has told the last one; nothing queues up. A new scheme is a variant of
//! [`PositionSource`] and a module that gives a [`Position`].

mod file;
mod fixed;
mod ros1;
pub(crate) mod settings;
mod simulated;

use std::path::PathBuf;
use std::str::FromStr;

use muster_agent_core::pose::judge::Verdict;
use muster_api::pose::{FixedPosition, FixedPositionError, Pose};
use tokio::sync::watch;
use tokio_util::task::AbortOnDropHandle;

use self::settings::PoseSettings;
use crate::sim::keeper::Simulator;

/// What a source says.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Seen {
    /// In the map frame; `None`: not known yet.
    pub(crate) pose: Option<Pose>,
    /// Whether it is new enough; `None`: it does not grow old.
    pub(crate) fresh: Option<Verdict>,
    /// Whether the robot knows where it is.
    pub(crate) localized: Verdict,
}

impl Default for Seen {
    fn default() -> Self {
        Seen::of(None)
    }
}

impl Seen {
    /// A pose that is true until there is another one.
    fn of(pose: Option<Pose>) -> Self {
        let localized = match pose.as_ref().map(|pose| pose.localized) {
            Some(true) => Verdict::yes("Localized"),
            Some(false) => Verdict::no("Lost", String::new()),
            None => Verdict::no("NoPose", String::new()),
        };
        Seen { pose, fresh: None, localized }
    }
}

/// Tells where the robot is; its source ends with it.
#[derive(Debug)]
pub(crate) struct Position {
    newest: watch::Receiver<Seen>,
    _source: Option<AbortOnDropHandle<()>>,
}

impl Position {
    /// The newest pose; `None`: not known yet.
    pub(crate) fn current(&self) -> Option<Pose> {
        self.newest.borrow().pose.clone()
    }

    /// Whether it counts, and why not.
    pub(crate) fn seen(&self) -> Seen {
        self.newest.borrow().clone()
    }

    /// Ready when the robot is known to be somewhere else than `told`, or later there. Cancel safe.
    pub(crate) async fn other_than(&mut self, told: Option<&Pose>) {
        if self.newest.wait_for(|seen| seen.pose.as_ref() != told).await.is_err() {
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
    /// A topic of ROS 1.
    Ros1(String),
    /// There is no robot: it is simulated in the world of this file.
    Sim(PathBuf),
}

/// Why a text names no source.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum PositionSourceError {
    #[error(
        "{0:?} names no position source; write static:X,Y[,YAW], file:PATH, ros1:TOPIC or sim:WORLD"
    )]
    Scheme(String),
    #[error("in static:")]
    Static(#[source] FixedPositionError),
    #[error("file:{0} is no absolute path; write file:/run/robot/pose")]
    File(String),
    #[error("sim: names no world; write sim:world.yaml")]
    World,
    #[error(transparent)]
    Topic(#[from] muster_ros1::name::NameError),
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
            Some(("ros1", topic)) => {
                // A private name would be below the agent's own node, which publishes nothing.
                muster_ros1::name::Resolver::new("/", "agent", [])?.resolve(topic)?;
                Ok(PositionSource::Ros1(topic.to_owned()))
            }
            Some(("sim", "")) => Err(PositionSourceError::World),
            Some(("sim", world)) => Ok(PositionSource::Sim(world.into())),
            _ => Err(PositionSourceError::Scheme(text.to_owned())),
        }
    }
}

impl PositionSource {
    /// Starts the source of the robot `name`; its poses are in `map`. None: it is a simulator's, and there is none.
    pub(crate) fn open(
        &self,
        map: &str,
        name: &str,
        settings: &PoseSettings,
        simulator: Option<&Simulator>,
    ) -> Option<Position> {
        Some(match self {
            PositionSource::Static(place) => fixed::open(*place, map),
            PositionSource::File(path) => file::open(path, map),
            PositionSource::Ros1(topic) => ros1::open(topic, map, name, settings),
            PositionSource::Sim(_) => simulated::open(simulator?, map),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_is_named_by_its_scheme() {
        let file = PositionSource::File("/run/pose".into());
        assert_eq!("file:/run/pose".parse(), Ok(file));
        assert_eq!("ros1:/odom".parse(), Ok(PositionSource::Ros1("/odom".to_owned())));
        assert_eq!("sim:w.yaml".parse(), Ok(PositionSource::Sim("w.yaml".into())));
        let bad = [
            "sim:",
            "ros1:",
            "ros1:/a b",
            "file:pose",
            "file:",
            "/run/pose",
            "ros9:/odom",
            "static:1",
        ];
        for text in bad {
            assert!(text.parse::<PositionSource>().is_err(), "{text}");
        }
    }
}
