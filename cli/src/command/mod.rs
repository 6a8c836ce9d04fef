//! The verbs, one a file. Each gives the exit code of what it found, or an error with a class.

pub(crate) mod apply;
pub(crate) mod completion;
pub(crate) mod cordon;
pub(crate) mod create;
pub(crate) mod delete;
pub(crate) mod describe;
pub(crate) mod drain;
pub(crate) mod estop;
pub(crate) mod exec;
pub(crate) mod fence;
pub(crate) mod framework;
pub(crate) mod get;
pub(crate) mod gone;
pub(crate) mod lease;
pub(crate) mod local;
pub(crate) mod lock;
pub(crate) mod logs;
pub(crate) mod node;
pub(crate) mod offers;
pub(crate) mod plan;
pub(crate) mod rollout;
pub(crate) mod scale;
pub(crate) mod settle;
pub(crate) mod simulate;
pub(crate) mod token;
pub(crate) mod top;
mod transaction;
mod user_token;
pub(crate) mod version;
pub(crate) mod wait;
pub(crate) mod why;

use std::process::ExitCode;

use crate::args::{Cli, Command, Global};
use crate::error::CliError;
use crate::exit;
use crate::output::ui::Ui;
use crate::session::Session;

/// The exit code, when nothing went wrong that has a class.
pub(crate) type Outcome = Result<u8, CliError>;

/// Runs a verb.
pub(crate) fn run(cli: Cli) -> Result<ExitCode, CliError> {
    let Cli { global, command } = cli;
    match command {
        Command::Local(command) => local::run(command, &mut Ui::of_process(global.color)),
        client => run_client(client, global).map(ExitCode::from),
    }
}

/// Client verbs wait for one connection at a time; one thread is enough, and it starts faster.
fn run_client(command: Command, global: Global) -> Outcome {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(CliError::Output)?;
    let plan = matches!(command, Command::Plan(_));
    let outcome = runtime.block_on(async {
        let ui = Ui::of_process(global.color);
        if let Command::Version(args) = command {
            return version::run(args, &global, ui).await;
        }
        let mut session = Session::open(&global, ui).await?;
        dispatch(command, &mut session).await
    });
    match outcome {
        // 1 says that there are changes, so nothing else may use the low numbers.
        Err(error) if plan && !matches!(error, CliError::BrokenPipe) => {
            Ui::of_process(global.color).report(&error);
            Ok(exit::PLAN_ERROR)
        }
        outcome => outcome,
    }
}

pub(crate) async fn dispatch(command: Command, session: &mut Session) -> Outcome {
    match command {
        Command::Apply(args) => apply::run(args, session).await,
        Command::Create(command) => create::run(command, session).await,
        Command::Plan(args) => plan::run(args, session).await,
        Command::Get(args) => get::run(args, session).await,
        Command::Describe(args) => describe::run(args, session).await,
        Command::Why(args) => why::run(args, session).await,
        Command::Offers(args) => offers::run(args, session).await,
        Command::Delete(args) => delete::run(args, session).await,
        Command::Scale(args) => scale::run(args, session).await,
        Command::Rollout(command) => rollout::run(command, session).await,
        Command::Exec(args) => exec::run(args, session).await,
        Command::Logs(args) => logs::run(args, session).await,
        Command::Top(args) => top::run(args, session).await,
        Command::Wait(args) => wait::run(args, session).await,
        Command::Cordon(args) => cordon::run(args, true, session).await,
        Command::Uncordon(args) => cordon::run(args, false, session).await,
        Command::Drain(args) => drain::run(args, session).await,
        Command::Estop(args) => estop::run(args, session).await,
        Command::Node(command) => node::run(command, session).await,
        Command::Lease(command) => lease::run(command, session).await,
        Command::Framework(command) => framework::run(command, session).await,
        Command::Token(command) => token::run(command, session).await,
        Command::Local(_) | Command::Version(_) => {
            unreachable!("these are run before a kubeconfig is read")
        }
    }
}

/// Remembers the first error of several steps that each went on after reporting theirs.
#[derive(Debug, Default)]
pub(crate) struct FirstError(Option<u8>);

impl FirstError {
    /// Reports the error and goes on; a reader that left ends everything.
    pub(crate) fn note(&mut self, error: CliError, ui: &Ui) -> Result<(), CliError> {
        if matches!(error, CliError::BrokenPipe) {
            return Err(error);
        }
        ui.report(&error);
        self.0.get_or_insert_with(|| error.class().exit());
        Ok(())
    }

    /// The code of the first one, or 0.
    pub(crate) fn exit(self) -> u8 {
        self.0.unwrap_or(exit::OK)
    }
}
