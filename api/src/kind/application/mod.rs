//! Application: parts that belong together, some of which may leave their robot for a stronger computer and come back
//! (AnyScale).
//!
//! What is written down is what the paper characterises offline (III-B): the parts with their cpu on each scale, the
//! connections with threshold frequency, tolerance Δ and bandwidth. [`pin`] derives from it which parts never leave the
//! robot. Where the others are at a moment is decided in `muster_controller_core::offload`, and stands in the status.

pub mod pin;
mod rules;
mod status;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use status::{
    ApplicationPhase, ApplicationStatus, AttemptStatus, ConnectionStatus, MAX_TIMELINE,
    MappingStatus, MoveStage, Obstacle, PartClass, PartStatus, PinStatus, SignalStatus, stamp,
};

use super::KindInfo;
use super::task::TaskSpec;
use super::taskset::TemplateMetadata;
use crate::duration::Span;
use crate::quantity::{BitRate, MilliCpu};
use crate::selector::LabelSelector;

/// On each task of an application: its name.
pub const APPLICATION_LABEL: &str = "muster.dev/application";
/// On each task of an application: the part.
pub const PART_LABEL: &str = "muster.dev/part";

/// Parts and connections, and how they may be spread over the robot and the scales.
#[derive(CustomResource, Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[kube(
    group = "muster.dev",
    version = "v1alpha1",
    kind = "Application",
    plural = "applications",
    namespaced,
    status = "ApplicationStatus",
    derive = "PartialEq",
    shortname = "app"
)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ApplicationSpec {
    /// The robot that it belongs to: the paper's master scale, where everything can run.
    pub home: String,
    /// Where parts may run besides.
    #[serde(default)]
    pub scales: Scales,
    /// What it consists of.
    pub parts: Vec<Part>,
    /// Who publishes to whom.
    #[serde(default)]
    pub connections: Vec<Connection>,
    /// What else must hold while parts are away, such as AnyScale's 4 degrees a second.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub signals: Vec<Signal>,
    /// What is maximised.
    #[serde(default)]
    pub objective: Objective,
    /// Who decides.
    #[serde(default)]
    pub policy: Policy,
    /// Between two looks for something better; a violation does not wait for it.
    #[serde(default = "default_period")]
    pub period: Span,
    /// A part that was moved is not moved again within this time, unless a violation brings it home (the paper's T).
    #[serde(default = "default_cooldown")]
    pub cooldown: Span,
    /// How long it takes at most until a part that is brought home serves there. It is begun that much before the
    /// tolerance of what is violated ends.
    #[serde(default = "default_return_time")]
    pub return_time: Span,
}

fn default_period() -> Span {
    Span::from_secs(1)
}

fn default_cooldown() -> Span {
    Span::from_secs(10)
}

fn default_return_time() -> Span {
    Span::from_millis(500)
}

/// Where parts may run besides home. Nothing given: every Cloud node.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Scales {
    /// By name.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<String>,
    /// By labels, robots too.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub selector: Option<LabelSelector>,
    /// The paper's α by node: what a millicore there is worth, when one at home is worth 1. A node that is not named has
    /// the ratio of its cores to home's, and at least 1.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub gains: BTreeMap<String, f64>,
}

/// One program of the application: a ROS node, in the paper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Part {
    /// Its name among the parts.
    pub name: String,
    /// When it runs.
    #[serde(default)]
    pub runs: Runs,
    /// Of a part that runs sometimes: which share of the time, above 0 to 1. What moving it is worth is that much less; its
    /// cpu and bandwidth are kept for it all the same.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub duty: Option<f64>,
    /// Mean use of cpu at home, measured with tools like `top` or `muster top`. None: as it is measured while it runs, and
    /// until then `resources.cpu` of its task.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cpu: Option<MilliCpu>,
    /// Mean use of cpu on other scales, by node; of those that are not named it is as at home.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub cpu_on: BTreeMap<String, MilliCpu>,
    /// What its cpu counts in the objective, when others' counts 1.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub gain: f64,
    /// How good its results are at home, 0 to 1, when they are 1 elsewhere (lower resolution, fewer particles). Counts with
    /// the weight `objective.accuracy`.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub home_accuracy: f64,
    /// What its robot does when it is cut off while the part is away.
    #[serde(default, skip_serializing_if = "CutOff::is_default")]
    pub when_cut_off: CutOff,
    /// The task that it is. Sensors and actuators keep the part at home.
    pub template: PartTemplate,
}

fn one() -> f64 {
    1.0
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_one(value: &f64) -> bool {
    *value == 1.0
}

/// When a part runs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Runs {
    /// All the time.
    #[default]
    Always,
    /// When it is needed. While it is idle nothing is expected on its connections.
    Sometimes,
    /// It gives its data once and is done: a map server. It stays at home, and its connections have no frequency.
    Once,
}

/// What a robot does that is cut off while a part of it is away. Of a part none of whose connections has a `minHz` nothing is
/// urgent: it is always `Fenced`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum CutOff {
    /// It begins the part before the tolerance of its connections is over, and not before it has been without contact for
    /// 5 s: a controller that is started again disturbs nobody. For some seconds what is away may run beside it, where the
    /// robot cannot see it: until the controller has noticed, or its own node.
    #[default]
    InTime,
    /// It begins the part when what is away has surely ended, however little its connections tolerate. For a part that
    /// writes where others read, and must never do so twice.
    Fenced,
}

impl CutOff {
    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
    fn is_default(&self) -> bool {
        *self == CutOff::default()
    }
}

/// What a part's task is made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct PartTemplate {
    /// Labels and annotations of the task.
    #[serde(default, skip_serializing_if = "TemplateMetadata::is_empty")]
    pub metadata: TemplateMetadata,
    /// Its spec. A `restartPolicy` that is left out is Always, and OnFailure of a part that runs once.
    pub spec: TaskSpec,
}

/// A topic from one part to another.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Connection {
    /// The topic.
    pub topic: String,
    /// The part that publishes.
    pub from: String,
    /// The part that subscribes.
    pub to: String,
    /// The threshold: below this the subscriber does not work as it should. None: it is not watched, as of parts that run
    /// once.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_hz: Option<f64>,
    /// The frequency that serves best.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub opt_hz: Option<f64>,
    /// The paper's Δ: for how long the frequency may be below the threshold, or 0. With `0s` both parts are critical.
    #[serde(default)]
    pub tolerance: Span,
    /// What it needs of the network when its ends are apart, bits a second at `optHz`.
    #[serde(default)]
    pub bandwidth: BitRate,
}

/// Something measured that must stay within limits while parts are away; outside of them for longer than `tolerance` is a
/// violation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Signal {
    /// What it is called.
    pub name: String,
    /// Its unit, for people: `deg/s`.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub unit: String,
    /// Most that is right.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max: Option<f64>,
    /// Least that is right.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min: Option<f64>,
    /// For how long it may be outside.
    #[serde(default)]
    pub tolerance: Span,
    /// The parts that come home for it; none: all that are away.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub parts: Vec<String>,
}

/// What is maximised: a sum of terms, each with its weight.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Objective {
    /// Of Σ cpuUsage·α in cores (AnyScale, eq. 1).
    pub cpu: f64,
    /// Taken away for each second of the network's latency between the ends of a connection.
    pub latency: f64,
    /// Taken away for each core that is used at home, which drains the battery, and for each 100 Mbit/s of its radio.
    pub energy: f64,
    /// Added for each part whose results are as good as they can be; see `homeAccuracy`.
    pub accuracy: f64,
    /// A part moves only for a gain of at least this share of what it is worth where it is, so that noise in what is
    /// measured moves nothing.
    pub hysteresis: f64,
}

impl Default for Objective {
    fn default() -> Self {
        Objective { cpu: 1.0, latency: 0.0, energy: 0.0, accuracy: 0.0, hysteresis: 0.05 }
    }
}

/// Who decides where parts are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Policy {
    /// Branch and bound: the best mapping, or one with a proven gap.
    #[default]
    Optimal,
    /// The paper's Algorithm 1: one part a look, the hungriest to the strongest scale that takes it.
    Greedy,
    /// Everything stays at home.
    Home,
}

/// The name of a part's task, which `rules` keep short enough. Numbers come again after a hundred thousand.
#[must_use]
pub fn task_name(application: &str, part: &str, number: u64) -> String {
    format!("{application}-{part}-{}", number % 100_000)
}

impl ApplicationSpec {
    /// The part of this name.
    #[must_use]
    pub fn part(&self, name: &str) -> Option<&Part> {
        self.parts.iter().find(|p| p.name == name)
    }
}

impl PartTemplate {
    /// Letters that stand for what it says: a changed template has others.
    ///
    /// # Panics
    ///
    /// Never: a template is texts, numbers, lists and maps.
    #[must_use]
    pub fn digest(&self) -> String {
        let text = serde_json::to_vec(self).expect("a template serializes to JSON");
        super::taskset::digest(&text, 0)
    }
}

impl Part {
    /// The share of the time that it runs.
    #[must_use]
    pub fn share(&self) -> f64 {
        match self.runs {
            Runs::Always => 1.0,
            Runs::Sometimes => self.duty.unwrap_or(1.0),
            Runs::Once => 0.0,
        }
    }
}

pub(super) const INFO: KindInfo = KindInfo {
    group: crate::GROUP,
    version: crate::VERSION,
    kind: "Application",
    plural: "applications",
    singular: "application",
    short_names: &["app"],
    namespaced: true,
    has_status: true,
    selectable: &[],
    admit_body: rules::admit_body,
    admit_change: rules::change_rules,
    schema: |g| g.subschema_for::<Application>(),
};
