//! Our ROS 1 client and master, and the agent's poses, sensors, drivers and tasks, against Debian's ROS 1: roscore, rospy, rostopic, rosnode.

mod attacks;
mod clicks;
mod client;
mod containers;
mod gate;
mod master;
mod pose;
mod probes;
mod sensors;
mod tasks;
mod view;
