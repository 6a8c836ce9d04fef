//! Our ROS 1 client, and the agent's poses, sensors, drivers and tasks, against Debian's ROS 1: roscore, rospy, rostopic, rosnode.

mod attacks;
mod client;
mod gate;
mod pose;
mod probes;
mod sensors;
mod tasks;
