//! The simulated robot: a process of its own that is what a real robot is to the agent. It stands and drives in a world of walls,
//! whether anybody looks or not, and outlives the agent as a robot does. What happens in the world is decided in
//! `muster_agent_core::sim`.
//!
//! ```text
//!  gate ── commands, a line each ──▶ drive ─┐
//!  agent ◀── pose and charge, a line each ── state ─┼── robot: core's base, laser, camera
//!  agent's sensors ◀── frames ── laser, camera ─┘
//! ```
//!
//! | module | runs in | holds |
//! |---|---|---|
//! | `settings` | both | `world.yaml` |
//! | `robot` | simulator | the world, the base, and what is kept of it |
//! | `serve` | simulator | its sockets |
//! | `keeper` | agent | keeps a simulator alive, and hears where the robot is |
//!
//! It is a hidden verb of the agent's binary, `… simulated-robot DIR`: one event loop, one thread. In DIR, which is the agent's alone:
//!
//! | file | written by | says |
//! |---|---|---|
//! | `world.json` | agent | the world, with the walls of its map |
//! | `lock` | simulator, held | a simulator lives |
//! | `kept.json` | simulator | where the robot is and what is in its battery, for its next life |
//! | `drive` | simulator | the gate's socket: `{"linear": m/s, "angular": rad/s}`; its end stops the robot |
//! | `state`, `laser`, `camera` | simulator | the agent's sockets |
//! | `log` | simulator | what it has to say |
//!
//! Commands come through the gate or not at all: the drive socket takes one connection at a time, and the gate has it. Frames are
//! messages of `muster.ros.v1`, a big-endian 32-bit length before each. A simulator that nobody has been connected to for
//! `LINGERS` (a minute) ends.

pub(crate) mod keeper;
pub(crate) mod robot;
mod serve;
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
pub const VERB: &str = "simulated-robot";

/// The simulator's directory, in the agent's data directory.
pub(crate) const DIR: &str = "sim";
/// The gate's socket in it.
pub(crate) const DRIVE: &str = "drive";
/// Sockets of the agent.
const STATE: &str = "state";
pub(crate) const LASER: &str = "laser";
pub(crate) const CAMERA: &str = "camera";
/// The world.
const WORLD: &str = "world.json";
/// What it says.
const LOG: &str = "log";
/// The command that stops the robot.
pub(crate) const STOP: &str = r#"{"linear": 0, "angular": 0}"#;

/// Why a simulator does not run.
#[derive(Debug, thiserror::Error)]
enum SimError {
    #[error("usage: {VERB} DIR")]
    Usage,
    #[error("there is no world in {0}")]
    NoWorld(PathBuf),
    #[error("another simulator runs in {0}")]
    InUse(PathBuf),
    #[error("the robot would begin in a wall")]
    InWall,
    #[error("its files failed")]
    File(#[from] FileError),
    #[error("failed to {what}")]
    System {
        what: &'static str,
        #[source]
        source: std::io::Error,
    },
}

/// Runs the simulator with the arguments after the verb, and ends the process.
pub fn main(args: impl IntoIterator<Item = OsString>) -> ! {
    let code = match run(args) {
        Ok(()) => 0,
        Err(error) => {
            // Its log; nobody else is listening.
            let _ = writeln!(std::io::stderr(), "muster {VERB}: {}", crate::driver::chain(&error));
            1
        }
    };
    std::process::exit(code)
}

fn run(args: impl IntoIterator<Item = OsString>) -> Result<(), SimError> {
    let args: Vec<OsString> = args.into_iter().collect();
    let [dir] = args.as_slice() else { return Err(SimError::Usage) };
    let dir = PathBuf::from(dir);
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    let _lock = lock(&dir)?;
    let path = dir.join(WORLD);
    let settings: Settings = durable::read_json(&path)?.ok_or(SimError::NoWorld(path))?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        // The record's.
        .max_blocking_threads(1)
        .build()
        .map_err(|source| SimError::System { what: "start", source })?;
    runtime.block_on(serve::serve(&dir, &settings))
}

/// There is one robot.
fn lock(dir: &Path) -> Result<File, SimError> {
    let path = dir.join("lock");
    let file = File::options().create(true).truncate(false).write(true).open(&path);
    let file = file.map_err(FileError::at("open", &path))?;
    match rustix::fs::flock(file.as_fd(), FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(file),
        Err(rustix::io::Errno::WOULDBLOCK) => Err(SimError::InUse(dir.to_owned())),
        Err(errno) => Err(FileError::at("lock", &path)(errno.into()).into()),
    }
}

/// A world, in short.
fn digest(world: &[u8]) -> String {
    let digest = ring::digest::digest(&ring::digest::SHA256, world);
    digest.as_ref().iter().take(12).map(|byte| format!("{byte:02x}")).collect()
}
