//! Where an Application's parts are, and why.

use std::collections::BTreeMap;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::pin::Pin;
use crate::condition::Condition;
use crate::quantity::MilliCpu;

/// What has become of the application.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct ApplicationStatus {
    /// The generation of the spec that this is about.
    pub observed_generation: i64,
    /// How its parts are, in a word.
    pub phase: ApplicationPhase,
    /// Its parts, in the order of the spec.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub parts: Vec<PartStatus>,
    /// The nodes where parts may run besides home, as of now.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub scales: Vec<String>,
    /// Mappings there would be if every part could go everywhere.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub mappings: String,
    /// Mappings that are left when those are pruned that always break a constraint.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub allowed_mappings: String,
    /// What the present mapping is worth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value: Option<f64>,
    /// Proven: no mapping is worth more than this.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bound: Option<f64>,
    /// The connections whose frequency somebody tells, in the order of the spec.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub connections: Vec<ConnectionStatus>,
    /// The signals that somebody tells, in the order of the spec.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub signals: Vec<SignalStatus>,
    /// The mappings that there were, the present one last; of many the newest [`MAX_TIMELINE`].
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub timeline: Vec<MappingStatus>,
    /// `Managed`, `Ready`, `Degraded`, `Characterised`, `FitsHome`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub conditions: Vec<Condition>,
}

/// Mappings that the status remembers.
pub const MAX_TIMELINE: usize = 20;

/// How an application's parts are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum ApplicationPhase {
    /// Not all of its parts have served yet.
    #[default]
    Pending,
    /// Every part serves, or has done what it had to.
    Running,
    /// A part that has served does not.
    Degraded,
}

/// One part.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct PartStatus {
    /// Its name.
    pub name: String,
    /// Whether it may move.
    pub class: PartClass,
    /// Why it stays at home.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub pinned: Vec<PinStatus>,
    /// The node where it serves.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<String>,
    /// It serves: its task runs and is Ready, or has done what it had to.
    pub ready: bool,
    /// How far a move of it has come; none: it has no task.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stage: Option<MoveStage>,
    /// The task that serves.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task: Option<AttemptStatus>,
    /// The task that is to serve next, or one that is ending.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub other: Option<AttemptStatus>,
    /// A third one, not known to be gone: its robot was cut off while it moved from one scale to another.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub also: Option<AttemptStatus>,
    /// While it is away: the task that stands by at home, with what it needs kept for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub standby: Option<AttemptStatus>,
    /// How many tasks it has had.
    pub attempts: u64,
    /// Why it is where it is, one word.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub reason: String,
    /// Why it is where it is, in a sentence.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub message: String,
    /// For each other scale: what stands in the way, or what there would be to gain.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub elsewhere: Vec<Obstacle>,
    /// Mean use of cpu as measured, by node.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub learned: BTreeMap<String, MilliCpu>,
    /// When it was moved last.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub moved_at: Option<MicroTime>,
}

/// Whether a part may move.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum PartClass {
    /// It stays at home.
    #[default]
    Critical,
    /// It may run on other scales.
    Migratable,
}

/// One reason why a part stays at home.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct PinStatus {
    /// One word.
    pub reason: String,
    /// A sentence.
    pub message: String,
}

impl From<&Pin> for PinStatus {
    fn from(pin: &Pin) -> Self {
        PinStatus { reason: pin.reason().to_owned(), message: pin.to_string() }
    }
}

/// What keeps a part from another scale.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct Obstacle {
    /// The scale.
    pub scale: String,
    /// One word.
    pub reason: String,
    /// What binds, with its numbers, and what it would take.
    pub message: String,
    /// What the objective would gain.
    pub gain: f64,
}

impl ApplicationStatus {
    /// The condition of this type.
    #[must_use]
    pub fn condition(&self, r#type: &str) -> Option<&Condition> {
        self.conditions.iter().find(|c| c.r#type == r#type)
    }

    /// The part of this name.
    #[must_use]
    pub fn part(&self, name: &str) -> Option<&PartStatus> {
        self.parts.iter().find(|p| p.name == name)
    }
}

/// A task of a part.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct AttemptStatus {
    /// The Task's name.
    pub name: String,
    /// Its uid; empty: it was created a moment ago.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub uid: String,
    /// Its node.
    pub scale: String,
    /// Which of the part's tasks it is; 1 is the first.
    pub number: u64,
    /// Stands for the template that it was made of.
    pub template: String,
    /// Why it was begun, one word.
    pub reason: String,
    /// Why it was begun, in a sentence.
    pub message: String,
}

/// How far a move has come. The serving task has the connections.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum MoveStage {
    /// There is one task, and nothing is going on.
    #[default]
    Settled,
    /// The next task is starting; the one before serves.
    Making,
    /// The next task is Ready, and is about to serve.
    Switching,
    /// The new task serves, the one before is ending.
    Breaking,
    /// The next task is given up and is ending; the one before goes on.
    Aborting,
    /// The robot was cut off, and has started the part by itself; the task on the other scale is not known to be gone.
    Alone,
}

/// A mapping that came to be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct MappingStatus {
    /// Since when.
    pub since: MicroTime,
    /// The part that moved last.
    pub part: String,
    /// Why, one word.
    pub reason: String,
    /// Why, in a sentence.
    pub message: String,
    /// The parts that were not at home, with their nodes.
    #[serde(default)]
    pub away: BTreeMap<String, String>,
}

/// What is observed of a connection.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct ConnectionStatus {
    /// The topic.
    pub topic: String,
    /// The part that publishes.
    pub from: String,
    /// The part that subscribes.
    pub to: String,
    /// Messages a second, as the subscriber told last.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hz: Option<f64>,
    /// Since when that is less than `minHz`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub below_since: Option<MicroTime>,
}

/// What is observed of a signal.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct SignalStatus {
    /// Its name.
    pub name: String,
    /// What was told last.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value: Option<f64>,
    /// Since when that is outside the limits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub outside_since: Option<MicroTime>,
}

/// A time as the status carries it.
#[must_use]
pub fn stamp(at: jiff::Timestamp) -> MicroTime {
    MicroTime(at)
}

impl PartStatus {
    /// Its tasks: the one that serves first.
    pub fn tasks(&self) -> impl Iterator<Item = &AttemptStatus> {
        [&self.task, &self.other, &self.also, &self.standby].into_iter().flatten()
    }
}
