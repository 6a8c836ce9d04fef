//! The cluster as the scheduler knows it: every node with its facts and its ledger, and the orders
//! in which nodes are tried.
//!
//! It is rebuilt from the store at start and fed with every change afterwards. Feeding the same
//! state twice changes nothing, so the scheduler's own writes may come back through the store.

mod facts;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use muster_api::id::{Epoch, TaskUid};
use muster_api::kind::node::{Node, NodeKind};
use muster_api::kind::quota::QuotaSpec;
use muster_api::kind::site::SiteSpec;
use muster_api::name::NodeName;
use muster_api::pose::Pose;
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::Compute;

use crate::fairness::{Accounts, Rank, Service};
use crate::ledger::{Denied, NodeLedger, Reservation, Standing};
use crate::site::Sites;
use crate::space::{Slot, Space};

pub use facts::NodeFacts;
use facts::{BATTERY_STEP, Models, is_move};

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
    sites: Sites,
    accounts: Accounts,
    service: Service,
    changed: BTreeSet<Slot>,
    moved: BTreeSet<Slot>,
    /// Nodes that have more than before, or take work again.
    freed: BTreeSet<Slot>,
    /// What declared tasks leave, and to whose frameworks.
    left: BTreeMap<Slot, BTreeSet<Arc<str>>>,
    /// Grows with everything that may give a waiting task another answer, but for live poses.
    edition: u64,
    /// How often room that was kept for a task was given up.
    given_up: u64,
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
        if member.facts.as_ref() != Some(&facts) {
            self.edition += 1;
        }
        self.accounts.discount_member(member);
        member.ledger.set_allocatable(allocatable);
        member.facts = Some(facts);
        self.accounts.count_member(member);
        if !same {
            member.facts_version += 1;
            self.freed.insert(slot);
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
            self.freed.insert(slot);
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
        self.accounts.discount_member(member);
        (member.facts, member.live_pose) = (None, false);
        self.touch(slot);
    }

    /// Books a task that the store says is placed.
    pub fn book(&mut self, uid: &TaskUid, node: &NodeName, reservation: Reservation) {
        let slot = self.slot(node);
        self.unnominate(uid);
        self.placed.insert(uid.clone(), slot);
        match self.members[slot as usize].ledger.reservation(uid) {
            None => {
                *self.priorities.entry(reservation.standing.priority).or_default() += 1;
                self.write(slot, Some(uid), |ledger| ledger.book(uid, reservation));
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
        self.edition += 1;
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
        self.given_up += 1;
        if self.members[slot as usize].ledger.unkeep(uid) {
            self.freed.insert(slot);
            self.touch(slot);
        }
    }

    /// Grows whenever room that was kept for a task is given up: others may have it.
    #[must_use]
    pub(crate) fn given_up(&self) -> u64 {
        self.given_up
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
        let is_new = self.members[slot as usize].ledger.reservation(uid).is_none();
        self.write(slot, Some(uid), |ledger| ledger.reserve(uid, reservation))?;
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
        let member = &self.members[slot as usize];
        if let Some(reservation) = member.ledger.reservation(uid) {
            uncount(&mut self.priorities, reservation.standing.priority);
        }
        self.write(slot, Some(uid), |ledger| ledger.undo(uid));
        self.members[slot as usize].version -= 1;
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
        let before = self.members[slot as usize].ledger.group(group);
        self.write(slot, None, |ledger| ledger.set_group(group, epoch, holder));
        let now = self.members[slot as usize].ledger.group(group);
        if now != before {
            if now.holder.is_none() {
                self.freed.insert(slot);
            }
            self.touch(slot);
        }
    }

    /// Frees what a task holds; gives the node it was on, if it held anything.
    pub fn release(&mut self, uid: &TaskUid) -> Option<NodeName> {
        self.free(uid, |ledger| {
            ledger.release(uid);
        })
    }

    /// The same for a [`Cluster::reserve`] whose bind failed to be written, as far as anybody knows. The disk may have it
    /// all the same, and the store say so later: the numbers of the grants are as before, so that its word counts then.
    pub fn withdraw(&mut self, uid: &TaskUid) -> Option<NodeName> {
        self.free(uid, |ledger| ledger.undo(uid))
    }

    fn free(&mut self, uid: &TaskUid, free: impl FnOnce(&mut NodeLedger)) -> Option<NodeName> {
        let slot = self.placed.remove(uid)?;
        if let Some(reservation) = self.members[slot as usize].ledger.reservation(uid) {
            uncount(&mut self.priorities, reservation.standing.priority);
        }
        self.write(slot, Some(uid), free);
        let member = &mut self.members[slot as usize];
        member.executors.retain(|executor| executor.uid != *uid);
        let name = member.name.clone();
        self.freed.insert(slot);
        self.touch(slot);
        Some(name)
    }

    /// Changes the books of a node, in what they say of `uid` and of leases, and the accounts with them.
    fn write<T>(
        &mut self,
        slot: Slot,
        uid: Option<&TaskUid>,
        change: impl FnOnce(&mut NodeLedger) -> T,
    ) -> T {
        let ledger = &mut self.members[slot as usize].ledger;
        self.accounts.discount(ledger, uid);
        let done = change(ledger);
        self.accounts.count(ledger, uid);
        done
    }

    /// What every namespace has.
    #[must_use]
    pub fn accounts(&self) -> &Accounts {
        &self.accounts
    }

    /// The weight of a namespace.
    #[must_use]
    pub fn weight(&self, namespace: &str) -> f64 {
        self.quota(namespace).map_or(1.0, |quota| quota.weight)
    }

    /// Whose turn it is: the namespace with the least share, and of equals the one that was served less.
    #[must_use]
    pub fn rank(&self, namespace: &str) -> Rank {
        self.service.rank(namespace, self.accounts.share(self, namespace))
    }

    /// A namespace was given a place by a decision of ours.
    pub(crate) fn serve(&mut self, namespace: &str, compute: &Compute, leases: u64) {
        let cost = self.accounts.part(compute, leases) / self.weight(namespace);
        self.service.serve(namespace, cost);
    }

    /// The node has changed in something that matters to offers.
    fn touch(&mut self, slot: Slot) {
        self.members[slot as usize].version += 1;
        self.edition += 1;
        self.changed.insert(slot);
        self.reorder(slot);
    }

    /// The same number as before: no waiting task has another answer than before, unless robots moved.
    #[must_use]
    pub fn edition(&self) -> u64 {
        self.edition
    }

    /// The nodes that have more than at the last call, or take work again.
    #[must_use = "they are told once"]
    pub fn take_freed(&mut self) -> BTreeSet<Slot> {
        std::mem::take(&mut self.freed)
    }

    /// Sets what declared tasks leave for now, and to frameworks of which namespaces.
    pub fn leave(&mut self, left: BTreeMap<Slot, BTreeSet<Arc<str>>>) {
        if self.left != left {
            self.left = left;
            self.edition += 1;
        }
    }

    /// The namespaces to whose frameworks a node is left, by those that have more.
    #[must_use]
    pub fn left_to(&self, slot: Slot) -> Option<&BTreeSet<Arc<str>>> {
        self.left.get(&slot)
    }

    /// The nodes that are left to somebody.
    pub fn left(&self) -> impl Iterator<Item = Slot> {
        self.left.keys().copied()
    }

    /// The nodes that changed since the last call, and those that only moved.
    #[must_use = "they are told once"]
    pub fn take_changes(&mut self) -> (BTreeSet<Slot>, BTreeSet<Slot>) {
        (std::mem::take(&mut self.changed), std::mem::take(&mut self.moved))
    }

    /// Sets or removes what a namespace may have.
    pub fn set_quota(&mut self, namespace: &str, quota: Option<QuotaSpec>) {
        self.edition += 1;
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

    /// Sets or removes what a Site says of its floor.
    pub fn set_site(&mut self, name: &str, site: Option<&SiteSpec>) {
        self.edition += 1;
        self.sites.set(name, site);
    }

    /// The floors of the maps that have a Site.
    #[must_use]
    pub fn sites(&self) -> &Sites {
        &self.sites
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
