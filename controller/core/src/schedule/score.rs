//! How good a robot is for a task: lower is better.

use muster_api::kind::node::NodeKind;
use muster_api::kind::task::{Cost, TaskSpec};

use crate::cluster::NodeFacts;

/// The score of a node that passed the filters: metres for the cost `Distance` (Avalon, Alg. 1),
/// seconds for `TravelTime` (straight line over speed). None: nothing to score by, because it is a
/// cloud node or the task has no operation position.
#[must_use]
pub fn score(facts: &NodeFacts, spec: &TaskSpec) -> Option<f64> {
    let at = spec.placement.at.as_ref().filter(|_| facts.kind == NodeKind::Robot)?;
    let distance = at.distance_to(facts.pose.as_ref()?)?;
    match spec.placement.cost {
        Cost::Distance => Some(distance),
        Cost::TravelTime => Some(distance / facts.speed?),
    }
}
