//! What nodes have and tasks ask for: computation, sensory and action resources (Avalon, III-B).
//!
//! * **CR** ([`Compute`]) is divisible: what a task reserves is used, the rest stays free.
//! * **SR** is shared: any number of tasks may use the same sensor function.
//! * **AR** is exclusive: a task that takes any actuator function of a robot's conflict group
//!   takes all of them.

use std::collections::{BTreeMap, BTreeSet};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::name::{FunctionName, FunctionNameError};
use crate::quantity::{Bytes, MilliCpu};

/// Computation resources: an amount of each divisible thing.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Compute {
    /// Cpu time.
    pub cpu: MilliCpu,
    /// Memory.
    pub memory: Bytes,
    /// Counted extras by name, `gpu: 1`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub extended: BTreeMap<String, u64>,
}

/// One dimension of [`Compute`] in which a request does not fit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Shortage {
    /// More cpu asked than is left.
    Cpu {
        /// What was asked for.
        asked: MilliCpu,
        /// What is left.
        left: MilliCpu,
    },
    /// More memory asked than is left.
    Memory {
        /// What was asked for.
        asked: Bytes,
        /// What is left.
        left: Bytes,
    },
    /// More of a counted extra asked than is left.
    Extended {
        /// The name of the extra.
        name: String,
        /// What was asked for.
        asked: u64,
        /// What is left.
        left: u64,
    },
}

impl Compute {
    /// An amount of cpu and memory, without extras.
    #[must_use]
    pub fn new(cpu: MilliCpu, memory: Bytes) -> Self {
        Compute { cpu, memory, extended: BTreeMap::new() }
    }

    /// The first dimension in which `asked` is more than `self`; none when it fits.
    #[must_use]
    pub fn shortage_for(&self, asked: &Compute) -> Option<Shortage> {
        if asked.cpu > self.cpu {
            return Some(Shortage::Cpu { asked: asked.cpu, left: self.cpu });
        }
        if asked.memory > self.memory {
            return Some(Shortage::Memory { asked: asked.memory, left: self.memory });
        }
        asked.extended.iter().find_map(|(name, &asked)| {
            let left = self.extended.get(name).copied().unwrap_or(0);
            (asked > left).then(|| Shortage::Extended { name: name.clone(), asked, left })
        })
    }

    /// Adds `other` in every dimension.
    pub fn add(&mut self, other: &Compute) {
        self.cpu += other.cpu;
        self.memory += other.memory;
        for (name, amount) in &other.extended {
            let entry = self.extended.entry(name.clone()).or_default();
            *entry = entry.saturating_add(*amount);
        }
    }

    /// Takes `other` away in every dimension, never below zero.
    pub fn saturating_sub(&mut self, other: &Compute) {
        self.cpu = self.cpu.saturating_sub(other.cpu);
        self.memory = self.memory.saturating_sub(other.memory);
        for (name, amount) in &other.extended {
            if let Some(left) = self.extended.get_mut(name) {
                *left = left.saturating_sub(*amount);
            }
        }
    }
}

/// Why a `--sr-res` or `--ar-res` text cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FunctionListError {
    /// An entry has no `device:` before its functions.
    #[error("{entry:?} names no device; write DEVICE:FUNCTION, several joined by ';'")]
    NoDevice {
        /// The entry.
        entry: String,
    },
    /// A part of an entry is not a name.
    #[error("in {entry:?}")]
    BadName {
        /// The entry.
        entry: String,
        /// What is wrong with the part.
        #[source]
        source: FunctionNameError,
    },
}

/// Reads a list of device functions in both grammars of the paper and that of its released code:
/// `kinect:ImageGen;kinect:LaserGen`, grouped `kinect:ImageGen,LaserGen`, braced
/// `kinect:{ImageGen};gps:{GpsGen}` (Avalon, IV-A2). Order and repetition mean nothing.
///
/// # Errors
///
/// Names the first entry that cannot be read.
pub fn parse_function_list(text: &str) -> Result<BTreeSet<FunctionName>, FunctionListError> {
    let mut functions = BTreeSet::new();
    for entry in text.split(';').map(str::trim).filter(|e| !e.is_empty()) {
        let (device, list) = entry
            .split_once(':')
            .ok_or_else(|| FunctionListError::NoDevice { entry: entry.to_owned() })?;
        let list = list.trim();
        let list = list.strip_prefix('{').and_then(|l| l.strip_suffix('}')).unwrap_or(list);
        for function in list.split(',') {
            let name = FunctionName::new(device.trim(), function.trim())
                .map_err(|source| FunctionListError::BadName { entry: entry.to_owned(), source })?;
            functions.insert(name);
        }
    }
    Ok(functions)
}

/// Prints a set grouped by device, `gps:GpsGen;kinect:ImageGen,LaserGen`; reads back the same.
#[must_use]
pub fn format_function_list(functions: &BTreeSet<FunctionName>) -> String {
    let mut by_device: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for name in functions {
        by_device.entry(name.device()).or_default().push(name.function());
    }
    let groups: Vec<String> = by_device
        .into_iter()
        .map(|(device, functions)| format!("{device}:{}", functions.join(",")))
        .collect();
    groups.join(";")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(text: &str) -> String {
        format_function_list(&parse_function_list(text).expect(text))
    }

    #[test]
    fn all_grammars_of_the_paper_mean_the_same() {
        let grouped = "gps:GpsGen;kinect:ImageGen,LaserGen";
        assert_eq!(list("kinect:ImageGen;kinect:LaserGen;gps:GpsGen"), grouped);
        assert_eq!(list("kinect:ImageGen,LaserGen;gps:GpsGen"), grouped);
        assert_eq!(list("kinect:{LaserGen};gps:{GpsGen};kinect:{ImageGen}; "), grouped);
        assert_eq!(list(""), "");
    }

    #[test]
    fn a_list_that_cannot_be_read_names_the_entry() {
        assert_eq!(
            parse_function_list("base:Drive;kinect").expect_err("no colon"),
            FunctionListError::NoDevice { entry: "kinect".to_owned() }
        );
        assert!(
            matches!(parse_function_list("a:,"), Err(FunctionListError::BadName { entry, .. }) if entry == "a:,")
        );
    }

    #[test]
    fn a_shortage_names_the_first_dimension_that_does_not_fit() {
        let mut free = Compute::new(MilliCpu(1000), Bytes(1 << 30));
        let mut asked = Compute::new(MilliCpu(1000), Bytes(1 << 30));
        assert_eq!(free.shortage_for(&asked), None);
        asked.extended.insert("gpu".to_owned(), 1);
        assert_eq!(
            free.shortage_for(&asked),
            Some(Shortage::Extended { name: "gpu".to_owned(), asked: 1, left: 0 })
        );
        free.saturating_sub(&Compute::new(MilliCpu(1), Bytes(0)));
        assert_eq!(
            free.shortage_for(&asked),
            Some(Shortage::Cpu { asked: MilliCpu(1000), left: MilliCpu(999) })
        );
    }
}
