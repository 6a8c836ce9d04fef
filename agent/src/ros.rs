//! What this node knows of ROS 1, for tasks: those that say nothing of it are given nothing.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use muster_api::kind::task::RosSpec;
use muster_ros1::env::{DEFAULT_MASTER, Environment, address_towards};
use muster_ros1::xmlrpc::http::Uri;

use crate::config::Config;
use crate::position::PositionSource;

/// Where the master of a task's view is, on its own loopback: ROS's default.
pub(crate) const VIEW_PORT: u16 = 11311;

/// By the agent's flags, then its environment.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Ros {
    /// None: nobody has said where a master is.
    pub(crate) master: Option<String>,
    /// Under what name or address ROS nodes reach this machine.
    pub(crate) host: Option<String>,
    /// Of names that do not begin with a slash.
    pub(crate) namespace: Option<String>,
}

impl Ros {
    /// Who reads poses from ROS without a word of a master means ROS's default.
    pub(crate) fn new(config: &Config) -> Ros {
        let environment = Environment::read();
        let poses = matches!(config.position, Some(PositionSource::Ros1(_)));
        let default = poses.then(|| DEFAULT_MASTER.to_owned());
        Ros {
            master: config.pose.master.clone().or(environment.master).or(default),
            host: config.pose.host.clone().or(environment.host),
            namespace: config.pose.namespace.clone().or(environment.namespace),
        }
    }

    /// The variables of a task. One whose network is not this machine's has an address of its own.
    pub(crate) fn variables(
        &self,
        task: &RosSpec,
        in_our_network: bool,
    ) -> impl Iterator<Item = (String, String)> {
        let (master, host) = if task.is_view() {
            let loopback = Ipv4Addr::LOCALHOST.to_string();
            (format!("http://{loopback}:{VIEW_PORT}"), Some(loopback))
        } else {
            let master = task.uri().or(self.master.as_deref()).unwrap_or(DEFAULT_MASTER).to_owned();
            let host = in_our_network.then(|| self.host.clone().or_else(|| own_address(&master)));
            (master, host.flatten())
        };
        let host = host.map(|host| match host.parse::<IpAddr>() {
            Ok(_) => ("ROS_IP", host),
            Err(_) => ("ROS_HOSTNAME", host),
        });
        let namespace = task.namespace.clone().or_else(|| self.namespace.clone());
        let namespace = namespace.map(|namespace| ("ROS_NAMESPACE", namespace));
        let all = [Some(("ROS_MASTER_URI", master)), namespace, host].into_iter().flatten();
        all.map(|(name, value)| (name.to_owned(), value))
    }
}

/// By which address this machine is seen from the master. ROS's own clients take the machine's name instead, which others often
/// cannot resolve; they do so still for a master that is named, for resolving it takes time.
fn own_address(master: &str) -> Option<String> {
    let Uri { host, port } = master.parse().ok()?;
    let address = match &*host {
        "localhost" => IpAddr::from([127, 0, 0, 1]),
        other => other.parse().ok()?,
    };
    Some(address_towards(SocketAddr::new(address, port)).to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn variables(ros: &Ros, task: &RosSpec, in_our_network: bool) -> Vec<String> {
        let all = ros.variables(task, in_our_network);
        all.map(|(name, value)| format!("{name}={value}")).collect()
    }

    #[test]
    fn the_task_goes_before_the_agent_and_the_agent_before_ros() {
        let (nobody, any) = (Ros::default(), RosSpec::default());
        let default = ["ROS_MASTER_URI=http://localhost:11311", "ROS_IP=127.0.0.1"];
        assert_eq!(variables(&nobody, &any, true), default);
        assert_eq!(variables(&nobody, &any, false), default[..1]);
        let robot = Ros {
            master: Some("http://robot:11311".to_owned()),
            host: Some("robot".to_owned()),
            namespace: Some("/r1".to_owned()),
        };
        assert_eq!(
            variables(&robot, &any, true),
            ["ROS_MASTER_URI=http://robot:11311", "ROS_NAMESPACE=/r1", "ROS_HOSTNAME=robot"]
        );
        let task =
            RosSpec { master: "http://127.0.0.1:5".to_owned(), namespace: Some("/t".to_owned()) };
        assert_eq!(
            variables(&robot, &task, true),
            ["ROS_MASTER_URI=http://127.0.0.1:5", "ROS_NAMESPACE=/t", "ROS_HOSTNAME=robot"]
        );
        let view = RosSpec { master: "View".to_owned(), namespace: None };
        assert_eq!(
            variables(&robot, &view, false),
            ["ROS_MASTER_URI=http://127.0.0.1:11311", "ROS_NAMESPACE=/r1", "ROS_IP=127.0.0.1"]
        );
    }
}
