//! What the environment says of ROS, as its own clients read it.

use std::net::{IpAddr, SocketAddr, ToSocketAddrs, UdpSocket};

/// Where the master is when nobody says.
pub const DEFAULT_MASTER: &str = "http://localhost:11311";

/// What `ROS_…` variables say.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Environment {
    /// `ROS_MASTER_URI`.
    pub master: Option<String>,
    /// `ROS_HOSTNAME`, which goes before `ROS_IP`: under what name others reach this node.
    pub host: Option<String>,
    /// `ROS_NAMESPACE`.
    pub namespace: Option<String>,
}

impl Environment {
    /// Of this process.
    #[must_use]
    pub fn read() -> Self {
        Self::from_variables(|name| std::env::var(name).ok())
    }

    /// Of variables that `get` knows. An empty one is not set.
    #[must_use]
    pub fn from_variables(get: impl Fn(&str) -> Option<String>) -> Self {
        let get = |name: &str| get(name).filter(|value| !value.is_empty());
        Environment {
            master: get("ROS_MASTER_URI"),
            host: get("ROS_HOSTNAME").or_else(|| get("ROS_IP")),
            namespace: get("ROS_NAMESPACE"),
        }
    }
}

/// The address by which this machine is seen from `master`: of the interface that the way there leads through. ROS's own
/// clients take the machine's name instead, which others often cannot resolve. Sends nothing.
#[must_use]
pub fn address_towards(master: SocketAddr) -> IpAddr {
    let any: SocketAddr = match master.ip() {
        IpAddr::V4(_) => ([0, 0, 0, 0], 0).into(),
        IpAddr::V6(_) => ([0u16; 8], 0).into(),
    };
    let way = UdpSocket::bind(any).and_then(|socket| {
        socket.connect(master)?;
        socket.local_addr()
    });
    way.map_or_else(|_| [127, 0, 0, 1].into(), |address| address.ip())
}

/// Where to listen so that others reach `host`: at its address when that is one of this machine's, else at all.
#[must_use]
pub fn listen_at(host: &str) -> SocketAddr {
    let ours = |address: &SocketAddr| {
        std::net::TcpListener::bind(SocketAddr::new(address.ip(), 0)).is_ok()
    };
    let resolved = (host, 0).to_socket_addrs().ok().and_then(|mut found| found.find(ours));
    resolved.unwrap_or_else(|| ([0, 0, 0, 0], 0).into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_host_name_goes_before_the_address() {
        let all = |name: &str| match name {
            "ROS_MASTER_URI" => Some("http://robot:11311".to_owned()),
            "ROS_HOSTNAME" => Some("robot".to_owned()),
            "ROS_IP" => Some("10.0.0.2".to_owned()),
            "ROS_NAMESPACE" => Some(String::new()),
            _ => None,
        };
        let environment = Environment::from_variables(all);
        assert_eq!(environment.host.as_deref(), Some("robot"));
        assert_eq!(environment.namespace, None, "an empty variable says nothing");
        let ip = |name: &str| all(name).filter(|_| name == "ROS_IP");
        assert_eq!(Environment::from_variables(ip).host.as_deref(), Some("10.0.0.2"));
    }

    #[test]
    fn a_loopback_master_is_reached_and_answered_on_loopback() {
        assert!(address_towards(([127, 0, 0, 1], 11311).into()).is_loopback());
        assert!(listen_at("127.0.0.1").ip().is_loopback());
        assert!(listen_at("localhost").ip().is_loopback());
    }
}
