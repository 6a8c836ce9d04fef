//! The pure core of the controller: it decides, and does nothing else.
//!
//! No clock, no I/O, no randomness: time comes in as an argument, and what comes out is data. The
//! same code runs in production, in `muster plan`, in `muster why` and in simulation.
//!
//! ```text
//!   store events ──▶ Cluster (nodes, ledger, space) ──schedule()──▶ Plan { binds, waits, preemptions }
//!   heartbeats  ──▶ NodeHealth ──tick()──▶ who was lost, who is back
//! ```
//!
//! | module | decides |
//! |---|---|
//! | [`access`] | who may do what |
//! | [`ledger`] | what each node has left, and who holds its actuators (invariants 1 and 2) |
//! | [`person`] | whether a person gets a robot's lease |
//! | [`poses`] | where every robot is now, and when that is written down |
//! | [`space`] | which robots are nearest, without a scan |
//! | [`site`] | how far robots have to go over a floor with walls, all at once |
//! | [`cluster`] | the nodes with their ledgers, and the orders in which they are tried |
//! | [`schedule`] | where a task goes, or why it goes nowhere (invariant 6) |
//! | [`preempt`] | who is ended to make room for whom |
//! | [`offer`] | which frameworks are shown what, and whose Accept passes |
//! | [`fairness`] | namespaces' shares, and what their quotas leave of what can be reserved |
//! | [`quota`] | whether a namespace's quota lets a new task in |
//! | [`apply`] | whose each field of an object is, and what an object becomes when somebody applies a part of it |
//! | [`hold`] | why a task is not considered for a place at all |
//! | [`config`] | what a task gets of ConfigMaps and Secrets |
//! | [`deadline`] | when a task has been on its node, or has been over, for long enough |
//! | [`radius`] | when a robot has left the radius of a task that runs on it |
//! | [`reschedule`] | whether a task that failed is tried on another node, and when |
//! | [`deletion`] | when an object is to be gone that somebody deletes |
//! | [`owner`] | whether an object is owned by another |
//! | [`project`] | tasks and nodes as Kubernetes' Pods and Nodes |
//! | [`recent`] | one allocation for what many nodes or tasks have in common |
//! | [`node_health`] | when a node counts as lost |
//! | [`taskset`] | which tasks of a TaskSet begin, end and follow each other |
//! | [`offload`] | where the parts of an Application run, and why (AnyScale) |
//! | [`simulation`] | nothing: it runs [`offload`] over random worlds, seeded |
//! | [`stray`] | what an agent runs and should not |
//! | [`ticket`] | who may exchange messages with an agent directly |
//! | [`upkeep`] | when a node is out of service for its battery or for people's work |
//! | [`report`] | typed reasons, with the words people read |
#![deny(missing_docs)]

pub mod access;
pub mod apply;
pub mod cluster;
pub mod config;
pub mod deadline;
pub mod deletion;
pub mod fairness;
#[cfg(test)]
mod fixtures;
pub mod hold;
pub mod ledger;
pub mod node_health;
pub mod offer;
pub mod offload;
pub mod owner;
pub mod person;
pub mod poses;
pub mod preempt;
pub mod project;
pub mod quota;
pub mod radius;
pub mod rate;
pub mod recent;
pub mod report;
pub mod reschedule;
pub mod schedule;
pub mod simulation;
pub mod site;
pub mod space;
pub mod stray;
pub mod taskset;
pub mod ticket;
pub mod upkeep;
