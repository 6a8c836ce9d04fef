//! Lease: the right of one task, or of one person, to a robot's actuators (AR), numbered by an epoch that only grows.
//!
//! One per robot and conflict group, named `<node>.<group>`. The controller writes it; clients read it, and people hold it by
//! its subresources `acquire`, `take` and `return`.

use std::fmt;

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
    /// The newest grant to a person. What was granted before it never counts again, returned or not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fence: Option<Epoch>,
}

/// Who holds a lease: a task, or a person.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct LeaseHolder {
    /// Which of the two.
    #[serde(default, skip_serializing_if = "HolderKind::is_task")]
    pub kind: HolderKind,
    /// The task's namespace; empty for a person. Always written: clients that know of tasks alone require it.
    #[serde(default)]
    pub namespace: String,
    /// The task's name, or the person's.
    pub name: String,
    /// The task's uid: a new task of the same name is another holder. A person's holding has one as well, made of their name
    /// and the grant's number.
    pub uid: TaskUid,
}

/// What holds a lease.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum HolderKind {
    /// A task.
    #[default]
    Task,
    /// A person, or a program that speaks for one.
    User,
}

impl HolderKind {
    fn is_task(&self) -> bool {
        *self == HolderKind::Task
    }
}

/// What the uid of a person's holding begins with; no task's does.
const PERSON: &str = "user ";

impl LeaseHolder {
    /// A person who holds a lease by this grant.
    #[must_use]
    pub fn person(user: &str, epoch: Epoch) -> Self {
        let (kind, namespace, name) = (HolderKind::User, String::new(), user.to_owned());
        LeaseHolder { kind, namespace, name, uid: TaskUid::new(format!("{PERSON}{user} #{epoch}")) }
    }

    /// The person whose holding has this uid; none: it is a task's.
    #[must_use]
    pub fn person_of(uid: &TaskUid) -> Option<Self> {
        let (user, epoch) = uid.as_str().strip_prefix(PERSON)?.rsplit_once(" #")?;
        Some(Self::person(user, Epoch(epoch.parse().ok()?)))
    }
}

impl fmt::Display for LeaseHolder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.kind {
            HolderKind::Task => write!(f, "{}/{}", self.namespace, self.name),
            HolderKind::User => write!(f, "{PERSON}{}", self.name),
        }
    }
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
