//! Frames of a robot's sensors, for the tasks that asked for them (`resources.sensors`).
//!
//! One reader of each source serves every task: a long frame lies once in memory that all of them see. A frame is this
//! program's until it asks for the next one; what it is too slow for is dropped for it alone, and counted. An agent that is
//! started again is connected to again; so is a source that fails, which [`Sensor::source`] tells of.
//!
//! ```no_run
//! # async fn watch() -> Result<(), muster_sdk::sensor::SensorError> {
//! use muster_sdk::sensor::{Mode, Sensor};
//!
//! let mut camera = Sensor::open("kinect:ImageGen", Mode::Latest).await?;
//! loop {
//!     let frame = camera.next().await?;
//!     println!("{}: {} bytes, {} dropped before", frame.sequence, frame.data.len(), frame.dropped);
//! }
//! # }
//! ```

mod line;

use std::collections::BTreeMap;
use std::env;
use std::fs::File;
use std::io;
use std::os::fd::AsRawFd as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use muster_api::name::{FunctionName, FunctionNameError};
use muster_api::wire::sensor::v1 as proto;
use proto::call::Call;
use proto::event::Event;
use proto::frame::Body;
use tokio::net::UnixStream;

use self::line::{Line, Mapping};
use crate::backoff::Backoff;

/// The variable that names the directory with the sockets of a task's sensors.
pub const DIR: &str = "MUSTER_SENSORS_DIR";
/// The variable that holds what the task shows there.
pub const TOKEN: &str = "MUSTER_SENSORS_TOKEN";

/// The protocol that this speaks.
const VERSION: u32 = 1;

/// A path that the kernel takes for a socket, bytes.
const LONGEST_PATH: usize = 107;

/// What becomes of frames that come while this program is busy with one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// The newest is kept. A reader begins with the newest that there is.
    Latest,
    /// So many wait at most (2 to 16), and the oldest goes. A reader begins with the next.
    Queue(u32),
}

/// How it stands with the source.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum State {
    /// Nothing has come yet.
    Starting,
    /// Frames come.
    Delivering,
    /// None come: why. It is tried again.
    Failing(String),
}

/// Why there are no frames for this program.
#[derive(Debug, thiserror::Error)]
pub enum SensorError {
    /// The environment says nothing of sensors.
    #[error(
        "{0} is not set; the task asks for no sensor that has a source on this node, or this is no task"
    )]
    NotSet(&'static str),
    /// The name is none.
    #[error(transparent)]
    Name(#[from] FunctionNameError),
    /// The task did not ask for it, or it has no source on this node.
    #[error(
        "{function}: there is no {path}; the task did not ask for it, or it has no source on this node"
    )]
    NotThere {
        /// What was to be read.
        function: FunctionName,
        /// Where its socket would be.
        path: PathBuf,
    },
    /// The agent does not let this program read, and would not the next time.
    #[error("the agent refuses: {0}")]
    Refused(String),
    /// The connection does not come about for a reason that does not go away by itself.
    #[error("the connection to the sensor")]
    Io(#[from] io::Error),
}

/// A frame, until the next one is asked for.
#[derive(Debug)]
pub struct Frame<'a> {
    /// Its number among the source's frames, in one life of the agent ([`Sensor::life`]).
    pub sequence: u64,
    /// Frames between this one and the one before that this program did not get.
    pub dropped: u64,
    /// When the agent had it whole.
    pub stamp: SystemTime,
    /// The same as the time since the machine's boot, suspend included.
    pub boot: Duration,
    /// What the source said; of a ROS topic, a serialised message.
    pub data: &'a [u8],
}

/// A reader of one function of a sensor.
#[derive(Debug)]
pub struct Sensor {
    function: FunctionName,
    path: PathBuf,
    token: String,
    mode: Mode,
    inline: bool,
    line: Option<Line>,
    slots: BTreeMap<u32, Mapping>,
    /// The frame that was given out last, and its bytes when they were sent.
    held: Option<Held>,
    state: State,
    format: String,
    life: String,
    backoff: Backoff,
}

#[derive(Debug)]
struct Held {
    frame: proto::Frame,
}

impl Sensor {
    /// Opens a function of a sensor as the task that this program runs in.
    ///
    /// # Errors
    ///
    /// The task did not ask for it, it has no source, or the agent refuses.
    pub async fn open(function: &str, mode: Mode) -> Result<Sensor, SensorError> {
        let get = |name| env::var(name).map_err(|_| SensorError::NotSet(name));
        Sensor::connect(Path::new(&get(DIR)?), get(TOKEN)?, function, mode).await
    }

    /// The same in a directory and with a token.
    ///
    /// # Errors
    ///
    /// As [`Sensor::open`].
    pub async fn connect(
        dir: &Path,
        token: String,
        function: &str,
        mode: Mode,
    ) -> Result<Sensor, SensorError> {
        let function: FunctionName = function.parse()?;
        let path = dir.join(function.path());
        if !path.exists() {
            return Err(SensorError::NotThere { function, path });
        }
        let mut sensor = Sensor {
            function,
            path,
            token,
            mode,
            inline: false,
            line: None,
            slots: BTreeMap::new(),
            held: None,
            state: State::Starting,
            format: String::new(),
            life: String::new(),
            backoff: Backoff::new(),
        };
        sensor.reach().await?;
        Ok(sensor)
    }

    /// Takes no shared memory from the next connection on: each frame is a copy that was sent.
    #[must_use]
    pub fn with_copies(mut self) -> Sensor {
        (self.inline, self.line) = (true, None);
        self
    }

    /// What is read.
    #[must_use]
    pub fn function(&self) -> &FunctionName {
        &self.function
    }

    /// How it stood with the source when something was last heard.
    #[must_use]
    pub fn source(&self) -> &State {
        &self.state
    }

    /// What frames are, as far as the source says it: `ros1:sensor_msgs/Image`.
    #[must_use]
    pub fn format(&self) -> &str {
        &self.format
    }

    /// The agent's life: sequences of another one are not comparable.
    #[must_use]
    pub fn life(&self) -> &str {
        &self.life
    }

    /// The next frame; the one before is given back. Waits for the source and for the agent as long as it takes. Cancel safe.
    ///
    /// # Errors
    ///
    /// The agent refuses, and would not the next time.
    pub async fn next(&mut self) -> Result<Frame<'_>, SensorError> {
        if let Some(Held { frame }) = self.held.take()
            && let Some(line) = &mut self.line
        {
            line.say(Call::Done(proto::Done { sequence: frame.sequence }))?;
        }
        let frame = loop {
            match self.hear().await? {
                Some(frame) => break frame,
                None => self.reach().await?,
            }
        };
        let Held { frame } = self.held.insert(Held { frame });
        let data: &[u8] = match &frame.body {
            Some(Body::Data(data)) => data,
            Some(Body::Shared(shared)) => {
                let mapping = self.slots.get(&shared.slot);
                mapping.map_or(&[], |mapping| mapping.bytes(shared.length))
            }
            None => &[],
        };
        let stamp = Duration::from_nanos(u64::try_from(frame.stamp_ns).unwrap_or(0));
        Ok(Frame {
            sequence: frame.sequence,
            dropped: frame.dropped,
            stamp: SystemTime::UNIX_EPOCH + stamp,
            boot: Duration::from_nanos(frame.boot_ns),
            data,
        })
    }

    /// The next frame of this connection; none: it has ended, and another one may come about.
    async fn hear(&mut self) -> Result<Option<proto::Frame>, SensorError> {
        let Some(line) = &mut self.line else { return Ok(None) };
        loop {
            let event = match line.hear().await {
                Ok(Some(event)) => event.event,
                Ok(None) | Err(_) => {
                    self.line = None;
                    return Ok(None);
                }
            };
            match event {
                Some(Event::Frame(frame)) => {
                    if let Some(Body::Shared(shared)) = &frame.body {
                        self.slots.retain(|slot, _| !shared.retired.contains(slot));
                        if shared.attached {
                            self.slots.insert(shared.slot, line.map(shared.capacity)?);
                        }
                    }
                    self.backoff.reset();
                    return Ok(Some(frame));
                }
                Some(Event::Opened(opened)) => self.life = opened.life,
                Some(Event::Source(source)) => {
                    self.format.clone_from(&source.format);
                    self.state = match source.state() {
                        proto::State::Delivering => State::Delivering,
                        proto::State::Failing => State::Failing(source.why),
                        proto::State::Starting | proto::State::Unspecified => State::Starting,
                    };
                }
                Some(Event::Closed(closed)) => {
                    self.line = None;
                    return match closed.reason() {
                        proto::Reason::TooSlow => Ok(None),
                        _ => Err(SensorError::Refused(closed.message)),
                    };
                }
                // Something newer than this program.
                None => {}
            }
        }
    }

    /// Connects, as often as it takes.
    async fn reach(&mut self) -> Result<(), SensorError> {
        self.slots.clear();
        loop {
            match socket(&self.path).await {
                Ok(stream) => {
                    let mut line = Line::new(stream);
                    line.say(Call::Open(proto::Open {
                        version: VERSION,
                        token: self.token.clone(),
                        queue: match self.mode {
                            Mode::Latest => 1,
                            Mode::Queue(depth) => depth,
                        },
                        inline: self.inline,
                    }))?;
                    self.line = Some(line);
                    return Ok(());
                }
                // The agent is being started again.
                Err(error) if is_away(&error) => tokio::time::sleep(self.backoff.pause()).await,
                Err(error) => return Err(error.into()),
            }
        }
    }
}

fn is_away(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionRefused, NotFound, WouldBlock};
    matches!(error.kind(), ConnectionRefused | NotFound | WouldBlock)
}

async fn socket(path: &Path) -> io::Result<UnixStream> {
    match (path.parent(), path.file_name()) {
        (Some(dir), Some(name)) if path.as_os_str().len() > LONGEST_PATH => {
            let dir = File::open(dir)?;
            let short = PathBuf::from(format!("/proc/self/fd/{}", dir.as_raw_fd()));
            UnixStream::connect(short.join(name)).await
        }
        _ => UnixStream::connect(path).await,
    }
}
