//! The gate: the small process that alone talks to a robot's drivers, and outlives the agent. What passes and when the robot is
//! stopped is decided in `muster_agent_core::gate`.
//!
//! ```text
//!  task ⇄ door ──┐                            ┌──▶ driver (program or socket)
//!  task ⇄ door ──┼──▶ hall: core decides ─────┼──▶ driver
//!  agent ⇄ desk ─┤      │ kept.json           └
//!  button ▶ hook ┘
//! ```
//!
//! | module | runs in | holds |
//! |---|---|---|
//! | `settings` | both | drivers, ladder, emergency stops |
//! | `hall` | gate | the one task that asks the core and carries out what it says |
//! | `door` | gate | sockets of tasks and of the agent |
//! | `driver` | gate | one driver, and what waits for it |
//! | `hook` | gate | files and pins that stop the robot |
//! | `record` | gate | what must be durable, and what waits for that |
//! | `log` | gate | its log, bounded |
//! | `keeper` | agent | keeps a gate alive, tells it what the controller grants, and hears how it stands |
//!
//! It is a hidden verb of the agent's binary, `… gate DIR`: one event loop, one thread. In DIR:
//!
//! | file | written by | says |
//! |---|---|---|
//! | `settings.json` | agent | what the gate is set up with |
//! | `lock` | gate, held | a gate lives; its pid |
//! | `kept.json` | gate | the newest token, and what stops the robot; durable before it counts |
//! | `agent` | gate | the agent's socket, nobody else's |
//! | `tasks/socket` | gate | the tasks' socket, in a directory of its own that containers see |
//! | `log`, `log.1` | gate, drivers | what they have to say; the older part of it |

pub(crate) mod door;
mod driver;
mod hall;
mod hook;
pub(crate) mod keeper;
mod log;
mod record;
pub(crate) mod settings;

use std::ffi::OsString;
use std::fs::File;
use std::io::Write as _;
use std::os::fd::AsFd as _;
use std::path::{Path, PathBuf};

use rustix::fs::FlockOperation;

use crate::durable::{self, FileError};
use settings::Settings;

/// The verb that both binaries know.
pub const VERB: &str = "gate";

/// The gate's directory, in the agent's data directory.
pub(crate) const DIR: &str = "gate";
/// Where in it the tasks' socket is. Containers see this directory, and nothing else of the gate's.
pub(crate) const TASKS_DIR: &str = "tasks";
/// The tasks' socket in that.
pub(crate) const SOCKET: &str = "socket";
/// What it and its drivers say.
const LOG: &str = "log";
/// The agent's socket in it.
const AGENT_SOCKET: &str = "agent";
/// Where a task finds the gate.
pub(crate) const SOCKET_ENV: &str = "MUSTER_GATE_SOCKET";
/// What it shows there.
pub(crate) const TOKEN_ENV: &str = "MUSTER_GATE_TOKEN";

/// Why a gate does not run.
#[derive(Debug, thiserror::Error)]
enum GateError {
    #[error("usage: {VERB} DIR")]
    Usage,
    #[error("there are no settings in {0}")]
    NoSettings(PathBuf),
    #[error("another gate runs in {0}")]
    InUse(PathBuf),
    #[error("its files failed")]
    File(#[from] FileError),
    #[error("failed to {what}")]
    System {
        what: &'static str,
        #[source]
        source: std::io::Error,
    },
}

/// Runs the gate with the arguments after the verb, and ends the process.
pub fn main(args: impl IntoIterator<Item = OsString>) -> ! {
    let code = match run(args) {
        Ok(()) => 0,
        Err(error) => {
            // Its log; nobody else is listening.
            let _ = writeln!(std::io::stderr(), "muster gate: {}", crate::driver::chain(&error));
            1
        }
    };
    std::process::exit(code)
}

fn run(args: impl IntoIterator<Item = OsString>) -> Result<(), GateError> {
    let args: Vec<OsString> = args.into_iter().collect();
    let [dir] = args.as_slice() else { return Err(GateError::Usage) };
    let dir = PathBuf::from(dir);
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    let _lock = lock(&dir)?;
    let path = dir.join(settings::FILE);
    let settings: Settings = durable::read_json(&path)?.ok_or(GateError::NoSettings(path))?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        // The record's and the log's.
        .max_blocking_threads(2)
        .build()
        .map_err(|source| GateError::System { what: "start", source })?;
    runtime.block_on(hall::serve(dir, settings))
}

/// Only one gate may speak to the drivers.
fn lock(dir: &Path) -> Result<File, GateError> {
    let path = dir.join("lock");
    let mut file = File::options()
        .create(true)
        .truncate(false)
        .write(true)
        .open(&path)
        .map_err(FileError::at("open", &path))?;
    match rustix::fs::flock(file.as_fd(), FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => {}
        Err(rustix::io::Errno::WOULDBLOCK) => return Err(GateError::InUse(dir.to_owned())),
        Err(errno) => return Err(FileError::at("lock", &path)(errno.into()).into()),
    }
    let pid = format!("{}\n", std::process::id());
    let written = file.set_len(0).and_then(|()| file.write_all(pid.as_bytes()));
    written.map_err(FileError::at("write", &path))?;
    Ok(file)
}
