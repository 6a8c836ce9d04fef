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
use std::path::PathBuf;

use crate::companion;
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
    companion::main(VERB, args, run)
}

fn run(dir: PathBuf) -> Result<(), SimError> {
    let Some(_lock) = companion::lock(&dir)? else { return Err(SimError::InUse(dir)) };
    let path = dir.join(WORLD);
    let settings: Settings = durable::read_json(&path)?.ok_or(SimError::NoWorld(path))?;
    // The record's.
    let runtime =
        companion::runtime(1).map_err(|source| SimError::System { what: "start", source })?;
    runtime.block_on(serve::serve(&dir, &settings))
}
