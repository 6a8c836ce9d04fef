//! One driver: a program or a socket, and what waits for it. A stop overtakes what waits.

use std::collections::VecDeque;
use std::io;
use std::process::Stdio;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::{BufMut as _, Bytes, BytesMut};
use tokio::io::{AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::UnixStream;
use tokio::net::unix::OwnedReadHalf;
use tokio::process::{Child, Command};
use tokio::sync::{Notify, mpsc, watch};
use tokio_util::task::AbortOnDropHandle;

use super::hall::Input;
use super::settings::{self, Framing};

/// Commands that may wait. They are of a moment: a driver that is this far behind is not driven any more.
const QUEUE: usize = 16;

/// Between two tries to reach a driver.
const AGAIN: Duration = Duration::from_millis(100);

/// Between a cut and the end of the driver: it reads its stop, if it reads at all.
const LAST_WORD: Duration = Duration::from_millis(20);

/// A driver that has not read for this long is begun anew.
const READS_WITHIN: Duration = Duration::from_millis(200);

/// What may lie in a driver's pipe, bytes: the least that the kernel has. What lies there comes before a stop.
const PIPE: usize = 4096;

/// A driver as the hall sees it.
#[derive(Debug)]
pub(super) struct Driver {
    pub(super) settings: settings::Driver,
    line: Arc<Line>,
    _task: AbortOnDropHandle<()>,
}

/// What waits for the driver.
#[derive(Debug, Default)]
struct Line {
    state: Mutex<State>,
    changed: Notify,
    /// Its power is cut: it is not to be there.
    cut: watch::Sender<bool>,
}

#[derive(Debug, Default)]
struct State {
    frames: VecDeque<Bytes>,
    there: bool,
}

impl Line {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Cancel safe: a frame that was taken is returned.
    async fn next(&self) -> Bytes {
        loop {
            if let Some(frame) = self.state().frames.pop_front() {
                return frame;
            }
            self.changed.notified().await;
        }
    }

    async fn allowed(&self) {
        let mut cut = self.cut.subscribe();
        // Closed: never, this holds its sender.
        let _ = cut.wait_for(|cut| !cut).await;
    }

    /// Returns when its power has been cut for so long that it has read its stop, or never will.
    async fn cut_off(&self) {
        let mut cut = self.cut.subscribe();
        let _ = cut.wait_for(|cut| *cut).await;
        tokio::time::sleep(LAST_WORD).await;
    }

    fn set_there(&self, there: bool) {
        let mut state = self.state();
        state.there = there;
        state.frames.clear();
    }
}

impl Driver {
    /// Begins to reach it; `inputs` hears when it is there and when it is gone.
    pub(super) fn start(
        at: usize,
        settings: settings::Driver,
        inputs: mpsc::Sender<Input>,
    ) -> Driver {
        let line = Arc::new(Line::default());
        let keeps = keep(at, settings.clone(), Arc::clone(&line), inputs);
        Driver { settings, line, _task: AbortOnDropHandle::new(tokio::spawn(keeps)) }
    }

    /// Whether it takes the command.
    pub(super) fn command(&self, data: &Bytes) -> bool {
        let Some(frame) = framed(self.settings.framing, data) else { return false };
        let mut state = self.line.state();
        if !state.there || state.frames.len() >= QUEUE {
            return false;
        }
        state.frames.push_back(frame);
        drop(state);
        self.line.changed.notify_one();
        true
    }

    /// Before everything that waits, which is dropped.
    pub(super) fn stop(&self) {
        self.at_once(&self.settings.stop);
    }

    /// The same with the hold command.
    pub(super) fn hold(&self) {
        self.at_once(self.settings.hold.as_ref().unwrap_or(&self.settings.stop));
    }

    fn at_once(&self, text: &str) {
        let Some(frame) = framed(self.settings.framing, text.as_bytes()) else { return };
        let mut state = self.line.state();
        state.frames.clear();
        // One that is not there is stopped as soon as it is.
        if state.there {
            state.frames.push_back(frame);
        }
        drop(state);
        self.line.changed.notify_one();
    }

    /// Cuts the power, by the driver's own command; one that has none is ended until `cut` is said to be over.
    pub(super) fn cut(&self) {
        match &self.settings.cut {
            Some(text) => {
                self.stop();
                let _ = self.command(&Bytes::copy_from_slice(text.as_bytes()));
            }
            None => self.keep_off(true),
        }
    }

    /// Whether its power is to stay cut.
    pub(super) fn keep_off(&self, cut: bool) {
        let cut = cut && self.settings.cut.is_none();
        self.line.cut.send_if_modified(|is| std::mem::replace(is, cut) != cut);
    }
}

/// `None`: it cannot be kept apart from the next one.
fn framed(framing: Framing, data: &[u8]) -> Option<Bytes> {
    let mut frame = BytesMut::with_capacity(data.len() + 4);
    match framing {
        Framing::Lines if data.contains(&b'\n') => return None,
        Framing::Lines => {
            frame.put_slice(data);
            frame.put_u8(b'\n');
        }
        Framing::Length => {
            frame.put_u32(u32::try_from(data.len()).ok()?);
            frame.put_slice(data);
        }
    }
    Some(frame.freeze())
}

/// Reaches the driver, feeds it, and begins again when it is gone.
async fn keep(at: usize, settings: settings::Driver, line: Arc<Line>, inputs: mpsc::Sender<Input>) {
    loop {
        line.allowed().await;
        let error = match reach(&settings).await {
            Ok((mut to, mut end)) => {
                line.set_there(true);
                // Closed: the gate ends.
                let _ = inputs.send(Input::DriverBack(at)).await;
                // Neither is polled again after the other has ended.
                let error = tokio::select! {
                    error = end.gone() => Some(error),
                    error = feed(&line, &mut to) => Some(error),
                    () = line.cut_off() => None,
                };
                line.set_there(false);
                end.now().await;
                error
            }
            Err(error) => Some(error),
        };
        let why = error.map_or_else(|| "its power is cut".to_owned(), |error| error.to_string());
        let _ = inputs.send(Input::DriverGone(at, why)).await;
        tokio::time::sleep(AGAIN).await;
    }
}

/// How a driver ends.
enum End {
    Program(Child),
    Socket(OwnedReadHalf),
}

impl End {
    /// Returns when the driver is gone.
    async fn gone(&mut self) -> io::Error {
        match self {
            End::Program(child) => match child.wait().await {
                Ok(status) => io::Error::other(format!("it ended: {status}")),
                Err(error) => error,
            },
            End::Socket(from) => {
                // What a driver says is for its own log.
                let mut heard = [0; 1024];
                loop {
                    match from.read(&mut heard).await {
                        Ok(0) => return io::Error::other("it closed its socket"),
                        Ok(_) => {}
                        Err(error) => return error,
                    }
                }
            }
        }
    }

    /// Ends it, and waits for that: the next one is the only one.
    async fn now(self) {
        match self {
            End::Program(mut child) => {
                let group = child.id().and_then(|id| i32::try_from(id).ok());
                if let Some(group) = group.and_then(rustix::process::Pid::from_raw) {
                    // Gone already: that is what was wanted.
                    let _ =
                        rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
                }
                drop(child.kill().await);
            }
            End::Socket(from) => drop(from),
        }
    }
}

type To = Box<dyn AsyncWrite + Send + Unpin>;

async fn reach(settings: &settings::Driver) -> io::Result<(To, End)> {
    if let Some(path) = &settings.unix {
        let stream = UnixStream::connect(path).await?;
        // The kernel takes no less than its least.
        rustix::net::sockopt::set_socket_send_buffer_size(&stream, PIPE)?;
        let (from, to) = stream.into_split();
        return Ok((Box::new(to), End::Socket(from)));
    }
    let missing = || io::Error::new(io::ErrorKind::InvalidInput, "no program");
    let (program, args) = settings.exec.split_first().ok_or_else(missing)?;
    let mut command = Command::new(program);
    // Its standard error is the gate's log.
    command.args(args).stdin(Stdio::piped()).stdout(Stdio::null()).kill_on_drop(true);
    // What it starts ends with it.
    command.process_group(0);
    // SAFETY: prctl is async-signal-safe, and nothing else happens between fork and exec.
    unsafe {
        // Two of one driver must never be: it ends with the gate, however that ends.
        command.pre_exec(|| match libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) {
            0 => Ok(()),
            _ => Err(io::Error::last_os_error()),
        });
    }
    let mut child = command.spawn()?;
    let to = child.stdin.take().ok_or_else(|| io::Error::other("its pipe is not there"))?;
    rustix::pipe::fcntl_setpipe_size(&to, PIPE)?;
    Ok((Box::new(to), End::Program(child)))
}

/// Until it does not read any more.
async fn feed(line: &Line, to: &mut To) -> io::Error {
    loop {
        let frame = line.next().await;
        match tokio::time::timeout(READS_WITHIN, to.write_all(&frame)).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return error,
            // A stop may wait behind it, and would wait for ever.
            Err(_) => {
                return io::Error::new(io::ErrorKind::TimedOut, "it does not read its commands");
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames() {
        assert_eq!(framed(Framing::Lines, b"go").unwrap(), "go\n");
        assert_eq!(framed(Framing::Lines, b"go\non"), None);
        assert_eq!(framed(Framing::Length, b"a\n").unwrap().as_ref(), b"\0\0\0\x02a\n");
    }
}
