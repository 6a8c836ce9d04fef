//! Which roots are whose, among agents that share a base.
//!
//! Every agent holds a lock on its own root for life, and makes and removes roots only under the lock
//! of the level above, the gate. So a root whose lock is free is a dead agent's, and an agent that
//! just starts cannot lose the root that it has just made. The kernel drops the locks with their
//! holder, however it ends; nothing else has to be kept anywhere.

use std::fs::{self, File, Permissions};
use std::io;
use std::os::fd::AsFd;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rustix::fs::FlockOperation;

use super::Controller;
use super::hierarchy::{AGENT_LEAF, Hierarchy, HierarchyError};

/// Says that a root's agent keeps the lock. A root without it is nobody's to judge: it is being made
/// at this moment, or its agent is of a version that knows no lock.
const MARK: u32 = 0o1000;

/// Gates are held for some file operations, roots of one's own by nobody else.
const PATIENCE: Duration = Duration::from_secs(5);

/// A lock on a directory, until it is dropped.
#[derive(Debug)]
pub(super) struct Held(#[expect(dead_code, reason = "its lock is its purpose")] File);

fn try_lock(dir: &Path) -> io::Result<Option<Held>> {
    let file = File::open(dir)?;
    match rustix::fs::flock(file.as_fd(), FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(Some(Held(file))),
        Err(rustix::io::Errno::WOULDBLOCK) => Ok(None),
        Err(errno) => Err(errno.into()),
    }
}

fn lock(dir: &Path) -> Result<Held, HierarchyError> {
    let until = Instant::now() + PATIENCE;
    loop {
        match try_lock(dir) {
            Ok(Some(held)) => return Ok(held),
            Ok(None) if Instant::now() < until => std::thread::sleep(Duration::from_millis(2)),
            Ok(None) => return Err(HierarchyError::Held { dir: dir.to_owned() }),
            Err(source) => return Err(HierarchyError::Denied { dir: dir.to_owned(), source }),
        }
    }
}

impl Hierarchy {
    /// The root whose lock stands for all roots of an agent, and the level above it.
    fn key(&self) -> Option<(&Path, &Path)> {
        let root = self.roots().get(&Controller::Cpu)?;
        Some((root, root.parent()?))
    }

    /// Keeps every other agent of this base from making or removing roots.
    pub(super) fn gate(&self) -> Result<Option<Held>, HierarchyError> {
        let Some((_, shared)) = self.key() else { return Ok(None) };
        let denied = |source| HierarchyError::Denied { dir: shared.to_owned(), source };
        fs::create_dir_all(shared).map_err(denied)?;
        lock(shared).map(Some)
    }

    /// Takes the lock of this agent's own root. Behind the gate.
    pub(super) fn claim(&self) -> Result<Option<Held>, HierarchyError> {
        let Some((root, _)) = self.key() else { return Ok(None) };
        let held = lock(root)?;
        let denied = |source| HierarchyError::Denied { dir: root.to_owned(), source };
        let mode = fs::metadata(root).map_err(denied)?.permissions().mode();
        fs::set_permissions(root, Permissions::from_mode(mode | MARK)).map_err(denied)?;
        Ok(Some(held))
    }

    /// Removes the roots of dead agents of which nothing lives. Behind the gate.
    pub(super) fn sweep_dead(&self) {
        let Some((own, shared)) = self.key() else { return };
        for entry in fs::read_dir(shared).into_iter().flatten().flatten() {
            let (dir, name) = (entry.path(), entry.file_name());
            let marked = entry.metadata().is_ok_and(|m| m.permissions().mode() & MARK != 0);
            if dir == own || !marked {
                continue;
            }
            let Ok(Some(_held)) = try_lock(&dir) else { continue };
            // The one with the lock goes last: what a crash leaves is still found by it.
            for root in self.distinct_roots().into_iter().rev() {
                remove_empty(&root.with_file_name(&name));
            }
            if !dir.exists() {
                tracing::info!(root = %dir.display(), "the groups of a dead agent are removed");
            }
        }
    }

    /// Every root once, the one with the lock first.
    pub(super) fn distinct_roots(&self) -> Vec<&PathBuf> {
        let mut roots: Vec<&PathBuf> = self.roots().values().collect();
        roots.dedup();
        roots
    }
}

/// Removes a root in which nothing is; the kernel keeps one that has groups or processes.
fn remove_empty(root: &Path) {
    let _ = fs::remove_dir(root.join(AGENT_LEAF));
    let _ = fs::remove_dir(root);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::cgroup::hierarchy::Version;

    fn agent(base: &Path, identity: &str) -> Hierarchy {
        let roots = [(Controller::Cpu, "cpu"), (Controller::Memory, "memory")]
            .map(|(controller, name)| (controller, base.join(name).join("muster").join(identity)));
        for (_, root) in &roots {
            fs::create_dir_all(root).unwrap();
        }
        Hierarchy::of(Version::V1, roots.into())
    }

    #[test]
    fn only_what_is_provably_dead_and_empty_goes() {
        let dir = tempfile::tempdir().unwrap();
        let (living, dead) = (agent(dir.path(), "living"), agent(dir.path(), "dead"));
        let (busy, older) = (agent(dir.path(), "busy"), agent(dir.path(), "older"));
        let lock = living.claim().unwrap();
        drop(dead.claim().unwrap());
        drop(busy.claim().unwrap());
        // A task that outlives its agent.
        fs::create_dir(busy.roots()[&Controller::Memory].join("task.1")).unwrap();
        fs::create_dir(busy.roots()[&Controller::Cpu].join("task.1")).unwrap();

        let own = agent(dir.path(), "own");
        let gate = own.gate().unwrap();
        let claim = own.claim().unwrap();
        own.sweep_dead();
        let there = |hierarchy: &Hierarchy| {
            hierarchy.distinct_roots().into_iter().map(|root| root.exists()).collect::<Vec<_>>()
        };
        assert_eq!(there(&dead), [false, false]);
        for other in [&living, &busy, &older, &own] {
            assert_eq!(there(other), [true, true]);
        }
        drop((lock, gate, claim));
        own.sweep_dead();
        assert_eq!(there(&living), [false, false]);
    }
}
