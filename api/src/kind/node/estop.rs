//! The emergency stop of a robot, apart from its leases: whoever holds it, it stands.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Taint of a robot that is stopped, while the condition `EmergencyStop` holds.
pub const ESTOP_TAINT: &str = "muster.dev/emergency-stop";

/// Annotation of a Node: when a person last ordered a stop. A stop that is as far as the one before is written, too, so that a
/// release which was decided before it does not count.
pub const ORDERED: &str = "muster.dev/estop-ordered";

/// How far a robot is stopped. The order is that of restriction.
#[derive(
    Debug,
    Clone,
    Copy,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    JsonSchema,
)]
pub enum EStopTier {
    /// It may move.
    #[default]
    None,
    /// Its drivers get their stop command, and no other command passes.
    Settle,
    /// The same, and its drivers cut the motors' power.
    Cut,
}

impl EStopTier {
    /// It may move.
    #[must_use]
    pub fn is_none(&self) -> bool {
        *self == EStopTier::None
    }

    /// The tier of a number on the wire; one that is not known is the most restrictive.
    #[must_use]
    pub fn from_number(number: u32) -> Self {
        match number {
            0 => EStopTier::None,
            1 => EStopTier::Settle,
            _ => EStopTier::Cut,
        }
    }

    /// Its number on the wire.
    #[must_use]
    pub fn number(self) -> u32 {
        self as u32
    }
}

impl fmt::Display for EStopTier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            EStopTier::None => "None",
            EStopTier::Settle => "Settle",
            EStopTier::Cut => "Cut",
        })
    }
}

/// What stops the robot, as its gate says.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct EStopStatus {
    /// The most restrictive of all that is demanded.
    pub tier: EStopTier,
    /// The number of the newest stop; `spec.estopRelease` must name it to release everything.
    pub number: u64,
    /// Who demands what. What was demanded on the robot stays until a person releases it.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub demands: Vec<EStopDemand>,
}

/// What one source demands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct EStopDemand {
    /// `the controller`, `button on the robot`.
    pub source: String,
    /// How far.
    pub tier: EStopTier,
}
