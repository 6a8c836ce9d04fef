//! The controller as its clients see it: real TLS on a free port, a real store in a temporary directory.
#![expect(clippy::unwrap_used, reason = "a failed step of a test is the test's failure")]

mod access;
mod agent;
mod audit;
mod config;
mod dependencies;
mod fencing;
mod fleet;
mod frameworks;
mod host;
mod leases;
mod limits;
mod objects;
mod overload;
mod poses;
mod quotas;
mod radius;
mod removal;
mod reschedule;
mod roles;
mod support;
mod tokens;
mod transaction;
mod views;
mod watching;
