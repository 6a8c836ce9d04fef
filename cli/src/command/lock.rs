//! `muster node lock`, `muster node unlock`: a robot in the middle of a mission keeps the tasks that it has.
//!
//! This lock is an annotation of the Node, so anybody who may write nodes sets it, a task with a credential too. On the
//! robot itself a task sets one by a file in its `$MUSTER_RUN_DIR`, and a person by one in the agent's data directory.

use muster_api::kind::node::{MISSION_LOCK, Node};
use serde_json::{Value, json};

use super::Outcome;
use crate::client::Mode;
use crate::error::CliError;
use crate::exit;
use crate::session::Session;
use crate::target;

/// `muster node lock`.
#[derive(Debug, clap::Args)]
pub(crate) struct LockArgs {
    /// The node, NAME or node/NAME
    node: String,
    /// Who is on the mission: a person, a task
    #[arg(long, value_name = "WHO")]
    holder: String,
    /// What it is about
    #[arg(long, value_name = "TEXT", default_value = "")]
    reason: String,
}

/// `muster node unlock`.
#[derive(Debug, clap::Args)]
pub(crate) struct UnlockArgs {
    /// The node, NAME or node/NAME
    node: String,
    /// Only a lock of this holder
    #[arg(long, value_name = "WHO")]
    holder: Option<String>,
}

pub(crate) async fn lock(args: LockArgs, session: &mut Session) -> Outcome {
    let name = target::one(&args.node, "node")?.name.unwrap_or_default();
    let holder = args.holder.trim();
    if holder.is_empty() || holder.contains(':') {
        return Err(CliError::usage("--holder is a word without ':'"));
    }
    let present = node(name, session).await?;
    if let Some(other) = present.annotated_lock().filter(|l| l.holder != holder) {
        return Err(CliError::Failed {
            what: format!("node/{name} is locked by {} already: {}", other.holder, other.reason),
            hint: Some(format!("`muster node unlock {name}` takes that lock away")),
        });
    }
    let text = format!("{holder}: {}", args.reason.trim());
    write(name, text.trim().into(), session).await?;
    session.ui.line(&format!("node/{name} locked by {holder}"))?;
    Ok(exit::OK)
}

pub(crate) async fn unlock(args: UnlockArgs, session: &mut Session) -> Outcome {
    let name = target::one(&args.node, "node")?.name.unwrap_or_default();
    let present = node(name, session).await?;
    let local = present.status.iter().flat_map(|status| &status.mission_locks).next();
    let Some(lock) = present.annotated_lock() else {
        if let Some(lock) = local {
            let (holder, reason) = (&lock.holder, &lock.reason);
            let hint = "it is unlocked there: its file mission-lock is removed, or the task ends";
            return Err(CliError::Failed {
                what: format!("node/{name} is locked on the robot itself, by {holder}: {reason}"),
                hint: Some(hint.to_owned()),
            });
        }
        session.ui.line(&format!("node/{name} is not locked"))?;
        return Ok(exit::OK);
    };
    if let Some(holder) = args.holder.as_deref().filter(|h| *h != lock.holder) {
        return Err(CliError::Failed {
            what: format!("node/{name} is locked by {}, not by {holder}", lock.holder),
            hint: None,
        });
    }
    write(name, Value::Null, session).await?;
    session.ui.line(&format!("node/{name} unlocked"))?;
    if let Some(local) = local {
        let line = format!("node/{name} is still locked on the robot itself, by {}", local.holder);
        session.ui.warn(&line);
    }
    Ok(exit::OK)
}

async fn node(name: &str, session: &Session) -> Result<Node, CliError> {
    let object = session.client.get(target::kind("node")?, None, name).await?;
    let node = serde_json::from_value(object).map_err(|source| CliError::Answer {
        server: session.client.server.clone(),
        request: format!("GET node/{name}"),
        source,
    })?;
    Ok(node)
}

async fn write(name: &str, lock: Value, session: &Session) -> Result<(), CliError> {
    let patch = json!({"metadata": {"annotations": {MISSION_LOCK: lock}}});
    session.client.patch(target::kind("node")?, None, name, &patch, Mode::Store).await.map(drop)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::{Fake, node};

    #[tokio::test]
    async fn one_holder_at_a_time() {
        let fake = Fake::new();
        fake.put("nodes/r1", node("r1", json!({})));
        let line = ["node", "lock", "r1", "--holder", "ada", "--reason", "carries a tray"];
        assert_eq!(fake.run(&line).await, (exit::OK, "node/r1 locked by ada\n".to_owned()));
        let notes = fake.object("nodes/r1").expect("there")["metadata"]["annotations"].clone();
        assert_eq!(notes["muster.dev/mission-lock"], "ada: carries a tray");
        let other = fake.try_run(&["node", "lock", "r1", "--holder", "bob"]).await;
        assert_eq!(
            other.expect_err("held").to_string(),
            "node/r1 is locked by ada already: carries a tray"
        );
        fake.try_run(&["node", "unlock", "r1", "--holder", "bob"]).await.expect_err("not his");
        assert_eq!(fake.run(&["node", "unlock", "r1"]).await.1, "node/r1 unlocked\n");
        assert_eq!(fake.run(&["node", "unlock", "r1"]).await.1, "node/r1 is not locked\n");
        fake.edit("nodes/r1", |node| {
            let lock = json!({"holder": "task default/patrol", "reason": "far away"});
            node["status"]["missionLocks"] = json!([lock]);
        });
        let local = fake.try_run(&["node", "unlock", "r1"]).await.expect_err("set on the robot");
        assert!(local.to_string().contains("task default/patrol: far away"), "{local}");
    }
}
