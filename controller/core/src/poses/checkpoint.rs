//! When a live pose is written into its Node object.
//!
//! `Node.status.pose` is for people and for a restart: objects must not change at the rate of poses.

use std::time::Duration;

use muster_api::pose::Pose;

/// A robot that is this far from its checkpoint gets a new one at once, metres: as far as a person sees it in another
/// place on a floor plan.
pub const STEP: f64 = 1.0;
/// One that moved less gets one after this time.
pub const SETTLE: Duration = Duration::from_secs(10);
/// Less than this is no move, metres …
const STILL: f64 = 0.01;
/// … and radians: what trackers measure of a robot that stands.
const STILL_YAW: f64 = 0.01;

/// When a pose is to be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Due {
    /// Now.
    Now,
    /// When [`SETTLE`] has passed since the last one.
    Later,
    /// Not while the robot stays.
    Never,
}

/// Whether `live` is to be written, when `written` is what the object says for the time `since`.
#[must_use]
pub fn due(written: Option<&Pose>, live: &Pose, since: Duration) -> Due {
    let Some(written) = written else { return Due::Now };
    let distance = nalgebra::distance(&written.position(), &live.position());
    let elsewhere = written.map != live.map
        || written.localized != live.localized
        || written.source != live.source
        || distance >= STEP;
    if elsewhere {
        return Due::Now;
    }
    let turned = (written.yaw - live.yaw).abs();
    match distance > STILL || turned > STILL_YAW {
        true if since >= SETTLE => Due::Now,
        true => Due::Later,
        false => Due::Never,
    }
}
