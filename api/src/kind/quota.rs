//! Quota: what a namespace may have at most, and its weight where namespaces compete.
//!
//! One per namespace, named `default`. It holds for declared tasks and for frameworks alike: the books refuse what
//! would pass it.

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
    /// The most that its tasks may have reserved at once.
    pub hard: Limits,
    /// Its part where namespaces compete: twice the weight, twice the share. Above 0.
    pub weight: f64,
}

impl Default for QuotaSpec {
    fn default() -> Self {
        QuotaSpec { hard: Limits::default(), weight: 1.0 }
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
    /// What its tasks have, limited or not.
    pub used: Used,
}

/// What tasks have reserved, by resource.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct Used {
    /// Cpu.
    pub cpu: MilliCpu,
    /// Memory.
    pub memory: Bytes,
    /// Leases of robots (AR).
    pub leases: u64,
    /// Counted extras by name; those that are limited are named at 0 as well.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub extended: BTreeMap<String, u64>,
}

fn rules(spec: &QuotaSpec, violations: &mut Violations) {
    if !(spec.weight > 0.0 && spec.weight.is_finite()) {
        violations
            .invalid("spec.weight", format!("{} is not a weight", spec.weight))
            .suggest("a number above 0; 1 is usual");
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
}
