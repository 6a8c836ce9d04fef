//! The Rust SDK: frameworks, which take offers and launch tasks, and executors, which run many of them in one process.
//!
//! ```text
//!  your Scheduler ◀─ callbacks ─ SchedulerDriver ◀─ EventStream ─┐
//!        └────────── actions ───▶ FrameworkHandle ── Command ──▶ link::session ◀──▶ controller
//!                                        └─ messages of executors ─▶ link::direct ◀──▶ agent
//!  your Executor  ◀─ callbacks ─ ExecutorDriver ◀── frames ─────────────────────▶ agent (Unix socket)
//!        └────────── actions ───▶ ExecutorHandle
//! ```
//!
//! | module | holds |
//! |---|---|
//! | [`framework`] | [`Framework::builder`]: who the framework is and what it wants |
//! | [`handle`] | the actions: launch, decline, kill, … |
//! | [`event`] | what happens, as a stream |
//! | [`scheduler`] | the same as callbacks, named as in the paper and in Mesos |
//! | [`launch`] | tasks to launch |
//! | [`position`] | where the work is, and sources that move it |
//! | [`filter`] | what a node must have to be offered |
//! | [`poses`] | for a building's localisation: a stream of robots' poses |
//! | [`gate`] | for tasks: commands for a robot's actuators |
//! | [`sensor`] | for tasks: frames of a robot's sensors |
//! | [`executor`] | the other side: a program that runs a framework's tasks |
//! | `link` | the session: kubeconfig, TLS, reconnecting, duplicates |
//!
//! Semantics are Mesos', except that offers are optimistic: who accepts too late is refused with
//! [`Reason::OfferGone`] or [`Reason::Conflict`] and is offered again what is left.
#![deny(missing_docs)]

mod backoff;
mod error;
pub mod event;
pub mod executor;
pub mod filter;
pub mod framework;
pub mod gate;
pub mod handle;
pub mod launch;
mod link;
pub mod poses;
pub mod position;
pub mod scheduler;
pub mod sensor;

pub use error::{CallRefused, Cause, ConnectError, FrameworkError, KubeconfigError, Reason};
pub use event::{Event, EventStream};
pub use filter::Filter;
pub use framework::Framework;
pub use handle::FrameworkHandle;
pub use launch::Launch;
pub use position::{Position, PositionSource};
pub use scheduler::{Scheduler, SchedulerDriver};

/// Messages of the session that callbacks and events carry as they are; `framework.proto` documents their fields.
pub mod wire {
    pub use muster_api::wire::framework::v1::{
        Compute, Cost, Executor, ExecutorLost, Launched, Message, Moved, NodeKind, NodeLost, Offer,
        Pose, RescindReason, TaskState, Update,
    };
}
