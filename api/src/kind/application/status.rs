//! Where an Application's parts are, and why.

use std::collections::BTreeMap;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
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
    /// `Managed`, `Characterised`, `FitsHome`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub conditions: Vec<Condition>,
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
    /// The node where it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<String>,
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
    pub moved_at: Option<Time>,
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
