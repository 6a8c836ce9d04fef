//! Quotas at the door: whether what a new task asks for is left in its namespace.
//!
//! What is counted here is what tasks *ask for* until they have ended, placed or waiting; what they have *reserved* is
//! the ledger's ([`crate::fairness::Accounts`]). The ledger would refuse a task that passes here by mistake, so nothing
//! is given out twice whatever this says.

use std::collections::HashMap;
use std::fmt;

use muster_api::id::TaskUid;
use muster_api::kind::quota::{Excess, QuotaSpec, Used};
use muster_api::kind::task::Resources;

/// What one task asks for.
#[must_use]
pub fn asked(resources: &Resources) -> Used {
    let reserved = resources.reserved();
    Used {
        cpu: reserved.cpu,
        memory: reserved.memory,
        leases: u64::from(!resources.actuators.is_empty()),
        tasks: 1,
        extended: reserved.extended,
    }
}

/// What the tasks of one namespace ask for that have not ended.
#[derive(Debug, Clone, Default)]
pub struct Requests {
    tasks: HashMap<TaskUid, Used>,
    sum: Used,
}

impl Requests {
    /// Counts a task; one that is counted already is not counted again.
    pub fn put(&mut self, uid: &TaskUid, asked: Used) {
        if self.tasks.contains_key(uid) {
            return;
        }
        self.sum.add(&asked);
        self.tasks.insert(uid.clone(), asked);
    }

    /// Counts a task no longer.
    pub fn remove(&mut self, uid: &TaskUid) {
        if let Some(asked) = self.tasks.remove(uid) {
            self.sum.sub(&asked);
        }
    }

    /// Of all that are counted.
    #[must_use]
    pub fn sum(&self) -> &Used {
        &self.sum
    }
}

/// Something that a task asks for and the quota does not leave.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// The field of the task that asks for it.
    pub field: String,
    /// What: `cpu`, `leases` …
    pub resource: String,
    /// How much the task asks for.
    pub asked: String,
    /// How much the others ask for.
    pub used: String,
    /// How much there may be.
    pub hard: String,
    /// How much is left.
    pub left: String,
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Refusal { resource, asked, used, hard, left, .. } = self;
        write!(
            f,
            "asks for {asked} {resource}; the namespace's quota is {hard}, {used} are used and {left} are left"
        )
    }
}

/// What of `asked` is not left when `used` is asked for already; empty: it may pass.
#[must_use]
pub fn refusals(quota: &QuotaSpec, used: &Used, asked: &Used) -> Vec<Refusal> {
    let hard = &quota.hard;
    let mut refusals = Vec::new();
    let mut count = |(field, resource): (&str, &str), asked: u64, used: u64, hard: u64| {
        if asked > 0 && used.saturating_add(asked) > hard {
            let left = hard.saturating_sub(used);
            refusals.push(refusal(field, resource, asked, used, hard, left));
        }
    };
    if let Some(hard) = hard.tasks {
        count(("metadata.namespace", "tasks"), asked.tasks, used.tasks, hard);
    }
    if quota.excess == Excess::Wait {
        return refusals;
    }
    if let Some(hard) = hard.leases {
        count(("spec.resources.actuators", "leases"), asked.leases, used.leases, hard);
    }
    for (name, hard) in &hard.extended {
        let of = |amounts: &Used| amounts.extended.get(name).copied().unwrap_or_default();
        count((&format!("spec.resources.extended.{name}"), name), of(asked), of(used), *hard);
    }
    if let Some(hard) = hard.memory
        && asked.memory.0 > 0
        && used.memory + asked.memory > hard
    {
        let (field, left) = ("spec.resources.memory", hard.saturating_sub(used.memory));
        refusals.push(refusal(field, "memory", asked.memory, used.memory, hard, left));
    }
    if let Some(hard) = hard.cpu
        && asked.cpu.0 > 0
        && used.cpu + asked.cpu > hard
    {
        let (field, left) = ("spec.resources.cpu", hard.saturating_sub(used.cpu));
        refusals.push(refusal(field, "cpu", asked.cpu, used.cpu, hard, left));
    }
    refusals.reverse();
    refusals
}

fn refusal<T: fmt::Display>(
    field: &str,
    resource: &str,
    asked: T,
    used: T,
    hard: T,
    left: T,
) -> Refusal {
    Refusal {
        field: field.to_owned(),
        resource: resource.to_owned(),
        asked: asked.to_string(),
        used: used.to_string(),
        hard: hard.to_string(),
        left: left.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use muster_api::kind::quota::Limits;
    use muster_api::quantity::{Bytes, MilliCpu};
    use proptest::prelude::*;

    use super::*;

    fn used(cpu: u64, memory: u64, leases: u64, tasks: u64) -> Used {
        let (cpu, memory) = (MilliCpu(cpu), Bytes(memory));
        Used { cpu, memory, leases, tasks, extended: BTreeMap::new() }
    }

    fn quota(excess: Excess) -> QuotaSpec {
        let hard = Limits {
            cpu: Some(MilliCpu(2_000)),
            memory: Some(Bytes(1 << 20)),
            leases: Some(1),
            tasks: Some(3),
            extended: BTreeMap::from([("gpu".to_owned(), 1)]),
        };
        QuotaSpec { hard, excess, ..QuotaSpec::default() }
    }

    #[test]
    fn the_rim_is_inside_and_everything_that_is_short_is_said() {
        let refuse = quota(Excess::Refuse);
        let full = used(2_000, 1 << 20, 1, 3);
        assert_eq!(refusals(&refuse, &Used::default(), &full), []);
        let mut more = used(500, 1, 1, 1);
        more.extended.insert("gpu".to_owned(), 2);
        let said: Vec<String> = refusals(&refuse, &full, &more)
            .iter()
            .map(|refusal| format!("{}: {refusal}", refusal.field))
            .collect();
        assert_eq!(
            said,
            [
                "spec.resources.cpu: asks for 500m cpu; the namespace's quota is 2, 2 are used and 0 are left",
                "spec.resources.memory: asks for 1 memory; the namespace's quota is 1Mi, 1Mi are used and 0 are left",
                "spec.resources.extended.gpu: asks for 2 gpu; the namespace's quota is 1, 0 are used and 1 are left",
                "spec.resources.actuators: asks for 1 leases; the namespace's quota is 1, 1 are used and 0 are left",
                "metadata.namespace: asks for 1 tasks; the namespace's quota is 3, 3 are used and 0 are left",
            ]
        );
    }

    /// A quota that was lowered refuses nobody who asks for none of it.
    #[test]
    fn who_asks_for_nothing_of_it_passes() {
        let over = used(9_000, 9 << 20, 9, 2);
        assert_eq!(refusals(&quota(Excess::Refuse), &over, &used(0, 0, 0, 1)), []);
    }

    #[test]
    fn waiting_is_for_what_ends_and_not_for_objects() {
        let full = used(2_000, 1 << 20, 1, 3);
        let fields: Vec<String> = refusals(&quota(Excess::Wait), &full, &used(500, 1, 1, 1))
            .into_iter()
            .map(|refusal| refusal.field)
            .collect();
        assert_eq!(fields, ["metadata.namespace"]);
    }

    proptest! {
        /// The sum is that of the tasks that are counted, in whatever order they come and go, and however often.
        #[test]
        fn what_is_counted_adds_up(steps in proptest::collection::vec((0_u8..6, any::<bool>(), 0_u64..4), 0..60)) {
            let mut requests = Requests::default();
            let mut model: BTreeMap<u8, Used> = BTreeMap::new();
            for (task, comes, amount) in steps {
                let uid = TaskUid::new(format!("t{task}"));
                if comes {
                    let mut asked = used(amount * 100, amount, amount % 2, 1);
                    asked.extended.insert("gpu".to_owned(), amount + 1);
                    requests.put(&uid, asked.clone());
                    model.entry(task).or_insert(asked);
                } else {
                    requests.remove(&uid);
                    model.remove(&task);
                }
                let sum = requests.sum();
                let add = |of: &dyn Fn(&Used) -> u64| model.values().map(of).sum::<u64>();
                prop_assert_eq!(sum.cpu.0, add(&|u| u.cpu.0));
                prop_assert_eq!(sum.memory.0, add(&|u| u.memory.0));
                prop_assert_eq!(sum.leases, add(&|u| u.leases));
                prop_assert_eq!(sum.tasks, add(&|u| u.tasks));
                let gpus = sum.extended.get("gpu").copied().unwrap_or_default();
                prop_assert_eq!(gpus, add(&|u| u.extended["gpu"]));
            }
        }
    }
}
