//! Which nodes can take a task at all. The filters stand in the order of how hard their reasons are
//! to change, so that the first refusal is the one worth reading.

use std::collections::BTreeSet;

use muster_api::kind::node::{NodeKind, Taint, TaintEffect};
use muster_api::kind::task::{Cost, NodeChoice, TaskSpec};
use muster_api::name::FunctionName;
use muster_api::pose::OperationPosition;

use super::Demand;
use crate::cluster::{Member, NodeFacts};
use crate::fairness::namespace_of;
use crate::ledger::Denied;
use crate::report::Refusal;
use crate::site::{Sites, Travel};

/// The first reason for which `member` does not take the task; none: it does.
#[must_use]
pub fn refusal(sites: &Sites, member: &Member, demand: &Demand) -> Option<Refusal> {
    let Some(facts) = &member.facts else {
        return Some(Refusal::NotReady { message: "its Node object is gone".to_owned() });
    };
    let spec = &*demand.spec;
    identity(member.name.as_str(), facts, spec)
        .or_else(|| executor(member, demand))
        .or_else(|| apart(member, demand))
        .or_else(|| abilities(facts, spec))
        .or_else(|| too_small(member, spec))
        .or_else(|| admission(facts, spec))
        .or_else(|| reach(sites, facts, spec))
        .or_else(|| charge(facts, spec))
        .or_else(|| what_is_left(member, facts, demand))
}

fn identity(name: &str, facts: &NodeFacts, spec: &TaskSpec) -> Option<Refusal> {
    let placement = &spec.placement;
    if let Some(node) = placement.node.as_ref().filter(|n| *n != name) {
        return Some(Refusal::PinnedElsewhere { node: node.clone() });
    }
    if !spec.allows_kind(facts.kind) {
        return Some(Refusal::WrongKind {
            kind: facts.kind,
            by_choice: placement.on != NodeChoice::Any,
        });
    }
    (!placement.selector.matches(&facts.labels))
        .then(|| Refusal::SelectorMismatch { selector: placement.selector.to_string() })
}

/// Work for an executor goes where that executor is, and only to one of the same framework: a name in a namespace is no
/// permission.
fn executor(member: &Member, demand: &Demand) -> Option<Refusal> {
    let task = &demand.spec.run.executor.as_ref()?.task;
    let namespace = namespace_of(&demand.title);
    let is_it = |title: &str| title.split_once('/') == Some((namespace, task.as_str()));
    let here = member
        .ledger
        .reservations()
        .any(|(_, r)| is_it(&r.title) && r.framework == demand.framework && !r.standing.stopping);
    (!here).then(|| Refusal::NoExecutor { task: task.clone() })
}

/// Tasks that are to be apart are on different nodes.
fn apart(member: &Member, demand: &Demand) -> Option<Refusal> {
    let word = demand.spec.placement.apart.as_deref()?;
    let namespace = namespace_of(&demand.title);
    let here = member
        .ledger
        .reservations()
        .find(|(_, r)| r.apart.as_deref() == Some(word) && namespace_of(&r.title) == namespace);
    here.map(|(_, r)| Refusal::Apart { task: r.title.to_string() })
}

/// What of a node stands against a task for as long as both are what they are: not what is busy, lost or cordoned now.
#[must_use]
pub fn unsuited(name: &str, facts: &NodeFacts, spec: &TaskSpec) -> Option<Refusal> {
    let resources = &spec.resources;
    let joined = || {
        let message = "its agent has not joined".to_owned();
        facts.runtimes.is_empty().then_some(Refusal::NotReady { message })
    };
    identity(name, facts, spec)
        .or_else(joined)
        .or_else(|| functions(facts, &resources.sensors, &resources.actuators))
        .or_else(|| tainted(facts, spec))
}

fn abilities(facts: &NodeFacts, spec: &TaskSpec) -> Option<Refusal> {
    let runtime = if spec.run.container.is_some() { "docker" } else { "process" };
    let offered = facts.runtimes.iter().find(|r| r.name == runtime);
    if spec.run.executor.is_none() && !offered.is_some_and(|r| r.available) {
        let message = offered.map(|r| r.message.clone()).unwrap_or_default();
        return Some(Refusal::NoRuntime { runtime, message });
    }
    functions(facts, &spec.resources.sensors, &spec.resources.actuators)
}

/// The first sort of functions, SR before AR, of which the node lacks some.
pub(crate) fn functions(
    facts: &NodeFacts,
    sensors: &[FunctionName],
    actuators: &[FunctionName],
) -> Option<Refusal> {
    let lacking = |asked: &[FunctionName], has: &BTreeSet<FunctionName>| -> Vec<FunctionName> {
        asked.iter().filter(|f| !has.contains(*f)).cloned().collect()
    };
    let missing = lacking(sensors, &facts.sensors);
    if !missing.is_empty() {
        return Some(Refusal::NoSensor { missing });
    }
    let missing = lacking(actuators, &facts.actuators);
    (!missing.is_empty()).then_some(Refusal::NoActuator { missing })
}

fn too_small(member: &Member, spec: &TaskSpec) -> Option<Refusal> {
    // A node that never reported has nothing; "not ready" says more about it.
    let ready = member.facts.as_ref().is_some_and(|f| f.not_ready.is_none());
    let shortage = member.ledger.allocatable().shortage_for(&spec.resources.reserved())?;
    ready.then_some(Refusal::TooSmall { shortage })
}

fn tainted(facts: &NodeFacts, spec: &TaskSpec) -> Option<Refusal> {
    untolerated(&facts.taints, spec).map(|taint| Refusal::Tainted { taint })
}

fn untolerated(taints: &[Taint], spec: &TaskSpec) -> Option<Taint> {
    let keeps_away = |t: &&Taint| {
        t.effect == TaintEffect::NoSchedule
            && !spec.placement.tolerations.iter().any(|o| o.tolerates(t))
    };
    taints.iter().find(keeps_away).cloned()
}

/// The battery that the task itself asks for.
fn charge(facts: &NodeFacts, spec: &TaskSpec) -> Option<Refusal> {
    let (percent, wanted) = (facts.battery?, spec.placement.min_battery?);
    (percent < wanted).then_some(Refusal::BatteryLow { percent, wanted })
}

fn admission(facts: &NodeFacts, spec: &TaskSpec) -> Option<Refusal> {
    if let Some(refusal) = tainted(facts, spec) {
        return Some(refusal);
    }
    if let Some(taint) = untolerated(&facts.passing, spec) {
        return Some(Refusal::OutOfService { taint });
    }
    if facts.unschedulable {
        return Some(Refusal::Cordoned);
    }
    facts.not_ready.as_ref().map(|message| Refusal::NotReady { message: message.clone() })
}

/// The range filter (Avalon, Alg. 1). Cloud nodes have no pose; it does not apply to them.
fn reach(sites: &Sites, facts: &NodeFacts, spec: &TaskSpec) -> Option<Refusal> {
    let placement = &spec.placement;
    let within = placement.within.unwrap_or(f64::INFINITY);
    reach_of(sites, facts, (placement.at.as_ref(), within, placement.cost))
}

/// The same for any operation position, radius in metres and cost, a task's or a framework's.
pub(crate) fn reach_of(
    sites: &Sites,
    facts: &NodeFacts,
    (at, within, cost): (Option<&OperationPosition>, f64, Cost),
) -> Option<Refusal> {
    let at = at.filter(|_| facts.kind == NodeKind::Robot)?;
    let Some(pose) = &facts.pose else {
        return Some(Refusal::NoPose);
    };
    if !pose.localized {
        return Some(Refusal::NotLocalized);
    }
    let Some(distance) = at.distance_to(pose) else {
        return Some(Refusal::OtherMap { robot: pose.map.clone(), wanted: at.map.clone() });
    };
    if distance > within {
        return Some(Refusal::OutOfRange { distance, within });
    }
    if cost == Cost::Distance {
        return None;
    }
    if facts.speed.is_none() {
        return Some(Refusal::NoSpeed);
    }
    match sites.travel(at, pose) {
        Travel::NoSite | Travel::Way(_) => None,
        Travel::None(why) => {
            let site = sites.of_map(&at.map).unwrap_or_default().to_owned();
            Some(Refusal::Unreachable { site, why })
        }
    }
}

fn what_is_left(member: &Member, facts: &NodeFacts, demand: &Demand) -> Option<Refusal> {
    let resources = &demand.spec.resources;
    let groups = facts.groups_for(&resources.actuators);
    let who = (&demand.uid, demand.spec.priority);
    match member.ledger.check_for(who, &resources.reserved(), &groups).err()? {
        Denied::Kept { title } => Some(Refusal::Kept { title: title.to_string() }),
        Denied::Short(shortage) => Some(Refusal::Exhausted { shortage }),
        Denied::Held { group, holder } => {
            let title = member
                .ledger
                .reservation(&holder)
                .map_or_else(|| holder.to_string(), |r| r.title.to_string());
            Some(Refusal::LeaseHeld { group, holder: title })
        }
    }
}
