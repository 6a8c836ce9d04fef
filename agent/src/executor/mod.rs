//! Executors: tasks that run other tasks (their *works*) themselves, over a socket that the agent
//! keeps for every task. What must happen is decided in `muster_agent_core::executor`.
//!
//! ```text
//! executor ⇄ seat (its task's driver owns it) ⇄ desks ⇄ work runtime ⇄ driver of the work
//!                                                 ⇅
//!                      messages of the framework: post ⇄ link, or directly: direct
//! ```
//!
//! | module | holds |
//! |---|---|
//! | [`frame`] | messages on the socket |
//! | [`queue`] | what waits for a slow reader, bounded |
//! | [`seat`] | one task's socket and the connection on it |
//! | [`post`] | messages of frameworks: which way each goes, and who may come |
//! | [`direct`] | connections of frameworks: the listener and what goes over each |
//! | [`desk`] | all executors of the node and their works; carries out what the core decides |
//! | [`room`] | an executor's limits: its own resources and those of its live works |
//! | [`work`] | works as tasks: the runtime that their drivers ask |

pub(crate) mod desk;
pub(crate) mod direct;
pub(crate) mod frame;
mod post;
pub(crate) mod queue;
mod room;
pub(crate) mod seat;
pub(crate) mod work;

/// The directory of a task in which its socket is. Only the agent can write in it.
pub(crate) const DIR: &str = "executor";
/// The socket's name in it.
pub(crate) const SOCKET: &str = "socket";
/// Where a task finds its socket.
pub(crate) const SOCKET_ENV: &str = "MUSTER_EXECUTOR_SOCKET";
/// What it shows there.
pub(crate) const TOKEN_ENV: &str = "MUSTER_EXECUTOR_TOKEN";
