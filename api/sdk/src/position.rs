//! Where the work is, and what moves it.

use std::future::Future;

use muster_api::wire::framework::v1 as proto;
pub use proto::Cost;
use tokio::sync::mpsc;

/// Where a framework works and how far a robot may be from there: metres, in the frame of a map.
#[derive(Debug, Clone, PartialEq)]
pub struct Position(pub(crate) proto::Position);

impl Position {
    /// At `x` metres east and `y` metres north of the origin of the default map, any distance away.
    #[must_use]
    pub fn at(x: f64, y: f64) -> Self {
        Position(proto::Position { x, y, ..proto::Position::default() })
    }

    /// Metres above the map's origin.
    #[must_use]
    pub fn z(mut self, z: f64) -> Self {
        self.0.z = z;
        self
    }

    /// In the frame of another map.
    #[must_use]
    pub fn map(mut self, map: impl Into<String>) -> Self {
        self.0.map = map.into();
        self
    }

    /// Robots further away than this many metres are not offered; the rim is inside.
    #[must_use]
    pub fn radius(mut self, metres: f64) -> Self {
        self.0.radius = Some(metres);
        self
    }

    /// Whether offers are scored in metres or in seconds of travel.
    #[must_use]
    pub fn cost(mut self, cost: Cost) -> Self {
        self.0.cost = cost.into();
        self
    }
}

/// Something that says where the work is as it moves: a click on a map, a person who is followed.
/// [`FrameworkHandle::follow`](crate::FrameworkHandle::follow) takes positions from it.
pub trait PositionSource: Send {
    /// The next position; none: there will be no more, and the last one stays.
    fn next(&mut self) -> impl Future<Output = Option<Position>> + Send;
}

impl PositionSource for mpsc::Receiver<Position> {
    async fn next(&mut self) -> Option<Position> {
        self.recv().await
    }
}
