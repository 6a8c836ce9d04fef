//! Our ROS 1 client, and the agent's poses and sensors, against Debian's ROS 1: roscore, rospy, rostopic, rosnode.

mod client;
mod pose;
mod probes;
mod sensors;
