//! The main job with real processes, cgroups, SQLite and Docker.

mod cli;
mod config;
mod demo;
mod dependencies;
mod examples;
mod exec;
mod fence;
mod figure4;
mod frameworks;
mod gate;
mod images;
mod lease;
mod lines;
mod messages;
mod missions;
mod poses;
mod preemption;
mod probes;
mod quotas;
mod reschedule;
mod sensors;
mod sim;
mod site;
mod survival;
mod tasksets;
mod upkeep;
