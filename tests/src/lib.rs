//! A cluster of real processes for the tests: one controller, any number of agents, all from the
//! binaries that the same build made, in a directory of its own, on ports of the kernel's choice.
//!
//! | module | is |
//! |---|---|
//! | [`cluster`] | starting, killing and restarting the daemons; the API of the cluster |
//! | [`wait`] | waiting for what a watch or the kernel shows, with a generous deadline |
//! | [`puppet`] | frameworks on the Python SDK, one process each |
//! | [`echo`] | a framework on the Rust SDK, with an executor that sends messages back |
//! | [`ros`] | a real ROS 1: a roscore of its own, and programs that talk to it |
//! | [`docker`] | an image without a registry |
//! | [`registry`] | a registry of images on loopback |
//! | [`dice`] | random choices of a seed |
//! | [`kernel`] | what the kernel says: processes, start times, cgroups |
//! | [`netns`], [`wire`] | network namespaces, and wires between them with delay, losses, a rate and cuts |
//!
//! A missing piece (a binary, root, Docker) fails the test that needs it; nothing is skipped.

pub mod cluster;
pub mod dice;
pub mod docker;
pub mod echo;
pub mod kernel;
pub mod netns;
pub mod puppet;
pub mod registry;
pub mod ros;
pub mod ros_robot;
pub mod wait;
pub mod wire;

pub use cluster::{AgentOptions, Cluster};
pub use echo::Echo;
pub use puppet::Puppet;
pub use ros::Ros;
