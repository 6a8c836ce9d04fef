//! Whether the disk of the agent's data directory is nearly full: tasks' logs and work directories are there, and the
//! agent's own notes of what it runs.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::Gauge;

/// A disk fills in seconds at worst; looking costs one system call.
const EVERY: Duration = Duration::from_secs(2);
/// Nearly full when less than this is left, percent of the space or of the inodes …
const LEAST: u64 = 5;
/// … until this is left again.
const ENOUGH: u64 = 7;

/// Tells whether the disk is nearly full.
#[derive(Debug)]
pub(crate) struct DiskGauge(Gauge<Option<String>>);

impl DiskGauge {
    pub(crate) fn open(dir: &Path) -> Self {
        let dir: PathBuf = dir.to_owned();
        DiskGauge(Gauge::open(EVERY, None, move |last| look(&dir, last)))
    }

    /// What is short; none: there is enough.
    pub(crate) fn pressure(&self) -> Option<String> {
        self.0.newest()
    }
}

/// A disk that does not answer stays as it was.
fn look(dir: &Path, last: Option<String>) -> Option<String> {
    let Ok(disk) = rustix::fs::statvfs(dir) else { return last };
    pressure(last.is_some(), (disk.f_bavail, disk.f_blocks), (disk.f_favail, disk.f_files))
}

/// `(left, of all)` of the blocks and of the inodes; file systems without a number of inodes say 0 of 0.
fn pressure(was: bool, blocks: (u64, u64), inodes: (u64, u64)) -> Option<String> {
    let least = if was { ENOUGH } else { LEAST };
    let short =
        |(left, all): (u64, u64)| u128::from(left) * 100 < u128::from(all) * u128::from(least);
    // Without the numbers themselves: a message that changed with every block would be written with every block.
    let what = match (short(blocks), short(inodes)) {
        (false, false) => return None,
        (true, _) => "space",
        (false, true) => "inodes",
    };
    Some(format!("less than {LEAST} % of the {what} of the agent's disk was left"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_is_nearly_full_until_there_is_a_little_more() {
        let plenty = (50, 100);
        assert_eq!(pressure(false, (5, 100), plenty), None);
        assert!(pressure(false, (4, 100), plenty).is_some_and(|why| why.contains("space")));
        assert!(pressure(true, (6, 100), plenty).is_some());
        assert_eq!(pressure(true, (7, 100), plenty), None);
        assert!(pressure(false, plenty, (4, 100)).is_some_and(|why| why.contains("inodes")));
        assert_eq!(pressure(false, plenty, (0, 0)), None);
    }

    #[test]
    fn a_disk_that_is_not_there_stays_as_it_was() {
        let nowhere = Path::new("/no/such/directory");
        assert_eq!(look(nowhere, None), None);
        assert_eq!(look(nowhere, Some("full".to_owned())), Some("full".to_owned()));
    }
}
