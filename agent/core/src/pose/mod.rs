//! Where the robot is, from what ROS says: frames, their tree, and whether the pose counts.
//!
//! | module | holds |
//! |---|---|
//! | [`frame`] | rigid transforms: made of messages, read from settings, applied to covariances |
//! | [`tf`] | the tree of frames over time, static ones too |
//! | [`tracker`] | what came last, in the map frame |
//! | [`judge`] | whether that is new enough and sure enough, and why not |
//!
//! Frames are REP 105's: `map` → `odom` → `base_link`. A transform `a_from_b` turns coordinates in `b` into ones in `a`.

pub mod frame;
pub mod judge;
pub mod tf;
pub mod tracker;
