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
//! | `supervisor`, `driver` | what `muster-agent-core` decides, carried out |
//! | `checkpoint`, `durable` | what survives the agent |
//! | `board` | what tasks show of themselves |
//! | `depends` | the tasks that a task waits for |
//! | `given` | what tasks are given of ConfigMaps and Secrets |
//! | `executor` | tasks that run other tasks, over a socket of their own |
//! | `gate` | the process that alone talks to the drivers, and what the agent tells it |
//! | `gauge` | what is read off the machine: battery, disk, labels |
//! | `footprint` | memory that is given back after the start |
//! | `contact` | when the controller was last heard, for the shims too |
//! | `mission` | mission locks that are set on the robot itself |
//! | `link` | joining, the session, logs on request |
//! | `node`, `capacity`, `position` | what this node is, has, and where it is |
//! | `probe` | checks of running tasks |
//! | `runtime`, `shim` | what runs tasks |

mod app;
mod board;
mod capacity;
mod checkpoint;
mod clock;
pub mod config;
mod contact;
mod declared;
mod depends;
mod driver;
mod durable;
mod executor;
mod footprint;
pub mod gate;
mod gauge;
mod given;
mod link;
mod mission;
mod node;
mod position;
mod probe;
mod runtime;
pub mod shim;
mod spec;
mod supervisor;

pub use app::{AgentError, run, serve};
pub use runtime::process::Reexec;
