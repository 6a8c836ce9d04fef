//! A program beside a running attempt: a check. A thread of its own starts it, listens to it, and kills its process
//! group when it is over or is to be over: forks and control groups take milliseconds that the agent's one thread has
//! not, and the program is tied to that thread, so that it does not outlive an agent that is killed.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, Stdio};
use std::time::Duration;

use futures::future::BoxFuture;
use rustix::event::{PollFd, PollFlags, Timespec};
use rustix::pipe::PipeFlags;
use rustix::process::{Pid, PidfdFlags, Signal};
use tokio::sync::oneshot;

use super::attempt::{AttemptDir, Order, Process};
use super::scan;
use crate::runtime::{Executed, KEPT_WORDS, RuntimeError};
use crate::shim::start::{self, StartError, Streams};

const WHAT: &str = "run a program beside a task";

/// How long a program that was killed is waited for. One that the kernel itself holds up is left to it.
pub(super) const GONE_AFTER: Duration = Duration::from_secs(1);

/// The thread's stack: it calls nothing deep.
pub(super) const STACK: usize = 256 << 10;

pub(super) async fn exec(
    dir: AttemptDir,
    argv: &[String],
    until: BoxFuture<'_, ()>,
) -> Result<Executed, RuntimeError> {
    let (cut, keep) = rustix::pipe::pipe_with(PipeFlags::CLOEXEC)
        .map_err(|errno| RuntimeError::new(WHAT, errno))?;
    let (answer, mut answered) = oneshot::channel();
    let argv = argv.to_vec();
    std::thread::Builder::new()
        .name("check".to_owned())
        .stack_size(STACK)
        // Whoever asked may be gone: then its end of `cut` is closed, and the thread ends soon.
        .spawn(move || answer.send(run(&dir, &argv, &cut)))
        .map_err(|error| RuntimeError::new(WHAT, error))?;
    // Cancel-safe: dropped whole, which closes `keep` and so kills the program.
    let done = tokio::select! {
        // An answer that is there counts, however late anybody looks.
        biased;
        done = &mut answered => done,
        () = until => {
            drop(keep);
            answered.await
        }
    };
    done.unwrap_or_else(|error| Err(RuntimeError::new(WHAT, error)))
}

fn run(dir: &AttemptDir, argv: &[String], cut: &OwnedFd) -> Result<Executed, RuntimeError> {
    let failed = |error: io::Error| RuntimeError::new(WHAT, error);
    let order = dir.order().map_err(|error| RuntimeError::new(WHAT, error))?;
    let order: Order = order.ok_or_else(|| RuntimeError::new(WHAT, "it has no order"))?;
    let (output, child_output) = rustix::pipe::pipe_with(PipeFlags::CLOEXEC | PipeFlags::NONBLOCK)
        .map_err(|errno| failed(errno.into()))?;
    // Only the reading end may refuse to wait.
    rustix::io::ioctl_fionbio(&child_output, false).map_err(|errno| failed(errno.into()))?;
    let both = (child_output.try_clone().map_err(failed)?, child_output);
    let (stdout, stderr) = both;
    let streams = Streams { stdin: Stdio::null(), stdout, stderr, terminal: false };
    let beside = beside(dir).ok_or_else(|| RuntimeError::new(WHAT, "it does not run"))?;
    let child = match start::spawn((&order, &variables(dir)), argv, streams, Some(beside)) {
        Ok(child) => child,
        Err(error @ StartError::Order(_)) => return Ok(Executed::NotStarted(error.to_string())),
        Err(error) => return Err(failed(io::Error::other(error.to_string()))),
    };
    let mut words = Words { output, said: Vec::new(), open: true };
    attend(child, &mut words, cut).map_err(failed)
}

/// The attempt's own program.
pub(super) fn beside(dir: &AttemptDir) -> Option<Process> {
    dir.running().ok().flatten().map(|running| running.process)
}

/// The variables that the attempt's program was started with: those that it was given of ConfigMaps and Secrets are in no
/// file.
pub(super) fn variables(dir: &AttemptDir) -> BTreeMap<OsString, OsString> {
    beside(dir).map(scan::variables).unwrap_or_default()
}

/// What the program says, as far as it is kept.
struct Words {
    output: OwnedFd,
    said: Vec<u8>,
    open: bool,
}

impl Words {
    /// Reads what there is. All of it: a program must not wait for a reader.
    fn take(&mut self) {
        let mut buffer = [0; 4096];
        while self.open {
            match rustix::io::read(&self.output, &mut buffer) {
                Ok(0) => self.open = false,
                Ok(n) => {
                    let room = KEPT_WORDS.saturating_sub(self.said.len());
                    self.said.extend_from_slice(&buffer[..n.min(room)]);
                }
                Err(rustix::io::Errno::INTR) => {}
                Err(rustix::io::Errno::AGAIN) => return,
                Err(_) => self.open = false,
            }
        }
    }

    fn text(&self) -> String {
        String::from_utf8_lossy(&self.said).into_owned()
    }
}

/// The program's whole process group; it is its leader, and not reaped while this lives.
struct Whole(Pid);

impl Drop for Whole {
    fn drop(&mut self) {
        // Gone already: nothing to kill.
        let _ = rustix::process::kill_process_group(self.0, Signal::KILL);
    }
}

fn attend(mut child: Child, words: &mut Words, cut: &OwnedFd) -> io::Result<Executed> {
    let pid = Pid::from_child(&child);
    let whole = Whole(pid);
    let ended = rustix::process::pidfd_open(pid, PidfdFlags::empty())?;
    let was_cut = loop {
        let mut fds = vec![
            PollFd::from_borrowed_fd(ended.as_fd(), PollFlags::IN),
            PollFd::from_borrowed_fd(cut.as_fd(), PollFlags::IN),
        ];
        if words.open {
            fds.push(PollFd::from_borrowed_fd(words.output.as_fd(), PollFlags::IN));
        }
        match rustix::event::poll(&mut fds, None) {
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(errno) => return Err(errno.into()),
        }
        let (over, is_cut) = (!fds[0].revents().is_empty(), !fds[1].revents().is_empty());
        words.take();
        if over || is_cut {
            break !over;
        }
    };
    drop(whole);
    let wait = Timespec { tv_sec: GONE_AFTER.as_secs().cast_signed(), tv_nsec: 0 };
    let mut gone = [PollFd::from_borrowed_fd(ended.as_fd(), PollFlags::IN)];
    // Whatever it says, the look below does not wait.
    let _ = rustix::event::poll(&mut gone, Some(&wait));
    words.take();
    let status = child.try_wait()?;
    let said = words.text();
    Ok(match status {
        Some(status) if !was_cut => {
            let code = status.code().unwrap_or_else(|| 128 + status.signal().unwrap_or(0));
            Executed::Ended { code, said }
        }
        _ => Executed::Cut { said },
    })
}
