//! One driver: a program, a socket or a topic of ROS's, and what waits for it. A stop overtakes what waits.

use std::collections::VecDeque;
use std::io;
use std::os::fd::AsRawFd as _;
use std::process::Stdio;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::process::{Child, ChildStdin, Command};
use tokio::sync::{Notify, mpsc, watch};
use tokio::time::Instant;
use tokio_util::task::AbortOnDropHandle;

use super::codec::Codec;
use super::hall::Input;
use super::settings::{self, Ros, Waiting};
use super::topic::{self, Say};

/// Between two tries to reach a driver.
const AGAIN: Duration = Duration::from_millis(100);

/// Between a cut and the end of the driver: it reads its stop, if it reads at all.
const LAST_WORD: Duration = Duration::from_millis(20);

/// A driver that has not read its stop for this long is begun anew.
const READS_WITHIN: Duration = Duration::from_millis(500);

/// The first time: a program has to start.
const BEGINS_WITHIN: Duration = Duration::from_secs(10);

/// What may lie in a driver's pipe, bytes: the least that the kernel has.
const PIPE: usize = 4096;

/// Between two looks whether a driver has read its last command. What lies in its pipe comes before a stop, so that is one
/// command at most.
const LOOK: Duration = Duration::from_millis(1);

/// A driver as the hall sees it.
#[derive(Debug)]
pub(super) struct Driver {
    pub(super) settings: settings::Driver,
    codec: Codec,
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
    frames: VecDeque<Frame>,
    there: bool,
    /// It has not read its newest stop.
    owes: bool,
}

#[derive(Debug)]
struct Frame {
    bytes: Bytes,
    /// What it commands; absent: a stop, which does not wait until what is before it was read.
    actuator: Option<String>,
}

impl Line {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Cancel safe: a frame that was taken is returned.
    async fn next(&self, to: &To) -> Frame {
        loop {
            let waits = {
                let mut state = self.state();
                match state.frames.front() {
                    Some(first) if first.actuator.is_none() || to.takes_more() => {
                        state.frames.pop_front().map(Ok)
                    }
                    first => first.map(|_| Err(())),
                }
            };
            match waits {
                Some(Ok(frame)) => return frame,
                // A stop takes the place of what waits.
                Some(Err(())) => {
                    let _ = tokio::time::timeout(LOOK, self.changed.notified()).await;
                }
                None => self.changed.notified().await,
            }
        }
    }

    /// It has read everything. A stop that was said meanwhile is still to be written.
    fn stands(&self) {
        let mut state = self.state();
        state.owes = state.frames.iter().any(|frame| frame.actuator.is_none());
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
        (state.there, state.owes) = (there, false);
        state.frames.clear();
    }
}

impl Driver {
    /// Begins to reach it; `inputs` hears when it is there and when it is gone.
    pub(super) fn start(
        at: usize,
        settings: settings::Driver,
        ros: &Ros,
        inputs: mpsc::Sender<Input>,
    ) -> Driver {
        let (line, codec) = (Arc::new(Line::default()), Codec::of(&settings));
        let stop = codec.encode("", settings.stop.as_bytes()).unwrap_or_default();
        let place = Place { settings: settings.clone(), ros: ros.clone(), stop };
        let keeps = keep(place, Arc::clone(&line), Say { at, inputs });
        Driver { settings, codec, line, _task: AbortOnDropHandle::new(tokio::spawn(keeps)) }
    }

    /// Whether it takes the command. One that waits for it is of a moment that is over: as the driver is set up, the newer one
    /// takes its place, or is not taken.
    pub(super) fn command(&self, actuator: &str, format: &str, data: &[u8]) -> bool {
        let Some(bytes) = self.codec.encode(format, data) else { return false };
        let mut state = self.line.state();
        if !state.there {
            return false;
        }
        let same = |frame: &&mut Frame| frame.actuator.as_deref() == Some(actuator);
        match (state.frames.iter_mut().find(same), self.settings.waiting) {
            (Some(_), Waiting::Each) => return false,
            (Some(frame), Waiting::Newest) => frame.bytes = bytes,
            (None, _) => {
                state.frames.push_back(Frame { bytes, actuator: Some(actuator.to_owned()) });
            }
        }
        drop(state);
        self.line.changed.notify_one();
        true
    }

    /// Whether it has read its newest stop.
    pub(super) fn stands(&self) -> bool {
        !self.line.state().owes
    }

    /// Before everything that waits, which is dropped.
    pub(super) fn stop(&self) {
        self.at_once([self.settings.stop.as_str()]);
    }

    /// The same with the hold command.
    pub(super) fn hold(&self) {
        self.at_once([self.settings.hold.as_ref().unwrap_or(&self.settings.stop).as_str()]);
    }

    fn at_once<const N: usize>(&self, texts: [&str; N]) {
        let mut state = self.line.state();
        state.frames.clear();
        // One that is not there is stopped as soon as it is.
        if state.there {
            let frames = texts.map(|text| self.codec.encode("", text.as_bytes()));
            let frame = |bytes| Frame { bytes, actuator: None };
            state.frames.extend(frames.into_iter().flatten().map(frame));
            state.owes = true;
        }
        drop(state);
        self.line.changed.notify_one();
    }

    /// Cuts the power, by the driver's own command; one that has none is ended until `cut` is said to be over.
    pub(super) fn cut(&self) {
        match &self.settings.cut {
            Some(text) => self.at_once([&self.settings.stop, text]),
            None => self.keep_off(true),
        }
    }

    /// Whether its power is to stay cut.
    pub(super) fn keep_off(&self, cut: bool) {
        let cut = cut && self.settings.cut.is_none();
        self.line.cut.send_if_modified(|is| std::mem::replace(is, cut) != cut);
    }
}

/// Where a driver is.
struct Place {
    settings: settings::Driver,
    ros: Ros,
    /// As it reads it.
    stop: Bytes,
}

/// Reaches the driver, feeds it, and begins again when it is gone.
async fn keep(place: Place, line: Arc<Line>, say: Say) {
    let Say { at, inputs } = &say;
    loop {
        line.allowed().await;
        let error = match reach(&place, &say).await {
            Ok((mut to, mut end)) => {
                line.set_there(true);
                // Closed: the gate ends.
                let _ = inputs.send(Input::DriverBack(*at)).await;
                // Neither is polled again after the other has ended.
                let error = tokio::select! {
                    error = end.gone() => Some(error),
                    error = feed(&line, &mut to, inputs) => Some(error),
                    () = line.cut_off() => None,
                };
                line.set_there(false);
                end.now().await;
                error
            }
            Err(error) => Some(error),
        };
        let why = error.map_or_else(|| "its power is cut".to_owned(), |error| error.to_string());
        let _ = inputs.send(Input::DriverGone(*at, why)).await;
        tokio::time::sleep(AGAIN).await;
    }
}

/// How a driver ends.
enum End {
    Program(Child),
    Socket(OwnedReadHalf),
    Topic(Box<topic::End>),
}

impl End {
    /// Returns when the driver is gone.
    async fn gone(&mut self) -> io::Error {
        match self {
            End::Program(child) => match child.wait().await {
                Ok(status) => io::Error::other(format!("it ended: {status}")),
                Err(error) => error,
            },
            End::Topic(end) => end.gone().await,
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
            End::Topic(end) => end.now().await,
        }
    }
}

/// Where its commands go.
enum To {
    Pipe(ChildStdin),
    Socket(OwnedWriteHalf),
    Topic(topic::To),
}

impl To {
    async fn write(&mut self, frame: &Frame) -> io::Result<()> {
        match self {
            To::Pipe(to) => to.write_all(&frame.bytes).await,
            To::Socket(to) => to.write_all(&frame.bytes).await,
            To::Topic(to) => {
                to.write(&frame.bytes, frame.actuator.is_none());
                Ok(())
            }
        }
    }

    /// Whether it may be given another command.
    fn takes_more(&self) -> bool {
        match self {
            To::Pipe(_) | To::Socket(_) => self.is_read(),
            To::Topic(to) => to.takes_more(),
        }
    }

    /// Whether everything that was written has been read. What the kernel does not tell counts as read.
    fn is_read(&self) -> bool {
        let mut bytes: libc::c_int = 0;
        let (fd, what) = match self {
            To::Pipe(to) => (to.as_raw_fd(), libc::FIONREAD),
            To::Socket(to) => (to.as_ref().as_raw_fd(), libc::TIOCOUTQ),
            To::Topic(to) => return to.is_read(),
        };
        // SAFETY: the descriptor is open, and both requests write one int.
        unsafe { libc::ioctl(fd, what, &mut bytes) != 0 || bytes == 0 }
    }
}

async fn reach(place: &Place, say: &Say) -> io::Result<(To, End)> {
    let Place { settings, ros, stop } = place;
    if let Some(topic) = &settings.ros1 {
        let reached = topic::reach(topic, settings.waiting, (ros, stop.clone()), say.clone());
        let (to, end) = reached.await?;
        return Ok((To::Topic(to), End::Topic(Box::new(end))));
    }
    if let Some(path) = &settings.unix {
        let stream = UnixStream::connect(path).await?;
        // The kernel takes no less than its least.
        rustix::net::sockopt::set_socket_send_buffer_size(&stream, PIPE)?;
        let (from, to) = stream.into_split();
        return Ok((To::Socket(to), End::Socket(from)));
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
    Ok((To::Pipe(to), End::Program(child)))
}

/// Until it does not read any more. Says whenever it has read its stop.
async fn feed(line: &Line, to: &mut To, inputs: &mpsc::Sender<Input>) -> io::Error {
    let deaf = || io::Error::new(io::ErrorKind::TimedOut, "it does not read its commands");
    let mut within = BEGINS_WITHIN;
    let mut unread: Option<Instant> = None;
    loop {
        // Neither takes anything before it is done.
        let frame = tokio::select! {
            frame = line.next(to) => frame,
            read = reads(to, unread) => match read {
                true => {
                    (unread, within) = (None, READS_WITHIN);
                    line.stands();
                    // Closed: the gate ends.
                    let _ = inputs.send(Input::DriverStands).await;
                    continue;
                }
                false => return deaf(),
            },
        };
        match tokio::time::timeout(within, to.write(&frame)).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return error,
            // A stop may wait behind it, and would wait for ever.
            Err(_) => return deaf(),
        }
        if frame.actuator.is_none() {
            unread.get_or_insert_with(|| Instant::now() + within);
        }
    }
}

/// Whether it has read everything until then; never, if it owes nothing.
async fn reads(to: &To, until: Option<Instant>) -> bool {
    let Some(until) = until else { return std::future::pending().await };
    loop {
        match to.is_read() {
            true => return true,
            false if Instant::now() >= until => return false,
            false => tokio::time::sleep(LOOK).await,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use tokio::net::UnixListener;

    use super::*;

    /// A driver that reads nothing, and where it is reached.
    fn deaf(at: &Path) -> (settings::Driver, UnixListener) {
        let listener = UnixListener::bind(at).unwrap();
        let settings = serde_json::json!({"actuators": ["base:Drive"], "unix": at, "stop": "stop"});
        (serde_json::from_value(settings).unwrap(), listener)
    }

    async fn reached(
        settings: settings::Driver,
        listener: &UnixListener,
    ) -> (Driver, UnixStream, mpsc::Receiver<Input>) {
        let (inputs, mut heard) = mpsc::channel(4);
        let driver = Driver::start(0, settings, &Ros::default(), inputs);
        let (stream, _) = listener.accept().await.unwrap();
        assert!(matches!(heard.recv().await, Some(Input::DriverBack(0))));
        (driver, stream, heard)
    }

    /// Until what waits has been written.
    async fn written(driver: &Driver) {
        while !driver.line.state().frames.is_empty() {
            tokio::task::yield_now().await;
        }
    }

    #[tokio::test]
    async fn one_command_at_most_lies_before_a_stop() {
        let dir = tempfile::tempdir().unwrap();
        let (settings, listener) = deaf(&dir.path().join("driver"));
        let (driver, mut stream, _heard) = reached(settings, &listener).await;
        let go = |text: &'static str| driver.command("base:Drive", "", text.as_bytes());
        assert!(go("first"));
        written(&driver).await;
        for _ in 0..3 {
            assert!(go("more"));
        }
        // Looked at many times, and not written.
        for _ in 0..100 {
            tokio::task::yield_now().await;
        }
        driver.stop();
        written(&driver).await;
        drop(driver);
        let mut text = String::new();
        stream.read_to_string(&mut text).await.unwrap();
        assert_eq!(text, "first\nstop\n");
    }

    #[tokio::test]
    async fn a_driver_that_is_behind_gets_what_is_newest() {
        let dir = tempfile::tempdir().unwrap();
        let (mut settings, listener) = deaf(&dir.path().join("driver"));
        for (waiting, taken, next) in
            [(Waiting::Newest, true, "twist 20\n"), (Waiting::Each, false, "twist 1\n")]
        {
            settings.waiting = waiting;
            let (driver, mut stream, _heard) = reached(settings.clone(), &listener).await;
            assert!(driver.command("base:Drive", "", b"twist 0"));
            written(&driver).await;
            assert!(driver.command("arm:Grasp", "", b"close"));
            assert!(driver.command("base:Drive", "", b"twist 1"));
            for n in 2..=20 {
                let twist = format!("twist {n}");
                assert_eq!(driver.command("base:Drive", "", twist.as_bytes()), taken);
            }
            let mut read = async |text: &str| {
                let mut bytes = vec![0; text.len()];
                stream.read_exact(&mut bytes).await.unwrap();
                assert_eq!(String::from_utf8(bytes).unwrap(), text);
            };
            for text in ["twist 0\n", "close\n", next] {
                read(text).await;
            }
        }
    }

    #[tokio::test]
    async fn a_driver_that_does_not_read_its_stop_is_begun_anew() {
        let dir = tempfile::tempdir().unwrap();
        let (settings, listener) = deaf(&dir.path().join("driver"));
        let (driver, mut stream, mut heard) = reached(settings, &listener).await;
        driver.stop();
        assert!(!driver.stands());
        let mut stop = [0; 5];
        stream.read_exact(&mut stop).await.unwrap();
        assert!(matches!(heard.recv().await, Some(Input::DriverStands)));
        assert!(driver.stands());
        driver.stop();
        match heard.recv().await {
            Some(Input::DriverGone(0, why)) => assert!(why.contains("does not read"), "{why}"),
            _ => panic!("it is there"),
        }
        listener.accept().await.unwrap();
    }

    /// See `muster-hostile`.
    #[test]
    fn whatever_a_driver_says_its_commands_come_whole() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let dir = tempfile::tempdir().unwrap();
        let reached = runtime.block_on(async {
            let (settings, listener) = deaf(&dir.path().join("driver"));
            reached(settings, &listener).await
        });
        let all = Mutex::new((runtime, reached));
        let inputs = muster_hostile::inputs("driver");
        muster_hostile::feed(bolero::check!(), inputs, |bytes| {
            let mut all = all.lock().unwrap();
            let (runtime, (driver, stream, _heard)) = &mut *all;
            let mut heard = [0; 3];
            runtime.block_on(async {
                stream.write_all(bytes).await.unwrap();
                assert!(driver.command("base:Drive", "", b"go"));
                stream.read_exact(&mut heard).await.unwrap();
            });
            assert_eq!(&heard, b"go\n");
        });
    }
}
