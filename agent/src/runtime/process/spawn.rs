//! From a launch to a shim: directory, group, lock, fork. All before the fork can be taken back.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Seek as _, Write as _};
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::os::unix::fs::DirBuilderExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;

use muster_agent_core::workload::Failure;
use muster_failpoint::{Failpoint, Step, reach};
use rustix::fs::{MemfdFlags, memfd_create};
use rustix::pipe::PipeFlags;

use super::attempt::{AttemptDir, Order};
use super::{Inner, KEPT_ATTEMPTS, Live, Reexec, Word, pidfd, scan};
use crate::durable::FileError;
use crate::given::files::DIR_ENV;
use crate::runtime::RuntimeError;
use crate::runtime::cgroup::group::Group;
use crate::runtime::launch::{Launch, Program};

/// A shim that was just started.
#[derive(Debug)]
pub(super) struct Spawned {
    pub(super) live: Live,
    pub(super) word: Word,
}

#[derive(Debug)]
pub(super) enum SpawnError {
    /// Nothing was started.
    Refused(Failure),
    /// Something may have been.
    Unclear(RuntimeError),
}

fn refused(reason: &str, message: String, retry: bool) -> SpawnError {
    SpawnError::Refused(Failure { reason: reason.to_owned(), message, retry })
}

fn files(error: &FileError) -> SpawnError {
    refused("NodeError", format!("{error}: {}", error.source), true)
}

pub(super) fn spawn(inner: &Inner, mut launch: Launch) -> Result<Spawned, SpawnError> {
    reach(Failpoint::AttemptDirs, Step::Before);
    let dir = make_dirs(inner, &launch).map_err(|error| files(&error))?;
    reach(Failpoint::AttemptDirs, Step::After);
    let lock = match dir.lock() {
        Ok(Some(lock)) => lock,
        Ok(None) => return Err(unclear("lock an attempt", "a shim of this attempt lives")),
        Err(error) => return Err(files(&error)),
    };
    if !matches!((dir.begun(), dir.exit()), (Ok(None), Ok(None))) {
        return Err(unclear("start an attempt", "it was started before"));
    }
    hand_files(inner, &mut launch)?;
    let given = variables(&launch)
        .map_err(|error| refused("NodeError", format!("no memory for variables: {error}"), true))?;
    let group = make_group(inner, &launch)?;
    let order = Order {
        work_dir: inner.work_dir(&launch.id.uid),
        launch,
        group: group.clone(),
        guarded: None,
        contact: inner.config.contact.clone(),
        boot_id: inner.boot_id.clone(),
        log: inner.config.log,
    };
    let give_up = |error: SpawnError| {
        if let Some(group) = &group {
            // The next sweep takes what stays.
            let _ = group.remove();
        }
        error
    };
    dir.write_order(&order).map_err(|error| give_up(files(&error)))?;
    let (word, child_word) = rustix::pipe::pipe_with(PipeFlags::CLOEXEC | PipeFlags::NONBLOCK)
        .map_err(|errno| give_up(refused("NodeError", format!("no pipe: {errno}"), true)))?;
    // Only the reading end may refuse to wait.
    let _ = rustix::io::ioctl_fionbio(&child_word, false);
    reach(Failpoint::ShimStart, Step::Before);
    let child =
        spawn_shim(&inner.config.reexec, &dir, &lock, (given, child_word)).map_err(|error| {
            give_up(refused("NodeError", format!("failed to start a shim: {error}"), true))
        })?;
    reach(Failpoint::ShimStart, Step::After);
    // From here on the shim holds the lock as well.
    drop(lock);
    let pid = child.id().cast_signed();
    let shim = scan::process(pid).and_then(|process| pidfd(process).ok().flatten());
    let Some(shim) = shim else {
        return Err(unclear("watch a new shim", "it was gone at once"));
    };
    let reach = crate::shim::reach(&order, pid, None);
    Ok(Spawned { live: Live { shim: Arc::new(shim), reach }, word: Word(word) })
}

/// Files of ConfigMaps and Secrets, and where they are.
fn hand_files(inner: &Inner, launch: &mut Launch) -> Result<(), SpawnError> {
    let work = inner.work_dir(&launch.id.uid);
    let links = match &launch.program {
        Program::Process { working_dir: None, .. } => Some(work.as_path()),
        _ => None,
    };
    let files = &inner.config.files;
    files.write(launch, links).map_err(SpawnError::Refused)?;
    if let Some(given) = launch.given.as_ref().filter(|given| !given.files.is_empty()) {
        let dir = files.dir(&launch.id, given).display().to_string();
        launch.env.insert(DIR_ENV.to_owned(), dir);
    }
    Ok(())
}

/// Variables of ConfigMaps and Secrets as the shim's standard input: in memory, and in no file.
fn variables(launch: &Launch) -> io::Result<Stdio> {
    let given = launch.given.iter().flat_map(|given| &given.variables);
    let given: BTreeMap<&str, &str> = given.map(|v| (&*v.name, &*v.value)).collect();
    if given.is_empty() {
        return Ok(Stdio::null());
    }
    let mut memory = File::from(memfd_create("muster-variables", MemfdFlags::CLOEXEC)?);
    memory.write_all(&serde_json::to_vec(&given)?)?;
    memory.rewind()?;
    Ok(memory.into())
}

fn unclear(what: &'static str, why: &'static str) -> SpawnError {
    SpawnError::Unclear(RuntimeError::new(what, why))
}

fn make_dirs(inner: &Inner, launch: &Launch) -> Result<AttemptDir, FileError> {
    let dir = inner.dir(&launch.id);
    let make = |path: &Path| {
        // Passable for all: a task may run as another user. Nothing in it can be listed.
        fs::DirBuilder::new()
            .recursive(true)
            .mode(0o711)
            .create(path)
            .map_err(FileError::at("make", path))
    };
    make(dir.path())?;
    for part in [
        inner.work_dir(&launch.id.uid),
        inner.config.tasks.join(launch.id.uid.as_str()).join("run"),
    ] {
        make(&part)?;
        if let Program::Process { user: Some(user), .. } = &launch.program
            && let Some((uid, gid)) = crate::shim::user_ids(user)
        {
            std::os::unix::fs::chown(&part, Some(uid), Some(gid))
                .map_err(FileError::at("hand over", &part))?;
        }
    }
    if let Some(old) = launch.id.attempt.checked_sub(KEPT_ATTEMPTS)
        && let Some(attempts) = dir.path().parent()
    {
        // Older logs go; a failure only keeps them longer.
        let _ = fs::remove_dir_all(attempts.join(old.to_string()));
    }
    Ok(dir)
}

fn make_group(inner: &Inner, launch: &Launch) -> Result<Option<Group>, SpawnError> {
    let enforcer = match &inner.enforcer {
        Ok(enforcer) => enforcer,
        Err(_) if inner.config.unenforced || !launch.promised => return Ok(None),
        Err(why) => {
            let hint = "start the agent with --unenforced-quotas to run it unlimited";
            let message = format!("this node cannot hold a task to its quotas: {why} ({hint})");
            return Err(refused("QuotaNotEnforced", message, false));
        }
    };
    let disk = inner.work_dir(&launch.id.uid);
    match enforcer.make(&launch.id.to_string(), &launch.limits, &disk) {
        Ok(group) => Ok(Some(group)),
        Err(error) => {
            let mut message = error.to_string();
            let mut cause = std::error::Error::source(&error);
            while let Some(source) = cause {
                message = format!("{message}: {source}");
                cause = source.source();
            }
            Err(refused("QuotaNotEnforced", message, false))
        }
    }
}

/// Executes the shim for an attempt's directory; it inherits the lock, reads the variables that are not in its order from
/// the first stream, and says its word on the second.
pub(crate) fn spawn_shim(
    reexec: &Reexec,
    dir: &AttemptDir,
    lock: &fs::File,
    (variables, word): (Stdio, OwnedFd),
) -> io::Result<Child> {
    let errors = fs::File::create(dir.path().join("shim.log"))?;
    let mut command = Command::new(&reexec.program);
    command.args(&reexec.verb);
    command.arg(dir.path()).arg("--lock-fd").arg(lock.as_raw_fd().to_string());
    // Not the agent's own standard streams: whoever reads them would wait for the last shim.
    command.stdin(variables).stdout(word).stderr(errors).current_dir("/");
    let lock = lock.as_fd().as_raw_fd();
    // SAFETY: only async-signal-safe system calls, on values made before the fork.
    unsafe {
        command.pre_exec(move || {
            if libc::setsid() == -1 || libc::fcntl(lock, libc::F_SETFD, 0) == -1 {
                return Err(io::Error::last_os_error());
            }
            let mut set = std::mem::zeroed::<libc::sigset_t>();
            libc::sigemptyset(&raw mut set);
            for signal in crate::shim::SIGNALS {
                libc::sigaddset(&raw mut set, signal);
            }
            libc::sigprocmask(libc::SIG_BLOCK, &raw const set, std::ptr::null_mut());
            Ok(())
        });
    }
    command.spawn()
}
