//! A made group. Plain file operations only: the shim uses them too.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::Controller;
use super::hierarchy::Version;
use crate::runtime::Used;

/// A dead group's last references go within milliseconds of its last process; longer means that
/// somebody else is in it.
const REMOVE_WITHIN: Duration = Duration::from_secs(2);

/// The directories of one attempt's group.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Group {
    version: Version,
    /// By controller; several controllers may share one directory.
    dirs: BTreeMap<Controller, PathBuf>,
}

impl Group {
    pub(crate) fn new(version: Version, dirs: BTreeMap<Controller, PathBuf>) -> Group {
        Group { version, dirs }
    }

    pub(crate) fn version(&self) -> Version {
        self.version
    }

    pub(crate) fn dir(&self, controller: Controller) -> Option<&Path> {
        self.dirs.get(&controller).map(PathBuf::as_path)
    }

    fn distinct(&self) -> BTreeSet<&Path> {
        self.dirs.values().map(PathBuf::as_path).collect()
    }

    pub(crate) fn create(&self) -> io::Result<()> {
        for dir in self.distinct() {
            match fs::create_dir(dir) {
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                done => done?,
            }
        }
        Ok(())
    }

    /// Opens what a process writes "0" to, to enter the group. Opened before the fork, so that
    /// entering needs neither allocation nor rights of its own.
    pub(crate) fn entrances(&self) -> io::Result<Vec<File>> {
        self.distinct()
            .into_iter()
            .map(|dir| OpenOptions::new().write(true).open(dir.join("cgroup.procs")))
            .collect()
    }

    /// The processes in the group and in groups made below it. A process that left one hierarchy
    /// of several is still found in the others.
    pub(crate) fn pids(&self) -> BTreeSet<i32> {
        let mut pids = BTreeSet::new();
        for dir in self.distinct() {
            for dir in with_children(dir) {
                let text = fs::read_to_string(dir.join("cgroup.procs")).unwrap_or_default();
                // 0 is a process that this pid namespace cannot name.
                pids.extend(
                    text.lines().filter_map(|l| l.parse::<i32>().ok()).filter(|pid| *pid > 0),
                );
            }
        }
        pids
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.pids().is_empty()
    }

    pub(crate) fn signal(&self, signal: i32) {
        for pid in self.pids() {
            // SAFETY: kill takes no pointers. A pid that ended meanwhile is no error here.
            unsafe { libc::kill(pid, signal) };
        }
    }

    /// Kills everything in the group. Frozen first where the kernel has no `cgroup.kill`, so that
    /// nothing can fork away between the listing and the signal.
    pub(crate) fn kill(&self) {
        if self.version == Version::V2
            && let Some(dir) = self.distinct().first()
            && fs::write(dir.join("cgroup.kill"), "1").is_ok()
        {
            return;
        }
        self.freeze(true);
        self.signal(libc::SIGKILL);
        self.freeze(false);
    }

    fn freeze(&self, frozen: bool) {
        let (file, on, off) = match self.version {
            Version::V1 => ("freezer.state", "FROZEN", "THAWED"),
            Version::V2 => ("cgroup.freeze", "1", "0"),
        };
        let dir = match self.version {
            Version::V1 => self.dir(Controller::Freezer),
            Version::V2 => self.distinct().first().copied(),
        };
        let Some(file) = dir.map(|dir| dir.join(file)) else { return };
        // Without a freezer the kill is repeated until nothing is left; that ends a fork bomb too,
        // only later.
        if fs::write(&file, if frozen { on } else { off }).is_err() || !frozen {
            return;
        }
        let until = Instant::now() + Duration::from_millis(50);
        while self.version == Version::V1
            && Instant::now() < until
            && fs::read_to_string(&file).is_ok_and(|state| state.trim() == "FREEZING")
        {
            std::thread::sleep(Duration::from_micros(200));
        }
    }

    /// How many processes the kernel killed here for memory.
    pub(crate) fn oom_kills(&self) -> u64 {
        let Some(dir) = self.dir(Controller::Memory) else { return 0 };
        let file = match self.version {
            Version::V1 => "memory.oom_control",
            Version::V2 => "memory.events",
        };
        keyed(&dir.join(file), "oom_kill").unwrap_or(0)
    }

    /// What the kernel counted for the group.
    pub(crate) fn used(&self) -> Option<Used> {
        let number = |controller, file: &str| -> Option<u64> {
            fs::read_to_string(self.dir(controller)?.join(file)).ok()?.trim().parse().ok()
        };
        Some(match self.version {
            Version::V1 => Used {
                cpu_usec: number(Controller::Cpuacct, "cpuacct.usage")? / 1_000,
                memory_bytes: number(Controller::Memory, "memory.usage_in_bytes").unwrap_or(0),
            },
            Version::V2 => Used {
                cpu_usec: keyed(&self.dir(Controller::Cpu)?.join("cpu.stat"), "usage_usec")?,
                memory_bytes: number(Controller::Memory, "memory.current").unwrap_or(0),
            },
        })
    }

    /// Removes the empty group, children first.
    pub(crate) fn remove(&self) -> io::Result<()> {
        let until = Instant::now() + REMOVE_WITHIN;
        for dir in self.distinct() {
            let mut children = with_children(dir);
            children.reverse();
            for dir in children {
                loop {
                    match fs::remove_dir(&dir) {
                        Ok(()) => break,
                        Err(error) if error.kind() == io::ErrorKind::NotFound => break,
                        Err(error) if Instant::now() >= until => return Err(error),
                        Err(_) => std::thread::sleep(Duration::from_millis(1)),
                    }
                }
            }
        }
        Ok(())
    }
}

/// `dir` and every group below it, parents first.
fn with_children(dir: &Path) -> Vec<PathBuf> {
    let mut found = vec![dir.to_owned()];
    let mut next = 0;
    while next < found.len() {
        for entry in fs::read_dir(&found[next]).into_iter().flatten().flatten() {
            if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                found.push(entry.path());
            }
        }
        next += 1;
    }
    found
}

/// The number after `key` in a file of `key number` lines.
fn keyed(file: &Path, key: &str) -> Option<u64> {
    let text = fs::read_to_string(file).ok()?;
    text.lines().find_map(|line| {
        let (name, value) = line.split_once(' ')?;
        if name == key { value.trim().parse().ok() } else { None }
    })
}
