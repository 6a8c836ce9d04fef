//! `muster node fence`: a person's word that a node is off, so that what it held may be given away.
//!
//! The only thing that frees a robot's actuators without its agent's report, so the command says what is
//! being confirmed before it asks, and a script has to say `--yes`.

use std::io::{self, BufRead as _, IsTerminal as _};

use muster_api::condition;
use serde_json::{Value, json};

use super::Outcome;
use crate::client::path;
use crate::error::CliError;
use crate::exit;
use crate::session::Session;
use crate::target;

/// `muster node fence`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The node, NAME or node/NAME
    node: String,
    /// What you saw; it is kept with the node and its tasks
    #[arg(long, value_name = "TEXT")]
    reason: String,
    /// Who saw it, when it is not you
    #[arg(long, value_name = "WHO")]
    by: Option<String>,
    /// Confirm it here, without being asked
    #[arg(short, long)]
    yes: bool,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let info = target::kind("node")?;
    let node = target::one(&args.node, "node")?.name.unwrap_or_default();
    if !args.yes {
        session.ui.note(&assertion(node));
        let mut answer = String::new();
        if io::stdin().is_terminal() {
            session.ui.note("Type the node's name to confirm it:");
            io::stdin().lock().read_line(&mut answer).map_err(CliError::Output)?;
        }
        if !confirms(&answer, node) {
            return Err(CliError::Usage {
                message: format!("node/{node} is not fenced: nobody confirmed it"),
                hint: Some("look at it, then confirm with --yes".to_owned()),
            });
        }
    }
    let mut body = json!({"reason": args.reason});
    if let Some(by) = &args.by {
        body["by"] = by.as_str().into();
    }
    let uri = format!("{}/fence", path(info, None, Some(node)));
    let answer: Value = session.client.post_json(&uri, &body).await?;
    session.ui.line(&format!("node/{node} fenced"))?;
    let conditions = answer.pointer("/status/conditions").and_then(Value::as_array);
    let fenced = conditions.into_iter().flatten().find(|c| c["type"] == condition::FENCED);
    if let Some(said) = fenced.and_then(|c| c["message"].as_str()) {
        session.ui.note(said);
    }
    Ok(exit::OK)
}

fn assertion(node: &str) -> String {
    format!(
        "You confirm that {node} is powered off or its processes are gone. Its tasks count as ended, and its \
         actuators may be given to others at once; if something of them still moves, two drivers do."
    )
}

/// The name, not a `y`: it is typed by somebody who read which robot is meant.
fn confirms(answer: &str, node: &str) -> bool {
    answer.trim() == node
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::fake::Fake;

    #[tokio::test]
    async fn a_fence_needs_a_word_and_a_reason() {
        let fake = Fake::new();
        let uri = "POST /apis/muster.dev/v1alpha1/nodes/r1/fence";
        let condition = json!({"type": "Fenced", "status": "True", "message": "m"});
        fake.answer(uri, json!({"status": {"conditions": [condition]}}));
        let line = ["node", "fence", "node/r1", "--reason", "plug pulled", "--yes"];
        assert_eq!(fake.run(&line).await, (exit::OK, "node/r1 fenced\n".to_owned()));
        assert_eq!(fake.last_body(), json!({"reason": "plug pulled"}));
        let line = ["node", "fence", "r1", "--reason", "x", "--by", "ada", "-y"];
        fake.run(&line).await;
        assert_eq!(fake.last_body(), json!({"reason": "x", "by": "ada"}));
        assert!(
            assertion("r1")
                .contains("You confirm that r1 is powered off or its processes are gone")
        );
        assert!(confirms("r1\n", "r1") && !confirms("y\n", "r1") && !confirms("", "r1"));
    }
}
