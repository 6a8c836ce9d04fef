//! A device node, a FIFO or a file.

use std::io;
use std::path::Path;

use rustix::fs::{Mode, OFlags};
use tokio_util::sync::CancellationToken;

use super::input::Input;
use crate::sensor::channel::Channel;

pub(super) async fn run(path: &Path, channel: &Channel, end: CancellationToken) -> String {
    let of = |error: &dyn std::fmt::Display| format!("{}: {error}", path.display());
    let input = match open(path).await {
        Ok(input) => input,
        Err(error) => return of(&error),
    };
    // Nothing of it is read again after this.
    tokio::select! {
        () = end.cancelled() => "nobody wants it".to_owned(),
        why = input.frames(channel) => of(&why.as_deref().unwrap_or("it ended")),
    }
}

async fn open(path: &Path) -> io::Result<Input> {
    let path = path.to_owned();
    // A device may take its time to open. A FIFO is open at once, and says when somebody writes to it.
    let flags = OFlags::RDONLY | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
    let open = move || rustix::fs::open(path, flags, Mode::empty());
    let fd = tokio::task::spawn_blocking(open).await.map_err(io::Error::other)??;
    Input::new(fd)
}
