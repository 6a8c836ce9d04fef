//! `muster lease`: a person's hold on a robot's actuators.

use muster_api::kind::lease::{DEFAULT_GROUP, LeaseSpec};
use serde_json::{Value, json};

use super::Outcome;
use crate::client::path;
use crate::exit;
use crate::session::Session;
use crate::target;

/// `muster lease`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Take a robot's actuators if nobody has them; no task drives it until they are returned
    Acquire(Args),
    /// Take a robot's actuators from whoever has them; a task that had them runs on without, and is refused from then on
    Take(Args),
    /// Give them back; a new task may have them, the one before does not get them again
    Return(Args),
}

/// Which robot.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The robot, or a conflict group of its actuators
    #[arg(value_name = "NODE[/GROUP]")]
    robot: String,
    /// What for, for those who find it taken
    #[arg(long, value_name = "TEXT")]
    reason: Option<String>,
}

pub(crate) async fn run(command: Command, session: &mut Session) -> Outcome {
    let (verb, did, args) = match command {
        Command::Acquire(args) => ("acquire", "acquired", args),
        Command::Take(args) => ("take", "taken", args),
        Command::Return(args) => ("return", "returned", args),
    };
    let (node, group) = args.robot.split_once('/').unwrap_or((&args.robot, DEFAULT_GROUP));
    let name = LeaseSpec::object_name(node, group);
    let uri = format!("{}/{verb}", path(target::kind("lease")?, None, Some(&name)));
    let mut body = json!({});
    if let Some(reason) = args.reason {
        body["reason"] = reason.into();
    }
    let lease: Value = session.client.post_json(&uri, &body).await?;
    let epoch = lease["status"]["epoch"].as_u64().unwrap_or_default();
    session.ui.line(&format!("lease/{name} {did}, epoch {epoch}"))?;
    Ok(exit::OK)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fake::Fake;

    #[tokio::test]
    async fn the_default_group_need_not_be_named() {
        let fake = Fake::new();
        let answer = json!({"status": {"epoch": 5}});
        fake.answer("POST /apis/muster.dev/v1alpha1/leases/r1.body/take", answer.clone());
        fake.answer("POST /apis/muster.dev/v1alpha1/leases/r1.arm/return", answer);
        let take = fake.run(&["lease", "take", "r1", "--reason", "stuck in a door"]).await;
        assert_eq!(take, (exit::OK, "lease/r1.body taken, epoch 5\n".to_owned()));
        assert_eq!(fake.last_body(), json!({"reason": "stuck in a door"}));
        let back = fake.run(&["lease", "return", "r1/arm"]).await;
        assert_eq!(back, (exit::OK, "lease/r1.arm returned, epoch 5\n".to_owned()));
    }
}
