//! How a pose that comes from ROS is read: where the master is, what the frames are called, when a pose counts.

use std::time::Duration;

use muster_agent_core::pose::frame::{Offset, Transform};
use muster_agent_core::pose::judge::{self, Limits};
use muster_agent_core::pose::tracker::Frames;
use muster_api::duration::Span;
use serde::{Deserialize, Serialize};

/// Flags of the pose, and the same as fields of `pose` in `agent.yaml`: texts, as the user wrote them.
#[derive(Debug, Clone, Default, PartialEq, clap::Args, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct PoseArgs {
    /// The ROS master, `http://HOST:PORT` [default: as given last, else `$ROS_MASTER_URI`, else <http://localhost:11311>]
    #[arg(long, value_name = "URI")]
    pub(crate) ros_master: Option<String>,
    /// The namespace of ROS names that do not begin with a slash [default: as given last, else `$ROS_NAMESPACE`]
    #[arg(long, value_name = "NAME")]
    pub(crate) ros_namespace: Option<String>,
    /// Under what name or address ROS nodes reach this machine [default: as given last, else `$ROS_HOSTNAME`, `$ROS_IP`,
    /// or the address that leads to the master]
    #[arg(long, value_name = "HOST")]
    pub(crate) ros_host: Option<String>,
    /// Names of the frames of map, odometry and robot [default: as given last, else map,odom,base_link]
    #[arg(long, value_name = "MAP,ODOM,BASE")]
    pub(crate) ros_frames: Option<String>,
    /// Where the odometry's origin is in the map: `X,Y,YAW` or `X,Y,Z,ROLL,PITCH,YAW`, metres and radians [default: as
    /// given last, else 0,0,0; for /tf, what it says]
    #[arg(long, value_name = "TRANSFORM", allow_hyphen_values = true)]
    pub(crate) map_to_odom: Option<String>,
    /// How old a pose may be [default: as given last, else 2s; 60s of PoseWithCovarianceStamped]
    #[arg(long, value_name = "TIME")]
    pub(crate) pose_max_age: Option<String>,
    /// How large the standard deviation of the position may be, metres [default: as given last, else 1.0]
    #[arg(long, value_name = "METRES")]
    pub(crate) pose_max_deviation: Option<String>,
}

impl PoseArgs {
    fn fields(&mut self) -> [(&'static str, &mut Option<String>); 7] {
        [
            ("--ros-master", &mut self.ros_master),
            ("--ros-namespace", &mut self.ros_namespace),
            ("--ros-host", &mut self.ros_host),
            ("--ros-frames", &mut self.ros_frames),
            ("--map-to-odom", &mut self.map_to_odom),
            ("--pose-max-age", &mut self.pose_max_age),
            ("--pose-max-deviation", &mut self.pose_max_deviation),
        ]
    }

    /// Takes from `other` what is not said here; the flags of it.
    pub(crate) fn fill(&mut self, mut other: PoseArgs) -> Vec<&'static str> {
        let mut filled = Vec::new();
        for ((flag, ours), (_, theirs)) in self.fields().into_iter().zip(other.fields()) {
            if ours.is_none() && theirs.is_some() {
                *ours = theirs.take();
                filled.push(flag);
            }
        }
        filled
    }

    /// The settings that these texts mean.
    ///
    /// # Errors
    ///
    /// The flag, and what is wrong with it.
    pub(crate) fn resolve(&self) -> Result<PoseSettings, (&'static str, String)> {
        let parsed = |flag, error: &dyn std::error::Error| (flag, error.to_string());
        let master: Option<muster_ros1::xmlrpc::http::Uri> = match &self.ros_master {
            Some(text) => Some(text.parse().map_err(|e| parsed("--ros-master", &e))?),
            None => None,
        };
        let namespace = self.ros_namespace.clone();
        if let Some(namespace) = &namespace {
            muster_ros1::name::Resolver::new(namespace, "agent", [])
                .map_err(|e| parsed("--ros-namespace", &e))?;
        }
        let frames = match &self.ros_frames {
            Some(text) => frames(text).ok_or_else(|| {
                let text =
                    format!("{text:?} is not three names of frames; write map,odom,base_link");
                ("--ros-frames", text)
            })?,
            None => Frames::default(),
        };
        let offset: Option<Offset> = match &self.map_to_odom {
            Some(text) => Some(text.parse().map_err(|e| parsed("--map-to-odom", &e))?),
            None => None,
        };
        let max_age: Option<Span> = match &self.pose_max_age {
            Some(text) => {
                Some(text.parse().map_err(|error: muster_api::duration::SpanError| {
                    ("--pose-max-age", format!("{error}; {}", error.suggestion()))
                })?)
            }
            None => None,
        };
        let max_deviation = match &self.pose_max_deviation {
            Some(text) => {
                text.trim().parse().ok().filter(|m: &f64| m.is_finite() && *m > 0.0).ok_or_else(
                    || {
                        (
                            "--pose-max-deviation",
                            format!("{text:?} is no length in metres above 0; write 0.5"),
                        )
                    },
                )?
            }
            None => judge::MAX_DEVIATION,
        };
        Ok(PoseSettings {
            master: master.map(|uri| uri.to_string()),
            namespace,
            host: self.ros_host.clone(),
            frames,
            map_to_odom: offset.map(|offset| offset.0),
            max_age: max_age.map(Span::as_duration),
            max_deviation,
        })
    }
}

fn frames(text: &str) -> Option<Frames> {
    let names: Vec<&str> = text.split(',').map(str::trim).collect();
    let [map, odom, base] = *names.as_slice() else { return None };
    let good = |name: &str| !name.is_empty() && !name.contains(char::is_whitespace);
    [map, odom, base].into_iter().all(good).then(|| Frames {
        map: map.to_owned(),
        odom: odom.to_owned(),
        base: base.to_owned(),
    })
}

/// Settings that make sense.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PoseSettings {
    /// Absent: the environment's.
    pub(crate) master: Option<String>,
    pub(crate) namespace: Option<String>,
    pub(crate) host: Option<String>,
    pub(crate) frames: Frames,
    /// The map frame from the odometry frame.
    pub(crate) map_to_odom: Option<Transform>,
    /// Absent: by the type of the topic.
    pub(crate) max_age: Option<Duration>,
    pub(crate) max_deviation: f64,
}

impl PoseSettings {
    /// For a source whose poses may be `default` old when nobody says.
    pub(crate) fn limits(&self, default: Duration) -> Limits {
        Limits { max_age: self.max_age.unwrap_or(default), max_deviation: self.max_deviation }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_makes_no_sense_is_named_by_its_flag() {
        let one = |set: &dyn Fn(&mut PoseArgs, Option<String>), text: &str| {
            let mut args = PoseArgs::default();
            set(&mut args, Some(text.to_owned()));
            args.resolve().map_err(|(flag, _)| flag)
        };
        assert_eq!(one(&|a, t| a.ros_master = t, "robot:11311"), Err("--ros-master"));
        assert_eq!(one(&|a, t| a.ros_namespace = t, "a b"), Err("--ros-namespace"));
        assert_eq!(one(&|a, t| a.ros_frames = t, "map,odom"), Err("--ros-frames"));
        assert_eq!(one(&|a, t| a.map_to_odom = t, "1,2"), Err("--map-to-odom"));
        assert_eq!(one(&|a, t| a.pose_max_age = t, "2"), Err("--pose-max-age"));
        assert_eq!(one(&|a, t| a.pose_max_deviation = t, "0"), Err("--pose-max-deviation"));
        let frames = one(&|a, t| a.ros_frames = t, "map, r1/odom,r1/base_link").unwrap().frames;
        assert_eq!((frames.map.as_str(), frames.odom.as_str()), ("map", "r1/odom"));
    }

    #[test]
    fn what_is_not_said_now_is_as_it_was() {
        let said = |text: &str| Some(text.to_owned());
        let mut now = PoseArgs { map_to_odom: said("1,2,3"), ..PoseArgs::default() };
        let last = PoseArgs {
            map_to_odom: said("0,0,0"),
            pose_max_age: said("3s"),
            ..PoseArgs::default()
        };
        assert_eq!(now.fill(last), ["--pose-max-age"]);
        assert_eq!((now.map_to_odom, now.pose_max_age), (said("1,2,3"), said("3s")));
    }
}
