//! Values as files, for as long as an attempt may live.
//!
//! Each attempt has a directory of its own, in memory (tmpfs) when anything in it is a Secret's:
//!
//! ```text
//! /run/muster/<agent>/<uid>/<attempt>/<mountPath>/<path>     a process; MUSTER_FILES_DIR is up to <attempt>
//! /run/muster/<agent>/<uid>/<attempt>/<n>/<path>             a container; <n> is bound at the n-th mountPath
//! ```
//!
//! A process without a working directory of its own finds the first part of each `mountPath` in its work directory, as
//! a link. Only that one name is made there, and it is never followed: the directory is the task's, and what an earlier
//! attempt left in it must not lead the agent elsewhere.

use std::collections::BTreeSet;
use std::fs::{self, DirBuilder, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{
    DirBuilderExt as _, MetadataExt as _, OpenOptionsExt as _, PermissionsExt as _,
};
use std::path::{Path, PathBuf};

use muster_agent_core::workload::Failure;
use muster_api::id::TaskUid;
use muster_api::wire::agent::v1 as proto;
use muster_failpoint::{Failpoint, Step, reach};

use crate::durable::{self, FileError};
use crate::runtime::launch::{AttemptId, Launch, Program};

/// The variable that names a process's directory.
pub(crate) const DIR_ENV: &str = "MUSTER_FILES_DIR";

/// `statfs` of a file system in memory.
const TMPFS: i64 = 0x0102_1994;
const RAMFS: i64 = 0x8584_58f6;

/// Where files go.
#[derive(Debug, Clone)]
pub(crate) struct Place {
    /// In memory; or why there is no such place.
    memory: Result<PathBuf, String>,
    /// Holds `<uid>`, on the disk.
    tasks: PathBuf,
}

/// A directory of the host that a container sees.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Bound {
    pub(crate) host: PathBuf,
    pub(crate) container: String,
}

impl Place {
    /// `identity`: the agent's; `tasks`: where tasks have their directories.
    pub(crate) fn find(identity: &str, tasks: &Path) -> Place {
        Place { memory: in_memory(identity), tasks: tasks.to_owned() }
    }

    /// An attempt's directory.
    pub(crate) fn dir(&self, id: &AttemptId, config: &proto::Config) -> PathBuf {
        let secret = config.files.iter().any(|file| file.secret);
        let of_task = match &self.memory {
            Ok(memory) => memory.join(id.uid.as_str()),
            // Refused before anything is written, when it is a Secret's.
            Err(_) => self.on_disk(&id.uid),
        };
        let of_task = if secret { of_task } else { self.on_disk(&id.uid) };
        of_task.join(id.attempt.to_string())
    }

    fn on_disk(&self, uid: &TaskUid) -> PathBuf {
        self.tasks.join(uid.as_str()).join("files")
    }

    /// Writes an attempt's files, and removes those of earlier ones.
    pub(crate) fn write(&self, launch: &Launch, links: Option<&Path>) -> Result<(), Failure> {
        let Some(config) = launch.given.as_ref().filter(|given| !given.files.is_empty()) else {
            return Ok(());
        };
        if let (Err(why), true) = (&self.memory, config.files.iter().any(|file| file.secret)) {
            return Err(Failure {
                reason: "NoMemoryFiles".to_owned(),
                message: format!("files of a Secret are kept in memory only: {why}"),
                retry: false,
            });
        }
        let failed = |error: FileError| Failure {
            reason: "NodeError".to_owned(),
            message: format!("{error}: {}", error.source),
            retry: true,
        };
        self.clear(&launch.id.uid).map_err(failed)?;
        reach(Failpoint::AttemptFiles, Step::Before);
        let dir = self.dir(&launch.id, config);
        let owner = owner(launch);
        let container = matches!(launch.program, Program::Container(_));
        // Whoever is not meant stays outside; what a container sees is bound past this directory.
        make_dir(dir.parent().unwrap_or(&dir), 0o711, None).map_err(failed)?;
        make_dir(&dir, if container { 0o700 } else { 0o711 }, None).map_err(failed)?;
        for file in &config.files {
            let below = match container {
                true => dir.join(number(config, &file.directory).to_string()),
                false => dir.join(&file.directory),
            };
            write_file(&dir, &below.join(&file.path), file, owner).map_err(failed)?;
        }
        reach(Failpoint::AttemptFiles, Step::After);
        match links {
            Some(work) if !container => link(&dir, work, config),
            _ => Ok(()),
        }
    }

    /// What a container sees of its attempt's files.
    pub(crate) fn bound(&self, launch: &Launch) -> Vec<Bound> {
        let Some(config) = &launch.given else { return Vec::new() };
        let dir = self.dir(&launch.id, config);
        let places: BTreeSet<&str> = config.files.iter().map(|file| &*file.directory).collect();
        let bound = |place: &str| Bound {
            host: dir.join(number(config, place).to_string()),
            container: place.to_owned(),
        };
        places.into_iter().map(bound).collect()
    }

    /// Removes what a task has.
    pub(crate) fn clear(&self, uid: &TaskUid) -> Result<(), FileError> {
        let memory = self.memory.iter().map(|memory| memory.join(uid.as_str()));
        reach(Failpoint::FilesRemoval, Step::Before);
        for path in memory.chain([self.on_disk(uid)]) {
            durable::remove_dir_all(&path)?;
        }
        reach(Failpoint::FilesRemoval, Step::After);
        Ok(())
    }

    /// The agent ends: its directory goes, when no task has files in it.
    pub(crate) fn retire(&self) {
        if let Ok(memory) = &self.memory {
            // Not empty: the tasks stay.
            let _ = fs::remove_dir(memory);
        }
    }

    /// Removes what tasks have that this agent does not know.
    pub(crate) fn sweep(&self, known: &BTreeSet<TaskUid>) {
        let Ok(memory) = &self.memory else { return };
        for entry in fs::read_dir(memory).into_iter().flatten().flatten() {
            let name = entry.file_name();
            if name.to_str().is_none_or(|name| !known.contains(&TaskUid::new(name))) {
                // What stays is tried again at the next start.
                let _ = fs::remove_dir_all(entry.path());
            }
        }
    }
}

/// A directory of this agent on a file system in memory.
fn in_memory(identity: &str) -> Result<PathBuf, String> {
    let user = rustix::process::geteuid();
    let mut places = Vec::new();
    if user.is_root() {
        places.push(PathBuf::from("/run/muster"));
    } else if let Some(dir) = std::env::var_os("XDG_RUNTIME_DIR") {
        places.push(PathBuf::from(dir).join("muster"));
    }
    places.push(PathBuf::from(format!("/dev/shm/muster-{}", user.as_raw())));
    let mut why = Vec::new();
    for place in places {
        match usable(&place, user.as_raw()).and_then(|()| {
            let own = place.join(identity);
            match DirBuilder::new().mode(0o711).create(&own) {
                Err(error) if error.kind() != io::ErrorKind::AlreadyExists => Err(error),
                _ => Ok(own),
            }
        }) {
            Ok(own) => return Ok(own),
            Err(error) => why.push(format!("{}: {error}", place.display())),
        }
    }
    Err(format!("this node has no tmpfs for its agent ({})", why.join("; ")))
}

/// Makes the directory. Where everybody may write, somebody else may have made it before.
fn usable(place: &Path, user: u32) -> io::Result<()> {
    let kind = rustix::fs::statfs(place.parent().unwrap_or(place))?.f_type;
    if kind != TMPFS && kind != RAMFS {
        return Err(io::Error::other("is not in memory"));
    }
    match DirBuilder::new().mode(0o711).create(place) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error),
        _ => {}
    }
    let seen = fs::symlink_metadata(place)?;
    if !seen.is_dir() || seen.uid() != user || seen.mode() & 0o022 != 0 {
        return Err(io::Error::other("is not this user's own directory"));
    }
    Ok(())
}

/// Whose the files are; none: the agent's own.
fn owner(launch: &Launch) -> Option<(u32, u32)> {
    match &launch.program {
        Program::Process { user: Some(user), .. } => crate::shim::user_ids(user),
        Program::Container(container) => container.user,
        Program::Process { user: None, .. } | Program::Work(_) => None,
    }
}

/// Which of the places of a container's files this is.
fn number(config: &proto::Config, directory: &str) -> usize {
    let first = config.files.iter().position(|file| file.directory == directory);
    first.unwrap_or_default()
}

fn make_dir(path: &Path, mode: u32, owner: Option<(u32, u32)>) -> Result<(), FileError> {
    match DirBuilder::new().mode(mode).create(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => return Ok(()),
        done => done.map_err(FileError::at("make", path))?,
    }
    if let Some((uid, gid)) = owner {
        std::os::unix::fs::chown(path, Some(uid), Some(gid))
            .map_err(FileError::at("hand over", path))?;
    }
    Ok(())
}

fn write_file(
    dir: &Path,
    path: &Path,
    file: &proto::File,
    owner: Option<(u32, u32)>,
) -> Result<(), FileError> {
    let between: Vec<&Path> = path.ancestors().skip(1).take_while(|above| *above != dir).collect();
    for above in between.into_iter().rev() {
        make_dir(above, 0o755, owner)?;
    }
    // New and nobody's yet: the right permissions before the first byte.
    let mut to = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(path)
        .map_err(FileError::at("create", path))?;
    to.write_all(&file.data).map_err(FileError::at("write", path))?;
    if let Some((uid, gid)) = owner {
        std::os::unix::fs::fchown(&to, Some(uid), Some(gid))
            .map_err(FileError::at("hand over", path))?;
    }
    to.set_permissions(fs::Permissions::from_mode(file.mode & 0o777))
        .map_err(FileError::at("set the permissions of", path))
}

/// The first part of each place, in the task's work directory.
fn link(dir: &Path, work: &Path, config: &proto::Config) -> Result<(), Failure> {
    let firsts: BTreeSet<&str> =
        config.files.iter().filter_map(|file| file.directory.split('/').next()).collect();
    for first in firsts {
        let at = work.join(first);
        let failed = |error: io::Error| Failure {
            reason: "NodeError".to_owned(),
            message: format!("failed to link {}: {error}", at.display()),
            retry: true,
        };
        match fs::symlink_metadata(&at) {
            Ok(there) if there.file_type().is_symlink() => fs::remove_file(&at).map_err(failed)?,
            Ok(_) => {
                return Err(Failure {
                    reason: "FilesInTheWay".to_owned(),
                    message: format!(
                        "its work directory has a {first:?} of its own; files are to be there"
                    ),
                    retry: false,
                });
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(failed(error)),
        }
        std::os::unix::fs::symlink(dir.join(first), &at).map_err(failed)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use muster_api::kind::task::StopSignal;
    use std::collections::BTreeMap;
    use std::sync::Arc;

    use super::*;
    use crate::runtime::Limits;
    use crate::runtime::launch::Network;

    fn launch(files: &[(&str, &str, u32, bool)], attempt: u32) -> Launch {
        let file = |(directory, path, mode, secret): &(&str, &str, u32, bool)| proto::File {
            directory: (*directory).to_owned(),
            path: (*path).to_owned(),
            data: format!("{attempt}").into(),
            mode: *mode,
            secret: *secret,
        };
        let config =
            proto::Config { files: files.iter().map(file).collect(), ..Default::default() };
        Launch {
            id: AttemptId { uid: TaskUid::new("t"), attempt },
            program: Program::Process {
                argv: Vec::new(),
                working_dir: None,
                user: None,
                network: Network::Host,
            },
            env: BTreeMap::new(),
            given: Some(Arc::new(config)),
            limits: Limits::default(),
            promised: false,
            stop_signal: StopSignal::default(),
            grace_ms: 0,
            stop_after_ms: None,
        }
    }

    fn place(dir: &Path) -> Place {
        let memory = dir.join("memory");
        fs::create_dir_all(&memory).unwrap();
        fs::create_dir_all(dir.join("tasks/t")).unwrap();
        Place { memory: Ok(memory), tasks: dir.join("tasks") }
    }

    #[test]
    fn an_attempt_has_its_own_files_and_those_of_a_secret_are_in_memory() {
        let dir = tempfile::tempdir().unwrap();
        let (place, work) = (place(dir.path()), dir.path().join("work"));
        fs::create_dir(&work).unwrap();
        let all = [("etc/app", "d/a", 0o444, false), ("keys", "k", 0o400, true)];
        for attempt in [1, 2] {
            place.write(&launch(&all, attempt), Some(&work)).unwrap();
            let now = attempt.to_string();
            assert_eq!(fs::read_to_string(work.join("etc/app/d/a")).unwrap(), now);
            assert_eq!(fs::read_to_string(work.join("keys/k")).unwrap(), now);
        }
        let of_second = dir.path().join("memory/t/2");
        assert_eq!(fs::metadata(of_second.join("keys/k")).unwrap().mode() & 0o777, 0o400);
        assert!(!dir.path().join("memory/t/1").exists());
        place.clear(&TaskUid::new("t")).unwrap();
        assert!(!dir.path().join("memory/t").exists());

        let plain = [("etc", "a", 0o444, false)];
        place.write(&launch(&plain, 3), None).unwrap();
        assert!(dir.path().join("tasks/t/files/3/etc/a").exists());
        place.sweep(&BTreeSet::new());
    }

    #[test]
    fn what_the_task_put_in_the_way_is_neither_followed_nor_removed() {
        let dir = tempfile::tempdir().unwrap();
        let (place, work) = (place(dir.path()), dir.path().join("work"));
        let outside = dir.path().join("outside");
        fs::create_dir_all(&outside).unwrap();
        fs::create_dir_all(work.join("mine")).unwrap();
        std::os::unix::fs::symlink(&outside, work.join("etc")).unwrap();
        let all = [("etc/app", "a", 0o444, false)];
        place.write(&launch(&all, 1), Some(&work)).unwrap();
        assert_eq!(fs::read_dir(&outside).unwrap().count(), 0);
        assert_eq!(fs::read_to_string(work.join("etc/app/a")).unwrap(), "1");
        let refused = place.write(&launch(&[("mine", "a", 0o444, false)], 1), Some(&work));
        assert_eq!(refused.unwrap_err().reason, "FilesInTheWay");
    }

    #[test]
    fn a_secret_is_refused_where_nothing_is_in_memory() {
        let dir = tempfile::tempdir().unwrap();
        let place = Place { memory: Err("none".to_owned()), ..place(dir.path()) };
        let refused = place.write(&launch(&[("a", "b", 0o400, true)], 1), None).unwrap_err();
        assert_eq!(refused.reason, "NoMemoryFiles");
    }
}
