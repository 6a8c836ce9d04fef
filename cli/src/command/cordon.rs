//! `muster cordon`, `muster uncordon`: whether new tasks may be placed on nodes. What runs goes on.

use serde_json::{Value, json};

use super::{FirstError, Outcome};
use crate::client::Mode;
use crate::error::CliError;
use crate::session::Session;
use crate::target;

/// `muster cordon` and `muster uncordon`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The nodes, NAME or node/NAME
    #[arg(value_name = "NODE", required = true)]
    nodes: Vec<String>,
}

pub(crate) async fn run(args: Args, cordon: bool, session: &mut Session) -> Outcome {
    let mut errors = FirstError::default();
    for word in &args.nodes {
        let name = target::one(word, "node")?.name.unwrap_or_default();
        match set(name, cordon, session).await {
            Ok(()) => {}
            Err(error) if args.nodes.len() == 1 => return Err(error),
            Err(error) => errors.note(error, &session.ui)?,
        }
    }
    Ok(errors.exit())
}

/// Cordons a node or lifts it, and says which.
pub(crate) async fn set(name: &str, cordon: bool, session: &mut Session) -> Result<(), CliError> {
    let info = target::kind("node")?;
    let node = session.client.get(info, None, name).await?;
    let is = node.pointer("/spec/unschedulable").and_then(Value::as_bool).unwrap_or(false);
    let done = if cordon { "cordoned" } else { "uncordoned" };
    if is == cordon {
        return session.ui.line(&format!("node/{name} is {done} already"));
    }
    // Absent is the normal form of false.
    let value = if cordon { json!(true) } else { Value::Null };
    let patch = json!({"spec": {"unschedulable": value}});
    session.client.patch(info, None, name, &patch, Mode::Store).await?;
    session.ui.line(&format!("node/{name} {done}"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::{Fake, node};

    #[tokio::test]
    async fn there_and_back() {
        let fake = Fake::new();
        fake.put("nodes/r1", node("r1", json!({})));
        assert_eq!(fake.run(&["cordon", "r1"]).await.1, "node/r1 cordoned\n");
        assert_eq!(fake.object("nodes/r1").expect("there")["spec"]["unschedulable"], true);
        assert_eq!(fake.run(&["cordon", "node/r1"]).await.1, "node/r1 is cordoned already\n");
        assert_eq!(fake.run(&["uncordon", "r1"]).await.1, "node/r1 uncordoned\n");
        assert_eq!(fake.object("nodes/r1").expect("there")["spec"].get("unschedulable"), None);
        assert_eq!(fake.run(&["cordon", "r1", "r9"]).await.0, exit::NOT_FOUND);
    }
}
