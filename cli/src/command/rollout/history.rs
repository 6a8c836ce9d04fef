//! `muster rollout history`: the templates that a set has had.

use muster_api::kind::taskset::{CHANGE_CAUSE, TaskSetStatus};
use muster_api::kind::taskset_revision::TaskSetRevision;

use super::super::Outcome;
use super::{get, revisions};
use crate::error::CliError;
use crate::exit;
use crate::output::objects::{Format, document};
use crate::output::table::Table;
use crate::session::Session;
use crate::target;

/// `muster rollout history`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The set, NAME or taskset/NAME
    #[arg(value_name = "TASKSET")]
    set: String,
    /// Show the template of this one, whole
    #[arg(long, value_name = "N")]
    revision: Option<u64>,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let name = target::one(&args.set, "taskset")?.name.unwrap_or_default();
    let set = get(name, session).await?;
    let revisions = revisions(name, &set, session).await?;
    if let Some(number) = args.revision {
        let Some(found) = revisions.iter().find(|r| r.spec.revision == number) else {
            return Err(CliError::Failed {
                what: format!("taskset/{name} has no revision {number}"),
                hint: Some(format!("`muster rollout history taskset/{name}` shows what there is")),
            });
        };
        session.ui.line(&format!("taskset/{name} with revision #{number}"))?;
        let template = serde_json::to_value(&found.spec.template).unwrap_or_default();
        session.ui.print(&document(&template, Format::Yaml)?)?;
        return Ok(exit::OK);
    }
    let status: Option<TaskSetStatus> =
        set.get("status").and_then(|s| serde_json::from_value(s.clone()).ok());
    let status = status.unwrap_or_default();
    let mut table = Table::new(["REVISION", "NAME", "CHANGE-CAUSE", "STATE"]);
    for revision in &revisions {
        let name = revision.metadata.name.clone().unwrap_or_default();
        let notes = revision.metadata.annotations.as_ref();
        let cause = notes.and_then(|n| n.get(CHANGE_CAUSE)).cloned().unwrap_or_default();
        table.push([revision.spec.revision.to_string(), name, cause, state(revision, &status)]);
    }
    session.ui.line(&format!("taskset/{name}"))?;
    let text = table.text(&session.ui.styles);
    session.ui.print(&text)?;
    Ok(exit::OK)
}

fn state(revision: &TaskSetRevision, status: &TaskSetStatus) -> String {
    let name = revision.metadata.name.as_deref().unwrap_or_default();
    let given_up = status.rolled_back_from.as_ref().is_some_and(|b| b.revision == name);
    let states = [
        (status.update_revision == name, "template"),
        (status.current_revision == name, "last good"),
        (given_up, "given up"),
    ];
    let said: Vec<&str> = states.iter().filter(|(is, _)| *is).map(|(_, word)| *word).collect();
    said.join(", ")
}
