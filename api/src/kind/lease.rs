//! Lease: the right of one task to a robot's actuators (AR), numbered by an epoch that only grows.
//!
//! One per robot and conflict group, named `<node>.<group>`. The controller writes it; clients read it.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{KindInfo, admit_spec, any_change};
use crate::id::{Epoch, TaskUid};
use crate::name::FunctionName;
use crate::validate::Violations;

/// The conflict group of a robot whose operator made no groups: all its actuators.
pub const DEFAULT_GROUP: &str = "body";

/// Which actuators the lease is for.
#[derive(CustomResource, Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[kube(
    group = "muster.dev",
    version = "v1alpha1",
    kind = "Lease",
    plural = "leases",
    status = "LeaseStatus",
    derive = "PartialEq"
)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct LeaseSpec {
    /// The robot.
    pub node: String,
    /// The conflict group of its actuators.
    pub group: String,
    /// The actuator functions in the group.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub actuators: Vec<FunctionName>,
}

/// Who holds the lease.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct LeaseStatus {
    /// The number of the newest grant, held or not.
    #[serde(default)]
    pub epoch: Epoch,
    /// The holder; none: free.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub holder: Option<LeaseHolder>,
    /// When the present holder got it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub acquired: Option<MicroTime>,
    /// When the holder's node was last heard, as far as it is written down.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub renewed: Option<MicroTime>,
}

/// The task that holds a lease.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct LeaseHolder {
    /// The task's namespace.
    pub namespace: String,
    /// The task's name.
    pub name: String,
    /// The task's uid: a new task of the same name is another holder.
    pub uid: TaskUid,
}

impl LeaseSpec {
    /// The name of the Lease object of a robot's group.
    #[must_use]
    pub fn object_name(node: &str, group: &str) -> String {
        format!("{node}.{group}")
    }
}

fn rules(_: &LeaseSpec, _: &mut Violations) {}

pub(super) const INFO: KindInfo = KindInfo {
    group: crate::GROUP,
    version: crate::VERSION,
    kind: "Lease",
    plural: "leases",
    singular: "lease",
    short_names: &["le"],
    namespaced: false,
    has_status: true,
    selectable: &["spec.node", "spec.group"],
    schema: |g| g.subschema_for::<Lease>(),
    admit_body: |object, violations| admit_spec::<LeaseSpec>(object, violations, rules),
    admit_change: any_change,
};
