//! When the agent was last in contact, for those who must act when the agent cannot: the shims of
//! tasks that may not run alone. Sixteen bytes in a small file, written in place.
//!
//! The time is that of the *sending* of the last message that was answered, so that a stop here
//! always happens before the controller, which counts from its receipt, relies on it.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::Path;

use muster_agent_core::time::Boot;

/// The file, open.
#[derive(Debug)]
pub(crate) struct ContactFile {
    file: File,
    boot: [u8; 8],
}

impl ContactFile {
    /// Opens or makes the file. Contact of an earlier boot does not count.
    pub(crate) fn open(path: &Path, boot_id: &str) -> io::Result<ContactFile> {
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(path)?;
        Ok(ContactFile { file, boot: fingerprint(boot_id) })
    }

    /// Records contact.
    pub(crate) fn write(&self, at: Boot) -> io::Result<()> {
        let mut record = [0; 16];
        record[..8].copy_from_slice(&self.boot);
        record[8..].copy_from_slice(&at.0.to_le_bytes());
        self.file.write_all_at(&record, 0)
    }

    /// The last contact of this boot.
    pub(crate) fn read(&self) -> Option<Boot> {
        let mut record = [0; 16];
        self.file.read_exact_at(&mut record, 0).ok()?;
        let (boot, at) = record.split_at(8);
        if boot != self.boot {
            return None;
        }
        Some(Boot(u64::from_le_bytes(at.try_into().ok()?)))
    }
}

/// FNV-1a: only to tell boots apart, and the same in every build of the agent.
fn fingerprint(boot_id: &str) -> [u8; 8] {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for byte in boot_id.trim().bytes() {
        hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    }
    hash.to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contact_of_another_boot_does_not_count() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("contact");
        let first = ContactFile::open(&path, "a").unwrap();
        assert_eq!(first.read(), None);
        first.write(Boot(7)).unwrap();
        assert_eq!(first.read(), Some(Boot(7)));
        assert_eq!(ContactFile::open(&path, "a").unwrap().read(), Some(Boot(7)));
        assert_eq!(ContactFile::open(&path, "b").unwrap().read(), None);
    }
}
