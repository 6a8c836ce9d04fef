//! A ROS 1 client in Rust, without ROS on the machine: what a node needs to be one among others.
//!
//! | module | holds |
//! |---|---|
//! | [`message`], [`wire`], [`time`] | messages made from `msgs/`, with their checksums and serialisation |
//! | [`layout`] | messages of types that are named at run time, from JSON |
//! | [`convert`] | the same messages as protobuf, both ways |
//! | [`name`], [`mod@env`] | graph names, namespaces, remapping; what `ROS_…` variables say |
//! | [`xmlrpc`] | values, calls, answers; the client's and the server's side over HTTP |
//! | [`master`] | the master's API |
//! | [`registry`], [`roscore`] | a master: its state, and the server |
//! | [`tcpros`] | connection headers, frames |
//! | [`node`] | a node: its slave API, its registrations, its subscriptions and publications |
//! | [`peer`] | what other nodes say of themselves |
//! | [`pace`] | how often others may call a server |
//! | [`rate`] | how often a topic is published |
//!
//! ```text
//!   Node ── registrar ── registerX, lookupNode ──▶ master       every second: does it still know us?
//!    │          ▲ publisherUpdate ── slave API ◀── master
//!    ├─ Subscriber ── a task a publisher ── requestTopic, TCPROS ──▶ publisher
//!    └─ Publisher ◀── a task a subscriber ── TCPROS ◀── subscriber
//! ```
//!
//! Everything is level-triggered: what is wanted is kept, and compared with what the master and the publishers say, so
//! that restarts of either cost time and nothing else. All that comes from the network is bounded.

pub mod convert;
pub mod env;
pub mod layout;
pub mod master;
pub mod message;
pub mod name;
pub mod node;
pub mod pace;
pub mod peer;
mod queue;
pub mod rate;
pub mod registry;
pub mod roscore;
pub mod tcpros;
pub mod time;
pub mod wire;
pub mod xmlrpc;

pub use message::Message;
pub use node::{Node, NodeOptions};

/// Structs made from `msgs/`.
#[allow(
    clippy::all,
    clippy::allow_attributes,
    clippy::allow_attributes_without_reason,
    reason = "generated"
)]
mod made {
    include!(concat!(env!("OUT_DIR"), "/messages.rs"));

    use crate::message::{Description, describe};
}
pub use made::{ALL, geometry_msgs, nav_msgs, rosgraph_msgs, sensor_msgs, std_msgs, tf2_msgs};

/// The protobuf messages of `muster.ros.v1`.
#[allow(
    clippy::all,
    clippy::allow_attributes,
    clippy::allow_attributes_without_reason,
    missing_debug_implementations,
    reason = "generated"
)]
pub mod proto {
    include!(concat!(env!("OUT_DIR"), "/wire.rs"));
}
