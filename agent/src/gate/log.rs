//! The gate's log, which its drivers write to as well: bounded.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use tokio::task::JoinHandle;

/// It is put aside at this length, bytes.
const MOST: u64 = 8 << 20;

/// Looks after the log.
pub(super) struct Log {
    path: PathBuf,
    putting: Option<JoinHandle<()>>,
}

impl Log {
    pub(super) fn new(path: PathBuf) -> Log {
        Log { path, putting: None }
    }

    /// What a long log says goes into another file, and what that said is gone.
    pub(super) fn look(&mut self) {
        let busy = self.putting.as_ref().is_some_and(|putting| !putting.is_finished());
        if !busy && fs::metadata(&self.path).is_ok_and(|log| log.len() > MOST) {
            let path = self.path.clone();
            self.putting = Some(tokio::task::spawn_blocking(move || {
                if let Err(error) = put_aside(&path) {
                    tracing::warn!(%error, "the log cannot be put aside");
                }
            }));
        }
    }
}

/// Drivers hold the log open, so it is emptied and not replaced. What cannot be put aside is no reason to keep all of it.
fn put_aside(log: &Path) -> io::Result<()> {
    let copied = fs::copy(log, log.with_extension("1"));
    File::options().write(true).open(log)?.set_len(0)?;
    copied.map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_put_aside_is_in_the_other_file() {
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("log");
        let mut writer = File::options().create(true).append(true).open(&log).unwrap();
        io::Write::write_all(&mut writer, b"old").unwrap();
        put_aside(&log).unwrap();
        io::Write::write_all(&mut writer, b"new").unwrap();
        assert_eq!(fs::read_to_string(&log).unwrap(), "new");
        assert_eq!(fs::read_to_string(dir.path().join("log.1")).unwrap(), "old");
    }
}
