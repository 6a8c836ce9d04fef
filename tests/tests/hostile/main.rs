//! Everything that reads what others send, fed with what a stranger may send: nothing panics, nothing grows without end, and what
//! was understood is understood the same when it is said again.
//!
//! What a crate keeps to itself has its targets there: `controller/src/rest/hostile.rs`, `agent/src/hostile.rs`,
//! `api/sdk/src/link/kubeconfig.rs`.

mod manifests;
mod ros;
mod texts;
mod wire;
