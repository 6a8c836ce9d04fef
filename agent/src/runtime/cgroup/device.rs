//! The block device under a directory. The kernel throttles whole disks, not partitions.

use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

/// `major:minor` of a whole disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Disk {
    pub(crate) major: u64,
    pub(crate) minor: u64,
}

/// The disk that holds `dir`; `None` when its file system has no single block device (tmpfs,
/// overlay, btrfs), where a rate cannot be enforced.
pub(crate) fn disk_of(dir: &Path) -> io::Result<Option<Disk>> {
    let dev = std::fs::metadata(dir)?.dev();
    let (major, minor) = (u64::from(libc::major(dev)), u64::from(libc::minor(dev)));
    if major == 0 {
        return Ok(None);
    }
    let node = Path::new("/sys/dev/block").join(format!("{major}:{minor}"));
    let Ok(node) = node.canonicalize() else { return Ok(None) };
    if !node.join("partition").exists() {
        return Ok(Some(Disk { major, minor }));
    }
    let Some(whole) = node.parent() else { return Ok(None) };
    Ok(parse(&std::fs::read_to_string(whole.join("dev"))?))
}

/// The device node of a disk, as Docker wants it.
pub(crate) fn path_of(disk: Disk) -> io::Result<String> {
    let uevent =
        std::fs::read_to_string(format!("/sys/dev/block/{}:{}/uevent", disk.major, disk.minor))?;
    let name = uevent.lines().find_map(|line| line.strip_prefix("DEVNAME="));
    match name {
        Some(name) => Ok(format!("/dev/{name}")),
        None => Err(io::Error::new(io::ErrorKind::NotFound, "the disk has no device node")),
    }
}

fn parse(dev: &str) -> Option<Disk> {
    let (major, minor) = dev.trim().split_once(':')?;
    Some(Disk { major: major.parse().ok()?, minor: minor.parse().ok()? })
}
