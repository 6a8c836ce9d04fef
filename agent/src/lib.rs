//! The agent: runs tasks on a robot or a cloud server, held to their quotas.
//!
//! ```text
//! controller ⇄ link ──▶ supervisor ──▶ driver (one a task) ──▶ runtime ──▶ shim ──▶ program
//!                │                        │   core decides          └──▶ Docker Engine
//!                └──── board ◀────────────┘   checkpoint remembers
//! ```
//!
//! | module | holds |
//! |---|---|
//! | `config` | flags and `agent.yaml` |
//! | `declared` | what the node said of itself, for its next start |
//! | `app` | starts, joins and ends everything |
//! | [`assigned`] | what the controller sends, decoded |
//! | `supervisor`, `driver` | what `muster-agent-core` decides, carried out |
//! | `checkpoint`, `durable` | what survives the agent |
//! | `board` | what tasks show of themselves |
//! | `depends` | the tasks that a task waits for |
//! | `images` | images that are pulled before a task needs them |
//! | `given` | what tasks are given of ConfigMaps and Secrets |
//! | `exec` | programs that clients run in tasks |
//! | `executor` | tasks that run other tasks, over a socket of their own |
//! | `gate` | the process that alone talks to the drivers, and what the agent tells it |
//! | [`sim`] | the process that is the robot, where there is none |
//! | `sensor` | sources that are read once, for every task that asked for them |
//! | `gauge` | what is read off the machine: battery, disk, labels |
//! | `footprint` | memory that is given back after the start |
//! | `contact` | when the controller was last heard, for the shims too |
//! | `mission` | mission locks that are set on the robot itself |
//! | `told` | what tasks tell of topics and signals |
//! | `link` | joining, the session, logs on request |
//! | `node`, `capacity`, `position` | what this node is, has, and where it is |
//! | `probe` | checks of running tasks |
//! | `ros` | what the environment of tasks says of ROS |
//! | `runtime`, `shim` | what runs tasks |
//! | `view` | a ROS master for one task alone, and what it sees of the robot in it |

mod app;
pub mod assigned;
mod board;
mod capacity;
mod checkpoint;
mod clock;
mod companion;
pub mod config;
mod contact;
mod declared;
mod depends;
mod driver;
mod durable;
mod exec;
mod executor;
mod footprint;
pub mod gate;
mod gauge;
mod given;
#[cfg(test)]
mod hostile;
mod images;
mod link;
mod mission;
mod node;
mod position;
mod probe;
mod ros;
mod runtime;
mod sensor;
pub mod shim;
pub mod sim;
mod socket;
mod spec;
mod supervisor;
mod told;
mod view;

pub use app::{AgentError, run, serve};
pub use link::dial::{DEAF_AFTER, PAUSE as DIAL_PAUSE};
pub use link::report::to_wire as report_to_wire;
pub use runtime::process::Reexec;
