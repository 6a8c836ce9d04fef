//! The link to the controller.
//!
//! | module | holds |
//! |---|---|
//! | [`kubeconfig`] | which controller is dialled, and as whom |
//! | [`tls`] | the connection |
//! | [`direct`] | messages of executors, without the controller where that is possible |
//! | [`session`] | one stream at a time, made again whenever it breaks |
//! | [`pending`] | calls without an answer yet |
//! | [`seen`] | which updates were handed out before |
//! | [`state`] | the framework's id, across runs of the program |

pub(crate) mod direct;
pub(crate) mod kubeconfig;
mod pending;
mod seen;
pub(crate) mod session;
pub(crate) mod state;
pub(crate) mod tls;
