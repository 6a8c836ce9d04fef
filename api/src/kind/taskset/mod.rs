//! TaskSet: tasks that are kept running on N nodes, or on every node that matches, and changed
//! robot by robot.
//!
//! Its tasks are ordinary Task objects that name it as their controller. An old template stays as a
//! [`TaskSetRevision`](super::taskset_revision::TaskSetRevision), so that it can be gone back to.
//! What is decided from all that is in `muster_controller_core::taskset`.

mod rules;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize, de};

use super::KindInfo;
use super::node::image::ImageWish;
use super::task::TaskSpec;
use crate::condition::Condition;
use crate::duration::Span;
use crate::portion::Portion;
use crate::selector::{LabelSelector, Labels};

/// Label of a task and of a revision: the name of its TaskSet.
pub const SET_LABEL: &str = "muster.dev/taskset";
/// Label of a task: the name of the TaskSetRevision that it was made of.
pub const REVISION_LABEL: &str = "muster.dev/revision";
/// Annotation of a template: when somebody asked that its tasks are started anew (`muster rollout restart`).
pub const RESTARTED_AT: &str = "muster.dev/restartedAt";
/// Annotation that `muster rollout history` shows, Kubernetes' own.
pub const CHANGE_CAUSE: &str = "kubernetes.io/change-cause";
/// Longest name of a TaskSet: the names of its revisions and tasks begin with it, and are labels too.
pub const MAX_SET_NAME_LEN: usize = 52;

/// Which tasks there should be.
#[derive(CustomResource, Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[kube(
    group = "muster.dev",
    version = "v1alpha1",
    kind = "TaskSet",
    plural = "tasksets",
    namespaced,
    status = "TaskSetStatus",
    derive = "PartialEq",
    shortname = "ts"
)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct TaskSetSpec {
    /// That many tasks, on the best nodes for them (with an operation position: the nearest robots).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replicas: Option<u32>,
    /// One task on each node that the template's placement matches, as it joins.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub every_node: bool,
    /// Which tasks of the namespace are taken in when nobody else controls them; the template's labels
    /// must match. None: those that carry the set's name in the label `muster.dev/taskset`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub selector: Option<LabelSelector>,
    /// What each task is.
    pub template: TaskTemplate,
    /// With `replicas`: at most one task on a node.
    #[serde(default = "yes")]
    pub spread: bool,
    /// Seconds that a task must run before it counts as available. A program that cannot run mostly ends
    /// at once; 0 lets a rollout go on before that shows.
    #[serde(default = "default_min_ready")]
    pub min_ready_seconds: u32,
    /// How a changed template reaches the tasks.
    #[serde(default)]
    pub rollout: Rollout,
    /// What happens when a task's node cannot be reached.
    #[serde(default)]
    pub on_unreachable: OnUnreachable,
}

fn yes() -> bool {
    true
}

fn default_min_ready() -> u32 {
    DEFAULT_MIN_READY_SECONDS
}

/// Of a set that names none. Kubernetes has 0; here the canary would prove nothing.
pub const DEFAULT_MIN_READY_SECONDS: u32 = 5;

/// What a task of the set is made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct TaskTemplate {
    /// Labels and annotations of the tasks.
    #[serde(default, skip_serializing_if = "TemplateMetadata::is_empty")]
    pub metadata: TemplateMetadata,
    /// Their spec. `restartPolicy` is Always, and is when it is left out.
    #[serde(deserialize_with = "always_restarted")]
    pub spec: TaskSpec,
}

/// A task's spec whose restart policy, when it is left out, is Always, as in a Kubernetes template.
fn always_restarted<'de, D: Deserializer<'de>>(d: D) -> Result<TaskSpec, D::Error> {
    let mut spec = serde_json::Map::deserialize(d)?;
    spec.entry("restartPolicy").or_insert_with(|| "Always".into());
    serde_json::from_value(spec.into()).map_err(de::Error::custom)
}

/// What of a task's metadata a template may set.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct TemplateMetadata {
    /// Labels.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub labels: Labels,
    /// Annotations.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub annotations: BTreeMap<String, String>,
}

impl TemplateMetadata {
    /// Nothing is set.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.labels.is_empty() && self.annotations.is_empty()
    }
}

/// How a changed template reaches the tasks. Tasks are immutable, so each is ended, and when nothing of it runs
/// any more another begins on the same node. There is never one more than the set asks for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Rollout {
    /// In which way.
    pub strategy: Strategy,
    /// Most tasks that may be down because of the rollout; at least 1, because nothing is started beside the old.
    pub max_unavailable: Portion,
    /// How many are changed first; the others follow when those are available.
    pub canary: u32,
    /// Seconds that a changed task gets to become available.
    pub progress_deadline_seconds: u32,
    /// Go back to the last template that was available everywhere when a changed task fails.
    pub auto_rollback: bool,
    /// Change nothing for now.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub paused: bool,
    /// Old templates that are kept.
    pub revision_history_limit: u32,
}

impl Default for Rollout {
    fn default() -> Self {
        Rollout {
            strategy: Strategy::Rolling,
            max_unavailable: Portion::Count(1),
            canary: 1,
            progress_deadline_seconds: 600,
            auto_rollback: true,
            paused: false,
            revision_history_limit: 10,
        }
    }
}

/// In which way tasks are changed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Strategy {
    /// By the controller: canaries first, then the others.
    #[default]
    Rolling,
    /// When somebody deletes a task, the next one is of the new template.
    OnDelete,
}

/// What happens when a task's node cannot be reached.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct OnUnreachable {
    /// What happens.
    pub policy: UnreachablePolicy,
    /// With Replace: how long it must be out of reach first; none: 30 s. A task that ends itself without contact
    /// (`onDisconnect: Stop`) is replaced only when it surely has.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after: Option<Span>,
}

/// What happens when a task's node cannot be reached.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum UnreachablePolicy {
    /// The set waits for the node.
    #[default]
    Wait,
    /// Another task begins elsewhere, beside the one that may still run.
    Replace,
}

/// How long a node must be out of reach when [`OnUnreachable`] does not say: most losses of a radio link are shorter.
pub const DEFAULT_REPLACE_AFTER: Span = Span::from_secs(30);

/// What has become of the set.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct TaskSetStatus {
    /// The generation of the spec that this is about.
    pub observed_generation: i64,
    /// Tasks that should be.
    pub desired_replicas: u32,
    /// Tasks that are, and are not being ended.
    pub replicas: u32,
    /// Those that run and are ready.
    pub ready_replicas: u32,
    /// Those that have been ready for `minReadySeconds`.
    pub available_replicas: u32,
    /// Those of the spec's template.
    pub updated_replicas: u32,
    /// What is missing of the desired ones to be available.
    pub unavailable_replicas: u32,
    /// Name of the last revision that was available everywhere; empty: none was yet.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub current_revision: String,
    /// Name of the revision of the spec's template.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub update_revision: String,
    /// The revision that was given up. While it is that of the spec, the tasks are of `currentRevision`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rolled_back_from: Option<RolledBack>,
    /// Tasks that a rollout is ending, to begin others in their places.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub replacing: Vec<Replacing>,
    /// Images that a rollout wants on nodes before it ends a task there.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub image_pulls: Vec<ImagePull>,
    /// Nodes under a mission lock, where a task stays that would be changed or ended.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub held: Vec<Held>,
    /// The selector as text, for the scale subresource.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub selector: String,
    /// `Available`, `Progressing`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["type"]))]
    pub conditions: Vec<Condition>,
}

/// A rollout that was given up.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct RolledBack {
    /// The revision that failed.
    pub revision: String,
    /// The revision that was gone back to.
    pub to: String,
    /// Why, one CamelCase word.
    pub reason: String,
    /// Why, in a sentence: which task, where, and what it did.
    pub message: String,
    /// When.
    pub at: MicroTime,
}

impl RolledBack {
    /// A time as the status carries it.
    #[must_use]
    pub fn stamp(at: jiff::Timestamp) -> MicroTime {
        MicroTime(at)
    }
}

/// A place that a rollout empties. It is written down with the end of the task, so that whoever goes on, after a
/// crash too, knows what belongs there.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct Replacing {
    /// Name of the task that ends, and of the one that follows.
    pub task: String,
    /// Where it ran; the next one is tried there first.
    pub node: String,
    /// Name of the revision of the one that follows.
    pub revision: String,
}

/// An image that a node is to have before its task is ended for a rollout. It is written down so that its agent is told of
/// it, and of nothing else, by whichever controller.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct ImagePull {
    /// Where.
    pub node: String,
    /// Name of the revision that needs it.
    pub revision: String,
    /// What is wanted.
    pub wish: ImageWish,
}

/// A task that stays because of a mission.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct Held {
    /// The locked node.
    pub node: String,
    /// The task.
    pub task: String,
    /// Who locked it.
    pub holder: String,
    /// Why.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub reason: String,
}

impl TaskTemplate {
    /// Ten letters that differ between templates: FNV-1a over the template's JSON. `salt` gives others for two
    /// templates that happen to agree.
    ///
    /// # Panics
    ///
    /// Never: a template is texts, numbers, lists and maps.
    #[must_use]
    pub fn digest(&self, salt: u32) -> String {
        let json = serde_json::to_vec(self).expect("a template serializes to JSON");
        digest(&json, salt)
    }

    /// The labels of a task of this template.
    #[must_use]
    pub fn labels(&self, set: &str, revision: &str) -> Labels {
        let mut labels = self.metadata.labels.clone();
        labels.insert(SET_LABEL.to_owned(), set.to_owned());
        labels.insert(REVISION_LABEL.to_owned(), revision.to_owned());
        labels
    }
}

/// Ten letters for these bytes. No vowels and no look-alikes, as in Kubernetes' names.
#[must_use]
pub fn digest(bytes: &[u8], salt: u32) -> String {
    const LETTERS: &[u8; 27] = b"bcdfghjklmnpqrstvwxz2456789";
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for byte in bytes.iter().chain(&salt.to_le_bytes()) {
        hash = (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
    }
    let mut text = String::with_capacity(10);
    for _ in 0..10 {
        let letter = usize::try_from(hash % 27).expect("less than 27");
        text.push(char::from(LETTERS[letter]));
        hash /= 27;
    }
    text
}

impl TaskSetSpec {
    /// Which tasks are taken in.
    #[must_use]
    pub fn selects(&self, set: &str) -> LabelSelector {
        self.selector.clone().unwrap_or_else(|| LabelSelector {
            match_labels: [(SET_LABEL.to_owned(), set.to_owned())].into(),
            match_expressions: Vec::new(),
        })
    }
}

impl TaskSetStatus {
    /// The condition of this type.
    #[must_use]
    pub fn condition(&self, r#type: &str) -> Option<&Condition> {
        self.conditions.iter().find(|c| c.r#type == r#type)
    }
}

pub(super) const INFO: KindInfo = KindInfo {
    group: crate::GROUP,
    version: crate::VERSION,
    kind: "TaskSet",
    plural: "tasksets",
    singular: "taskset",
    short_names: &["ts"],
    namespaced: true,
    has_status: true,
    selectable: &[],
    schema: |g| g.subschema_for::<TaskSet>(),
    admit_body: rules::admit_body,
    admit_change: rules::change_rules,
};
