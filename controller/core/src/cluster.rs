//! The cluster as the scheduler knows it: every node with its facts and its ledger, and the orders
//! in which nodes are tried.
//!
//! It is rebuilt from the store at start and fed with every change afterwards. Feeding the same
//! state twice changes nothing, so the scheduler's own writes may come back through the store.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use muster_api::id::{Epoch, TaskUid};
use muster_api::kind::lease::DEFAULT_GROUP;
use muster_api::kind::node::upkeep::passing_taints;
use muster_api::kind::node::{Node, NodeKind, NodeStatus, RuntimeStatus, Taint};
use muster_api::kind::quota::QuotaSpec;
use muster_api::name::{FunctionName, NodeName};
use muster_api::pose::Pose;
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::selector::Labels;

use crate::ledger::{Denied, NodeLedger, Reservation, Standing};
use crate::recent::Recent;
use crate::space::{Slot, Space};

/// What filters need to know of a node. What is mostly the same in a fleet is shared.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeFacts {
    /// Robot or cloud.
    pub kind: NodeKind,
    /// Its labels.
    pub labels: Labels,
    /// Cordoned.
    pub unschedulable: bool,
    /// Its taints.
    pub taints: Vec<Taint>,
    /// Metres per second.
    pub speed: Option<f64>,
    /// `None`: ready; otherwise what the Ready condition says.
    pub not_ready: Option<String>,
    /// SR.
    pub sensors: Arc<BTreeSet<FunctionName>>,
    /// AR.
    pub actuators: Arc<BTreeSet<FunctionName>>,
    /// Where it is.
    pub pose: Option<Pose>,
    /// How tasks can be run.
    pub runtimes: Arc<Vec<RuntimeStatus>>,
    /// Taints that its conditions put on it for now.
    pub passing: Vec<Taint>,
    /// Percent of a full battery; none: it has none, or does not tell.
    pub battery: Option<u8>,
}

impl NodeFacts {
    /// The facts of one node, by itself.
    #[must_use]
    pub fn of(node: &Node) -> Self {
        Models::default().facts(node)
    }

    /// The conflict groups that a task with these actuators takes: all of the robot's when it takes
    /// any (Avalon, III-B), none when it takes none.
    #[must_use]
    pub fn groups_for(&self, actuators: &[FunctionName]) -> Vec<String> {
        if actuators.is_empty() { Vec::new() } else { vec![DEFAULT_GROUP.to_owned()] }
    }

    /// Every conflict group of the robot; none when it has no actuators.
    #[must_use]
    pub fn groups(&self) -> Vec<String> {
        if self.actuators.is_empty() { Vec::new() } else { vec![DEFAULT_GROUP.to_owned()] }
    }

    /// What its battery lacks of a full one, percent; nothing without a battery.
    #[must_use]
    pub fn battery_lacks(&self) -> u8 {
        100_u8.saturating_sub(self.battery.unwrap_or(100))
    }

    fn same_but_for_pose(&self, other: &NodeFacts) -> bool {
        self.kind == other.kind
            && self.labels == other.labels
            && self.unschedulable == other.unschedulable
            && self.taints == other.taints
            && self.speed == other.speed
            && self.not_ready == other.not_ready
            && self.sensors == other.sensors
            && self.actuators == other.actuators
            && is_move(self.pose.as_ref(), other.pose.as_ref())
            && self.runtimes == other.runtimes
            && self.passing == other.passing
            && self.battery_lacks() / BATTERY_STEP == other.battery_lacks() / BATTERY_STEP
    }
}

/// From one to the other the robot only moves. Localized or not decides who is offered the robot, so it is more than
/// that.
fn is_move(from: Option<&Pose>, to: Option<&Pose>) -> bool {
    match (from, to) {
        (Some(from), Some(to)) => from.map == to.map && from.localized == to.localized,
        (from, to) => from.is_none() && to.is_none(),
    }
}

/// What robots of one model have in common.
#[derive(Debug, Clone, Default)]
struct Models {
    functions: Recent<BTreeSet<FunctionName>>,
    runtimes: Recent<Vec<RuntimeStatus>>,
}

impl Models {
    fn facts(&mut self, node: &Node) -> NodeFacts {
        let nothing = NodeStatus::default();
        let status = node.status.as_ref().unwrap_or(&nothing);
        let not_ready = (!status.is_ready()).then(|| {
            let said = status.condition(muster_api::condition::READY);
            said.map_or_else(|| "its agent has not joined".to_owned(), |c| c.message.clone())
        });
        NodeFacts {
            kind: node.spec.kind,
            labels: node.metadata.labels.clone().unwrap_or_default(),
            unschedulable: node.spec.unschedulable,
            taints: node.spec.taints.clone(),
            speed: node.spec.speed,
            not_ready,
            sensors: self.functions.share(status.sensors.iter().cloned().collect()),
            actuators: self.functions.share(status.actuators.iter().cloned().collect()),
            pose: status.pose.clone(),
            runtimes: self.runtimes.share(status.runtimes.clone()),
            passing: passing_taints(status),
            battery: status.battery.map(|battery| battery.percent),
        }
    }
}

/// A task that runs others for its framework: it has registered with the agent of its node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Executor {
    /// The task.
    pub uid: TaskUid,
    /// Its name.
    pub name: Box<str>,
    /// Uid of the framework.
    pub framework: Arc<str>,
}

/// One node: what it is, and what of it is taken.
#[derive(Debug, Clone)]
pub struct Member {
    /// The node's name.
    pub name: NodeName,
    /// `None`: no Node object, but a task says that it is placed there.
    pub facts: Option<NodeFacts>,
    /// Its books.
    pub ledger: NodeLedger,
    /// Executors that live there, as its agent last said.
    pub executors: Vec<Executor>,
    /// Grows with every change of facts, books or executors; a robot that only moves keeps it.
    pub version: u64,
    /// Grows with every change of facts alone.
    pub facts_version: u64,
    /// Its pose came by [`Cluster::set_pose`]; what the Node object says of it is older from then on.
    live_pose: bool,
    in_order: Option<FreeKey>,
}

/// Kind, then the fuller battery in steps of [`BATTERY_STEP`], then most free cpu, then most free memory, then the order
/// of joining.
type FreeKey = (NodeKind, u8, Reverse<MilliCpu>, Reverse<Bytes>, Slot);

/// Batteries that differ by less are equally full, percent.
const BATTERY_STEP: u8 = 20;

/// Every node, found by name, by place and by what is free.
#[derive(Debug, Clone, Default)]
pub struct Cluster {
    members: Vec<Member>,
    slots: HashMap<NodeName, Slot>,
    placed: HashMap<TaskUid, Slot>,
    /// Tasks for which room is made.
    nominated: HashMap<TaskUid, Slot>,
    /// How many tasks of each priority hold something.
    priorities: BTreeMap<i32, usize>,
    space: Space,
    by_free: BTreeSet<FreeKey>,
    quotas: BTreeMap<Arc<str>, QuotaSpec>,
    changed: BTreeSet<Slot>,
    moved: BTreeSet<Slot>,
    models: Models,
}

impl Cluster {
    /// No nodes yet.
    #[must_use]
    pub fn new() -> Self {
        Cluster::default()
    }

    fn slot(&mut self, name: &NodeName) -> Slot {
        if let Some(slot) = self.slots.get(name) {
            return *slot;
        }
        let slot = Slot::try_from(self.members.len()).expect("fewer than 2^32 nodes");
        self.members.push(Member {
            name: name.clone(),
            facts: None,
            ledger: NodeLedger::default(),
            executors: Vec::new(),
            version: 0,
            facts_version: 0,
            live_pose: false,
            in_order: None,
        });
        self.slots.insert(name.clone(), slot);
        slot
    }

    /// Takes in the present state of a Node object.
    pub fn upsert_node(&mut self, name: &NodeName, node: &Node) {
        let slot = self.slot(name);
        let mut facts = self.models.facts(node);
        let member = &mut self.members[slot as usize];
        if let Some(known) = member.facts.as_ref().filter(|_| member.live_pose) {
            facts.pose.clone_from(&known.pose);
        }
        let allocatable = node.status.as_ref().map(|s| s.allocatable.clone()).unwrap_or_default();
        self.index_pose(slot, facts.kind, facts.pose.as_ref());
        let member = &mut self.members[slot as usize];
        // Our own writes of used and free come back as changes of the object that change nothing here.
        let same = member.ledger.allocatable() == &allocatable
            && member.facts.as_ref().is_some_and(|f| f.same_but_for_pose(&facts));
        if member.facts.as_ref().is_none_or(|f| f.pose != facts.pose) {
            self.moved.insert(slot);
        }
        member.ledger.set_allocatable(allocatable);
        member.facts = Some(facts);
        if !same {
            member.facts_version += 1;
            self.touch(slot);
        }
    }

    /// A robot moved; poses come more often than Node objects change, and are newer. A node that is not there is passed
    /// over.
    pub fn set_pose(&mut self, name: &NodeName, pose: &Pose) {
        let Some(&slot) = self.slots.get(name) else { return };
        let member = &mut self.members[slot as usize];
        let Some(facts) = member.facts.as_mut() else { return };
        member.live_pose = true;
        let moves = is_move(facts.pose.as_ref(), Some(pose));
        match &mut facts.pose {
            Some(old) => old.set(pose.view()),
            None => facts.pose = Some(pose.clone()),
        }
        let kind = facts.kind;
        self.moved.insert(slot);
        self.index_pose(slot, kind, Some(pose));
        if !moves {
            self.members[slot as usize].facts_version += 1;
            self.touch(slot);
        }
    }

    /// Takes in which executors live on a node.
    pub fn set_executors(&mut self, name: &NodeName, executors: Vec<Executor>) {
        let slot = self.slot(name);
        let member = &mut self.members[slot as usize];
        if member.executors != executors {
            member.executors = executors;
            self.touch(slot);
        }
    }

    fn index_pose(&mut self, slot: Slot, kind: NodeKind, pose: Option<&Pose>) {
        match pose.filter(|p| kind == NodeKind::Robot && p.localized) {
            Some(pose) => self.space.insert(slot, &pose.map, pose.position()),
            None => self.space.remove(slot),
        }
    }

    /// The Node object is gone. What tasks hold there stays booked until they end.
    pub fn remove_node(&mut self, name: &NodeName) {
        let Some(&slot) = self.slots.get(name) else { return };
        self.space.remove(slot);
        let member = &mut self.members[slot as usize];
        (member.facts, member.live_pose) = (None, false);
        self.touch(slot);
    }

    /// Books a task that the store says is placed.
    pub fn book(&mut self, uid: &TaskUid, node: &NodeName, reservation: Reservation) {
        let slot = self.slot(node);
        self.unnominate(uid);
        self.placed.insert(uid.clone(), slot);
        let ledger = &mut self.members[slot as usize].ledger;
        match ledger.reservation(uid) {
            None => {
                *self.priorities.entry(reservation.standing.priority).or_default() += 1;
                ledger.book(uid, reservation);
                self.touch(slot);
            }
            Some(present) if present.standing != reservation.standing => {
                self.set_standing(uid, reservation.standing);
            }
            Some(_) => {}
        }
    }

    /// A task that holds something stands otherwise than before.
    pub(crate) fn set_standing(&mut self, uid: &TaskUid, standing: Standing) {
        let Some(&slot) = self.placed.get(uid) else { return };
        let ledger = &mut self.members[slot as usize].ledger;
        let Some(present) = ledger.reservation(uid) else { return };
        let before = present.standing.priority;
        uncount(&mut self.priorities, before);
        *self.priorities.entry(standing.priority).or_default() += 1;
        ledger.set_standing(uid, standing);
    }

    /// A task that holds something is being ended, or is not after all.
    pub fn set_stopping(&mut self, uid: &TaskUid, stopping: bool) {
        let reservation = self.node_of(uid).and_then(|m| m.ledger.reservation(uid));
        if let Some(standing) = reservation.map(|r| r.standing.clone()) {
            self.set_standing(uid, Standing { stopping, ..standing });
        }
    }

    /// The least priority of all tasks that hold something.
    #[must_use]
    pub(crate) fn least_priority(&self) -> Option<i32> {
        self.priorities.first_key_value().map(|(priority, _)| *priority)
    }

    /// Keeps room on a node for a task, while others are ended to make it.
    pub fn nominate(&mut self, uid: &TaskUid, node: &NodeName, reservation: &Reservation) {
        self.unnominate(uid);
        let slot = self.slot(node);
        self.members[slot as usize].ledger.keep(uid, reservation);
        self.nominated.insert(uid.clone(), slot);
        self.touch(slot);
    }

    /// No room is kept for the task any more.
    pub fn unnominate(&mut self, uid: &TaskUid) {
        let Some(slot) = self.nominated.remove(uid) else { return };
        if self.members[slot as usize].ledger.unkeep(uid) {
            self.touch(slot);
        }
    }

    /// The node on which room is kept for a task.
    #[must_use]
    pub fn nomination(&self, uid: &TaskUid) -> Option<Slot> {
        self.nominated.get(uid).copied()
    }

    /// Reserves for a task by a decision of ours.
    ///
    /// # Errors
    ///
    /// What stands against it.
    pub fn reserve(
        &mut self,
        uid: &TaskUid,
        slot: Slot,
        reservation: Reservation,
    ) -> Result<(), Denied> {
        let priority = reservation.standing.priority;
        let ledger = &mut self.members[slot as usize].ledger;
        let is_new = ledger.reservation(uid).is_none();
        ledger.reserve(uid, reservation)?;
        if is_new {
            *self.priorities.entry(priority).or_default() += 1;
        }
        self.unnominate(uid);
        self.placed.insert(uid.clone(), slot);
        self.touch(slot);
        Ok(())
    }

    /// Takes back a [`Cluster::reserve`] that nobody was told of; the node is as it was before, its version too.
    pub fn undo(&mut self, uid: &TaskUid) {
        let Some(slot) = self.placed.remove(uid) else { return };
        let member = &mut self.members[slot as usize];
        if let Some(reservation) = member.ledger.reservation(uid) {
            uncount(&mut self.priorities, reservation.standing.priority);
        }
        member.ledger.undo(uid);
        member.version -= 1;
        self.reorder(slot);
    }

    /// Takes in the present state of a Lease object.
    pub fn set_lease(
        &mut self,
        node: &NodeName,
        group: &str,
        epoch: Epoch,
        holder: Option<TaskUid>,
    ) {
        let slot = self.slot(node);
        let ledger = &mut self.members[slot as usize].ledger;
        let before = ledger.group(group);
        ledger.set_group(group, epoch, holder);
        if ledger.group(group) != before {
            self.touch(slot);
        }
    }

    /// Frees what a task holds; gives the node it was on, if it held anything.
    pub fn release(&mut self, uid: &TaskUid) -> Option<NodeName> {
        let slot = self.placed.remove(uid)?;
        let member = &mut self.members[slot as usize];
        if let Some(reservation) = member.ledger.reservation(uid) {
            uncount(&mut self.priorities, reservation.standing.priority);
        }
        member.ledger.release(uid);
        member.executors.retain(|executor| executor.uid != *uid);
        let name = member.name.clone();
        self.touch(slot);
        Some(name)
    }

    /// The node has changed in something that matters to offers.
    fn touch(&mut self, slot: Slot) {
        self.members[slot as usize].version += 1;
        self.changed.insert(slot);
        self.reorder(slot);
    }

    /// The nodes that changed since the last call, and those that only moved.
    #[must_use = "they are told once"]
    pub fn take_changes(&mut self) -> (BTreeSet<Slot>, BTreeSet<Slot>) {
        (std::mem::take(&mut self.changed), std::mem::take(&mut self.moved))
    }

    /// Sets or removes what a namespace may have.
    pub fn set_quota(&mut self, namespace: &str, quota: Option<QuotaSpec>) {
        match quota {
            Some(quota) => drop(self.quotas.insert(namespace.into(), quota)),
            None => drop(self.quotas.remove(namespace)),
        }
    }

    /// What a namespace may have; none: as much as there is, with weight 1.
    #[must_use]
    pub fn quota(&self, namespace: &str) -> Option<&QuotaSpec> {
        self.quotas.get(namespace)
    }

    /// Every quota, by namespace.
    pub fn quotas(&self) -> impl Iterator<Item = (&Arc<str>, &QuotaSpec)> {
        self.quotas.iter()
    }

    /// Whether any namespace has a quota.
    #[must_use]
    pub fn has_quotas(&self) -> bool {
        !self.quotas.is_empty()
    }

    fn reorder(&mut self, slot: Slot) {
        let member = &mut self.members[slot as usize];
        let free = member.ledger.free();
        let key = member.facts.as_ref().map(|facts| {
            let lacks = facts.battery_lacks() / BATTERY_STEP;
            (facts.kind, lacks, Reverse(free.cpu), Reverse(free.memory), slot)
        });
        if key == member.in_order {
            return;
        }
        if let Some(old) = member.in_order.take() {
            self.by_free.remove(&old);
        }
        if let Some(key) = key {
            member.in_order = Some(key);
            self.by_free.insert(key);
        }
    }

    /// A node by name.
    #[must_use]
    pub fn member(&self, name: &NodeName) -> Option<&Member> {
        self.slots.get(name).map(|slot| &self.members[*slot as usize])
    }

    /// A node by its number.
    #[must_use]
    pub fn at(&self, slot: Slot) -> &Member {
        &self.members[slot as usize]
    }

    /// The number of a node.
    #[must_use]
    pub fn slot_of(&self, name: &str) -> Option<Slot> {
        self.slots.get(name).copied()
    }

    /// The node a task is placed on.
    #[must_use]
    pub fn node_of(&self, uid: &TaskUid) -> Option<&Member> {
        self.placed.get(uid).map(|slot| &self.members[*slot as usize])
    }

    /// Every node that has a Node object.
    pub fn members(&self) -> impl Iterator<Item = (Slot, &Member)> {
        (0_u32..).zip(&self.members).filter(|(_, m)| m.facts.is_some())
    }

    /// Every node, those included whose Node object is gone while tasks hold something there.
    pub fn all(&self) -> impl Iterator<Item = &Member> {
        self.members.iter()
    }

    /// Nodes of one kind, the fullest batteries first, of those the most free CR.
    pub fn by_free(&self, kind: NodeKind) -> impl Iterator<Item = Slot> {
        let first = (kind, 0, Reverse(MilliCpu(u64::MAX)), Reverse(Bytes(u64::MAX)), 0);
        self.by_free.range(first..).take_while(move |key| key.0 == kind).map(|key| key.4)
    }

    /// Where the robots are.
    #[must_use]
    pub fn space(&self) -> &Space {
        &self.space
    }
}

fn uncount(priorities: &mut BTreeMap<i32, usize>, priority: i32) {
    if let Some(count) = priorities.get_mut(&priority) {
        *count -= 1;
        if *count == 0 {
            priorities.remove(&priority);
        }
    }
}
