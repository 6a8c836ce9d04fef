//! `muster version`: of this program and of the controller.

use serde_json::{Value, json};

use super::Outcome;
use crate::args::Global;
use crate::error::CliError;
use crate::exit;
use crate::output::objects::{Format, document};
use crate::output::ui::Ui;
use crate::session::Session;

/// `muster version`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Only of this program; no controller is asked
    #[arg(long)]
    client: bool,
    /// How to print them
    #[arg(short, long, value_enum, value_name = "FORMAT")]
    output: Option<Format>,
}

const CLIENT: &str = env!("CARGO_PKG_VERSION");

pub(crate) async fn run(args: Args, global: &Global, mut ui: Ui) -> Outcome {
    let server = if args.client { None } else { Some(ask(global).await) };
    match args.output {
        Some(format @ (Format::Yaml | Format::Json)) => {
            let mut versions =
                json!({"client": {"version": CLIENT, "api": muster_api::API_VERSION}});
            if let Some(Ok((_, version))) = &server {
                versions["server"] = version.clone();
            }
            ui.print(&document(&versions, format)?)?;
        }
        _ => {
            ui.line(&format!("client  {CLIENT} ({})", muster_api::API_VERSION))?;
            if let Some(Ok((url, version))) = &server {
                let text = |f: &str| version[f].as_str().unwrap_or("?").to_owned();
                ui.line(&format!(
                    "server  {} on {} at {url}",
                    text("gitVersion"),
                    text("platform")
                ))?;
            }
        }
    }
    // The client's version is worth printing even when nobody answers.
    match server {
        Some(Err(error)) => Err(error),
        _ => Ok(exit::OK),
    }
}

async fn ask(global: &Global) -> Result<(String, Value), CliError> {
    let session = Session::open(global, Ui::of_process(global.color)).await?;
    let version = session.client.get_json("/version").await?;
    Ok((session.client.server, version))
}
