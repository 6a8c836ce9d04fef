//! Files that are whole or absent, also after a crash.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use muster_failpoint::{Failpoint, Step, reach};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// A file that could not be read or written.
#[derive(Debug, thiserror::Error)]
#[error("failed to {action} {path}")]
pub struct FileError {
    pub(crate) action: &'static str,
    pub(crate) path: PathBuf,
    #[source]
    pub(crate) source: io::Error,
}

impl FileError {
    /// There is no room on the disk, for now.
    pub(crate) fn is_full(&self) -> bool {
        use io::ErrorKind::{QuotaExceeded, StorageFull};
        matches!(self.source.kind(), StorageFull | QuotaExceeded)
    }

    pub(crate) fn at(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> FileError {
        let path = path.to_owned();
        move |source| FileError { action, path, source }
    }
}

/// Whether a write must survive a power cut, or only the end of this process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Keep {
    /// Survives `kill -9` of every process of ours.
    Crash,
    /// Survives a power cut.
    PowerCut,
}

/// Replaces `path` with `bytes`, whole. `point`: what it is, for tests that let this process die meanwhile.
pub(crate) fn write(
    point: Failpoint,
    path: &Path,
    bytes: &[u8],
    mode: u32,
    keep: Keep,
) -> Result<(), FileError> {
    reach(point, Step::Before);
    let mut tmp = path.as_os_str().to_owned();
    tmp.push(".tmp");
    let tmp = PathBuf::from(tmp);
    let mut file = OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(true)
        .mode(mode)
        .open(&tmp)
        .map_err(FileError::at("create", &tmp))?;
    reach(point, Step::Created);
    file.write_all(bytes).map_err(FileError::at("write", &tmp))?;
    if keep == Keep::PowerCut {
        file.sync_data().map_err(FileError::at("sync", &tmp))?;
    }
    reach(point, Step::Written);
    fs::rename(&tmp, path).map_err(FileError::at("rename to", path))?;
    if keep == Keep::PowerCut
        && let Some(dir) = path.parent()
    {
        sync_dir(dir)?;
    }
    reach(point, Step::After);
    Ok(())
}

/// Removes a file, if it is there.
pub(crate) fn remove_file(path: &Path) -> Result<(), FileError> {
    gone(fs::remove_file(path), path)
}

/// Removes a directory with all that is in it, if it is there.
pub(crate) fn remove_dir_all(path: &Path) -> Result<(), FileError> {
    gone(fs::remove_dir_all(path), path)
}

fn gone(removed: io::Result<()>, path: &Path) -> Result<(), FileError> {
    match removed {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(FileError::at("remove", path)(error))
        }
        _ => Ok(()),
    }
}

/// Makes the names in `dir` durable.
pub(crate) fn sync_dir(dir: &Path) -> Result<(), FileError> {
    File::open(dir).and_then(|dir| dir.sync_all()).map_err(FileError::at("sync", dir))
}

pub(crate) fn write_json<T: Serialize>(
    point: Failpoint,
    path: &Path,
    value: &T,
    keep: Keep,
) -> Result<(), FileError> {
    let bytes = serde_json::to_vec(value)
        .map_err(io::Error::from)
        .map_err(FileError::at("encode", path))?;
    write(point, path, &bytes, 0o600, keep)
}

/// `None`: there is no such file.
pub(crate) fn read_json<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, FileError> {
    let bytes = match fs::read(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        done => done.map_err(FileError::at("read", path))?,
    };
    serde_json::from_slice(&bytes)
        .map(Some)
        .map_err(io::Error::from)
        .map_err(FileError::at("decode", path))
}
