//! The control groups of the demo's agents. An agent leaves its own group behind, for its next life; the
//! demo's agents have none.
//!
//! Only empty groups are removed: the kernel refuses to remove one that has a process.

use std::fs;
use std::path::{Path, PathBuf};

use serde::Deserialize;

/// What is of interest in an agent's `agent.json`: it names its groups.
#[derive(Debug, Deserialize)]
struct Identity {
    id: String,
}

/// The groups of the agent with this data directory, in every hierarchy.
pub(super) fn of_agent(data_dir: &Path) -> Vec<PathBuf> {
    let identity = fs::read(data_dir.join("agent.json")).unwrap_or_default();
    let Ok(Identity { id }) = serde_json::from_slice(&identity) else { return Vec::new() };
    // Ids are made by agents; one that is a path would be none of theirs.
    if id.is_empty() || id.contains(['/', '.']) {
        return Vec::new();
    }
    let read = |path| fs::read_to_string(path).unwrap_or_default();
    let (mounts, own) = (read("/proc/self/mounts"), read("/proc/self/cgroup"));
    let all = candidates(&mounts, &own).into_iter().map(|dir| dir.join("muster").join(&id));
    all.filter(|dir| dir.is_dir()).collect()
}

/// Where groups below this process's own may be: in each hierarchy, by each name that it has in one.
fn candidates(mounts: &str, own: &str) -> Vec<PathBuf> {
    let mounts = mounts.lines().filter_map(|line| {
        let mut fields = line.split(' ').skip(1);
        let (dir, kind) = (fields.next()?, fields.next()?);
        matches!(kind, "cgroup" | "cgroup2").then_some(Path::new(dir))
    });
    // In a container a name may begin above what is mounted; then the mount itself is the group.
    let mut names: Vec<&str> = own.lines().filter_map(|line| line.splitn(3, ':').nth(2)).collect();
    names.push("/");
    names.sort_unstable();
    names.dedup();
    mounts.flat_map(|dir| names.iter().map(|n| dir.join(n.trim_start_matches('/')))).collect()
}

/// Removes a group and those below it.
pub(super) fn remove(dir: &Path) -> std::io::Result<()> {
    for entry in fs::read_dir(dir)?.flatten() {
        if entry.file_type()?.is_dir() {
            remove(&entry.path())?;
        }
    }
    fs::remove_dir(dir)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_hierarchy_is_looked_at() {
        let mounts = "proc /proc proc rw 0 0\ncgroup /sys/fs/cgroup/cpu cgroup rw,cpu 0 0\n\
            cgroup2 /sys/fs/cgroup/unified cgroup2 rw 0 0\n";
        let found = candidates(mounts, "2:cpu:/a/b\n0::/\n");
        let expected = ["cpu", "cpu/a/b", "unified", "unified/a/b"]
            .map(|p| Path::new("/sys/fs/cgroup").join(p));
        assert_eq!(found, expected);
    }

    #[test]
    fn groups_go_with_those_below_them_unless_something_is_in_them() {
        let dir = tempfile::tempdir().unwrap();
        let group = dir.path().join("muster/id");
        fs::create_dir_all(group.join("task.1/inner")).unwrap();
        remove(&group).unwrap();
        assert!(!group.exists());
        fs::create_dir_all(group.join("task.1")).unwrap();
        fs::write(group.join("task.1/process"), "").unwrap();
        assert!(remove(&group).is_err() && group.exists());
    }
}
