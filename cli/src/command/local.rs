//! Verbs that ask no controller: they run something inside this process. A new one is added to
//! [`Command`] and [`run`], nowhere else.

use std::io::IsTerminal as _;
use std::process::ExitCode;

use muster_agent::{Reexec, shim};
use muster_controller::app;
use tracing_subscriber::EnvFilter;

use super::{completion, simulate};
use crate::error::CliError;
use crate::output::ui::Ui;

/// Verbs that ask no controller.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Run the controller
    Controller(muster_controller::config::Args),
    /// Run the agent of a robot or a cloud server
    Agent(Box<muster_agent::config::Args>),
    /// Show one robot shared by three workloads, with processes of this program alone
    Demo(crate::demo::Args),
    /// Run a program for robots: Avalon's workloads, and probes for tests
    Workload(muster_workloads::Args),
    /// Run decisions over random worlds, with the code that decides in production
    #[command(subcommand)]
    Simulate(simulate::Command),
    /// Print a completion script for a shell
    Completion(completion::Args),
}

/// Runs a verb. Each makes the runtime that it needs.
pub(crate) fn run(command: Command, ui: &mut Ui) -> Result<ExitCode, CliError> {
    match command {
        Command::Controller(args) => controller(args),
        Command::Agent(args) => {
            log();
            Ok(muster_agent::run(*args, Reexec::this_binary(&[shim::VERB])))
        }
        Command::Demo(args) => crate::demo::run(&args, ui).map(ExitCode::from),
        Command::Workload(args) => Ok(muster_workloads::run(args).into()),
        Command::Simulate(command) => simulate::run(&command, ui).map(ExitCode::from),
        Command::Completion(args) => completion::run(&args, ui).map(ExitCode::from),
    }
}

fn controller(args: muster_controller::config::Args) -> Result<ExitCode, CliError> {
    log();
    let failed = |source| CliError::Daemon { name: "controller", source };
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|error| failed(error.into()))?;
    runtime
        .block_on(app::run(args.into(), app::signal()))
        .map(|()| ExitCode::SUCCESS)
        .map_err(|error| failed(error.into()))
}

/// Logs of a daemon, to standard error; `MUSTER_LOG` says how much.
fn log() {
    let filter = EnvFilter::try_from_env("MUSTER_LOG").unwrap_or_else(|_| EnvFilter::new("info"));
    let colour = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(colour)
        .with_writer(std::io::stderr)
        .init();
}
