//! TaskSetRevision: a template that a TaskSet has or had, as Kubernetes' ControllerRevision.
//!
//! Made and removed by the controller, at most `rollout.revisionHistoryLimit` old ones for a set. Its number grows when
//! the set goes back to it, so that the highest number is the newest wish.

use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::taskset::TaskTemplate;
use super::{KindInfo, admit_spec};
use crate::validate::Violations;

/// A template and its place in the history of its set.
#[derive(CustomResource, Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[kube(
    group = "muster.dev",
    version = "v1alpha1",
    kind = "TaskSetRevision",
    plural = "tasksetrevisions",
    namespaced,
    derive = "PartialEq",
    shortname = "tsr"
)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct TaskSetRevisionSpec {
    /// 1 is the first.
    pub revision: u64,
    /// What the tasks of this revision are made of.
    pub template: TaskTemplate,
}

fn template_stays(old: &Value, new: &Value, violations: &mut Violations) {
    let template = |object: &Value| object.pointer("/spec/template").cloned();
    if template(old) != template(new) {
        violations.forbidden("spec.template", "a revision stays what it was");
    }
}

pub(super) const INFO: KindInfo = KindInfo {
    group: crate::GROUP,
    version: crate::VERSION,
    kind: "TaskSetRevision",
    plural: "tasksetrevisions",
    singular: "tasksetrevision",
    short_names: &["tsr"],
    namespaced: true,
    has_status: false,
    selectable: &[],
    schema: |g| g.subschema_for::<TaskSetRevision>(),
    admit_body: |object, violations| {
        admit_spec::<TaskSetRevisionSpec>(object, violations, |_, _| {});
    },
    admit_change: template_stays,
};
