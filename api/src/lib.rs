//! What every part of muster speaks: resource kinds, the types they are made of, manifests and
//! wire messages. No runtime and no I/O: a function of this crate is given text or bytes and gives
//! back values or reasons.
//!
//! | module | holds |
//! |---|---|
//! | [`kind`] | the resources (Node, Task, TaskSet, Application, Lease, Framework, Quota, Site, Access, Namespace, Event): spec, status, admission |
//! | [`manifest`] | YAML or JSON text → objects whose every field knows its file, line and column |
//! | [`validate`] | violations (path, reason, suggestion) and the walk over a kind's schema |
//! | [`selector`] | label and field selectors, both forms and their string grammar |
//! | [`name`], [`id`] | names and identities as types |
//! | [`quantity`], [`duration`], [`portion`] | cpu, bytes, bit rates, time spans, numbers or percentages, with their units |
//! | [`resource`] | CR, SR and AR: what nodes have and tasks ask for |
//! | [`map`] | map_server's maps: a YAML file and an image, as a grid of cells |
//! | [`pose`] | where a robot is, in which map |
//! | [`direct`] | messages that do not pass the controller: frames, tickets, which way each goes |
//! | [`phase`], [`condition`] | states as enums |
//! | [`secret`] | comparing what is shown with what is secret |
//! | [`table`] | objects as rows: the columns of each kind |
//! | [`wire`] | generated protobuf messages and their conversions; wire types stop there |
#![deny(missing_docs)]

pub mod condition;
pub mod direct;
pub mod duration;
pub mod id;
pub mod kind;
pub mod manifest;
pub mod map;
pub mod name;
pub mod phase;
pub mod portion;
pub mod pose;
pub mod quantity;
pub mod resource;
pub mod secret;
pub mod selector;
pub mod table;
pub mod validate;
pub mod wire;

/// The API group of muster's own kinds.
pub const GROUP: &str = "muster.dev";
/// The version of muster's own kinds.
pub const VERSION: &str = "v1alpha1";
/// `apiVersion` of muster's own kinds.
pub const API_VERSION: &str = "muster.dev/v1alpha1";
