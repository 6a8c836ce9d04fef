//! The gate: the small process that alone talks to a robot's drivers, and outlives the agent. What passes and when the robot is
//! stopped is decided in `muster_agent_core::gate`.
//!
//! ```text
//!  task ⇄ door ──┐                            ┌──▶ driver (program, socket or ROS topic)
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
//! | `codec` | gate | how a command becomes what a driver reads |
//! | `topic` | gate | a driver that is a topic of ROS 1, and who else publishes it |
//! | `hook` | gate | files and pins that stop the robot |
//! | `record` | gate | what must be durable, and what waits for that |
//! | `log` | gate | its log, bounded |
//! | `keeper` | agent | keeps a gate alive, tells it what is wanted, and hears how it stands |
//! | `wanted`, `standing` | agent | what it is told, what it says; pure |
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

mod codec;
pub(crate) mod door;
mod driver;
mod hall;
mod hook;
pub(crate) mod keeper;
mod log;
mod record;
pub(crate) mod settings;
mod standing;
mod topic;
mod wanted;

use std::ffi::OsString;
use std::io::Write as _;
use std::path::PathBuf;

use crate::companion;
use crate::durable::{self, FileError};
use settings::Setup;
pub use standing::Standing;
pub use wanted::Wanted;

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
    companion::main(VERB, args, run)
}

fn run(dir: PathBuf) -> Result<(), GateError> {
    let Some(mut lock) = companion::lock(&dir)? else { return Err(GateError::InUse(dir)) };
    let pid = format!("{}\n", std::process::id());
    let written = lock.set_len(0).and_then(|()| lock.write_all(pid.as_bytes()));
    written.map_err(FileError::at("write the lock of", &dir))?;
    let path = dir.join(settings::FILE);
    let setup: Setup = durable::read_json(&path)?.ok_or(GateError::NoSettings(path))?;
    // The record's and the log's.
    let runtime =
        companion::runtime(2).map_err(|source| GateError::System { what: "start", source })?;
    runtime.block_on(hall::serve(dir, setup))
}
