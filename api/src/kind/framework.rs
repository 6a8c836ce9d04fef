//! Framework: an outside scheduler that takes offers and launches tasks (two-level scheduling; Avalon, III-A).
//!
//! The controller writes it when a framework subscribes, and removes it when the framework ends or stays away for
//! longer than its failover timeout. Its uid is the framework's id, and it owns the tasks that it launched: they go
//! when it goes.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::task::{Cost, NodeChoice};
use super::{KindInfo, admit_spec, any_change};
use crate::duration::Span;
use crate::name::FunctionName;
use crate::pose::OperationPosition;
use crate::resource::Compute;
use crate::selector::LabelSelector;
use crate::validate::Violations;

/// Label of a task that a framework launched: the framework's name.
pub const FRAMEWORK_LABEL: &str = "muster.dev/framework";
/// Finalizer of such a task until the framework has acknowledged its end.
pub const ACKNOWLEDGE_FINALIZER: &str = "muster.dev/framework-acknowledges";
/// Annotation of a Framework: the nonce of the Subscribe that registered it.
pub const NONCE_ANNOTATION: &str = "muster.dev/subscribe-nonce";
/// How long a framework may be away when it says nothing itself. Mesos' default of 0 kills a fleet's work with every
/// restart of its scheduler.
pub const DEFAULT_FAILOVER_TIMEOUT: Span = Span::from_secs(60);
/// Offers that a framework has at once when it names no number ("several closest robots", Avalon, III-C).
pub const DEFAULT_MOST_OFFERS: u32 = 16;

/// Most offers that a framework may have at once: each is kept, said again with every change of its node, and compared with
/// what there is.
pub const MAX_OFFERS: u32 = 1_000;

/// Where the framework works and what it wants to be offered, as it last said.
#[derive(CustomResource, Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[kube(
    group = "muster.dev",
    version = "v1alpha1",
    kind = "Framework",
    plural = "frameworks",
    namespaced,
    status = "FrameworkStatus",
    derive = "PartialEq",
    shortname = "fw"
)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct FrameworkSpec {
    /// The operation position; none: everywhere.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position: Option<OperationPosition>,
    /// How far from it a robot may be, metres; the rim is inside. None: any distance.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius: Option<f64>,
    /// How robots are scored; the lowest score is offered first.
    pub cost: Cost,
    /// What a node must have to be offered.
    pub filter: OfferFilter,
    /// How long the framework may be away until its tasks are killed.
    pub failover_timeout: FailoverTimeout,
}

/// Where a framework works, as somebody else may set it: the part of its spec that says so.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct FrameworkPosition {
    /// The operation position; none: everywhere.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position: Option<OperationPosition>,
    /// How far from it a robot may be, metres; none: any distance.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius: Option<f64>,
    /// How robots are scored.
    pub cost: Cost,
}

impl FrameworkPosition {
    /// The spec with this position in place of its own.
    #[must_use]
    pub fn of(&self, spec: &FrameworkSpec) -> FrameworkSpec {
        let FrameworkPosition { position, radius, cost } = self.clone();
        FrameworkSpec { position, radius, cost, ..spec.clone() }
    }
}

/// How long a framework may be away; a type of its own for its default.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct FailoverTimeout(pub Span);

impl Default for FailoverTimeout {
    fn default() -> Self {
        FailoverTimeout(DEFAULT_FAILOVER_TIMEOUT)
    }
}

/// What a node must have to be offered at all.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct OfferFilter {
    /// Which kind of node.
    pub on: NodeChoice,
    /// Labels the node must have.
    #[serde(skip_serializing_if = "LabelSelector::is_empty")]
    pub selector: LabelSelector,
    /// Least free CR.
    pub minimum: Compute,
    /// SR functions that it must have, each of them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub sensors: Vec<FunctionName>,
    /// AR functions that it must have, each of them, and that nobody holds.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub actuators: Vec<FunctionName>,
    /// Some AR that nobody holds.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub any_actuator: bool,
    /// At most so many offers at once, the closest first; 0: [`DEFAULT_MOST_OFFERS`]. No more than [`MAX_OFFERS`].
    pub most: u32,
}

impl OfferFilter {
    /// Offers at once.
    #[must_use]
    pub fn limit(&self) -> usize {
        let most = if self.most == 0 { DEFAULT_MOST_OFFERS } else { self.most };
        usize::try_from(most).unwrap_or(usize::MAX)
    }
}

/// Who is connected, and what it has.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct FrameworkStatus {
    /// A session is open.
    pub connected: bool,
    /// When the present or last session began.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub subscribed_at: Option<MicroTime>,
    /// When the last session ended; the failover timeout runs from here.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub disconnected_at: Option<MicroTime>,
    /// No offers are wanted.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub suppressed: bool,
    /// Offers that wait for an answer, as far as it is written down.
    pub offers: u32,
    /// Tasks that hold a node, as far as it is written down.
    pub tasks: u32,
    /// Weighted dominant share of its namespace, 0 to 1 at weight 1, as far as it is written down.
    pub share: f64,
}

fn rules(spec: &FrameworkSpec, violations: &mut Violations) {
    if let Some(radius) = spec.radius {
        if !(radius >= 0.0 && radius.is_finite()) {
            violations.invalid("spec.radius", format!("{radius} is not a radius in metres"));
        }
        if spec.position.is_none() {
            violations
                .required("spec.position")
                .suggest("`radius` needs the position it is around");
        }
    }
    for (axis, value) in spec.position.iter().flat_map(|p| [("x", p.x), ("y", p.y), ("z", p.z)]) {
        if !value.is_finite() {
            let reason = format!("{value} is not a number of metres");
            violations.invalid(format!("spec.position.{axis}"), reason);
        }
    }
    if spec.cost == Cost::TravelTime && spec.position.is_none() {
        violations
            .required("spec.position")
            .suggest("the cost TravelTime needs the position to travel to");
    }
    if spec.filter.most > MAX_OFFERS {
        let reason =
            format!("{} offers at once are more than the {MAX_OFFERS} allowed", spec.filter.most);
        violations
            .invalid("spec.filter.most", reason)
            .suggest("name a smaller number; the closest come first, and others take the places of those declined");
    }
    spec.filter.selector.validate("spec.filter.selector", violations);
}

impl FrameworkSpec {
    /// Everything that is wrong with it, by path under `spec`.
    #[must_use]
    pub fn violations(&self) -> Violations {
        let mut violations = Violations::new();
        rules(self, &mut violations);
        violations
    }
}

pub(super) const INFO: KindInfo = KindInfo {
    group: crate::GROUP,
    version: crate::VERSION,
    kind: "Framework",
    plural: "frameworks",
    singular: "framework",
    short_names: &["fw"],
    namespaced: true,
    has_status: true,
    selectable: &["status.connected"],
    schema: |g| g.subschema_for::<Framework>(),
    admit_body: |object, violations| admit_spec::<FrameworkSpec>(object, violations, rules),
    admit_change: any_change,
};

#[cfg(test)]
mod tests {
    use serde_json::json;

    #[test]
    fn a_radius_needs_its_position() {
        let object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Framework",
            "metadata": {"name": "deliver"}, "spec": {"radius": 5.0, "cost": "TravelTime"}
        });
        let problems: Vec<String> = super::super::admit(&object)
            .expect_err("refused")
            .iter()
            .map(|v| v.path.clone())
            .collect();
        assert_eq!(problems, ["spec.position", "spec.position"]);
    }

    #[test]
    fn offers_at_once_are_bounded() {
        let spec = |most| {
            let filter = super::OfferFilter { most, ..super::OfferFilter::default() };
            super::FrameworkSpec { filter, ..super::FrameworkSpec::default() }
        };
        assert!(spec(super::MAX_OFFERS).violations().is_empty());
        let violations = spec(10_000).violations();
        let paths: Vec<&str> = violations.iter().map(|v| &*v.path).collect();
        assert_eq!(paths, ["spec.filter.most"]);
    }
}
