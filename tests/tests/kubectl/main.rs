//! Stock clients against a real cluster: kubectl by a golden script, and the kube crate.
//!
//! `MUSTER_GOLDEN=write` writes what kubectl says now into the script, to be read before it is committed.

mod clients;
mod python;
mod redact;
mod script;
mod token;
