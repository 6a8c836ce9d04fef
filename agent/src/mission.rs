//! Mission locks that are set on the robot itself, with or without the controller: while there is one, no TaskSet ends a
//! task there.
//!
//! | file | set by | counts |
//! |---|---|---|
//! | `$MUSTER_RUN_DIR/mission-lock` of a task | the task; a word or two about the mission, or nothing | until the file is removed or the task has ended |
//! | `mission-lock` in the agent's data directory | a person on the robot, `HOLDER: REASON` | until the file is removed |
//!
//! They are looked at when the controller is told about the node: at once when it is back, before it can order anything.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use muster_api::id::TaskUid;
use muster_api::kind::node::MissionLock;
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;

use crate::checkpoint::Checkpoint;

const FILE: &str = "mission-lock";
/// More of a reason is not told.
const LONGEST: u64 = 200;

/// The locks that are set now: the person's first, then the tasks' in the order of their names.
pub(crate) fn locks(
    data_dir: &Path,
    checkpoint: &Checkpoint,
    live: impl IntoIterator<Item = (TaskUid, String)>,
) -> Vec<MissionLock> {
    let person = read(&data_dir.join(FILE)).map(|text| {
        let (holder, reason) = text.split_once(':').unwrap_or(("somebody on the robot", &text));
        MissionLock { holder: holder.trim().to_owned(), reason: reason.trim().to_owned() }
    });
    let of_task = |(uid, title): (TaskUid, String)| {
        let reason = read(&checkpoint.task_dir(&uid).join("run").join(FILE))?;
        Some(MissionLock { holder: format!("task {title}"), reason })
    };
    let mut tasks: Vec<MissionLock> = live.into_iter().filter_map(of_task).collect();
    tasks.sort_by(|a, b| a.holder.cmp(&b.holder));
    person.into_iter().chain(tasks).collect()
}

/// The beginning of a task's file, which is the task's to fill: it is a regular file or it does not count. A look never waits,
/// whatever the task makes of it meanwhile: a pipe, a link, a file that it has a lease of (`fcntl(2)`).
pub(crate) fn text_of(path: &Path, most: u64) -> Option<String> {
    let how = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = match rustix::fs::open(path, how, Mode::empty()) {
        Ok(file) => File::from(file),
        // It is not there, or is a link.
        Err(Errno::NOENT | Errno::NOTDIR | Errno::LOOP) => return None,
        // Set is set, also when it cannot be read.
        Err(_) => return Some(String::new()),
    };
    if !file.metadata().is_ok_and(|found| found.is_file()) {
        return None;
    }
    let mut bytes = Vec::new();
    let _ = file.take(most).read_to_end(&mut bytes);
    Some(String::from_utf8_lossy(&bytes).into_owned())
}

/// The first line of a file, as far as it is told.
fn read(path: &Path) -> Option<String> {
    let text = text_of(path, LONGEST)?;
    let line = text.lines().next().unwrap_or_default();
    let shown = line.chars().filter(|c| !c.is_control());
    Some(shown.collect::<String>().trim().to_owned())
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsRawFd as _;

    use super::*;

    #[test]
    fn a_file_is_a_lock_and_nothing_else_is() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(FILE);
        assert_eq!(read(&path), None);
        std::fs::write(&path, "carries a\u{7} tray\nto the kitchen\n").unwrap();
        assert_eq!(read(&path).as_deref(), Some("carries a tray"));
        std::fs::write(&path, "").unwrap();
        assert_eq!(read(&path).as_deref(), Some(""));
        std::fs::write(&path, vec![b'x'; 10_000]).unwrap();
        assert_eq!(read(&path).map(|text| text.len()), Some(200));
        std::fs::remove_file(&path).unwrap();
        std::os::unix::fs::symlink("/etc/passwd", &path).unwrap();
        assert_eq!(read(&path), None);
        std::fs::remove_file(&path).unwrap();
        std::fs::create_dir(&path).unwrap();
        assert_eq!(read(&path), None);
        std::fs::remove_dir(&path).unwrap();
        let made = std::process::Command::new("mkfifo").arg(&path).status().unwrap();
        assert!(made.success());
        assert_eq!(read(&path), None, "nobody writes to the pipe, and nobody waits");
    }

    /// Whoever opens it in the usual way waits until the lease is given back, 45 s at most.
    #[test]
    fn a_file_with_a_lease_is_set_and_not_waited_for() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(FILE);
        std::fs::write(&path, "carries a tray\n").unwrap();
        let held = File::open(&path).unwrap();
        drop(File::options().write(true).open(&path).unwrap());
        // SAFETY: a lease of a file of ours, with no pointers.
        let got = unsafe { libc::fcntl(held.as_raw_fd(), libc::F_SETLEASE, libc::F_WRLCK) };
        assert_eq!(got, 0, "{}", std::io::Error::last_os_error());
        // SAFETY: the signal that says that somebody opens it would end the process.
        unsafe { libc::signal(libc::SIGIO, libc::SIG_IGN) };
        assert_eq!(read(&path).as_deref(), Some(""));
    }
}
