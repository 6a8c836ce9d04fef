//! The muster controller: the store, the API, agent sessions and the reconcilers.
//!
//! | module | is |
//! |---|---|
//! | [`app`] | starts, joins and ends everything |
//! | [`config`] | flags and their defaults |
//! | [`configs`] | ConfigMaps and Secrets, from the store to tasks |
//! | [`context`] | what the parts share |
//! | [`store`] | revisioned objects, durable writes, watches |
//! | [`rest`] | Kubernetes API conventions over the store |
//! | [`session`] | agents: who is connected, what each should run, what each says |
//! | [`reconcile`] | level-triggered loops: scheduling, health, deletion, garbage |
//! | [`pki`], [`auth`], [`audit`] | certificates; who asks and whether they may; who changed what |
//! | [`events`], [`objects`] | Event objects; typed reading and writing of the kinds |
//! | `quota` | the door of namespaces with a Quota |
//! | `serve` | the TLS port |
//! | `kubeconfig`, `metrics`, `footprint` | the admin's credential file; the Prometheus recorder; freed memory and descriptors |

pub mod app;
pub mod audit;
pub mod auth;
pub mod config;
pub mod configs;
pub mod context;
mod depends;
pub mod events;
mod footprint;
pub mod kubeconfig;
mod metrics;
pub mod objects;
pub mod pki;
mod quota;
mod rates;
pub mod reconcile;
pub mod rest;
mod serve;
pub mod session;
pub mod store;
