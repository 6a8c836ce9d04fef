//! A robot that is not there: a world of walls, a base that drives in it, a laser and a camera that see it, a battery.
//!
//! | module | holds |
//! |---|---|
//! | [`world`] | walls, and what rays and a moving disc meet of them |
//! | [`outline`] | the walls of a map |
//! | [`base`] | a differential drive with limits, its battery and its docks, over time |
//! | [`laser`] | one revolution of a laser scanner |
//! | [`camera`] | one picture |
//! | [`noise`] | seeded randomness |
//!
//! Nothing here has a clock: the base is advanced to a time, in steps of [`base::STEP_MS`] on one grid, so that how often it is
//! looked at changes nothing. Frames are REP 105's: metres and radians in the map frame, x east, y north, headings
//! counter-clockwise from x.

pub mod base;
pub mod camera;
pub mod laser;
pub mod noise;
pub mod outline;
pub mod world;
