//! `muster why`: where a task runs and why there, how it ended, or, per node, what refuses it; why nodes are not
//! offered to a framework; what of a TaskSet does not serve; and why an Application's parts are where they are.

mod application;
mod framework;
mod task;
mod taskset;

use muster_api::kind::task::{EarlierTry, NodeRefusal};
use muster_api::kind::taskset::SET_LABEL;
use serde::Deserialize;
use serde_json::Value;

use super::Outcome;
use crate::client::{Selection, path};
use crate::error::CliError;
use crate::exit;
use crate::output::objects::{Format, document};
use crate::output::style::Styles;
use crate::output::table::Table;
use crate::session::Session;
use crate::target::{self, Named};

/// `muster why`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The task, NAME or task/NAME; or framework/NAME, taskset/NAME, application/NAME
    object: String,
    /// Print what the controller says, for programs
    #[arg(short, long, value_enum, value_name = "FORMAT")]
    output: Option<Format>,
}

/// What `…/NAME/why` answers of tasks and of frameworks.
#[derive(Debug, Default, Deserialize)]
struct Answer {
    #[serde(default)]
    why: Vec<NodeRefusal>,
}

/// An object and what the controller says of it.
struct Asked<'a> {
    name: &'a str,
    object: Value,
    /// None: an older controller. The object's status has the essence.
    answer: Option<Value>,
}

impl Asked<'_> {
    /// Every node's reason, when the controller gave them.
    fn refusals(&self) -> Option<Vec<NodeRefusal>> {
        let answer: Option<Answer> =
            self.answer.clone().and_then(|a| serde_json::from_value(a).ok());
        answer.map(|a| a.why)
    }
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let named = target::one_of(&args.object, &["task", "framework", "taskset", "application"])?;
    let asked = ask(&named, session).await?;
    let of_set = match named.info.kind {
        "TaskSet" => tasks_of(asked.name, session).await?,
        _ => Vec::new(),
    };
    let read = |source| CliError::Answer {
        server: session.client.server.clone(),
        request: args.object.clone(),
        source,
    };
    let (text, value) = match named.info.kind {
        "TaskSet" => taskset::told(&asked, &of_set, &session.ui.styles).map_err(read)?,
        "Application" => application::told(&asked, &session.ui.styles).map_err(read)?,
        "Framework" => framework::told(&asked, &session.ui.styles).map_err(read)?,
        _ => task::told(&asked, &session.ui.styles).map_err(read)?,
    };
    match args.output {
        Some(format @ (Format::Yaml | Format::Json)) => {
            session.ui.print(&document(&asked.answer.unwrap_or(value), format)?)?;
        }
        _ => session.ui.print(&text)?,
    }
    Ok(exit::OK)
}

async fn ask<'a>(named: &Named<'a>, session: &Session) -> Result<Asked<'a>, CliError> {
    let name = named.name.unwrap_or_default();
    let namespace = Some(session.namespace.as_str());
    let object = session.client.get(named.info, namespace, name).await?;
    let uri = why_path(named, namespace);
    let answer = match session.client.get_json(&uri).await {
        Ok(answer) => Some(answer),
        Err(error) if error.is_not_found() => None,
        Err(error) => return Err(error),
    };
    Ok(Asked { name, object, answer })
}

/// The tasks of a set.
async fn tasks_of(set: &str, session: &Session) -> Result<Vec<Value>, CliError> {
    let selection = Selection { labels: Some(format!("{SET_LABEL}={set}")), fields: None };
    let namespace = Some(session.namespace.as_str());
    let list = session.client.list(target::kind("task")?, namespace, &selection).await?;
    Ok(list.items)
}

fn why_path(named: &Named<'_>, namespace: Option<&str>) -> String {
    format!("{}/why", path(named.info, namespace, named.name))
}

/// Why each node is not offered to a framework.
pub(crate) async fn not_offered(
    namespace: &str,
    name: &str,
    session: &Session,
) -> Result<Vec<NodeRefusal>, CliError> {
    let named = Named { info: target::kind("framework")?, name: Some(name) };
    let answer: Answer = session.client.get_json(&why_path(&named, Some(namespace))).await?;
    Ok(answer.why)
}

/// Each node with the filter that refuses and what would have to change.
pub(crate) fn refusal_table(why: &[NodeRefusal]) -> Table {
    let mut table = Table::new(["NODE", "REFUSED BY", "WHY"]);
    for refusal in why {
        let node = if refusal.node.is_empty() { "(all)" } else { &refusal.node };
        table.push([node, refusal.reason.as_str(), refusal.message.as_str()]);
    }
    table
}

/// The nodes that a task was on before, and how that ended.
pub(crate) fn tries_table(earlier: &[EarlierTry]) -> Table {
    let mut table = Table::new(["NODE", "ATTEMPTS", "REASON", "EXIT", "MESSAGE"]);
    for one in earlier {
        let exit = match (one.signal, one.exit_code) {
            (Some(signal), _) => format!("signal {signal}"),
            (None, Some(code)) => code.to_string(),
            (None, None) => String::new(),
        };
        let attempts = one.attempts.to_string();
        table.push([&one.node, &attempts, &one.reason, &exit, &one.message].map(String::as_str));
    }
    table
}

/// The table and under it the next steps.
fn refusals_and_hints(why: &[NodeRefusal], hints: &[String], styles: &Styles) -> String {
    let mut text = String::new();
    if !why.is_empty() {
        text.push_str(&format!("\n{}", refusal_table(why).text(styles)));
    }
    for (i, hint) in hints.iter().enumerate() {
        let gap = if i == 0 { "\n" } else { "" };
        text.push_str(&format!("{gap}{} {hint}\n", styles.dim.paint("hint:")));
    }
    text
}

/// One of the nodes is refused for one of these.
fn refuses(why: &[NodeRefusal], words: &[&str]) -> bool {
    why.iter().any(|r| words.contains(&r.reason.as_str()))
}

/// Commands that help with the filters that refuse. `reach`: the field that says how far a robot may be.
fn advice(why: &[NodeRefusal], reach: &str) -> Vec<String> {
    let known: [(&[&str], String); 8] = [
        (
            &["ConfigMapNotFound", "ConfigMapKeyNotFound", "SecretNotFound", "SecretKeyNotFound"],
            "`muster create configmap` or `muster create secret` makes it; the task is placed at once then"
                .into(),
        ),
        (
            &["Unreachable"],
            "`muster get sites` shows the maps whose walls count; a new map is applied to its Site".into(),
        ),
        (
            &["LeaseHeld"],
            "`muster get leases` shows who drives; when the holder ends, the lease is free".into(),
        ),
        (
            &["Exhausted"],
            "`muster top nodes` shows what is used; `muster describe node/NAME` who reserved it"
                .into(),
        ),
        (
            &["QuotaExceeded"],
            "`muster describe quotas` shows what the namespace may have and what it has".into(),
        ),
        (&["NotReady"], "`muster describe node/NAME` shows when the node was last heard".into()),
        (
            &["OutOfRange", "OtherMap"],
            format!(
                "`muster get nodes` shows where the robots are; {reach} is how far they may be"
            ),
        ),
        (
            &["TooSmall", "NoSensor", "NoActuator", "WrongKind"],
            "what a node does not have will not come by waiting: `muster get nodes -o wide`".into(),
        ),
    ];
    // What will not come by waiting matters only when no node is merely busy.
    let busy =
        refuses(why, &["LeaseHeld", "Exhausted", "NotReady", "OutOfRange", "OtherMap", "Cordoned"]);
    known
        .into_iter()
        .filter(|(words, _)| refuses(why, words) && !(busy && words.contains(&"TooSmall")))
        .map(|(_, text)| text)
        .collect()
}
