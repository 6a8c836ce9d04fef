//! A program beside a running attempt, for a client: with the client's input and output as its streams, or as its terminal.
//!
//! As for a check, a thread of its own starts it, tied to it, and waits for its end; what it reads and writes passes through
//! the agent's one thread, without ever waiting there.

use std::io;
use std::os::fd::{AsFd as _, OwnedFd};
use std::os::unix::process::ExitStatusExt as _;
use std::process::{Child, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures::future::BoxFuture;
use rustix::event::{PollFd, PollFlags};
use rustix::io::Errno;
use rustix::pipe::PipeFlags;
use rustix::process::{Pid, PidfdFlags};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;

use super::attempt::AttemptDir;
use super::exec::{GONE_AFTER, STACK, beside, variables};
use super::{pty, scan};
use crate::exec::ends::{CHUNK, Ends, Input, Invocation, Outlet, Ran, Stream};
use crate::runtime::RuntimeError;
use crate::shim::start::{self, StartError, Streams};

const WHAT: &str = "run a program in a task";

/// As much as a pipe holds by default: what a program had written when it ended is no more than that. Others that it left
/// behind may go on writing, and nobody waits for them.
const LEFT: usize = 64 << 10;

/// What a terminal makes of the end of its client's input.
const END_OF_TRANSMISSION: &[u8] = &[4];

/// Our ends of a program's streams.
struct Ours {
    stdin: Option<OwnedFd>,
    stdout: OwnedFd,
    /// Absent: it is a terminal, and all three are one.
    stderr: Option<OwnedFd>,
}

pub(super) async fn interact(
    dir: AttemptDir,
    invocation: &Invocation,
    ends: Ends,
    until: BoxFuture<'_, ()>,
) -> Result<Ran, RuntimeError> {
    let failed = |error: io::Error| RuntimeError::new(WHAT, error);
    let (ours, theirs) = streams(invocation).map_err(failed)?;
    let (cut, keep) = rustix::pipe::pipe_with(PipeFlags::CLOEXEC)
        .map_err(|errno| RuntimeError::new(WHAT, errno))?;
    let (answer, mut answered) = oneshot::channel();
    let argv = invocation.argv.clone();
    std::thread::Builder::new()
        .name("exec".to_owned())
        .stack_size(STACK)
        // Whoever asked may be gone: then its end of `cut` is closed, and the thread ends soon.
        .spawn(move || answer.send(run(&dir, &argv, theirs, &cut)))
        .map_err(failed)?;
    let ended = CancellationToken::new();
    let Ends { input, room, output } = ends;
    let mut feed = Feed {
        stdin: ours.stdin.map(|fd| watched(fd, Interest::WRITABLE)).transpose().map_err(failed)?,
        terminal: invocation.tty,
        input,
        room,
    };
    let stdout = watched(ours.stdout, Interest::READABLE).map_err(failed)?;
    let stderr = ours.stderr.map(|fd| watched(fd, Interest::READABLE));
    let stderr = stderr.transpose().map_err(failed)?;
    let pumps = async {
        tokio::join!(
            pump(Some(&stdout), Stream::Stdout, &output, &ended),
            pump(stderr.as_ref(), Stream::Stderr, &output, &ended),
        )
    };
    // Known before all of its output is with the client, who may never read it.
    let end = OnceLock::new();
    let whole = async {
        let ends = async {
            let _ = end.set((&mut answered).await);
            ended.cancel();
        };
        tokio::join!(ends, pumps);
    };
    tokio::select! {
        () = whole => {}
        () = feed.run() => {}
        () = until => {}
    }
    // Before its streams are closed: who dies of that would seem to have ended, and what it left behind would stay.
    drop(keep);
    let done = match end.into_inner() {
        Some(done) => done,
        None => answered.await,
    };
    done.unwrap_or_else(|error| Err(RuntimeError::new(WHAT, error)))
}

/// Both ends of what a program reads and writes.
fn streams(invocation: &Invocation) -> io::Result<(Ours, Streams)> {
    if invocation.tty {
        let pty::Pty { ours, theirs } = pty::open()?;
        let again = || theirs.try_clone();
        let (stdin, stdout) = (again()?.into(), again()?);
        let streams = Streams { stdin, stdout, stderr: theirs, terminal: true };
        // Also without input: its size comes this way.
        return Ok((Ours { stdin: Some(ours.try_clone()?), stdout: ours, stderr: None }, streams));
    }
    let pipe = || rustix::pipe::pipe_with(PipeFlags::CLOEXEC).map_err(io::Error::from);
    let ((stdout, child_stdout), (stderr, child_stderr)) = (pipe()?, pipe()?);
    let (child_stdin, stdin) = match invocation.stdin {
        true => pipe().map(|(theirs, ours)| (theirs.into(), Some(ours)))?,
        false => (Stdio::null(), None),
    };
    let streams =
        Streams { stdin: child_stdin, stdout: child_stdout, stderr: child_stderr, terminal: false };
    Ok((Ours { stdin, stdout, stderr: Some(stderr) }, streams))
}

fn watched(fd: OwnedFd, interest: Interest) -> io::Result<AsyncFd<OwnedFd>> {
    rustix::io::ioctl_fionbio(&fd, true)?;
    // SAFETY: the `AsyncFd` owns the descriptor, and nobody takes it out or closes it meanwhile.
    unsafe { AsyncFd::register_with_interest(fd, interest) }.map_err(io::Error::from)
}

/// The client's input on its way to the program.
struct Feed {
    /// Absent: the program reads no more, or never did.
    stdin: Option<AsyncFd<OwnedFd>>,
    terminal: bool,
    input: tokio::sync::mpsc::UnboundedReceiver<Input>,
    room: crate::exec::ends::Room,
}

impl Feed {
    /// Ends when the client is gone.
    async fn run(&mut self) {
        while let Some(input) = self.input.recv().await {
            match input {
                Input::Data(data) => {
                    self.write(&data).await;
                    self.room.taken(data.len()).await;
                }
                Input::End if self.terminal => self.write(END_OF_TRANSMISSION).await,
                Input::End => self.stdin = None,
                Input::Size { columns, rows } => {
                    if let Some(stdin) = self.stdin.as_ref().filter(|_| self.terminal) {
                        pty::resize(stdin.get_ref(), columns, rows);
                    }
                }
            }
        }
    }

    /// What a program does not want to read is dropped.
    async fn write(&mut self, mut data: &[u8]) {
        while let Some(stdin) = self.stdin.as_ref().filter(|_| !data.is_empty()) {
            let written = stdin.async_io(Interest::WRITABLE, |fd| Ok(rustix::io::write(fd, data)?));
            match written.await {
                Ok(n) => data = data.get(n..).unwrap_or_default(),
                Err(_) => self.stdin = None,
            }
        }
    }
}

/// Passes output on until there is none any more; after `ended`, what is left of it.
async fn pump(
    from: Option<&AsyncFd<OwnedFd>>,
    stream: Stream,
    output: &Outlet,
    ended: &CancellationToken,
) {
    let Some(from) = from else { return };
    let mut buffer = vec![0; CHUNK];
    loop {
        let read = from.async_io(Interest::READABLE, |fd| Ok(rustix::io::read(fd, &mut buffer)?));
        let read = tokio::select! {
            biased;
            () = ended.cancelled() => break,
            read = read => read,
        };
        match read {
            // A terminal that nobody has open any more is an error to read.
            Ok(0) | Err(_) => return,
            Ok(n) => {
                if output.send(stream, Bytes::copy_from_slice(&buffer[..n])).await.is_err() {
                    return;
                }
            }
        }
    }
    let mut left = LEFT;
    while left > 0 {
        let room = left.min(buffer.len());
        match rustix::io::read(from.get_ref(), &mut buffer[..room]) {
            Err(Errno::INTR) => {}
            Ok(0) | Err(_) => return,
            Ok(n) => {
                left -= n;
                if output.send(stream, Bytes::copy_from_slice(&buffer[..n])).await.is_err() {
                    return;
                }
            }
        }
    }
}

/// The thread's work: from the start to the end.
fn run(
    dir: &AttemptDir,
    argv: &[String],
    theirs: Streams,
    cut: &OwnedFd,
) -> Result<Ran, RuntimeError> {
    let order = dir.order().map_err(|error| RuntimeError::new(WHAT, error))?;
    let order = order.ok_or_else(|| RuntimeError::new(WHAT, "it has no order"))?;
    let mut given = variables(dir);
    if theirs.terminal && !order.launch.env.contains_key("TERM") {
        // What the client's terminal understands nobody says; every one understands this.
        given.entry("TERM".into()).or_insert_with(|| "xterm".into());
    }
    let failed = |error: io::Error| RuntimeError::new(WHAT, error);
    let beside = beside(dir).ok_or_else(|| RuntimeError::new(WHAT, "it does not run"))?;
    match start::spawn((&order, &given), argv, theirs, Some(beside)) {
        Ok(child) => attend(child, cut).map_err(failed),
        Err(error @ StartError::Order(_)) => Ok(Ran::NotStarted(error.to_string())),
        Err(error) => Err(failed(io::Error::other(error.to_string()))),
    }
}

fn attend(mut child: Child, cut: &OwnedFd) -> io::Result<Ran> {
    let pid = Pid::from_child(&child);
    let whole = Whole(pid);
    let ended = rustix::process::pidfd_open(pid, PidfdFlags::empty())?;
    let over = loop {
        let mut fds = [
            PollFd::from_borrowed_fd(ended.as_fd(), PollFlags::IN),
            PollFd::from_borrowed_fd(cut.as_fd(), PollFlags::IN),
        ];
        match rustix::event::poll(&mut fds, None) {
            Ok(_) | Err(Errno::INTR) => {}
            Err(errno) => return Err(errno.into()),
        }
        let (over, is_cut) = (!fds[0].revents().is_empty(), !fds[1].revents().is_empty());
        if over || is_cut {
            break !is_cut;
        }
    };
    if over {
        // What it left running stays, as in a shell; it ends with the task.
        std::mem::forget(whole);
        let status = child.wait()?;
        let code = status.code().unwrap_or_else(|| 128 + status.signal().unwrap_or(0));
        return Ok(Ran::Ended(code));
    }
    drop(whole);
    child.try_wait()?;
    Ok(Ran::Cut)
}

/// The program's whole session; it is its leader, and not reaped while this lives.
struct Whole(Pid);

impl Drop for Whole {
    /// Kills until nothing is left: a process may fork while the table is read.
    fn drop(&mut self) {
        kill_session(self.0);
    }
}

/// Kills the processes of the session that `leader` leads, which is not reaped meanwhile; waits until they are gone, but for
/// those that the kernel itself holds up.
pub(crate) fn kill_session(leader: Pid) {
    let until = Instant::now() + GONE_AFTER;
    loop {
        let left = scan::session(leader.as_raw_nonzero().get());
        if left.is_empty() || Instant::now() > until {
            return;
        }
        for pid in left.into_iter().filter_map(Pid::from_raw) {
            // Gone already: nothing to kill.
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::KILL);
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}
