//! Who is ended to make room for a task of more priority.
//!
//! A task that finds no place may take that of tasks with strictly less priority, on a node that refuses it only for
//! what others hold there. The choice does the least harm: of two ways, the one whose most important victim is less
//! important; then the one with fewer victims; then the one with the less important ones; then the one whose victims
//! are younger. Of two nodes with the same harm the one with the better score, then the first.
//!
//! Victims end gracefully, by the controller's order to their agents. Until the last is gone nothing passes on, and the
//! ledger gives a lease only when its old holder's processes are gone (invariant 1). What the task will need is
//! *kept* meanwhile from tasks of no more priority ([`Cluster::nominate`]), else they would take it bit by bit. Every pass
//! decides anew: when the task fits elsewhere first, it goes there. Tasks that are ending already cost nothing, so a pass
//! after the order finds the same node again, with nobody more to end.

use std::cmp::{Ordering, Reverse};
use std::collections::BTreeMap;
use std::sync::Arc;

use muster_api::id::TaskUid;
use muster_api::kind::task::{self, NodeRefusal};
use muster_api::name::NodeName;
use muster_api::resource::Compute;

use crate::cluster::{Cluster, Member};
use crate::fairness::namespace_of;
use crate::ledger::{NodeLedger, Reservation};
use crate::report::Refusal;
use crate::schedule::{Demand, filter, score};
use crate::site::Sites;
use crate::space::Slot;

/// Up to this many candidates on a node every combination is looked at (4096 at most); above it they are spared one by
/// one, the most important first, as long as the rest makes room: nobody is ended for nothing, but there may be a set
/// with fewer.
const EXACT: usize = 12;

/// Room is made for a task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Preemption {
    /// For whom.
    pub uid: TaskUid,
    /// Where.
    pub node: NodeName,
    /// Who is to end, beside those that are ending already; none: it only waits for these.
    pub victims: Vec<Victim>,
}

/// A task that makes room.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Victim {
    /// Its uid.
    pub uid: TaskUid,
    /// `namespace/name`.
    pub title: Arc<str>,
}

/// What ending a set of tasks means; less is better.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Harm {
    highest: Option<i32>,
    count: usize,
    /// The most important first.
    priorities: Vec<i32>,
    /// The oldest first; a younger oldest is less harm.
    ages: Vec<Reverse<u64>>,
}

/// Finds the node where room for `demand` does the least harm, keeps it for it, and marks the victims as ending. Says who
/// they are, and why the task waits meanwhile.
pub(crate) fn make_room(
    cluster: &mut Cluster,
    demand: &Demand,
) -> Option<(Preemption, NodeRefusal)> {
    let (slot, victims) = choose(cluster, demand)?;
    let member = cluster.at(slot);
    let (node, facts) = (member.name.clone(), member.facts.as_ref()?);
    let reservation = demand.reservation(facts);
    let named = |uid: &TaskUid| {
        let title = member.ledger.reservation(uid).map(|r| Arc::clone(&r.title));
        Victim { uid: uid.clone(), title: title.unwrap_or_default() }
    };
    let named: Vec<Victim> = victims.iter().map(named).collect();
    for uid in &victims {
        cluster.set_stopping(uid, true);
    }
    let kept = cluster.at(slot).ledger.keeps(&demand.uid, &reservation);
    if !kept || cluster.nomination(&demand.uid) != Some(slot) {
        cluster.nominate(&demand.uid, &node, &reservation);
    }
    let ending = ending(&cluster.at(slot).ledger);
    let why = NodeRefusal {
        node: node.to_string(),
        reason: task::PREEMPTING.to_owned(),
        message: format!("waits until these have ended, to make room: {}", ending.join(", ")),
    };
    Some((Preemption { uid: demand.uid.clone(), node, victims: named }, why))
}

fn ending(ledger: &NodeLedger) -> Vec<String> {
    let ending = ledger.reservations().filter(|(_, r)| r.standing.stopping);
    ending.map(|(_, r)| r.title.to_string()).collect()
}

/// The node, and who would have to end there.
fn choose(cluster: &Cluster, demand: &Demand) -> Option<(Slot, Vec<TaskUid>)> {
    let priority = demand.spec.priority;
    let somebody = cluster.least_priority().is_some_and(|least| least < priority);
    if demand.spec.preemption == task::Preemption::Never || !somebody {
        return None;
    }
    let nominated = cluster.nomination(&demand.uid);
    // Nobody more has to end there: no other node does less harm.
    if let Some(slot) = nominated
        && let Some(nobody) =
            victims(cluster.sites(), cluster.at(slot), demand).filter(Vec::is_empty)
    {
        return Some((slot, nobody));
    }
    let mut best: Option<(Harm, bool, f64, Slot, Vec<TaskUid>)> = None;
    for (slot, member) in cluster.members() {
        let Some(victims) = victims(cluster.sites(), member, demand) else { continue };
        let harm = harm(&member.ledger, &victims);
        let facts = member.facts.as_ref().expect("a node with victims has facts");
        let score = score::score(cluster.sites(), facts, &demand.spec).unwrap_or(0.0);
        let elsewhere = nominated != Some(slot);
        let better = best.as_ref().is_none_or(|(h, e, s, ..)| {
            let order = harm.cmp(h).then(elsewhere.cmp(e)).then(score.total_cmp(s));
            order == Ordering::Less
        });
        if better {
            best = Some((harm, elsewhere, score, slot, victims));
        }
    }
    best.map(|(.., slot, victims)| (slot, victims))
}

/// What may end as one: a task, or an executor with the work it does.
#[derive(Debug)]
struct Candidate<'a> {
    tasks: Vec<(&'a TaskUid, &'a Reservation)>,
}

/// Who of a node ends for `demand`; none: that would not help, or is not needed.
fn victims(sites: &Sites, member: &Member, demand: &Demand) -> Option<Vec<TaskUid>> {
    match filter::refusal(sites, member, demand)? {
        Refusal::Exhausted { .. } | Refusal::LeaseHeld { .. } | Refusal::Kept { .. } => {}
        // What others hold is not, or not alone, what stands against it.
        _ => return None,
    }
    let facts = member.facts.as_ref()?;
    let reservation = demand.reservation(facts);
    let need = Need {
        ledger: &member.ledger,
        reservation: &reservation,
        kept: member.ledger.kept_from(&demand.uid, demand.spec.priority),
    };
    let priority = demand.spec.priority;
    if member.ledger.group_kept_from(&demand.uid, priority, &reservation.groups).is_some() {
        return None;
    }
    let mut candidates = candidates(&member.ledger, priority);
    // Work does not end the executor that is to do it.
    let own = reservation.standing.executor.as_ref();
    candidates.retain(|c| own != Some(&c.tasks[0].1.title));
    // Nor does a task end those that it waits for: it could not begin.
    let namespace = namespace_of(&demand.title);
    let waited_for = |title: &str| {
        let names = demand.spec.depends_on.iter().map(|one| one.task.as_str());
        title
            .split_once('/')
            .is_some_and(|(of, name)| of == namespace && names.clone().any(|n| n == name))
    };
    candidates.retain(|c| !c.tasks.iter().any(|(_, r)| waited_for(&r.title)));
    if !need.is_met(&everybody(&candidates)) {
        return None;
    }
    if need.is_met(&[]) {
        return Some(Vec::new());
    }
    // Nobody more important than needed.
    let highest = |c: &Candidate<'_>| c.tasks.iter().map(|(_, r)| r.standing.priority).max();
    candidates.sort_by_key(&highest);
    let (mut short, mut enough) = (0, candidates.len());
    while short + 1 < enough {
        let middle = short.midpoint(enough);
        if need.is_met(&everybody(&candidates[..middle])) {
            enough = middle;
        } else {
            short = middle;
        }
    }
    let limit = highest(&candidates[enough - 1]);
    candidates.retain(|c| highest(c) <= limit);
    Some(if candidates.len() <= EXACT {
        exact(&need, &candidates)
    } else {
        spare(&need, candidates)
    })
}

/// What must be free of a node.
struct Need<'a> {
    ledger: &'a NodeLedger,
    reservation: &'a Reservation,
    /// Not for this task.
    kept: Compute,
}

impl Need<'_> {
    /// Whether the task fits when these, in order of their uids, and those that are ending already are gone.
    fn is_met(&self, gone: &[TaskUid]) -> bool {
        let leaves =
            |uid: &TaskUid, r: &Reservation| r.standing.stopping || gone.binary_search(uid).is_ok();
        let held = self.reservation.groups.iter().filter_map(|g| self.ledger.group(g).holder);
        for holder in held {
            // Without a reservation it is not a task's: nobody here can end it.
            if !self.ledger.reservation(&holder).is_some_and(|r| leaves(&holder, r)) {
                return false;
            }
        }
        let mut left = self.ledger.allocatable().clone();
        for (uid, reservation) in self.ledger.reservations() {
            if !leaves(uid, reservation) {
                left.saturating_sub(&reservation.compute);
            }
        }
        left.saturating_sub(&self.kept);
        left.shortage_for(&self.reservation.compute).is_none()
    }
}

/// Who may end for a task of this priority.
fn candidates(ledger: &NodeLedger, priority: i32) -> Vec<Candidate<'_>> {
    let alive = || ledger.reservations().filter(|(_, r)| !r.standing.stopping);
    let mut works: BTreeMap<&str, Vec<(&TaskUid, &Reservation)>> = BTreeMap::new();
    for (uid, reservation) in alive() {
        if let Some(executor) = reservation.standing.executor.as_deref() {
            works.entry(executor).or_default().push((uid, reservation));
        }
    }
    let mut found = Vec::new();
    for (uid, reservation) in alive() {
        let mut tasks = vec![(uid, reservation)];
        tasks.extend(works.get(&*reservation.title).into_iter().flatten());
        if tasks.iter().all(|(_, r)| r.standing.priority < priority) {
            found.push(Candidate { tasks });
        }
    }
    found
}

fn everybody(candidates: &[Candidate<'_>]) -> Vec<TaskUid> {
    let mut uids: Vec<TaskUid> =
        candidates.iter().flat_map(|c| c.tasks.iter().map(|(uid, _)| (*uid).clone())).collect();
    uids.sort();
    uids.dedup();
    uids
}

fn harm(ledger: &NodeLedger, victims: &[TaskUid]) -> Harm {
    let priority = |uid: &TaskUid| ledger.reservation(uid).map(|r| r.standing.priority);
    let mut priorities: Vec<i32> = victims.iter().filter_map(priority).collect();
    priorities.sort_by_key(|p| Reverse(*p));
    let mut ages: Vec<Reverse<u64>> = victims.iter().map(|uid| Reverse(ledger.came(uid))).collect();
    ages.sort_by_key(|age| age.0);
    Harm { highest: priorities.first().copied(), count: victims.len(), priorities, ages }
}

/// The set with the least harm.
fn exact(need: &Need<'_>, candidates: &[Candidate<'_>]) -> Vec<TaskUid> {
    let mut best: Option<(Harm, Vec<TaskUid>)> = None;
    let mut sets: Vec<u32> = (1..1_u32 << candidates.len()).collect();
    sets.sort_by_key(|set| set.count_ones());
    for chosen in sets {
        // Each candidate is at least one more: no larger set has fewer.
        if best.as_ref().is_some_and(|(_, b)| b.len() < chosen.count_ones() as usize) {
            break;
        }
        let set = candidates.iter().enumerate().filter(|(i, _)| chosen >> i & 1 == 1);
        let mut uids: Vec<TaskUid> =
            set.flat_map(|(_, c)| c.tasks.iter().map(|(uid, _)| (*uid).clone())).collect();
        uids.sort();
        uids.dedup();
        if best.as_ref().is_some_and(|(_, b)| b.len() < uids.len()) || !need.is_met(&uids) {
            continue;
        }
        let harm = harm(need.ledger, &uids);
        if best.as_ref().is_none_or(|(h, _)| harm < *h) {
            best = Some((harm, uids));
        }
    }
    best.expect("all of them together make room").1
}

/// A set of which nobody can be spared.
fn spare(need: &Need<'_>, mut candidates: Vec<Candidate<'_>>) -> Vec<TaskUid> {
    let first = |c: &Candidate<'_>| {
        let priority = c.tasks.iter().map(|(_, r)| r.standing.priority).max();
        let oldest = c.tasks.iter().map(|(uid, _)| need.ledger.came(uid)).min();
        (Reverse(priority), oldest)
    };
    candidates.sort_by_key(first);
    let mut i = 0;
    while i < candidates.len() {
        let spared = candidates.remove(i);
        if !need.is_met(&everybody(&candidates)) {
            candidates.insert(i, spared);
            i += 1;
        }
    }
    everybody(&candidates)
}

#[cfg(test)]
mod tests;
