//! Below which group an agent makes its own, on v2.
//!
//! A group with processes cannot hand controllers to its children, so whoever stands in the chosen
//! group steps into a leaf of it. That is right where the group was given to this agent: one that a
//! service manager delegated (systemd: `Delegate=yes`, and `DelegateSubgroup=` one level deeper), the
//! root of a container's own view of the tree, or any group in which the agent is alone. Otherwise
//! the group is somebody else's (a login session), and the root of the tree is used, as by the kubelet;
//! an agent that may not write there enforces nothing, and says so.
//!
//! A service that leaves its tasks running while it is down needs `DelegateSubgroup=`: without it
//! systemd starts the agent anew in a group that hands controllers down, which the kernel refuses.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// What systemd writes on a group that it delegated; the second is for versions before 251.
const DELEGATED: [&str; 2] = ["user.delegate", "trusted.delegate"];

/// Moving processes races with their forks; a fork bomb must not hold the start up for ever.
const ROUNDS: usize = 10;

/// One group, as far as the choice depends on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Place {
    /// Of the whole machine: there processes and controllers go together.
    tree_root: bool,
    /// Its manager has given it away, to whom runs in it.
    delegated: bool,
    /// No process but this one is directly in it.
    alone: bool,
}

/// What was chosen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Base {
    /// The group that controllers are handed down from.
    pub(super) dir: PathBuf,
    /// The group that this agent was started in.
    pub(super) origin: PathBuf,
    /// Its processes have to go into a leaf before controllers are handed down.
    pub(super) to_be_cleared: bool,
}

impl Base {
    /// `own`: the group of this process, below the mount point `top` or `top` itself.
    pub(super) fn find(own: &Path, top: &Path) -> Base {
        let dirs: Vec<&Path> = own.ancestors().take_while(|dir| dir.starts_with(top)).collect();
        let places: Vec<Place> = dirs.iter().map(|dir| look(dir, *dir == top)).collect();
        let chosen = choose(&places);
        Base {
            dir: dirs.get(chosen).map_or(top, |dir| *dir).to_owned(),
            origin: own.to_owned(),
            to_be_cleared: places.get(chosen).is_some_and(|place| !place.tree_root),
        }
    }

    /// Makes room: what is directly in the group goes into `leaf`.
    pub(super) fn clear(&self, leaf: &Path) -> io::Result<()> {
        if !self.to_be_cleared {
            return Ok(());
        }
        fs::create_dir_all(leaf)?;
        move_all(&self.dir, leaf)
    }

    /// Takes `clear` and the handing down back, when nothing else is below the base than `root`, the
    /// agent's own, in which only the leaf is left. Nothing may be made below the base meanwhile.
    pub(super) fn restore(&self, root: &Path, leaf: &Path) -> io::Result<()> {
        let Some(shared) = root.parent() else { return Ok(()) };
        if !self.to_be_cleared || only_child(root).as_deref() != Some(leaf) {
            return Ok(());
        }
        if self.origin == self.dir {
            let unused = only_child(shared).as_deref() == Some(root)
                && only_child(&self.dir).as_deref() == Some(shared);
            if !unused {
                // Whoever sweeps next finds the leaf without a process.
                return Ok(());
            }
            for dir in [root, shared, &self.dir] {
                let file = dir.join("cgroup.subtree_control");
                for name in fs::read_to_string(&file)?.split_whitespace() {
                    fs::write(&file, format!("-{name}"))?;
                }
            }
        }
        move_all(leaf, &self.origin)?;
        fs::remove_dir(leaf)
    }
}

/// From the agent's own group up to the top: which one. The rules are in the module's header.
fn choose(places: &[Place]) -> usize {
    let given = places.iter().take(2).position(|place| place.delegated && !place.tree_root);
    let own = || places.first().filter(|own| own.alone && !own.tree_root).map(|_| 0);
    given.or_else(own).unwrap_or_else(|| places.len().saturating_sub(1))
}

fn look(dir: &Path, top: bool) -> Place {
    // Every group but the tree's root has a type.
    let tree_root = top && !dir.join("cgroup.type").exists();
    let namespace_root = top && !tree_root;
    Place { tree_root, delegated: namespace_root || is_delegated(dir), alone: alone_in(dir) }
}

fn is_delegated(dir: &Path) -> bool {
    DELEGATED.iter().any(|name| {
        let mut value = [0; 8];
        rustix::fs::getxattr(dir, *name, &mut value).is_ok_and(|size| value[..size] == *b"1")
    })
}

fn alone_in(dir: &Path) -> bool {
    let me = std::process::id();
    let Ok(procs) = fs::read_to_string(dir.join("cgroup.procs")) else { return false };
    procs.lines().all(|line| line.trim().parse() == Ok(me))
}

fn move_all(from: &Path, to: &Path) -> io::Result<()> {
    let to = to.join("cgroup.procs");
    for _ in 0..ROUNDS {
        let procs = fs::read_to_string(from.join("cgroup.procs"))?;
        if procs.trim().is_empty() {
            break;
        }
        for pid in procs.lines() {
            match fs::write(&to, pid) {
                // It has ended meanwhile.
                Err(error) if error.raw_os_error() == Some(libc::ESRCH) => {}
                done => done?,
            }
        }
    }
    Ok(())
}

/// The one group directly below `dir`, if there is exactly one.
fn only_child(dir: &Path) -> Option<PathBuf> {
    let entries = fs::read_dir(dir).ok()?.flatten();
    let mut groups = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
    let first = groups.next()?;
    groups.next().is_none().then(|| first.path())
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROOT: Place = Place { tree_root: true, delegated: false, alone: false };
    const SHARED: Place = Place { tree_root: false, delegated: false, alone: false };
    const ALONE: Place = Place { alone: true, ..SHARED };
    const GIVEN: Place = Place { delegated: true, ..SHARED };

    #[test]
    fn a_group_that_was_given_to_the_agent_or_that_it_is_alone_in_else_the_root() {
        let cases: [(&str, &[Place], usize); 8] = [
            ("the tree's root", &[ROOT], 0),
            ("a service that is delegated", &[GIVEN, ALONE, ROOT], 0),
            ("and starts through a shell", &[GIVEN, SHARED, ROOT], 0),
            ("a subgroup of such a service", &[ALONE, GIVEN, SHARED, ROOT], 1),
            ("a service that is not delegated", &[ALONE, SHARED, ROOT], 0),
            ("a login session", &[SHARED, SHARED, ROOT], 2),
            ("a terminal under a user's own manager", &[SHARED, SHARED, GIVEN, ROOT], 3),
            ("a container with a tree of its own", &[GIVEN], 0),
        ];
        for (what, places, expected) in cases {
            assert_eq!(choose(places), expected, "{what}");
        }
    }

    #[test]
    fn the_kernels_files_tell_the_places_apart() {
        let dir = tempfile::tempdir().unwrap();
        let service = dir.path().join("system.slice/muster-agent.service");
        fs::create_dir_all(&service).unwrap();
        for group in [service.as_path(), service.parent().unwrap()] {
            fs::write(group.join("cgroup.type"), "domain\n").unwrap();
        }
        fs::write(service.join("cgroup.procs"), format!("{}\n", std::process::id())).unwrap();
        let base = Base::find(&service, dir.path());
        assert_eq!((&base.dir, base.to_be_cleared), (&service, true));
        // Not alone: the root of the tree, which needs no leaf.
        fs::write(service.join("cgroup.procs"), "1\n2\n").unwrap();
        let base = Base::find(&service, dir.path());
        assert_eq!((base.dir.as_path(), base.to_be_cleared), (dir.path(), false));
        // The top of a container's view has a type: it is no root of a machine.
        fs::write(dir.path().join("cgroup.type"), "domain\n").unwrap();
        let base = Base::find(dir.path(), dir.path());
        assert_eq!((base.dir.as_path(), base.to_be_cleared), (dir.path(), true));
    }
}
