//! A program, by what it writes to its standard output. What it says on its standard error last is why it failed.

use std::io;
use std::os::fd::OwnedFd;
use std::process::Stdio;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use rustix::pipe::PipeFlags;
use rustix::process::{Pid, Signal};
use tokio::io::AsyncReadExt as _;
use tokio::process::{Child, ChildStderr, Command};
use tokio_util::sync::CancellationToken;

use super::input::Input;
use crate::sensor::channel::Channel;

/// The pipe holds a frame of a usual camera, so that its writer seldom waits for the agent; more than an unprivileged process
/// may ask for is not needed.
const PIPE: usize = 1 << 20;

/// Between SIGTERM and SIGKILL: the time to let a device go.
const GRACE: Duration = Duration::from_secs(2);

/// What is kept of its standard error, bytes.
const KEPT: usize = 256;

pub(super) async fn run(argv: &[String], channel: &Channel, end: CancellationToken) -> String {
    let program = argv.first().map_or("", String::as_str);
    let (mut child, output) = match start(argv) {
        Ok(started) => started,
        Err(error) => return format!("{program}: {error}"),
    };
    let last = Mutex::new(String::new());
    let errors = child.stderr.take();
    // Neither of the others is polled again after one has ended.
    let why = tokio::select! {
        biased;
        // What it said before it ended is there before its end.
        () = listen(errors, &last) => None,
        () = end.cancelled() => None,
        why = output.frames(channel) => Some(why),
    };
    drop(output);
    let ended = stop(child, why.is_none() || why.as_ref().is_some_and(Option::is_some)).await;
    let said = last.into_inner().unwrap_or_else(PoisonError::into_inner);
    let colon = if said.is_empty() { "" } else { ": " };
    match why.flatten() {
        Some(why) => format!("{program}: {why}{colon}{said}"),
        None => format!("{program}: {ended}{colon}{said}"),
    }
}

fn start(argv: &[String]) -> io::Result<(Child, Input)> {
    let missing = || io::Error::new(io::ErrorKind::InvalidInput, "no program");
    let (program, args) = argv.split_first().ok_or_else(missing)?;
    let (from, to): (OwnedFd, OwnedFd) = rustix::pipe::pipe_with(PipeFlags::CLOEXEC)?;
    // It is as large as it is.
    let _ = rustix::pipe::fcntl_setpipe_size(&from, PIPE);
    rustix::io::ioctl_fionbio(&from, true)?;
    let mut command = Command::new(program);
    command.args(args).stdin(Stdio::null()).stdout(to).stderr(Stdio::piped()).kill_on_drop(true);
    // What it starts ends with it.
    command.process_group(0);
    // SAFETY: prctl is async-signal-safe, and nothing else happens between fork and exec.
    unsafe {
        // Two of one source must never be: it ends with the agent, however that ends.
        command.pre_exec(|| match libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) {
            0 => Ok(()),
            _ => Err(io::Error::last_os_error()),
        });
    }
    let child = command.spawn()?;
    Ok((child, Input::new(from)?))
}

/// Never ends: its last line is kept as long as it may say anything.
async fn listen(errors: Option<ChildStderr>, last: &Mutex<String>) {
    let (mut tail, mut part) = (Vec::new(), [0; 1024]);
    if let Some(mut errors) = errors {
        while let Ok(more @ 1..) = errors.read(&mut part).await {
            tail.extend_from_slice(&part[..more]);
            tail.drain(..tail.len().saturating_sub(KEPT));
            let text = String::from_utf8_lossy(&tail);
            let line = text.lines().map(str::trim).rfind(|line| !line.is_empty());
            line.unwrap_or_default()
                .clone_into(&mut last.lock().unwrap_or_else(PoisonError::into_inner));
        }
    }
    std::future::pending().await
}

/// Ends it with all that it started; how it ended. `now`: it has not closed its output by itself.
async fn stop(mut child: Child, now: bool) -> String {
    let group = child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
    let signal = |signal| {
        // Gone already: that is what was wanted.
        group.map(|group| rustix::process::kill_process_group(group, signal))
    };
    if now {
        signal(Signal::TERM);
    }
    let ended = tokio::time::timeout(GRACE, child.wait()).await;
    signal(Signal::KILL);
    match ended {
        Ok(Ok(status)) => format!("it ended: {status}"),
        Ok(Err(error)) => error.to_string(),
        Err(_) => {
            drop(child.kill().await);
            "it closed its standard output and stayed".to_owned()
        }
    }
}
