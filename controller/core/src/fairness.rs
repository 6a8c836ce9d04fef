//! Who has how much: namespaces' shares of the pool and their quotas.
//!
//! Weighted dominant-resource fairness (Ghodsi et al., NSDI 2011): a namespace's share is the largest, over cpu,
//! memory, counted extras and robots' leases, of what its tasks have divided by what there is, divided by its weight.
//! AR counts as a resource like the others: who drives every robot has a share of 1, however little it computes.

use std::collections::BTreeMap;
use std::sync::Arc;

use muster_api::kind::quota::{Limits, QuotaSpec, QuotaStatus, Used};
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::{Compute, Shortage};

use crate::cluster::Cluster;

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

/// What every namespace has, and what there is.
#[derive(Debug, Clone, Default)]
pub struct Accounts {
    by_namespace: BTreeMap<Arc<str>, Account>,
    total: Account,
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

/// The namespace in `namespace/name`.
#[must_use]
pub fn namespace_of(title: &str) -> &str {
    title.split_once('/').map_or("", |(namespace, _)| namespace)
}

impl Accounts {
    /// Adds up the books of all nodes.
    #[must_use]
    pub fn of(cluster: &Cluster) -> Self {
        let mut accounts = Accounts::default();
        for (_, member) in cluster.members() {
            accounts.total.compute.add(member.ledger.allocatable());
            accounts.total.leases += member.facts.as_ref().map_or(0, |f| f.groups().len() as u64);
        }
        for member in cluster.all() {
            for (_, reservation) in member.ledger.reservations() {
                let namespace = namespace_of(&reservation.title);
                accounts.add(namespace, &reservation.compute, 0);
                accounts.entry(namespace).tasks += 1;
            }
            let holders = member.ledger.groups().filter_map(|(_, group)| group.holder.as_ref());
            for reservation in holders.filter_map(|uid| member.ledger.reservation(uid)) {
                accounts.add(namespace_of(&reservation.title), &Compute::default(), 1);
            }
        }
        accounts
    }

    /// Counts a new reservation.
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

    /// Takes back what [`Accounts::add`] counted.
    pub fn sub(&mut self, namespace: &str, compute: &Compute, leases: u64) {
        if let Some(account) = self.by_namespace.get_mut(namespace) {
            account.compute.saturating_sub(compute);
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
        let of = |part: u64, whole: u64| if whole == 0 { 0.0 } else { part as f64 / whole as f64 };
        let (has, all) = (&account.compute, &self.total.compute);
        let extended = has
            .extended
            .iter()
            .map(|(name, part)| of(*part, all.extended.get(name).copied().unwrap_or_default()));
        let dominant = [
            of(has.cpu.0, all.cpu.0),
            of(has.memory.0, all.memory.0),
            of(account.leases, self.total.leases),
        ]
        .into_iter()
        .chain(extended)
        .fold(0.0, f64::max);
        dominant / cluster.quota(namespace).map_or(1.0, |q| q.weight)
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

    /// The namespace can reserve nothing more of anything that its quota limits.
    #[must_use]
    pub fn is_exhausted(&self, cluster: &Cluster, namespace: &str) -> bool {
        let Some(quota) = cluster.quota(namespace) else { return false };
        let account = self.account(namespace);
        let no_cpu = quota.hard.cpu.is_some_and(|hard| account.compute.cpu >= hard);
        let no_memory = quota.hard.memory.is_some_and(|hard| account.compute.memory >= hard);
        no_cpu || no_memory
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

#[cfg(test)]
mod tests {
    use muster_api::id::TaskUid;
    use muster_api::kind::lease::DEFAULT_GROUP;
    use muster_api::kind::node::NodeKind;

    use super::*;
    use crate::fixtures::{name, node};
    use crate::ledger::Reservation;

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
        let status = |cluster: &Cluster| Accounts::of(cluster).of_quotas(cluster);
        let extended = BTreeMap::from([("gpu".to_owned(), 0)]);
        let used = Used { cpu: MilliCpu(1_000), memory: Bytes(128), leases: 1, tasks: 2, extended };
        let expected = QuotaStatus { hard, used, requested: Used::default() };
        assert_eq!(status(&cluster), BTreeMap::from([("lab".into(), expected)]));
        drop(cluster.release(&TaskUid::new("lab/driver")));
        let used = &status(&cluster)["lab"].used;
        assert_eq!((used.cpu, used.leases), (MilliCpu(500), 0));
    }
}
