//! How good a robot is for a task: lower is better.

use muster_api::kind::node::NodeKind;
use muster_api::kind::task::{Cost, TaskSpec};
use muster_api::pose::OperationPosition;

use crate::cluster::NodeFacts;
use crate::site::{Sites, Travel};

/// The score of a node that passed the filters: metres for the cost `Distance` (Avalon, Alg. 1),
/// seconds for `TravelTime` (the way over the floor of the map's Site, else the straight line, over speed); to either is added what the task asks for each
/// percent that the battery lacks. None: nothing to score by, because it is a
/// cloud node, the task has no operation position, or no way leads there.
#[must_use]
pub fn score(sites: &Sites, facts: &NodeFacts, spec: &TaskSpec) -> Option<f64> {
    let cost = score_at(sites, facts, spec.placement.at.as_ref(), spec.placement.cost)?;
    let lacks = f64::from(facts.battery_lacks());
    Some(cost + spec.placement.battery_cost.unwrap_or_default() * lacks)
}

/// The same for any operation position and cost, a task's or a framework's.
#[must_use]
pub fn score_at(
    sites: &Sites,
    facts: &NodeFacts,
    at: Option<&OperationPosition>,
    cost: Cost,
) -> Option<f64> {
    let at = at.filter(|_| facts.kind == NodeKind::Robot)?;
    let pose = facts.pose.as_ref()?;
    let distance = at.distance_to(pose)?;
    if cost == Cost::Distance {
        return Some(distance);
    }
    let way = match sites.travel(at, pose) {
        Travel::NoSite => distance,
        Travel::Way(metres) => metres,
        Travel::None(_) => return None,
    };
    Some(way / facts.speed?)
}
