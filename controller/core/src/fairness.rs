//! Who has how much: namespaces' shares of the pool and their quotas.
//!
//! Weighted dominant-resource fairness (Ghodsi et al., NSDI 2011): a namespace's share is the largest, over cpu,
//! memory, counted extras and robots' leases, of what its tasks have divided by what there is, divided by its weight.
//! AR counts as a resource like the others: who drives every robot has a share of 1, however little it computes.
//!
//! Shares have no memory. Of two namespaces that have the same, as when the one robot that both want comes free, the one
//! goes first that was served less for its weight (`Service`): else one of them would have it every time.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::sync::Arc;

use muster_api::id::TaskUid;
use muster_api::kind::quota::{Limits, QuotaSpec, QuotaStatus, Used};
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::{Compute, Shortage};

use crate::cluster::{Cluster, Member};
use crate::ledger::{NodeLedger, Reservation};

/// What one namespace has.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Account {
    /// Reserved CR.
    pub compute: Compute,
    /// Held leases.
    pub leases: u64,
    /// Tasks that have reserved something, be it nothing but a place.
    pub tasks: u64,
}

/// What every namespace has, and what there is; a [`Cluster`] keeps its own true with every change of its books.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Accounts {
    by_namespace: BTreeMap<Arc<str>, Account>,
    total: Account,
}

/// Whose turn it is: the least is the first.
#[derive(Debug, Clone, Copy)]
pub struct Rank {
    /// Weighted dominant share.
    share: f64,
    /// When its next service would start, of those that have the same.
    start: f64,
}

impl PartialEq for Rank {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Rank {}

impl PartialOrd for Rank {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Rank {
    fn cmp(&self, other: &Self) -> Ordering {
        self.share.total_cmp(&other.share).then(self.start.total_cmp(&other.start))
    }
}

/// What each namespace was given lately, for its weight: start-time fair queueing (Goyal et al., SIGCOMM 1996). A service costs
/// the part of the pool that it is by the namespace's weight; who wanted nothing for a while has saved nothing up.
#[derive(Debug, Clone, Default)]
pub(crate) struct Service {
    /// When the last service started, in costs.
    clock: f64,
    /// When each namespace's last service ends, where that is later.
    ends: BTreeMap<Arc<str>, f64>,
}

/// Above this many namespaces those whose services are over are forgotten.
const SERVED_KEPT: usize = 256;

impl Service {
    fn start(&self, namespace: &str) -> f64 {
        self.ends.get(namespace).copied().unwrap_or_default().max(self.clock)
    }

    /// A namespace was given something.
    pub(crate) fn serve(&mut self, namespace: &str, cost: f64) {
        self.clock = self.start(namespace);
        self.ends.insert(namespace.into(), self.clock + cost);
        if self.ends.len() > SERVED_KEPT {
            self.ends.retain(|_, end| *end > self.clock);
        }
    }

    /// The rank of a namespace with this share.
    pub(crate) fn rank(&self, namespace: &str, share: f64) -> Rank {
        Rank { share, start: self.start(namespace) }
    }
}

/// What a quota leaves nothing of.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Spent {
    /// CPU.
    pub cpu: bool,
    /// Memory.
    pub memory: bool,
    /// Leases: no robot's actuators.
    pub leases: bool,
    /// Tasks: nothing at all.
    pub tasks: bool,
}

/// What a quota refuses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OverQuota {
    /// CR; `left` is what the quota leaves.
    Short(Shortage),
    /// Leases.
    Leases {
        /// The most it may hold.
        hard: u64,
    },
}

impl std::fmt::Display for OverQuota {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            OverQuota::Short(Shortage::Cpu { asked, left }) => {
                write!(f, "asks for {asked} cpu, the namespace's quota leaves {left}")
            }
            OverQuota::Short(Shortage::Memory { asked, left }) => {
                write!(f, "asks for {asked} memory, the namespace's quota leaves {left}")
            }
            OverQuota::Short(Shortage::Extended { name, asked, left }) => {
                write!(f, "asks for {asked} {name}, the namespace's quota leaves {left}")
            }
            OverQuota::Leases { hard } => {
                write!(
                    f,
                    "asks for a robot's actuators, and the namespace holds all {hard} leases of its quota"
                )
            }
        }
    }
}

/// The reservations of those who hold a lease of the node, one for each lease.
fn holders(ledger: &NodeLedger) -> impl Iterator<Item = &Reservation> {
    let held = ledger.groups().filter_map(|(_, group)| group.holder.as_ref());
    held.filter_map(|uid| ledger.reservation(uid))
}

/// The namespace in `namespace/name`.
#[must_use]
pub fn namespace_of(title: &str) -> &str {
    title.split_once('/').map_or("", |(namespace, _)| namespace)
}

impl Accounts {
    /// Counts what a node's books say of a task and of every lease of the node.
    pub(crate) fn count(&mut self, ledger: &NodeLedger, uid: Option<&TaskUid>) {
        if let Some(reservation) = uid.and_then(|uid| ledger.reservation(uid)) {
            let account = self.entry(namespace_of(&reservation.title));
            account.compute.add(&reservation.compute);
            account.tasks += 1;
        }
        for reservation in holders(ledger) {
            self.entry(namespace_of(&reservation.title)).leases += 1;
        }
    }

    /// Takes back what [`Accounts::count`] counted, while the books still say the same.
    pub(crate) fn discount(&mut self, ledger: &NodeLedger, uid: Option<&TaskUid>) {
        for reservation in holders(ledger) {
            self.sub(namespace_of(&reservation.title), &Compute::default(), 1);
        }
        if let Some(reservation) = uid.and_then(|uid| ledger.reservation(uid)) {
            let namespace = namespace_of(&reservation.title);
            self.sub(namespace, &reservation.compute, 0);
            let account = self.entry(namespace);
            account.tasks = account.tasks.saturating_sub(1);
            if *account == Account::default() {
                self.by_namespace.remove(namespace);
            }
        }
    }

    /// Counts a node into what there is; one that has no Node object is none.
    pub(crate) fn count_member(&mut self, member: &Member) {
        if let Some(facts) = &member.facts {
            self.total.compute.add(member.ledger.allocatable());
            self.total.leases += facts.groups().len() as u64;
        }
    }

    /// Takes back what [`Accounts::count_member`] counted, while the node is still the same.
    pub(crate) fn discount_member(&mut self, member: &Member) {
        if let Some(facts) = &member.facts {
            self.total.compute.saturating_sub(member.ledger.allocatable());
            self.total.compute.extended.retain(|_, amount| *amount > 0);
            self.total.leases -= facts.groups().len() as u64;
        }
    }

    /// Counts a new reservation that is not in the books yet.
    pub fn add(&mut self, namespace: &str, compute: &Compute, leases: u64) {
        let account = self.entry(namespace);
        account.compute.add(compute);
        account.leases += leases;
    }

    fn entry(&mut self, namespace: &str) -> &mut Account {
        if !self.by_namespace.contains_key(namespace) {
            self.by_namespace.insert(namespace.into(), Account::default());
        }
        self.by_namespace.get_mut(namespace).expect("it was just put there")
    }

    fn sub(&mut self, namespace: &str, compute: &Compute, leases: u64) {
        if let Some(account) = self.by_namespace.get_mut(namespace) {
            account.compute.saturating_sub(compute);
            account.compute.extended.retain(|_, amount| *amount > 0);
            account.leases = account.leases.saturating_sub(leases);
        }
    }

    /// What each Quota object is to show.
    #[must_use]
    pub fn of_quotas(&self, cluster: &Cluster) -> BTreeMap<Arc<str>, QuotaStatus> {
        let status = |(namespace, quota): (&Arc<str>, &QuotaSpec)| {
            let Account { compute, leases, tasks } = self.account(namespace);
            let limited = quota.hard.extended.keys().map(|name| (name.clone(), 0));
            let used = Used {
                cpu: compute.cpu,
                memory: compute.memory,
                leases,
                tasks,
                extended: limited.chain(compute.extended).collect(),
            };
            let status = QuotaStatus { hard: quota.hard.clone(), used, ..QuotaStatus::default() };
            (Arc::clone(namespace), status)
        };
        cluster.quotas().map(status).collect()
    }

    /// What a namespace has.
    #[must_use]
    pub fn account(&self, namespace: &str) -> Account {
        self.by_namespace.get(namespace).cloned().unwrap_or_default()
    }

    /// The weighted dominant share of a namespace: 0 for one that has nothing.
    #[must_use]
    pub fn share(&self, cluster: &Cluster, namespace: &str) -> f64 {
        let Some(account) = self.by_namespace.get(namespace) else { return 0.0 };
        self.part(&account.compute, account.leases) / cluster.weight(namespace)
    }

    /// The part of the pool that this is, of whichever resource it is most of.
    #[must_use]
    pub fn part(&self, has: &Compute, leases: u64) -> f64 {
        let of = |part: u64, whole: u64| if whole == 0 { 0.0 } else { part as f64 / whole as f64 };
        let all = &self.total.compute;
        let extended = has
            .extended
            .iter()
            .map(|(name, part)| of(*part, all.extended.get(name).copied().unwrap_or_default()));
        [of(has.cpu.0, all.cpu.0), of(has.memory.0, all.memory.0), of(leases, self.total.leases)]
            .into_iter()
            .chain(extended)
            .fold(0.0, f64::max)
    }

    /// Whether `compute` and `leases` more would pass the namespace's quota.
    #[must_use]
    pub fn over_quota(
        &self,
        cluster: &Cluster,
        namespace: &str,
        compute: &Compute,
        leases: u64,
    ) -> Option<OverQuota> {
        let hard = &cluster.quota(namespace)?.hard;
        let account = self.account(namespace);
        if let Some(most) = hard.leases
            && leases > 0
            && account.leases + leases > most
        {
            return Some(OverQuota::Leases { hard: most });
        }
        left(hard, &account.compute).shortage_for(&limited(hard, compute)).map(OverQuota::Short)
    }

    /// What the namespace's quota leaves nothing of.
    #[must_use]
    pub fn spent(&self, cluster: &Cluster, namespace: &str) -> Spent {
        let Some(quota) = cluster.quota(namespace) else { return Spent::default() };
        let (hard, none) = (&quota.hard, Account::default());
        let has = self.by_namespace.get(namespace).unwrap_or(&none);
        Spent {
            cpu: hard.cpu.is_some_and(|hard| has.compute.cpu >= hard),
            memory: hard.memory.is_some_and(|hard| has.compute.memory >= hard),
            leases: hard.leases.is_some_and(|hard| has.leases >= hard),
            tasks: hard.tasks.is_some_and(|hard| has.tasks >= hard),
        }
    }
}

/// What of `compute` the quota limits: a dimension it does not name is not compared.
fn limited(hard: &Limits, compute: &Compute) -> Compute {
    Compute {
        cpu: if hard.cpu.is_some() { compute.cpu } else { MilliCpu(0) },
        memory: if hard.memory.is_some() { compute.memory } else { Bytes(0) },
        extended: compute
            .extended
            .iter()
            .filter(|(name, _)| hard.extended.contains_key(*name))
            .map(|(name, amount)| (name.clone(), *amount))
            .collect(),
    }
}

fn left(hard: &Limits, used: &Compute) -> Compute {
    let mut left = Compute {
        cpu: hard.cpu.unwrap_or_default(),
        memory: hard.memory.unwrap_or_default(),
        extended: hard.extended.clone(),
    };
    left.saturating_sub(used);
    left
}

/// The accounts, added up anew from the books of all nodes: what a cluster's own must always be.
#[cfg(test)]
pub(crate) fn added_up(cluster: &Cluster) -> Accounts {
    let mut accounts = Accounts::default();
    for member in cluster.all() {
        accounts.count_member(member);
        for (_, reservation) in member.ledger.reservations() {
            let account = accounts.entry(namespace_of(&reservation.title));
            account.compute.add(&reservation.compute);
            account.tasks += 1;
        }
        accounts.count(&member.ledger, None);
    }
    accounts
}

#[cfg(test)]
mod tests {
    use muster_api::id::TaskUid;
    use muster_api::kind::lease::DEFAULT_GROUP;
    use muster_api::kind::node::NodeKind;

    use super::*;
    use crate::fixtures::{name, node};

    #[test]
    fn a_quota_shows_what_its_namespace_has_and_nothing_of_others() {
        let mut cluster = Cluster::new();
        cluster.upsert_node(&name("r"), &node(NodeKind::Robot, 2_000, None));
        let extended = BTreeMap::from([("gpu".to_owned(), 1)]);
        let hard = Limits { cpu: Some(MilliCpu(1_500)), extended, ..Limits::default() };
        cluster.set_quota("lab", Some(QuotaSpec { hard: hard.clone(), ..QuotaSpec::default() }));
        let reserve = |cluster: &mut Cluster, title: &str, groups: &[&str]| {
            let compute = Compute::new(MilliCpu(500), Bytes(64));
            let groups = groups.iter().map(|group| (*group).to_owned()).collect();
            let reservation =
                Reservation { title: title.into(), compute, groups, ..Reservation::default() };
            cluster.reserve(&TaskUid::new(title), 0, reservation).expect("there is room");
        };
        reserve(&mut cluster, "lab/driver", &[DEFAULT_GROUP]);
        reserve(&mut cluster, "lab/other", &[]);
        reserve(&mut cluster, "elsewhere/third", &[]);
        let status = |cluster: &Cluster| cluster.accounts().of_quotas(cluster);
        let extended = BTreeMap::from([("gpu".to_owned(), 0)]);
        let used = Used { cpu: MilliCpu(1_000), memory: Bytes(128), leases: 1, tasks: 2, extended };
        let expected = QuotaStatus { hard, used, requested: Used::default() };
        assert_eq!(status(&cluster), BTreeMap::from([("lab".into(), expected)]));
        drop(cluster.release(&TaskUid::new("lab/driver")));
        let used = &status(&cluster)["lab"].used;
        assert_eq!((used.cpu, used.leases), (MilliCpu(500), 0));
    }
}
