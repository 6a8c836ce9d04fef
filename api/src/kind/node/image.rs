//! Images that a node is to have before a task needs them, and how it stands with them.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::kind::task::PullPolicy;

/// An image that somebody wants a node to have. Two wishes are the same when all of them is: a later one of an image that is
/// pulled `Always` is another one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct ImageWish {
    /// As a container names it.
    pub image: String,
    /// What is done for it.
    #[serde(default)]
    pub pull_policy: PullPolicy,
    /// Since when it is wanted, by the controller's clock.
    pub since: MicroTime,
}

impl ImageWish {
    /// A wish that begins now.
    #[must_use]
    pub fn new(image: &str, pull_policy: PullPolicy, now: jiff::Timestamp) -> Self {
        ImageWish { image: image.to_owned(), pull_policy, since: MicroTime(now) }
    }
}

/// How it stands with a wish.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct ImageStatus {
    /// What is wanted.
    pub wish: ImageWish,
    /// How far it is.
    pub phase: ImagePhase,
    /// Why the last pull failed, one CamelCase word; empty: none has.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub reason: String,
    /// The same in a sentence.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub message: String,
    /// Pulls that have failed.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub failures: u32,
}

fn is_zero(n: &u32) -> bool {
    *n == 0
}

/// How far an image is on its way to a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum ImagePhase {
    /// Others are pulled before it.
    Waiting,
    /// It is looked for, or pulled.
    Pulling,
    /// The node has it.
    Pulled,
    /// It could not be had; it is tried again, later each time.
    BackOff,
}

impl ImagePhase {
    /// The word for people.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            ImagePhase::Waiting => "Waiting",
            ImagePhase::Pulling => "Pulling",
            ImagePhase::Pulled => "Pulled",
            ImagePhase::BackOff => "BackOff",
        }
    }
}
