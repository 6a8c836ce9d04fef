//! Control groups, version 1 and 2: one group per attempt, made and limited by the agent before the
//! attempt's shim exists, emptied and removed by the shim (or by the agent, when the shim is lost).
//!
//! | module | holds |
//! |---|---|
//! | [`hierarchy`] | what is mounted where, and where this agent may make groups |
//! | [`place`] | v2: below which group |
//! | [`claim`] | which roots are whose; removing those of dead agents |
//! | [`limits`] | limits → kernel files, through cgroups-rs' controllers; each one read back |
//! | [`group`] | a made group: enter, list, freeze, kill, evidence of OOM, usage, remove |
//! | [`device`] | the block device under a directory, for I/O rates |
//!
//! `cgroups-rs` writes the limits; it is kept away from the rest: its builder swallows errors, its
//! v2 root is fixed, and its delete sleeps.

mod claim;
pub(crate) mod device;
pub(crate) mod group;
pub(crate) mod hierarchy;
pub(crate) mod limits;
mod place;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use muster_failpoint::{Failpoint, Step, reach};

use crate::runtime::Limits;
use group::Group;
use hierarchy::{Hierarchy, HierarchyError};
use limits::LimitError;

/// The controllers that a task's limits need. On v1 `cpuacct` and `freezer` are controllers too.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize, serde::Deserialize,
)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Controller {
    /// Quota and weight.
    Cpu,
    /// Time used (v1 only; v2 has it in `cpu.stat`).
    Cpuacct,
    /// Limit and OOM evidence.
    Memory,
    /// Number of processes.
    Pids,
    /// I/O rates (`io` on v2).
    Blkio,
    /// Freezing (v1 only; on v2 every group can be frozen).
    Freezer,
}

/// Holds a group that is in use to other limits.
pub(crate) fn resize(group: &Group, limits: &Limits) -> Result<(), LimitError> {
    limits::resize(group, limits)
}

/// What the agent needs of a kernel that enforces quotas. [`Kernel`] is the real one.
pub(crate) trait Enforcer: Send + Sync + std::fmt::Debug {
    /// Makes a group of that name, empty and limited. Every limit was read back from the kernel.
    fn make(&self, name: &str, limits: &Limits, disk: &Path) -> Result<Group, LimitError>;
    /// The groups that exist under this agent's root, by name.
    fn existing(&self) -> BTreeMap<String, Group>;
    /// Removes this agent's root if no group is left in it.
    fn retire(&self);
}

/// Groups below this agent's own root in each hierarchy.
#[derive(Debug)]
pub(crate) struct Kernel {
    hierarchy: Hierarchy,
    /// For life: other agents know by it that this one lives.
    _claim: Option<claim::Held>,
}

impl Kernel {
    /// Finds the hierarchies and makes this agent's root in them. `identity` is the data
    /// directory's, so that agents with different directories never see one another's groups.
    pub(crate) fn open(identity: &str) -> Result<Kernel, HierarchyError> {
        let hierarchy = Hierarchy::detect(identity)?;
        let _gate = hierarchy.gate()?;
        hierarchy.make_roots()?;
        let claim = hierarchy.claim()?;
        hierarchy.sweep_dead();
        Ok(Kernel { hierarchy, _claim: claim })
    }

    /// Where docker's containers would be found: the mounts by controller.
    pub(crate) fn hierarchy(&self) -> &Hierarchy {
        &self.hierarchy
    }

    fn group(&self, name: &str) -> Group {
        let dirs: BTreeMap<Controller, PathBuf> =
            self.hierarchy.roots().iter().map(|(c, root)| (*c, root.join(name))).collect();
        Group::new(self.hierarchy.version(), dirs)
    }
}

impl Enforcer for Kernel {
    fn retire(&self) {
        match self.hierarchy.gate() {
            Ok(_gate) => {
                self.hierarchy.sweep_dead();
                self.hierarchy.remove_roots();
            }
            Err(error) => tracing::warn!(%error, "the agent's own groups stay behind"),
        }
    }

    fn make(&self, name: &str, limits: &Limits, disk: &Path) -> Result<Group, LimitError> {
        let group = self.group(name);
        reach(Failpoint::Group, Step::Before);
        group.create().map_err(|source| LimitError::Create { name: name.to_owned(), source })?;
        reach(Failpoint::Group, Step::Half);
        let made = limits::apply(&group, limits, disk);
        if let Err(error) = made {
            // Nothing entered it yet; a failure to remove it is left to the next sweep.
            let _ = group.remove();
            return Err(error);
        }
        reach(Failpoint::Group, Step::After);
        Ok(group)
    }

    fn existing(&self) -> BTreeMap<String, Group> {
        let mut names = std::collections::BTreeSet::new();
        for root in self.hierarchy.roots().values() {
            for entry in std::fs::read_dir(root).into_iter().flatten().flatten() {
                if entry.file_type().is_ok_and(|kind| kind.is_dir())
                    && let Ok(name) = entry.file_name().into_string()
                    && name != hierarchy::AGENT_LEAF
                {
                    names.insert(name);
                }
            }
        }
        names.into_iter().map(|name| (name.clone(), self.group(&name))).collect()
    }
}
