//! Unix sockets at paths.

use std::fs;
use std::io;
use std::os::fd::AsRawFd as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use tokio::net::UnixListener;

/// What `sun_path` holds, less the byte that ends it.
const LONGEST_PATH: usize = 107;

/// Listens at `path`, for those who may write to a file of `mode`; what an earlier life left there is replaced. Whoever finds
/// the socket may connect: it is made beside the path, and comes to it with its mode.
///
/// # Errors
///
/// The system's.
pub(crate) fn listen(path: &Path, mode: u32) -> io::Result<UnixListener> {
    let new = path.with_added_extension("new");
    match fs::remove_file(&new) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let listener = match (new.parent(), new.file_name()) {
        (Some(dir), Some(name)) if new.as_os_str().len() > LONGEST_PATH => {
            let dir = fs::File::open(dir)?;
            let short = PathBuf::from(format!("/proc/self/fd/{}", dir.as_raw_fd()));
            UnixListener::bind(short.join(name))?
        }
        _ => UnixListener::bind(&new)?,
    };
    fs::set_permissions(&new, fs::Permissions::from_mode(mode))?;
    fs::rename(&new, path)?;
    Ok(listener)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn it_takes_the_place_of_an_earlier_one() {
        let dir = tempfile::tempdir().expect("a directory");
        let deep = dir.path().join("x".repeat(LONGEST_PATH));
        fs::create_dir(&deep).expect("a directory");
        for path in [dir.path().join("s"), deep.join("s.sock")] {
            let _earlier = listen(&path, 0o600).expect("it listens");
            let now = listen(&path, 0o666).expect("it listens again");
            let mode = fs::metadata(&path).expect("it is there").permissions().mode();
            assert_eq!(mode & 0o777, 0o666);
            assert!(!path.with_added_extension("new").exists());
            let dir = fs::File::open(path.parent().expect("a directory")).expect("it opens");
            let short = format!("/proc/self/fd/{}", dir.as_raw_fd());
            let short = Path::new(&short).join(path.file_name().expect("a name"));
            let (to, at) = tokio::join!(tokio::net::UnixStream::connect(short), now.accept());
            assert!(to.is_ok() && at.is_ok(), "{to:?} {at:?}");
        }
    }
}
