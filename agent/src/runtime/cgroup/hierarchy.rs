//! What is mounted where, and where this agent may make groups.
//!
//! The base is the agent's own group in each hierarchy, so that limits that were put on the agent
//! (a service, a container) hold for its tasks as well; below it `muster/<identity>`. On v2 not every
//! group can be a base: see `place`.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use super::Controller;
use super::group::Group;
use super::place::Base;

/// The leaf that holds the agent itself on v2.
pub(crate) const AGENT_LEAF: &str = "agent";

/// How much an agent's root weighs against what runs outside of it, per core, where one process
/// outside weighs 1. As much as the machine has cores would be fair; but tasks were promised what they
/// reserved, and a busy build or browser on the robot must not take it. Not more, because the system
/// has to live as well.
const WEIGHT_PER_CORE: u64 = 4;

/// Which interface the kernel gives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Version {
    /// One tree per controller.
    V1,
    /// One tree.
    V2,
}

/// Why no quota can be enforced here.
#[derive(Debug, thiserror::Error)]
pub(crate) enum HierarchyError {
    #[error("the kernel's {file} could not be read")]
    Proc {
        file: &'static str,
        #[source]
        source: io::Error,
    },
    #[error("no cgroup hierarchy is mounted that has cpu and memory")]
    NotMounted,
    #[error("controller {controller} is not available in {dir}")]
    NoController { controller: &'static str, dir: PathBuf },
    #[error("{dir} is not writable for this agent")]
    Denied {
        dir: PathBuf,
        #[source]
        source: io::Error,
    },
    #[error("{dir} is held by another agent: two agents have one identity, or one stands still")]
    Held { dir: PathBuf },
}

/// Where this agent's groups are.
#[derive(Debug)]
pub(crate) struct Hierarchy {
    version: Version,
    /// The directory that this agent's groups are made in, by controller.
    roots: BTreeMap<Controller, PathBuf>,
    /// v2: the group that controllers are handed down from.
    base: Option<Base>,
}

struct Mount {
    /// Path inside the hierarchy that is mounted.
    root: String,
    point: PathBuf,
    v2: bool,
    options: Vec<String>,
}

const V1: [(Controller, &str); 6] = [
    (Controller::Cpu, "cpu"),
    (Controller::Cpuacct, "cpuacct"),
    (Controller::Memory, "memory"),
    (Controller::Pids, "pids"),
    (Controller::Blkio, "blkio"),
    (Controller::Freezer, "freezer"),
];

const V2: [(Controller, &str); 4] = [
    (Controller::Cpu, "cpu"),
    (Controller::Memory, "memory"),
    (Controller::Pids, "pids"),
    (Controller::Blkio, "io"),
];

impl Hierarchy {
    pub(crate) fn detect(identity: &str) -> Result<Hierarchy, HierarchyError> {
        let mountinfo = read("/proc/self/mountinfo", "mountinfo")?;
        let own = read("/proc/self/cgroup", "cgroup")?;
        let mounts = parse_mounts(&mountinfo);
        let below = Path::new("muster").join(identity);
        if let Some(mount) = mounts.iter().find(|mount| mount.v2 && has_controllers(&mount.point)) {
            return Ok(Self::v2(mount, &own, &below));
        }
        Self::v1(&mounts, &own, &below)
    }

    fn v1(mounts: &[Mount], own: &str, below: &Path) -> Result<Hierarchy, HierarchyError> {
        let mut roots = BTreeMap::new();
        for (controller, name) in V1 {
            let found = mounts.iter().find(|m| !m.v2 && m.options.iter().any(|o| o == name));
            let Some(mount) = found else {
                // Without I/O rates or accounting the rest still holds; a task that needs the
                // missing one is refused when its limits are written.
                if matches!(controller, Controller::Cpu | Controller::Memory) {
                    return Err(HierarchyError::NotMounted);
                }
                continue;
            };
            let base = below_mount(mount, &own_path(own, Some(name)), below);
            roots.insert(controller, base.join(below));
        }
        Ok(Hierarchy { version: Version::V1, roots, base: None })
    }

    fn v2(mount: &Mount, own: &str, below: &Path) -> Hierarchy {
        let own = below_mount(mount, &own_path(own, None), below);
        let base = Base::find(&own, &mount.point);
        let root = base.dir.join(below);
        let roots = V2.iter().map(|(controller, _)| (*controller, root.clone())).collect();
        Hierarchy { version: Version::V2, roots, base: Some(base) }
    }

    /// Makes the roots, and on v2 hands the controllers down to them.
    pub(crate) fn make_roots(&self) -> Result<(), HierarchyError> {
        for root in self.roots.values() {
            std::fs::create_dir_all(root)
                .map_err(|source| HierarchyError::Denied { dir: root.clone(), source })?;
        }
        if let Some(base) = &self.base {
            self.hand_down(base)?;
        }
        self.weigh()?;
        Ok(())
    }

    /// Gives the root, and the level above it that agents share, their weight.
    fn weigh(&self) -> Result<(), HierarchyError> {
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get) as u64;
        let (file, one, most) = match self.version {
            Version::V1 => ("cpu.shares", 1024, 262_144),
            Version::V2 => ("cpu.weight", 100, 10_000),
        };
        let weight = (one * cores * WEIGHT_PER_CORE).min(most).to_string();
        let Some(root) = self.roots.get(&Controller::Cpu) else { return Ok(()) };
        for dir in root.ancestors().take(2) {
            let file = dir.join(file);
            std::fs::write(&file, &weight)
                .map_err(|source| HierarchyError::Denied { dir: file, source })?;
        }
        Ok(())
    }

    fn hand_down(&self, base: &Base) -> Result<(), HierarchyError> {
        let Some(root) = self.roots.values().next() else { return Ok(()) };
        let leaf = root.join(AGENT_LEAF);
        base.clear(&leaf).map_err(|source| HierarchyError::Denied { dir: leaf, source })?;
        let base = base.dir.as_path();
        let mut dir = base.to_owned();
        let below = root.strip_prefix(base).unwrap_or_else(|_| Path::new(""));
        for part in std::iter::once(None).chain(below.components().map(Some)) {
            if let Some(part) = part {
                dir.push(part);
            }
            enable(&dir)?;
        }
        Ok(())
    }

    /// Takes back what `make_roots` made, as far as nothing uses it.
    pub(super) fn remove_roots(&self) {
        if let (Some(base), Some(root)) = (&self.base, self.roots.values().next())
            && let Err(error) = base.restore(root, &root.join(AGENT_LEAF))
        {
            tracing::debug!(%error, "the agent stays in its leaf");
        }
        for root in self.distinct_roots().into_iter().rev() {
            // Tasks stay, and so does the root that holds their groups.
            let _ = std::fs::remove_dir(root);
        }
    }

    #[cfg(test)]
    pub(super) fn of(version: Version, roots: BTreeMap<Controller, PathBuf>) -> Hierarchy {
        Hierarchy { version, roots, base: None }
    }

    pub(crate) fn version(&self) -> Version {
        self.version
    }

    pub(crate) fn roots(&self) -> &BTreeMap<Controller, PathBuf> {
        &self.roots
    }
}

/// The groups that this process is in for a controller, its own first, and which interface they
/// have: their limits are limits of this agent too.
pub(crate) fn enclosing(controller: &str) -> (Version, Vec<PathBuf>) {
    let mountinfo = std::fs::read_to_string("/proc/self/mountinfo").unwrap_or_default();
    let own = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let mounts = parse_mounts(&mountinfo);
    let v1 = mounts.iter().find(|m| !m.v2 && m.options.iter().any(|o| o == controller));
    let v2 = mounts.iter().find(|m| m.v2);
    let (version, mount, own) = match (v1, v2) {
        (Some(mount), _) => (Version::V1, mount, own_path(&own, Some(controller))),
        (None, Some(mount)) => (Version::V2, mount, own_path(&own, None)),
        (None, None) => return (Version::V2, Vec::new()),
    };
    let mut dir = below_mount(mount, &own, Path::new("\0"));
    let mut dirs = vec![dir.clone()];
    while dir != mount.point && dir.pop() {
        dirs.push(dir.clone());
    }
    (version, dirs)
}

/// The group of another's process (a container's), with the files to read its usage and to end it.
pub(crate) fn group_of(pid: i32) -> Option<Group> {
    let mountinfo = std::fs::read_to_string("/proc/self/mountinfo").ok()?;
    let theirs = std::fs::read_to_string(format!("/proc/{pid}/cgroup")).ok()?;
    let mounts = parse_mounts(&mountinfo);
    let nothing = Path::new("\0");
    if let Some(mount) = mounts.iter().find(|mount| mount.v2 && has_controllers(&mount.point)) {
        let path = own_path(&theirs, None);
        let dir = below_mount(mount, &path, nothing);
        let dirs = V2.iter().map(|(controller, _)| (*controller, dir.clone())).collect();
        // Never the root: it holds everybody.
        return (dir != mount.point).then(|| Group::new(Version::V2, dirs));
    }
    let mut dirs = BTreeMap::new();
    for (controller, name) in V1 {
        let mount = mounts.iter().find(|m| !m.v2 && m.options.iter().any(|o| o == name));
        let Some(mount) = mount else { continue };
        let dir = below_mount(mount, &own_path(&theirs, Some(name)), nothing);
        if dir != mount.point {
            dirs.insert(controller, dir);
        }
    }
    (!dirs.is_empty()).then(|| Group::new(Version::V1, dirs))
}

fn enable(dir: &Path) -> Result<(), HierarchyError> {
    let file = dir.join("cgroup.subtree_control");
    let available = std::fs::read_to_string(dir.join("cgroup.controllers")).unwrap_or_default();
    for (_, name) in V2 {
        if !available.split_whitespace().any(|have| have == name) {
            // io may be missing from a kernel; cpu, memory and pids may not be missing here.
            if name == "io" {
                continue;
            }
            return Err(HierarchyError::NoController { controller: name, dir: dir.to_owned() });
        }
        std::fs::write(&file, format!("+{name}"))
            .map_err(|source| HierarchyError::Denied { dir: file.clone(), source })?;
    }
    Ok(())
}

fn read(path: &str, file: &'static str) -> Result<String, HierarchyError> {
    std::fs::read_to_string(path).map_err(|source| HierarchyError::Proc { file, source })
}

fn has_controllers(point: &Path) -> bool {
    let list = std::fs::read_to_string(point.join("cgroup.controllers")).unwrap_or_default();
    ["cpu", "memory"].iter().all(|name| list.split_whitespace().any(|have| have == *name))
}

fn parse_mounts(mountinfo: &str) -> Vec<Mount> {
    let mut mounts = Vec::new();
    for line in mountinfo.lines() {
        // 36 35 98:0 /root /point options [optional…] - fstype source super-options
        let Some((left, right)) = line.split_once(" - ") else { continue };
        let mut left = left.split(' ').skip(3);
        let mut right = right.split(' ');
        let (Some(root), Some(point)) = (left.next(), left.next()) else { continue };
        let v2 = match right.next() {
            Some("cgroup2") => true,
            Some("cgroup") => false,
            _ => continue,
        };
        let options = right.nth(1).unwrap_or_default().split(',').map(str::to_owned).collect();
        let point = PathBuf::from(point.replace("\\040", " "));
        mounts.push(Mount { root: root.to_owned(), point, v2, options });
    }
    mounts
}

/// The agent's own group in the hierarchy of a v1 controller, or in the v2 tree.
pub(super) fn own_path(cgroup: &str, controller: Option<&str>) -> String {
    for line in cgroup.lines() {
        let mut fields = line.splitn(3, ':');
        let (Some(_), Some(controllers), Some(path)) =
            (fields.next(), fields.next(), fields.next())
        else {
            continue;
        };
        let found = match controller {
            Some(name) => controllers.split(',').any(|have| have == name),
            None => controllers.is_empty(),
        };
        if found {
            return path.to_owned();
        }
    }
    "/".to_owned()
}

/// `own` as a directory under the mount. An agent that was started from inside its own root (by
/// itself) stands on the same base as before.
fn below_mount(mount: &Mount, own: &str, below: &Path) -> PathBuf {
    let own = own.strip_prefix(mount.root.trim_end_matches('/')).unwrap_or("/");
    let own = Path::new(own.trim_start_matches('/'));
    let parts: Vec<_> = own.components().collect();
    let root: Vec<_> = below.components().collect();
    let end = parts.windows(root.len()).position(|window| window == root).unwrap_or(parts.len());
    let mut dir = mount.point.clone();
    dir.extend(&parts[..end]);
    // Seen from another cgroup namespace the path may not exist.
    if dir.is_dir() { dir } else { mount.point.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mounts_apart_and_together() {
        let text = "\
32 31 0:29 / /sys/fs/cgroup/cpu,cpuacct rw,relatime shared:9 - cgroup cgroup rw,cpu,cpuacct
33 31 0:30 /docker/x /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory
41 31 0:38 / /sys/fs/cgroup/unified rw,relatime - cgroup2 cgroup2 rw
42 31 0:39 / /proc rw - proc proc rw";
        let mounts = parse_mounts(text);
        assert_eq!(mounts.len(), 3);
        assert_eq!(mounts[0].options, ["rw", "cpu", "cpuacct"]);
        assert_eq!(mounts[1].root, "/docker/x");
        assert!(mounts[2].v2);
    }

    #[test]
    fn own_group_by_controller() {
        let text = "4:memory:/a/b\n3:cpu,cpuacct:/c\n0::/d:e\n";
        assert_eq!(own_path(text, Some("memory")), "/a/b");
        assert_eq!(own_path(text, Some("cpuacct")), "/c");
        assert_eq!(own_path(text, Some("pids")), "/");
        assert_eq!(own_path(text, None), "/d:e");
    }

    #[test]
    fn the_base_is_the_same_from_inside_its_own_root() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(dir.path().join("svc/muster/id/agent")).unwrap();
        let mount =
            Mount { root: "/".into(), point: dir.path().to_owned(), v2: true, options: vec![] };
        let below = Path::new("muster/id");
        let expected = dir.path().join("svc");
        assert_eq!(below_mount(&mount, "/svc", below), expected);
        assert_eq!(below_mount(&mount, "/svc/muster/id/agent", below), expected);
        assert_eq!(below_mount(&mount, "/elsewhere", below), dir.path());
    }
}
