//! Where tasks go: filter → score → bind (DESIGN §5; Avalon, III-C).
//!
//! [`schedule`] takes the waiting tasks and the cluster, and gives a [`Plan`]: which task is bound
//! where, and for every other one why no node takes it. The plan's reservations are made in the
//! cluster as it goes; whoever cannot carry a bind out releases it again.
//!
//! Order of tasks: priority, then the namespace with the least weighted dominant share, its share counted anew after every
//! place that it got, then who waited longest. Order of nodes: a task that needs computation
//! only tries the cloud first; robots by score where there is an operation position; else by fuller battery and most
//! free CR. Nodes with a taint of effect PreferNoSchedule come after those, and nodes that the task has failed on last. A
//! task that has no place may make room: see [`crate::preempt`]. What was just freed is left for a moment to frameworks that
//! have less: see [`crate::offer::courtesy`].

mod courtesy;
pub mod filter;
pub mod score;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use muster_api::id::{Epoch, TaskUid};
use muster_api::kind::node::{NodeKind, TaintEffect};
use muster_api::kind::task::{Cost, NodeRefusal, TaskSpec};
use muster_api::name::NodeName;

use crate::cluster::{Cluster, NodeFacts};
use crate::fairness::{Accounts, OverQuota, namespace_of};
use crate::ledger::{Reservation, Standing};
use crate::preempt::{self, Preemption};
use crate::report::Refusal;
use crate::space::Slot;

pub use courtesy::Claim;
use courtesy::refusal;

/// A task that waits for a place.
#[derive(Debug, Clone)]
pub struct Demand {
    /// Its uid.
    pub uid: TaskUid,
    /// `namespace/name`.
    pub title: Arc<str>,
    /// What it is and needs.
    pub spec: Arc<TaskSpec>,
    /// When it was created, by [`since`]: who waits longest comes first.
    pub since: u64,
    /// Nodes that it has failed on: they come last.
    pub avoid: Arc<[NodeName]>,
    /// Uid of the framework that launched it; none: a declared task.
    pub framework: Option<Arc<str>>,
}

/// The order of creation: by time, which an object tells in seconds since 1970, and in a second by the store's revision.
#[must_use]
pub fn since(created: i64, revision: u64) -> u64 {
    const REVISION_BITS: u32 = 24;
    (created.unsigned_abs() << REVISION_BITS) | (revision & ((1 << REVISION_BITS) - 1))
}

impl Demand {
    /// What it would hold of a node.
    #[must_use]
    pub fn reservation(&self, facts: &NodeFacts) -> Reservation {
        Reservation {
            title: Arc::clone(&self.title),
            compute: self.spec.resources.reserved(),
            groups: facts.groups_for(&self.spec.resources.actuators),
            standing: standing(&self.title, &self.spec, false),
            apart: self.spec.placement.apart.as_deref().map(Into::into),
            framework: self.framework.clone(),
        }
    }
}

/// How a task stands that holds something.
#[must_use]
pub fn standing(title: &str, spec: &TaskSpec, stopping: bool) -> Standing {
    let executor = spec.run.executor.as_ref();
    Standing {
        priority: spec.priority,
        stopping,
        executor: executor.map(|e| executor_title(title, &e.task).into()),
    }
}

/// A task gets a place.
#[derive(Debug, Clone, PartialEq)]
pub struct Bind {
    /// The task.
    pub uid: TaskUid,
    /// The node.
    pub node: NodeName,
    /// The node's score, metres or seconds.
    pub score: Option<f64>,
    /// Granted conflict groups with the numbers of the grants.
    pub leases: Vec<(String, Epoch)>,
}

/// A task gets none.
#[derive(Debug, Clone, PartialEq)]
pub struct Wait {
    /// The task.
    pub uid: TaskUid,
    /// Why, per node; one list for all that ask the same.
    pub why: Arc<[NodeRefusal]>,
    /// For a moment only: it leaves a node that would take it. Older reasons may stand meanwhile.
    pub brief: bool,
}

impl Wait {
    fn new(demand: &Demand, why: Arc<[NodeRefusal]>) -> Self {
        Wait { uid: demand.uid.clone(), why, brief: false }
    }
}

/// What is to be done.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plan {
    /// Tasks that get a place, in the order of decision.
    pub binds: Vec<Bind>,
    /// Tasks that wait, each with its reasons.
    pub waits: Vec<Wait>,
    /// Tasks that are to end, to make room for some of those that wait.
    pub preemptions: Vec<Preemption>,
    /// What some of those that wait leave to frameworks.
    pub claims: Vec<Claim>,
    /// What was decided gave something that tasks may have wanted whose turn was before: room that was kept for another, or the
    /// executor that they are work for. They are to be looked at again.
    pub again: bool,
}

/// Most nodes that are named in a task's reasons; the others are counted. A status must not grow
/// with the fleet: 10 000 waiting tasks on 5 000 nodes would be gigabytes.
pub const WHY_LIMIT: usize = 16;

/// Decides for all waiting tasks at once.
pub fn schedule(cluster: &mut Cluster, demands: &mut [Demand]) -> Plan {
    decide(cluster, demands, Depth::Whole)
}

/// What of the waiting tasks can be placed now that robots moved, without a word about the others: their reasons name
/// every node, and robots move many times a second. Nobody is ended for them either. Only tasks that ask for a place gain
/// by it; the caller gives those.
pub fn schedule_moved(cluster: &mut Cluster, demands: &mut [Demand]) -> Plan {
    decide(cluster, demands, Depth::Places)
}

/// What is decided of tasks that have no place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Depth {
    /// Whether others make room, and why they wait.
    Whole,
    /// Nothing.
    Places,
}

fn decide(cluster: &mut Cluster, demands: &mut [Demand], depth: Depth) -> Plan {
    demands.sort_by_key(|d| (std::cmp::Reverse(d.spec.priority), d.since));
    let (mut plan, given_up) = (Plan::default(), cluster.given_up());
    // Whose executor has no place yet, by its title.
    let mut idle: BTreeSet<String> = BTreeSet::new();
    // A pass mostly takes, so what had no place for a task has none for one that asks the same; when it gave, there is another.
    let mut hopeless = Hopeless::default();
    let mut accounts = cluster.accounts().clone();
    let mut turns = Turns::new(demands);
    while let Some(demand) = turns.next(cluster, &accounts) {
        if let Some(over) = over_quota(cluster, &accounts, demand) {
            cluster.unnominate(&demand.uid);
            plan.waits.push(Wait::new(demand, [quota_refusal(&over)].into()));
            continue;
        }
        // One for which room is kept has what others have not.
        let nominated = cluster.nomination(&demand.uid).is_some();
        if let Some(wait) = hopeless.known(demand).filter(|_| !nominated) {
            plan.waits.push(wait);
            continue;
        }
        let place = choose(cluster, demand);
        let claims = if place.is_none() { courtesy::claims(cluster, demand) } else { Vec::new() };
        // Nobody is ended for one that may have a place in a moment.
        if place.is_none() && claims.is_empty() && depth == Depth::Whole {
            if let Some((preemption, why)) = preempt::make_room(cluster, demand) {
                // It counts already: nobody is ended for room that the quota would not let it have.
                let resources = &demand.spec.resources;
                let leases = u64::from(!resources.actuators.is_empty());
                accounts.add(namespace_of(&demand.title), &resources.reserved(), leases);
                plan.waits.push(Wait::new(demand, [why].into()));
                plan.preemptions.push(preemption);
                continue;
            }
            cluster.unnominate(&demand.uid);
        }
        match place {
            Some(slot) => {
                let bind = take(cluster, demand, slot);
                let compute = demand.spec.resources.reserved();
                let (namespace, leases) = (namespace_of(&demand.title), bind.leases.len() as u64);
                accounts.add(namespace, &compute, leases);
                cluster.serve(namespace, &compute, leases);
                plan.again |= idle.contains(&*demand.title);
                plan.binds.push(bind);
            }
            None => {
                let why: Arc<[NodeRefusal]> = match depth {
                    Depth::Whole => summarise(explain(cluster, demand)).into(),
                    Depth::Places => [].into(),
                };
                let wait = Wait { brief: !claims.is_empty(), ..Wait::new(demand, why) };
                plan.claims.extend(claims);
                let executor = demand.spec.run.executor.as_ref();
                idle.extend(executor.map(|e| executor_title(&demand.title, &e.task)));
                hopeless.remember(demand, &wait);
                plan.waits.push(wait);
            }
        }
    }
    plan.again |= cluster.given_up() != given_up;
    plan
}

/// The title of the executor that a task of this title is work for.
fn executor_title(title: &str, executor: &str) -> String {
    format!("{}/{executor}", namespace_of(title))
}

/// Whose turn it is, of tasks that are sorted by priority and age.
#[derive(Debug)]
struct Turns<'a> {
    rest: &'a [Demand],
    /// Those of the present priority, by namespace.
    waiting: BTreeMap<&'a str, VecDeque<&'a Demand>>,
    /// Each namespace that waits: its share, since when its first task waits, its name.
    order: BTreeSet<(Share, u64, &'a str)>,
    /// Whose turn it was: its share may be another now.
    last: Option<&'a str>,
}

/// A share, which is never negative: its bits have its order.
type Share = u64;

impl<'a> Turns<'a> {
    fn new(sorted: &'a [Demand]) -> Self {
        Turns { rest: sorted, waiting: BTreeMap::new(), order: BTreeSet::new(), last: None }
    }

    fn next(&mut self, cluster: &Cluster, accounts: &Accounts) -> Option<&'a Demand> {
        if let Some(namespace) = self.last.take() {
            self.line_up(namespace, cluster, accounts);
        }
        if self.order.is_empty() {
            let priority = self.rest.first()?.spec.priority;
            let same = self.rest.partition_point(|demand| demand.spec.priority >= priority);
            let (same, rest) = self.rest.split_at(same);
            self.rest = rest;
            for demand in same {
                self.waiting.entry(namespace_of(&demand.title)).or_default().push_back(demand);
            }
            let namespaces: Vec<&str> = self.waiting.keys().copied().collect();
            namespaces.into_iter().for_each(|n| self.line_up(n, cluster, accounts));
        }
        let (_, _, namespace) = self.order.pop_first()?;
        self.last = Some(namespace);
        self.waiting.get_mut(namespace)?.pop_front()
    }

    fn line_up(&mut self, namespace: &'a str, cluster: &Cluster, accounts: &Accounts) {
        match self.waiting.get(namespace).and_then(VecDeque::front) {
            Some(first) => {
                let share = accounts.share(cluster, namespace);
                self.order.insert((share.to_bits(), first.since, namespace));
            }
            None => drop(self.waiting.remove(namespace)),
        }
    }
}

/// What of its namespace's quota a task would pass.
#[must_use]
pub fn over_quota(cluster: &Cluster, accounts: &Accounts, demand: &Demand) -> Option<OverQuota> {
    let resources = &demand.spec.resources;
    // A robot's groups are known when it is chosen; a task takes at least one.
    let leases = u64::from(!resources.actuators.is_empty());
    accounts.over_quota(cluster, namespace_of(&demand.title), &resources.reserved(), leases)
}

/// The quota as a reason in a task's status.
#[must_use]
pub fn quota_refusal(over: &OverQuota) -> NodeRefusal {
    NodeRefusal {
        node: String::new(),
        reason: "QuotaExceeded".to_owned(),
        message: over.to_string(),
    }
}

/// How many refused demands a pass remembers. Queues are mostly copies of a few templates; a longer
/// memory would cost more in comparing than it saves in scanning.
const HOPELESS_KEPT: usize = 8;

/// The last demands of a pass that were refused.
#[derive(Debug, Default)]
struct Hopeless<'a>(VecDeque<(&'a Demand, Wait)>);

impl<'a> Hopeless<'a> {
    fn remember(&mut self, demand: &'a Demand, wait: &Wait) {
        if self.0.len() == HOPELESS_KEPT {
            self.0.pop_front();
        }
        self.0.push_back((demand, wait.clone()));
    }

    /// What was said of one that asks the same. What one leaves, another of less may take.
    fn known(&self, demand: &Demand) -> Option<Wait> {
        let says = |(known, wait): &&(&Demand, Wait)| {
            let as_rich = || namespace_of(&known.title) == namespace_of(&demand.title);
            asks_the_same(known, demand) && (!wait.brief || as_rich())
        };
        let (_, wait) = self.0.iter().find(says)?;
        Some(Wait { uid: demand.uid.clone(), ..wait.clone() })
    }
}

fn asks_the_same(a: &Demand, b: &Demand) -> bool {
    let (one, other) = (&a.spec, &b.spec);
    one.resources == other.resources
        && one.preemption == other.preemption
        && one.placement == other.placement
        && one.run.container.is_some() == other.run.container.is_some()
        && a.avoid == b.avoid
        && one.run.executor.is_none()
        && other.run.executor.is_none()
        // Nobody ends those that it waits for.
        && one.depends_on == other.depends_on
        && (one.placement.apart.is_none() || namespace_of(&a.title) == namespace_of(&b.title))
}

pub(crate) fn take(cluster: &mut Cluster, demand: &Demand, slot: Slot) -> Bind {
    let member = cluster.at(slot);
    let facts = member.facts.as_ref().expect("a chosen node passed the filters, so it has facts");
    let (node, score) = (member.name.clone(), score::score(cluster.sites(), facts, &demand.spec));
    let reservation = demand.reservation(facts);
    let groups = reservation.groups.clone();
    cluster
        .reserve(&demand.uid, slot, reservation)
        .expect("the last filter asked the same ledger, and nothing came in between");
    let ledger = &cluster.at(slot).ledger;
    let leases = groups
        .into_iter()
        .map(|g| (ledger.group(&g).epoch, g))
        .map(|(epoch, g)| (g, epoch))
        .collect();
    Bind { uid: demand.uid.clone(), node, score, leases }
}

/// The best node that takes the task.
fn choose(cluster: &Cluster, demand: &Demand) -> Option<Slot> {
    let spec = &*demand.spec;
    if let Some(node) = &spec.placement.node {
        let slot = cluster.slot_of(node)?;
        return refusal(cluster, slot, demand).is_none().then_some(slot);
    }
    if let Some(slot) = preferred(cluster, demand) {
        return Some(slot);
    }
    let mut second_best = None;
    // A kind that the task does not allow is not scanned: thousands of nodes would say the same.
    if spec.resources.is_compute_only() && spec.allows_kind(NodeKind::Cloud) {
        // A CR-only task prefers the cloud: robots' CR is scarce, and it gains nothing there.
        let cloud = first_fit(cluster, demand, cluster.by_free(NodeKind::Cloud), &mut second_best);
        if cloud.is_some() {
            return cloud;
        }
    }
    if !spec.allows_kind(NodeKind::Robot) {
        return second_best.map(|(_, slot)| slot);
    }
    let robot = match (&spec.placement.at, spec.placement.cost) {
        (None, _) => first_fit(cluster, demand, cluster.by_free(NodeKind::Robot), &mut second_best),
        (Some(_), Cost::Distance) if spec.placement.battery_cost.is_none() => {
            nearest_fit(cluster, demand, &mut second_best)
        }
        (Some(_), Cost::Distance | Cost::TravelTime) => {
            best_scored(cluster, demand, &mut second_best)
        }
    };
    robot.or_else(|| second_best.map(|(_, slot)| slot))
}

/// The node that the task asks to be tried first, when it takes the task.
fn preferred(cluster: &Cluster, demand: &Demand) -> Option<Slot> {
    let slot = cluster.slot_of(demand.spec.placement.prefer.as_deref()?)?;
    let takes = refusal(cluster, slot, demand).is_none();
    (takes && !has_failed_on(cluster, demand, slot)).then_some(slot)
}

/// Why a node is left for later, the better first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Resort {
    /// A taint asks for it.
    Tainted,
    /// The task has failed there.
    Failed,
}

/// The best of the nodes that are left for later.
type SecondBest = Option<(Resort, Slot)>;

fn has_failed_on(cluster: &Cluster, demand: &Demand, slot: Slot) -> bool {
    demand.avoid.contains(&cluster.at(slot).name)
}

/// Why a node that takes the task is left for later; none: it is not.
fn resort(cluster: &Cluster, demand: &Demand, slot: Slot) -> Option<Resort> {
    if has_failed_on(cluster, demand, slot) {
        return Some(Resort::Failed);
    }
    let facts = cluster.at(slot).facts.as_ref()?;
    let tolerations = &demand.spec.placement.tolerations;
    let tainted = facts.taints.iter().any(|t| {
        t.effect == TaintEffect::PreferNoSchedule && !tolerations.iter().any(|o| o.tolerates(t))
    });
    tainted.then_some(Resort::Tainted)
}

/// Keeps a node for later, if it is better than what is kept.
fn keep(second_best: &mut SecondBest, resort: Resort, slot: Slot) {
    if second_best.is_none_or(|(kept, _)| resort < kept) {
        *second_best = Some((resort, slot));
    }
}

/// The first of `slots` that takes the task; one that should be left for last goes to `second_best`.
fn first_fit(
    cluster: &Cluster,
    demand: &Demand,
    slots: impl Iterator<Item = Slot>,
    second_best: &mut SecondBest,
) -> Option<Slot> {
    for slot in slots {
        if refusal(cluster, slot, demand).is_some() {
            continue;
        }
        match resort(cluster, demand, slot) {
            None => return Some(slot),
            Some(resort) => keep(second_best, resort, slot),
        }
    }
    None
}

/// Of two equally good robots: the fuller battery, then the most free cpu; less is better.
fn rank(cluster: &Cluster, slot: Slot) -> (u8, std::cmp::Reverse<u64>) {
    let member = cluster.at(slot);
    let lacks = member.facts.as_ref().map_or(100, NodeFacts::battery_lacks);
    (lacks, std::cmp::Reverse(member.ledger.free().cpu.0))
}

/// The nearest robot that takes the task; of equally near ones the better by [`rank`].
fn nearest_fit(cluster: &Cluster, demand: &Demand, second_best: &mut SecondBest) -> Option<Slot> {
    let at = demand.spec.placement.at.as_ref()?;
    let radius = demand.spec.placement.within.unwrap_or(f64::INFINITY);
    let mut best: Option<(f64, Slot)> = None;
    for found in cluster.space().nearest(&at.map, at.position(), radius) {
        if best.is_some_and(|(distance, _)| found.distance > distance) {
            break;
        }
        if refusal(cluster, found.slot, demand).is_some() {
            continue;
        }
        if let Some(resort) = resort(cluster, demand, found.slot) {
            keep(second_best, resort, found.slot);
            continue;
        }
        if best.is_none_or(|(_, slot)| rank(cluster, found.slot) < rank(cluster, slot)) {
            best = Some((found.distance, found.slot));
        }
    }
    best.map(|(_, slot)| slot)
}

/// The robot with the lowest score, where the order of scores is not that of distances.
fn best_scored(cluster: &Cluster, demand: &Demand, second_best: &mut SecondBest) -> Option<Slot> {
    let at = demand.spec.placement.at.as_ref()?;
    let radius = demand.spec.placement.within.unwrap_or(f64::INFINITY);
    let mut scored: Vec<_> = cluster
        .space()
        .nearest(&at.map, at.position(), radius)
        .filter(|found| refusal(cluster, found.slot, demand).is_none())
        .filter_map(|found| {
            let facts = cluster.at(found.slot).facts.as_ref()?;
            let score = score::score(cluster.sites(), facts, &demand.spec)?;
            Some((score, rank(cluster, found.slot), found.slot))
        })
        .collect();
    scored.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    first_fit(cluster, demand, scored.into_iter().map(|(_, _, slot)| slot), second_best)
}

/// Why each node does not take the task, those that only have to be waited for first.
#[must_use]
pub fn explain(cluster: &Cluster, demand: &Demand) -> Vec<(NodeName, Refusal)> {
    let mut refusals: Vec<(NodeName, Refusal)> = cluster
        .members()
        .filter_map(|(slot, member)| Some((member.name.clone(), refusal(cluster, slot, demand)?)))
        .collect();
    refusals
        .sort_by(|(a_name, a), (b_name, b)| hardness(a).cmp(&hardness(b)).then(a_name.cmp(b_name)));
    refusals
}

/// What ends by itself comes first, what the task's owner must change last.
fn hardness(refusal: &Refusal) -> u8 {
    match refusal {
        Refusal::LeaseHeld { .. }
        | Refusal::Exhausted { .. }
        | Refusal::Kept { .. }
        | Refusal::Left { .. }
        | Refusal::Apart { .. }
        | Refusal::NoExecutor { .. } => 0,
        Refusal::OutOfRange { .. }
        | Refusal::Unreachable { .. }
        | Refusal::NoPose
        | Refusal::NotLocalized => 1,
        Refusal::NotReady { .. }
        | Refusal::Cordoned
        | Refusal::Tainted { .. }
        | Refusal::OutOfService { .. }
        | Refusal::BatteryLow { .. } => 2,
        Refusal::TooSmall { .. } | Refusal::NoRuntime { .. } | Refusal::NoSpeed => 3,
        Refusal::NoSensor { .. } | Refusal::NoActuator { .. } | Refusal::OtherMap { .. } => 4,
        Refusal::SelectorMismatch { .. }
        | Refusal::WrongKind { .. }
        | Refusal::PinnedElsewhere { .. } => 5,
    }
}

/// The reasons as a status carries them: at most [`WHY_LIMIT`] nodes, the others counted by reason.
#[must_use]
pub fn summarise(refusals: Vec<(NodeName, Refusal)>) -> Vec<NodeRefusal> {
    if refusals.is_empty() {
        return vec![NodeRefusal {
            node: String::new(),
            reason: "NoNodes".to_owned(),
            message: "no node has joined; `muster token create` prints how one does".to_owned(),
        }];
    }
    let rest = refusals.split_at(WHY_LIMIT.min(refusals.len())).1;
    let mut counts: std::collections::BTreeMap<&'static str, usize> =
        std::collections::BTreeMap::new();
    for (_, refusal) in rest {
        *counts.entry(refusal.reason()).or_default() += 1;
    }
    let more = (!rest.is_empty()).then(|| NodeRefusal {
        node: String::new(),
        reason: "More".to_owned(),
        message: format!(
            "{} more nodes: {}",
            rest.len(),
            counts.iter().map(|(reason, n)| format!("{n} {reason}")).collect::<Vec<_>>().join(", ")
        ),
    });
    refusals
        .iter()
        .take(WHY_LIMIT)
        .map(|(node, refusal)| refusal.of_node(node.as_str()))
        .chain(more)
        .collect()
}

#[cfg(test)]
mod tests;
