//! `muster-controller`: flags, logs and signals; everything else is in the library.

use std::io::IsTerminal as _;
use std::process::ExitCode;

use clap::Parser;
use muster_controller::app;
use muster_controller::config::{Args, Config};
use tracing_subscriber::EnvFilter;

/// The muster controller: the store, the API and the placement of a robotcenter.
#[derive(Debug, Parser)]
#[command(version, about)]
struct Cli {
    #[command(flatten)]
    args: Args,
}

#[tokio::main]
async fn main() -> ExitCode {
    let cli = Cli::parse();
    let filter = EnvFilter::try_from_env("MUSTER_LOG").unwrap_or_else(|_| EnvFilter::new("info"));
    let colour = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(colour)
        .with_writer(std::io::stderr)
        .init();
    match app::run(Config::from(cli.args), app::signal()).await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}", app::chain(&error));
            ExitCode::FAILURE
        }
    }
}
