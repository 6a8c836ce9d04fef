//! `muster completion`: scripts with which shells complete verbs and flags.

use clap::CommandFactory as _;
use clap_complete::Shell;

use super::Outcome;
use crate::args::Cli;
use crate::exit;
use crate::output::ui::Ui;

/// `muster completion`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// For which shell; bash: source <(muster completion bash)
    #[arg(value_enum)]
    shell: Shell,
}

pub(crate) fn run(args: &Args, ui: &mut Ui) -> Outcome {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), "muster", &mut script);
    ui.print_bytes(&script)?;
    Ok(exit::OK)
}
