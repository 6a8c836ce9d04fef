//! `muster`: the client verbs, and the daemons behind the same binary.
//!
//! | module | holds |
//! |---|---|
//! | [`args`], [`target`] | the command line; which objects its words name |
//! | [`config`], [`client`], [`watch`], [`successor`] | kubeconfig; REST; following a collection, and a task over its uids |
//! | [`manifests`], [`sites`], [`merge`] | files → checked objects, maps too; three-way merge |
//! | [`command`] | one file a verb |
//! | [`output`] | tables, sheets, progress |
//! | [`error`], [`exit`] | classes of errors, their hints and exit codes |

mod args;
mod client;
mod command;
mod config;
mod demo;
mod error;
mod exit;
#[cfg(test)]
mod fake;
mod manifests;
mod merge;
mod output;
mod session;
mod sites;
mod successor;
mod target;
mod watch;

use std::process::ExitCode;

use clap::Parser as _;

use crate::error::CliError;
use crate::output::ui::Ui;

fn main() -> ExitCode {
    let mut args = std::env::args_os();
    // Before anything else: shim, gate and simulator must stay small, and they have no use for the rest.
    match args.nth(1) {
        Some(verb) if verb == muster_agent::shim::VERB => muster_agent::shim::main(args),
        Some(verb) if verb == muster_agent::gate::VERB => muster_agent::gate::main(args),
        Some(verb) if verb == muster_agent::sim::VERB => muster_agent::sim::main(args),
        _ => {}
    }
    // Before anything makes a TLS configuration. An error means that there is a provider already.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let cli = args::Cli::parse();
    let color = cli.global.color;
    match command::run(cli) {
        Ok(code) => code,
        // Whoever read our output left with what they wanted: `muster get tasks | head -1`.
        Err(CliError::BrokenPipe) => ExitCode::from(exit::OK),
        Err(error) => {
            Ui::of_process(color).report(&error);
            ExitCode::from(error.class().exit())
        }
    }
}
