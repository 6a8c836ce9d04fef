//! The ledger of one node: what is reserved of its CR, and who holds its AR.
//!
//! Invariant 2 lives here: a reservation that does not fit is refused, so the sum of reservations
//! never passes what is allocatable *by a decision of ours*. An agent that comes back with less than
//! before may leave the node overdrawn; then nothing is left and nothing new fits, but what runs is
//! not taken away.
//!
//! Invariant 1's reservation half lives here too: a group has at most one holder, and only
//! [`NodeLedger::release`] of that holder frees it.

use std::collections::BTreeMap;
use std::sync::Arc;

use muster_api::id::{Epoch, TaskUid};
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::{Compute, Shortage};

/// What one task holds of a node.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Reservation {
    /// `namespace/name`, for messages.
    pub title: Arc<str>,
    /// CR.
    pub compute: Compute,
    /// Conflict groups of actuators.
    pub groups: Vec<String>,
    /// How it stands against tasks that find no room.
    pub standing: Standing,
    /// Tasks of the namespace with the same word are not on the same node.
    pub apart: Option<Arc<str>>,
    /// Uid of the framework that launched it; none: a declared task.
    pub framework: Option<Arc<str>>,
}

/// What preemption asks of who holds something.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Standing {
    /// Tasks of more priority may take its place.
    pub priority: i32,
    /// It is being ended already.
    pub stopping: bool,
    /// Of work for an executor: the executor's `namespace/name`. The work ends with it.
    pub executor: Option<Arc<str>>,
}

/// A conflict group of a robot's actuators.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Group {
    /// Number of the newest grant.
    pub epoch: Epoch,
    /// Who holds it.
    pub holder: Option<TaskUid>,
}

/// Why a reservation is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Denied {
    /// Not enough CR is left.
    Short(Shortage),
    /// The group has a holder.
    Held {
        /// The group.
        group: String,
        /// Who holds it.
        holder: TaskUid,
    },
    /// It would fit, but for what is kept for a task of as much priority or more.
    Kept {
        /// For whom, `namespace/name`.
        title: Arc<str>,
    },
}

/// The books of one node.
#[derive(Debug, Clone, Default)]
pub struct NodeLedger {
    allocatable: Compute,
    used: Compute,
    reservations: BTreeMap<TaskUid, Reservation>,
    /// The order in which reservations came: the youngest is the last.
    came: BTreeMap<TaskUid, u64>,
    next: u64,
    groups: BTreeMap<String, Group>,
    /// What is kept for tasks while others are ended to make room for them.
    kept: BTreeMap<TaskUid, Reservation>,
}

impl NodeLedger {
    /// Sets what the node has; reservations stay.
    pub fn set_allocatable(&mut self, allocatable: Compute) {
        self.allocatable = allocatable;
    }

    /// What tasks may reserve in all.
    #[must_use]
    pub fn allocatable(&self) -> &Compute {
        &self.allocatable
    }

    /// What tasks have reserved.
    #[must_use]
    pub fn used(&self) -> &Compute {
        &self.used
    }

    /// What is left; zero where the node is overdrawn.
    #[must_use]
    pub fn free(&self) -> Compute {
        let mut free = self.allocatable.clone();
        free.saturating_sub(&self.used);
        free
    }

    /// The cpu and memory of [`NodeLedger::open`].
    #[must_use]
    pub fn open_cpu_memory(&self) -> (MilliCpu, Bytes) {
        let (all, used) = (&self.allocatable, &self.used);
        let mut open = (all.cpu.saturating_sub(used.cpu), all.memory.saturating_sub(used.memory));
        for kept in self.kept.values() {
            open.0 = open.0.saturating_sub(kept.compute.cpu);
            open.1 = open.1.saturating_sub(kept.compute.memory);
        }
        open
    }

    /// Whether any conflict group has a holder.
    #[must_use]
    pub fn is_any_group_held(&self) -> bool {
        self.groups.values().any(|g| g.holder.is_some())
    }

    /// The reservation of a task.
    #[must_use]
    pub fn reservation(&self, uid: &TaskUid) -> Option<&Reservation> {
        self.reservations.get(uid)
    }

    /// Every reservation.
    pub fn reservations(&self) -> impl Iterator<Item = (&TaskUid, &Reservation)> {
        self.reservations.iter()
    }

    /// Number of a reservation in the order in which they came here.
    #[must_use]
    pub fn came(&self, uid: &TaskUid) -> u64 {
        self.came.get(uid).copied().unwrap_or(0)
    }

    /// How a reservation stands now.
    pub fn set_standing(&mut self, uid: &TaskUid, standing: Standing) {
        if let Some(reservation) = self.reservations.get_mut(uid) {
            reservation.standing = standing;
        }
    }

    /// Keeps room for `uid` from tasks of no more priority.
    pub(crate) fn keep(&mut self, uid: &TaskUid, reservation: &Reservation) {
        self.kept.insert(uid.clone(), reservation.clone());
    }

    /// Whether exactly this is kept for `uid`.
    pub(crate) fn keeps(&self, uid: &TaskUid, reservation: &Reservation) -> bool {
        self.kept.get(uid) == Some(reservation)
    }

    /// What is left and kept for nobody: what can be offered.
    #[must_use]
    pub fn open(&self) -> Compute {
        let mut open = self.free();
        for kept in self.kept.values() {
            open.saturating_sub(&kept.compute);
        }
        open
    }

    /// Whether any conflict group has a holder, or is kept for somebody.
    #[must_use]
    pub fn is_any_group_taken(&self) -> bool {
        self.is_any_group_held() || self.kept.values().any(|k| !k.groups.is_empty())
    }

    /// Nothing is kept for `uid` any more. Says whether there was anything.
    pub(crate) fn unkeep(&mut self, uid: &TaskUid) -> bool {
        self.kept.remove(uid).is_some()
    }

    /// What is kept for others from a task of this priority.
    fn kept_for_others(&self, uid: &TaskUid, priority: i32) -> impl Iterator<Item = &Reservation> {
        let others = self
            .kept
            .iter()
            .filter(move |(other, kept)| *other != uid && kept.standing.priority >= priority);
        others.map(|(_, kept)| kept)
    }

    /// The sum of what is kept for others from a task of this priority.
    pub(crate) fn kept_from(&self, uid: &TaskUid, priority: i32) -> Compute {
        let mut sum = Compute::default();
        self.kept_for_others(uid, priority).for_each(|kept| sum.add(&kept.compute));
        sum
    }

    /// For whom a group is kept from a task of this priority.
    pub(crate) fn group_kept_from(
        &self,
        uid: &TaskUid,
        priority: i32,
        groups: &[String],
    ) -> Option<Arc<str>> {
        let wants = |kept: &&Reservation| kept.groups.iter().any(|g| groups.contains(g));
        self.kept_for_others(uid, priority).find(wants).map(|kept| Arc::clone(&kept.title))
    }

    /// Whether a reservation would be granted to this task, which may be one that room is kept from.
    ///
    /// # Errors
    ///
    /// What stands against it.
    pub fn check_for(
        &self,
        (uid, priority): (&TaskUid, i32),
        compute: &Compute,
        groups: &[String],
    ) -> Result<(), Denied> {
        self.check(compute, groups)?;
        if self.kept.is_empty() {
            return Ok(());
        }
        if let Some(title) = self.group_kept_from(uid, priority, groups) {
            return Err(Denied::Kept { title });
        }
        let mut free = self.free();
        free.saturating_sub(&self.kept_from(uid, priority));
        match (free.shortage_for(compute), self.kept_for_others(uid, priority).next()) {
            (Some(_), Some(kept)) => Err(Denied::Kept { title: Arc::clone(&kept.title) }),
            _ => Ok(()),
        }
    }

    /// The state of a conflict group; never granted: epoch 0.
    #[must_use]
    pub fn group(&self, name: &str) -> Group {
        self.groups.get(name).cloned().unwrap_or_default()
    }

    /// The conflict groups that were ever granted.
    pub fn groups(&self) -> impl Iterator<Item = (&str, &Group)> {
        self.groups.iter().map(|(name, group)| (name.as_str(), group))
    }

    /// Whether a new reservation would be granted.
    ///
    /// # Errors
    ///
    /// What stands against it.
    pub fn check(&self, compute: &Compute, groups: &[String]) -> Result<(), Denied> {
        for name in groups {
            if let Some(holder) = self.groups.get(name).and_then(|g| g.holder.clone()) {
                return Err(Denied::Held { group: name.clone(), holder });
            }
        }
        match self.free().shortage_for(compute) {
            Some(shortage) => Err(Denied::Short(shortage)),
            None => Ok(()),
        }
    }

    /// Reserves for `uid`, and grants it the groups with new epochs.
    ///
    /// # Errors
    ///
    /// What stands against it; nothing is changed then.
    pub fn reserve(&mut self, uid: &TaskUid, reservation: Reservation) -> Result<(), Denied> {
        if self.reservations.contains_key(uid) {
            return Ok(());
        }
        self.check(&reservation.compute, &reservation.groups)?;
        for name in &reservation.groups {
            let group = self.groups.entry(name.clone()).or_default();
            group.epoch = group.epoch.next();
            group.holder = Some(uid.clone());
        }
        self.book(uid, reservation);
        Ok(())
    }

    /// Books what is already so: a task that the store says is placed here, whatever is left. The
    /// groups' epochs and holders come from [`NodeLedger::set_group`].
    pub fn book(&mut self, uid: &TaskUid, reservation: Reservation) {
        if self.reservations.contains_key(uid) {
            return;
        }
        self.used.add(&reservation.compute);
        self.reservations.insert(uid.clone(), reservation);
        self.came.insert(uid.clone(), self.next);
        self.next += 1;
        self.kept.remove(uid);
    }

    /// Sets what the store says of a group. An epoch never goes back.
    pub fn set_group(&mut self, name: &str, epoch: Epoch, holder: Option<TaskUid>) {
        let group = self.groups.entry(name.to_owned()).or_default();
        if epoch >= group.epoch {
            *group = Group { epoch, holder };
        }
    }

    /// Takes a reservation back that nobody was told of: the epochs of its grants were never used.
    pub fn undo(&mut self, uid: &TaskUid) {
        for group in self.groups.values_mut().filter(|g| g.holder.as_ref() == Some(uid)) {
            group.epoch = Epoch(group.epoch.0.saturating_sub(1));
        }
        self.release(uid);
    }

    /// Frees what a task holds; groups it holds have no holder afterwards, their epochs stay.
    /// Says whether there was anything.
    pub fn release(&mut self, uid: &TaskUid) -> bool {
        for group in self.groups.values_mut().filter(|g| g.holder.as_ref() == Some(uid)) {
            group.holder = None;
        }
        self.came.remove(uid);
        let Some(reservation) = self.reservations.remove(uid) else {
            return false;
        };
        self.used.saturating_sub(&reservation.compute);
        true
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn reservation(cpu: u64, groups: &[&str]) -> Reservation {
        Reservation {
            title: "default/t".into(),
            compute: Compute::new(MilliCpu(cpu), Bytes(0)),
            groups: groups.iter().map(|g| (*g).to_owned()).collect(),
            ..Reservation::default()
        }
    }

    fn ledger(cpu: u64) -> NodeLedger {
        let mut ledger = NodeLedger::default();
        ledger.set_allocatable(Compute::new(MilliCpu(cpu), Bytes(0)));
        ledger
    }

    #[test]
    fn a_group_has_one_holder_and_its_epoch_only_grows() {
        let (a, b) = (TaskUid::new("a"), TaskUid::new("b"));
        let mut ledger = ledger(1000);
        ledger.reserve(&a, reservation(100, &["body"])).expect("free");
        assert_eq!(
            ledger.reserve(&b, reservation(100, &["body"])),
            Err(Denied::Held { group: "body".to_owned(), holder: a.clone() })
        );
        assert_eq!(ledger.used().cpu, MilliCpu(100), "a refused reservation changes nothing");
        assert!(ledger.release(&a));
        ledger.reserve(&b, reservation(100, &["body"])).expect("free again");
        assert_eq!(ledger.group("body"), Group { epoch: Epoch(2), holder: Some(b.clone()) });
        ledger.set_group("body", Epoch(1), None);
        assert_eq!(ledger.group("body").holder, Some(b), "an old state of the store is ignored");
    }

    proptest! {
        /// Whatever is reserved and released in whatever order, the sum of what was granted never
        /// passes what there is, and no group has two holders.
        #[test]
        fn invariant_no_oversubscription_and_one_holder(
            steps in proptest::collection::vec((0..12_u8, any::<bool>(), 0..700_u64, any::<bool>()), 0..80)
        ) {
            let mut ledger = ledger(1000);
            for (id, take, cpu, drive) in steps {
                let uid = TaskUid::new(format!("t{id}"));
                if take {
                    let groups: &[&str] = if drive { &["body"] } else { &[] };
                    let _ = ledger.reserve(&uid, reservation(cpu, groups));
                } else {
                    ledger.release(&uid);
                }
                let sum: MilliCpu = ledger.reservations().map(|(_, r)| r.compute.cpu).sum();
                prop_assert_eq!(sum, ledger.used().cpu);
                prop_assert!(sum <= MilliCpu(1000));
                let holders: Vec<_> =
                    ledger.reservations().filter(|(_, r)| !r.groups.is_empty()).map(|(uid, _)| uid.clone()).collect();
                prop_assert!(holders.len() <= 1);
                prop_assert_eq!(holders.first().cloned(), ledger.group("body").holder);
            }
        }
    }
}
