//! Terminals for programs: a pair of descriptors, of which the program has one and whoever serves it the other.

use std::io;
use std::os::fd::{AsRawFd as _, FromRawFd as _, OwnedFd};

/// A new terminal.
#[derive(Debug)]
pub(super) struct Pty {
    /// What is written here, the program reads; what is read here, it wrote.
    pub(super) ours: OwnedFd,
    /// The program's.
    pub(super) theirs: OwnedFd,
}

/// Makes a terminal. Neither end passes through an exec by itself: other threads start programs at any time.
pub(super) fn open() -> io::Result<Pty> {
    let flags = libc::O_RDWR | libc::O_NOCTTY | libc::O_CLOEXEC;
    // SAFETY: numbers only; each descriptor is new, and owned as soon as it is known to be one.
    unsafe {
        let ours = owned(libc::posix_openpt(flags))?;
        if libc::unlockpt(ours.as_raw_fd()) == -1 {
            return Err(io::Error::last_os_error());
        }
        // By the descriptor and not by its name: that may be another mount's.
        let theirs = owned(libc::ioctl(ours.as_raw_fd(), libc::TIOCGPTPEER, flags))?;
        Ok(Pty { ours, theirs })
    }
}

/// Says how large it is; whoever runs in it is told by a signal.
pub(super) fn resize(ours: &OwnedFd, columns: u16, rows: u16) {
    let size = libc::winsize { ws_row: rows, ws_col: columns, ws_xpixel: 0, ws_ypixel: 0 };
    // SAFETY: a live descriptor and a pointer to a local. A terminal that is gone has no size.
    let _ = unsafe { libc::ioctl(ours.as_raw_fd(), libc::TIOCSWINSZ, &raw const size) };
}

/// # Safety
/// `fd` is -1, or a new descriptor that nothing else owns.
unsafe fn owned(fd: i32) -> io::Result<OwnedFd> {
    if fd == -1 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: as the caller says.
    Ok(unsafe { OwnedFd::from_raw_fd(fd) })
}
