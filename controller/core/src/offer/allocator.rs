//! Which nodes a framework may be offered, best first.
//!
//! [`Closest`] is the paper's Algorithm 1: range filter, ascending score, the k closest. Robots and cloud nodes have
//! places of their own: a crowd of robots around the operation position must not hide the cloud, which no range filter
//! applies to.

use std::fmt;

use muster_api::kind::node::{NodeKind, TaintEffect};
use muster_api::kind::task::{Cost, NodeChoice};

use super::Wish;
use crate::cluster::{Cluster, Member, NodeFacts};
use crate::fairness::Spent;
use crate::report::Refusal;
use crate::schedule::filter;
use crate::schedule::score::score_at;
use crate::site::Sites;
use crate::space::Slot;

/// A node that a framework may be offered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The node.
    pub slot: Slot,
    /// Metres or seconds; none: nothing to score by.
    pub score: Option<f64>,
}

/// Chooses what a framework is shown.
pub trait Allocator: fmt::Debug + Send + Sync {
    /// The best robots and the best cloud nodes for `wish`, at most its limit of each, best first, robots before cloud
    /// nodes, without those that `refused` names. Every one passes [`refusal`], and is not [`is_spent`].
    fn candidates(
        &self,
        cluster: &Cluster,
        wish: &Wish,
        refused: &dyn Fn(Slot, Option<f64>) -> bool,
    ) -> Vec<Candidate>;
}

/// Algorithm 1: the closest robots within the radius; where there is no position, those with the most free CR.
#[derive(Debug, Clone, Copy, Default)]
pub struct Closest;

impl Allocator for Closest {
    fn candidates(
        &self,
        cluster: &Cluster,
        wish: &Wish,
        refused: &dyn Fn(Slot, Option<f64>) -> bool,
    ) -> Vec<Candidate> {
        let limit = wish.filter.limit();
        let fits = |c: &Candidate| {
            let member = cluster.at(c.slot);
            holdings_refusal(member, wish).is_none()
                && !is_spent(member, wish)
                && !refused(c.slot, c.score)
        };
        let mut found = Vec::new();
        if wish.filter.on != NodeChoice::Cloud {
            match (&wish.position, wish.cost) {
                (None, _) => {
                    found.extend(by_free(cluster, NodeKind::Robot).filter(fits).take(limit));
                }
                (Some(_), Cost::Distance) => {
                    found.extend(in_range(cluster, wish).filter(fits).take(limit));
                }
                (Some(_), Cost::TravelTime) => {
                    let mut timed: Vec<Candidate> = in_range(cluster, wish)
                        .filter_map(|c| {
                            let facts = cluster.at(c.slot).facts.as_ref()?;
                            let score = score(cluster.sites(), facts, wish)?;
                            Some(Candidate { score: Some(score), ..c })
                        })
                        .filter(fits)
                        .collect();
                    timed.sort_by(|a, b| {
                        let key = |c: &Candidate| c.score.unwrap_or(f64::INFINITY);
                        key(a).total_cmp(&key(b)).then(a.slot.cmp(&b.slot))
                    });
                    timed.truncate(limit);
                    found = timed;
                }
            }
        }
        if wish.filter.on != NodeChoice::Robot {
            found.extend(by_free(cluster, NodeKind::Cloud).filter(fits).take(limit));
        }
        found
    }
}

fn by_free(cluster: &Cluster, kind: NodeKind) -> impl Iterator<Item = Candidate> {
    cluster.by_free(kind).map(|slot| Candidate { slot, score: None })
}

fn in_range<'a>(cluster: &'a Cluster, wish: &Wish) -> impl Iterator<Item = Candidate> + use<'a> {
    let at = wish.position.as_ref();
    at.map(|at| cluster.space().nearest(&at.map, at.position(), wish.radius))
        .into_iter()
        .flatten()
        .map(|found| Candidate { slot: found.slot, score: Some(found.distance) })
}

/// The score of a robot for a framework: metres or seconds to the operation position. None: nothing to score by.
#[must_use]
pub fn score(sites: &Sites, facts: &NodeFacts, wish: &Wish) -> Option<f64> {
    score_at(sites, facts, wish.position.as_ref(), wish.cost)
}

/// Why a node is not offered to a framework; none: it can be.
#[must_use]
pub fn refusal(sites: &Sites, member: &Member, wish: &Wish) -> Option<Refusal> {
    reach_refusal(sites, member, wish).or_else(|| holdings_refusal(member, wish))
}

/// Whether what the framework could want of the node is what its namespace's quota leaves nothing of.
#[must_use]
pub fn is_spent(member: &Member, wish: &Wish) -> bool {
    let (spent, filter) = (wish.spent, &wish.filter);
    if spent == Spent::default() {
        return false;
    }
    let drives = filter.any_actuator || !filter.actuators.is_empty();
    let wanted = (spent.leases && drives)
        || (spent.cpu && filter.minimum.cpu.0 > 0)
        || (spent.memory && filter.minimum.memory.0 > 0);
    let (cpu, _) = member.ledger.open_cpu_memory();
    let computes = cpu.0 > 0 && !spent.cpu;
    let senses = member.facts.as_ref().is_some_and(|facts| !facts.sensors.is_empty());
    let acts = actuators_free(member) && !spent.leases;
    spent.tasks || wanted || !(computes || senses || acts)
}

/// The range filter. Cloud nodes have no pose; it does not apply to them.
#[must_use]
pub fn reach_refusal(sites: &Sites, member: &Member, wish: &Wish) -> Option<Refusal> {
    let facts = member.facts.as_ref()?;
    filter::reach_of(sites, facts, (wish.position.as_ref(), wish.radius, wish.cost))
}

/// Everything but the range: what the node is, whether it takes work, what is left of it.
#[must_use]
pub fn holdings_refusal(member: &Member, wish: &Wish) -> Option<Refusal> {
    let Some(facts) = &member.facts else {
        return Some(Refusal::NotReady { message: "its Node object is gone".to_owned() });
    };
    let filter = &wish.filter;
    let wrong_kind = match filter.on {
        NodeChoice::Any => false,
        NodeChoice::Robot => facts.kind != NodeKind::Robot,
        NodeChoice::Cloud => facts.kind != NodeKind::Cloud,
    };
    if wrong_kind {
        return Some(Refusal::WrongKind { kind: facts.kind, by_choice: true });
    }
    if !filter.selector.is_empty() && !filter.selector.matches(&facts.labels) {
        return Some(Refusal::SelectorMismatch { selector: filter.selector.to_string() });
    }
    if let Some(taint) = facts.passing.first() {
        return Some(Refusal::OutOfService { taint: taint.clone() });
    }
    if let Some(taint) = facts.taints.iter().find(|t| t.effect == TaintEffect::NoSchedule) {
        return Some(Refusal::Tainted { taint: taint.clone() });
    }
    if facts.unschedulable {
        return Some(Refusal::Cordoned);
    }
    if let Some(message) = &facts.not_ready {
        return Some(Refusal::NotReady { message: message.clone() });
    }
    functions_refusal(member, facts, wish).or_else(|| leftovers_refusal(member, facts, wish))
}

fn functions_refusal(member: &Member, facts: &NodeFacts, wish: &Wish) -> Option<Refusal> {
    let lacking = filter::functions(facts, &wish.filter.sensors, &wish.filter.actuators);
    if lacking.is_some() {
        return lacking;
    }
    if !wish.filter.any_actuator && wish.filter.actuators.is_empty() {
        return None;
    }
    if facts.actuators.is_empty() {
        return Some(Refusal::NoActuator { missing: Vec::new() });
    }
    let (group, holder) = held_group(member, facts)?;
    Some(Refusal::LeaseHeld { group, holder })
}

/// The first conflict group of a robot that somebody holds, with the holder's `namespace/name`.
fn held_group(member: &Member, facts: &NodeFacts) -> Option<(String, String)> {
    facts.groups().into_iter().find_map(|name| {
        let holder = member.ledger.group(&name).holder?;
        let title = member.ledger.reservation(&holder);
        Some((name, title.map_or_else(|| holder.to_string(), |r| r.title.to_string())))
    })
}

/// Whether nobody holds the robot's actuators, and it has some.
#[must_use]
pub fn actuators_free(member: &Member) -> bool {
    member
        .facts
        .as_ref()
        .is_some_and(|facts| !facts.actuators.is_empty() && !member.ledger.is_any_group_taken())
}

/// An offer of nothing is none: there must be free CR, a sensor to share, or actuators that nobody holds.
fn leftovers_refusal(member: &Member, facts: &NodeFacts, wish: &Wish) -> Option<Refusal> {
    let minimum = &wish.filter.minimum;
    let (cpu, memory) = member.ledger.open_cpu_memory();
    if minimum.cpu > cpu || minimum.memory > memory || !minimum.extended.is_empty() {
        let shortage = member.ledger.open().shortage_for(minimum);
        if let Some(shortage) = shortage {
            return Some(Refusal::Exhausted { shortage });
        }
    }
    if cpu.0 > 0 || !facts.sensors.is_empty() || actuators_free(member) {
        return None;
    }
    let free = member.ledger.open();
    let least = muster_api::resource::Compute::new(
        muster_api::quantity::MilliCpu(1),
        muster_api::quantity::Bytes(0),
    );
    free.shortage_for(&least).map(|shortage| Refusal::Exhausted { shortage })
}
