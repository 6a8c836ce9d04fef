//! The main job with real processes, cgroups, SQLite and Docker.

mod cli;
mod config;
mod demo;
mod dependencies;
mod examples;
mod fence;
mod figure4;
mod frameworks;
mod gate;
mod lease;
mod messages;
mod missions;
mod poses;
mod preemption;
mod probes;
mod quotas;
mod reschedule;
mod survival;
mod tasksets;
mod upkeep;
