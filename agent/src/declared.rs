//! What this node declared of itself last, for an agent that is started again without saying it.
//! `declared.json` in the data directory; written after a join, so that only a node that exists has one.

use std::collections::BTreeMap;
use std::path::Path;

use muster_failpoint::Failpoint;
use serde::{Deserialize, Serialize};

use crate::durable::{self, FileError, Keep};
use crate::position::settings::PoseArgs;

const FILE: &str = "declared.json";

/// The node's own part of the settings, as written by the user. Absent: not said.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(crate) struct Declared {
    /// As a whole: a label that is left out of a list is gone.
    pub(crate) labels: Option<BTreeMap<String, String>>,
    pub(crate) sr_res: Option<String>,
    pub(crate) ar_res: Option<String>,
    pub(crate) map: Option<String>,
    pub(crate) position: Option<String>,
    pub(crate) pose: PoseArgs,
    pub(crate) cpu: Option<String>,
    pub(crate) memory: Option<String>,
    pub(crate) speed: Option<f64>,
    pub(crate) battery: Option<String>,
}

impl Declared {
    /// What was declared last; nothing, in a directory that has not joined.
    pub(crate) fn last(data_dir: &Path) -> Result<Declared, FileError> {
        Ok(durable::read_json(&data_dir.join(FILE))?.unwrap_or_default())
    }

    /// Keeps it for the next start.
    pub(crate) fn keep(&self, data_dir: &Path) -> Result<(), FileError> {
        if Self::last(data_dir).is_ok_and(|last| last == *self) {
            return Ok(());
        }
        durable::write_json(Failpoint::AgentDeclared, &data_dir.join(FILE), self, Keep::PowerCut)
    }

    /// Takes from `last` what is not said now. Returns the flags that were remembered so.
    pub(crate) fn remember(&mut self, last: Declared) -> Vec<&'static str> {
        let mut remembered = Vec::new();
        let mut one = |flag, taken: bool| {
            if taken {
                remembered.push(flag);
            }
        };
        one("--label", fill(&mut self.labels, last.labels));
        one("--sr-res", fill(&mut self.sr_res, last.sr_res));
        one("--ar-res", fill(&mut self.ar_res, last.ar_res));
        one("--map", fill(&mut self.map, last.map));
        one("--position", fill(&mut self.position, last.position));
        self.pose.fill(last.pose).into_iter().for_each(|flag| one(flag, true));
        one("--cpu", fill(&mut self.cpu, last.cpu));
        one("--memory", fill(&mut self.memory, last.memory));
        one("--speed", fill(&mut self.speed, last.speed));
        one("--battery", fill(&mut self.battery, last.battery));
        remembered
    }
}

fn fill<T>(now: &mut Option<T>, last: Option<T>) -> bool {
    if now.is_some() || last.is_none() {
        return false;
    }
    *now = last;
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_said_now_wins_per_field() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(Declared::last(dir.path()).unwrap(), Declared::default());
        let last = Declared {
            sr_res: Some("kinect:ImageGen".to_owned()),
            ar_res: Some("base:Drive".to_owned()),
            cpu: Some("500m".to_owned()),
            ..Declared::default()
        };
        last.keep(dir.path()).unwrap();
        let mut now = Declared {
            // Said, and nothing: the robot has lost its arm.
            ar_res: Some(String::new()),
            cpu: Some("1".to_owned()),
            ..Declared::default()
        };
        let remembered = now.remember(Declared::last(dir.path()).unwrap());
        assert_eq!(remembered, ["--sr-res"]);
        let expected = Declared { ar_res: now.ar_res.clone(), cpu: Some("1".to_owned()), ..last };
        assert_eq!(now, expected);
    }
}
