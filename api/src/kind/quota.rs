//! Quota: what a namespace may have at most, and its weight where namespaces compete.
//!
//! One per namespace, named `default`. It holds for declared tasks and for frameworks alike, twice: a new task that asks
//! for more than is left is refused (or waits, as `excess` says), and the scheduler's books give out no more than is
//! allowed whatever was let in. It also says what a task has that names no limits itself.

use std::collections::BTreeMap;

use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{KindInfo, admit_spec, any_change};
use crate::quantity::{Bytes, MilliCpu};
use crate::validate::Violations;

/// The name that every Quota has.
pub const QUOTA_NAME: &str = "default";

/// What the namespace may have.
#[derive(CustomResource, Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[kube(
    group = "muster.dev",
    version = "v1alpha1",
    kind = "Quota",
    plural = "quotas",
    namespaced,
    status = "QuotaStatus",
    derive = "PartialEq"
)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct QuotaSpec {
    /// The most that its tasks may have at once.
    pub hard: Limits,
    /// What becomes of a task that asks for more than is left.
    #[serde(skip_serializing_if = "Excess::is_default")]
    pub excess: Excess,
    /// What a new task has that does not say it itself; work of an executor lives within the executor's and is left
    /// as it is.
    #[serde(skip_serializing_if = "TaskDefaults::is_empty")]
    pub defaults: TaskDefaults,
    /// Its part where namespaces compete: twice the weight, twice the share. Above 0.
    pub weight: f64,
}

impl Default for QuotaSpec {
    fn default() -> Self {
        let (hard, excess, defaults) = Default::default();
        QuotaSpec { hard, excess, defaults, weight: 1.0 }
    }
}

/// What becomes of a task that asks for more than the quota leaves.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Excess {
    /// It is refused (422): what all tasks of the namespace that have not ended ask for never passes `hard`.
    #[default]
    Refuse,
    /// It is taken and waits until others have ended: only what is reserved never passes `hard`. `hard.tasks` refuses
    /// in any case.
    Wait,
}

impl Excess {
    fn is_default(&self) -> bool {
        *self == Excess::default()
    }
}

/// What a task has that does not say it itself.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct TaskDefaults {
    /// `resources.cpu`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpu: Option<MilliCpu>,
    /// `resources.memory`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Bytes>,
    /// `resources.pids`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pids: Option<u64>,
}

impl TaskDefaults {
    fn is_empty(&self) -> bool {
        *self == TaskDefaults::default()
    }
}

/// Limits by resource; what is not named is not limited.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Limits {
    /// Cpu.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpu: Option<MilliCpu>,
    /// Memory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Bytes>,
    /// Leases of robots (AR).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub leases: Option<u64>,
    /// Task objects that have not ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tasks: Option<u64>,
    /// Counted extras by name.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub extended: BTreeMap<String, u64>,
}

/// What the namespace has of what it may have, as the scheduler's books last said; a fraction of a second behind them.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct QuotaStatus {
    /// The limits that hold.
    pub hard: Limits,
    /// What its tasks have reserved on nodes, limited or not.
    pub used: Used,
    /// What its tasks that have not ended ask for, placed or waiting.
    pub requested: Used,
}

/// What tasks have or ask for, by resource.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct Used {
    /// Cpu.
    pub cpu: MilliCpu,
    /// Memory.
    pub memory: Bytes,
    /// Leases of robots (AR).
    pub leases: u64,
    /// How many tasks they are.
    pub tasks: u64,
    /// Counted extras by name; those that are limited are named at 0 as well.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub extended: BTreeMap<String, u64>,
}

impl Used {
    /// Adds `other` in every dimension.
    pub fn add(&mut self, other: &Used) {
        self.cpu += other.cpu;
        self.memory += other.memory;
        self.leases += other.leases;
        self.tasks += other.tasks;
        for (name, amount) in &other.extended {
            *self.extended.entry(name.clone()).or_default() += amount;
        }
    }

    /// Takes away what [`Used::add`] added before; an extra of which nothing is left is not named any more.
    pub fn sub(&mut self, other: &Used) {
        self.cpu = self.cpu.saturating_sub(other.cpu);
        self.memory = self.memory.saturating_sub(other.memory);
        self.leases -= other.leases;
        self.tasks -= other.tasks;
        for (name, amount) in &other.extended {
            if let Some(all) = self.extended.get_mut(name) {
                *all -= amount;
            }
        }
        self.extended.retain(|_, all| *all > 0);
    }
}

fn rules(spec: &QuotaSpec, violations: &mut Violations) {
    if !(spec.weight > 0.0 && spec.weight.is_finite()) {
        violations
            .invalid("spec.weight", format!("{} is not a weight", spec.weight))
            .suggest("a number above 0; 1 is usual");
    }
    let QuotaSpec { hard, defaults, .. } = spec;
    if let (Some(most), Some(each)) = (hard.cpu, defaults.cpu)
        && each > most
    {
        violations
            .invalid("spec.defaults.cpu", format!("{each} is more than spec.hard.cpu, {most}"));
    }
    if let (Some(most), Some(each)) = (hard.memory, defaults.memory)
        && each > most
    {
        violations.invalid(
            "spec.defaults.memory",
            format!("{each} is more than spec.hard.memory, {most}"),
        );
    }
    if defaults.pids == Some(0) {
        violations.invalid("spec.defaults.pids", "a task has at least one process");
    }
}

fn admit_body(object: &mut Value, violations: &mut Violations) {
    let name = object.pointer("/metadata/name").and_then(Value::as_str);
    if name.is_some_and(|n| n != QUOTA_NAME) {
        violations
            .not_supported("metadata.name", "a namespace has one Quota")
            .suggest(format!("name it {QUOTA_NAME:?}"));
    }
    admit_spec::<QuotaSpec>(object, violations, rules);
}

pub(super) const INFO: KindInfo = KindInfo {
    group: crate::GROUP,
    version: crate::VERSION,
    kind: "Quota",
    plural: "quotas",
    singular: "quota",
    short_names: &["qu"],
    namespaced: true,
    has_status: true,
    schema: |g| g.subschema_for::<Quota>(),
    selectable: &[],
    admit_body,
    admit_change: any_change,
};

#[cfg(test)]
mod tests {
    use serde_json::json;

    fn problems(name: &str, spec: serde_json::Value) -> Vec<String> {
        let object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Quota", "metadata": {"name": name}, "spec": spec
        });
        match super::super::admit(&object) {
            Ok(_) => Vec::new(),
            Err(violations) => violations.iter().map(ToString::to_string).collect(),
        }
    }

    #[test]
    fn a_namespace_has_one_quota_with_a_weight() {
        assert_eq!(problems("default", json!({"hard": {"cpu": "4", "leases": 2}})), [""; 0]);
        assert_eq!(
            problems("other", json!({"weight": 0})),
            [
                "metadata.name: a namespace has one Quota; name it \"default\"",
                "spec.weight: 0 is not a weight; a number above 0; 1 is usual"
            ]
        );
    }

    #[test]
    fn what_a_task_has_by_default_fits_in_the_quota() {
        let spec = json!({"hard": {"cpu": "1", "memory": "1Gi"}, "defaults": {"cpu": "2", "memory": "1Gi", "pids": 0}});
        assert_eq!(
            problems("default", spec),
            [
                "spec.defaults.cpu: 2 is more than spec.hard.cpu, 1",
                "spec.defaults.pids: a task has at least one process"
            ]
        );
    }
}
