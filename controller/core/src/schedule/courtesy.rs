//! Nodes that declared tasks leave to frameworks for a moment: which, is decided in [`crate::offer::courtesy`].

use std::sync::Arc;

use super::{Demand, filter};
use crate::cluster::Cluster;
use crate::fairness::namespace_of;
use crate::report::Refusal;
use crate::space::Slot;

/// Tasks of a namespace leave a node that takes one of them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Claim {
    /// The node.
    pub slot: Slot,
    /// The tasks' namespace.
    pub namespace: Arc<str>,
}

/// The priority of who says nothing of it: above it nothing is left to anybody.
const USUAL_PRIORITY: i32 = 0;

/// Why a node does not take a task now: [`filter::refusal`], or because it is left to a framework.
pub(super) fn refusal(cluster: &Cluster, slot: Slot, demand: &Demand) -> Option<Refusal> {
    filter::refusal(cluster.sites(), cluster.at(slot), demand).or_else(|| {
        let namespace = left_to(cluster, slot, demand)?;
        Some(Refusal::Left { namespace: namespace.to_string() })
    })
}

/// The nodes that take the task and are left by it.
pub(super) fn claims(cluster: &Cluster, demand: &Demand) -> Vec<Claim> {
    let left = cluster.left().filter(|slot| {
        filter::refusal(cluster.sites(), cluster.at(*slot), demand).is_none()
            && left_to(cluster, *slot, demand).is_some()
    });
    let namespace = || namespace_of(&demand.title).into();
    left.map(|slot| Claim { slot, namespace: namespace() }).collect()
}

/// The namespace with less to whose frameworks the task leaves the node.
fn left_to<'a>(cluster: &'a Cluster, slot: Slot, demand: &Demand) -> Option<&'a Arc<str>> {
    let others = cluster.left_to(slot)?;
    if demand.framework.is_some()
        || demand.spec.priority > USUAL_PRIORITY
        || cluster.nomination(&demand.uid).is_some()
    {
        return None;
    }
    let own = cluster.rank(namespace_of(&demand.title));
    others.iter().find(|other| cluster.rank(other) < own)
}
