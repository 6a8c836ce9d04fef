//! A robot that stands still.

use muster_api::pose::{FixedPosition, Pose};

use super::Position;

#[derive(Debug)]
pub(super) struct Fixed {
    place: FixedPosition,
    map: String,
}

impl Fixed {
    pub(super) fn new(place: FixedPosition, map: &str) -> Fixed {
        Fixed { place, map: map.to_owned() }
    }
}

impl Position for Fixed {
    fn current(&self) -> Option<Pose> {
        Some(Pose {
            map: self.map.clone(),
            x: self.place.x,
            y: self.place.y,
            z: 0.0,
            yaw: self.place.yaw,
            // The pose holds now as it will hold later; a stamp would only make it look new.
            stamp: None,
            source: "static".to_owned(),
            localized: true,
        })
    }
}
