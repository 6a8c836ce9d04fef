//! `muster-agent`: the agent as a program of its own.

use std::process::ExitCode;

use clap::Parser;
use muster_agent::{Reexec, config, gate, shim, sim};
use tracing_subscriber::EnvFilter;

/// Runs tasks on this robot or cloud server, held to their quotas.
#[derive(Debug, Parser)]
#[command(name = "muster-agent", version)]
struct Cli {
    #[command(flatten)]
    agent: config::Args,
}

fn main() -> ExitCode {
    let mut args = std::env::args_os();
    // Before anything else: shim, gate and simulator must stay small, and they have no use for the rest.
    match args.nth(1) {
        Some(verb) if verb == shim::VERB => shim::main(args),
        Some(verb) if verb == gate::VERB => gate::main(args),
        Some(verb) if verb == sim::VERB => sim::main(args),
        _ => {}
    }
    let cli = Cli::parse();
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    muster_agent::run(cli.agent, Reexec::this_binary(&[shim::VERB]))
}
