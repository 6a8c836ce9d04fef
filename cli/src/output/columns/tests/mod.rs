//! How the tables of each kind look.

mod application;
mod framework;
mod node;
mod quota;
mod task;
mod taskset;
