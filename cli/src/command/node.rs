//! `muster node`: nodes before their agents have joined, and after they are lost.

use muster_api::kind;
use serde_json::{Map, Value, json};

use super::token::{Terms, join_command, make, secret};
use super::{Outcome, fence, lock};
use crate::args::pair;
use crate::client::Mode;
use crate::error::{Class, CliError};
use crate::exit;
use crate::session::Session;
use crate::target;

/// `muster node`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Create a Node and print the command with which its agent joins
    Register(RegisterArgs),
    /// Confirm that a node is off: its tasks end, and what they held is free
    Fence(fence::Args),
    /// Keep the tasks on nodes from being changed while a mission lasts
    Lock(lock::LockArgs),
    /// Say that the mission is over
    Unlock(lock::UnlockArgs),
}

/// `muster node register`.
#[derive(Debug, clap::Args)]
pub(crate) struct RegisterArgs {
    /// The node's name
    name: String,
    /// What it is
    #[arg(long, value_enum)]
    kind: NodeKind,
    /// Usual speed of a robot, m/s; the cost TravelTime needs it
    #[arg(long, value_name = "M/S")]
    speed: Option<f64>,
    /// A label; may be given several times
    #[arg(long = "label", value_name = "KEY=VALUE", value_parser = pair)]
    labels: Vec<(String, String)>,
    #[command(flatten)]
    terms: Terms,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum NodeKind {
    Robot,
    Cloud,
}

impl NodeKind {
    fn as_flag(self) -> &'static str {
        match self {
            NodeKind::Robot => "robot",
            NodeKind::Cloud => "cloud",
        }
    }
}

pub(crate) async fn run(command: Command, session: &mut Session) -> Outcome {
    match command {
        Command::Register(args) => register(args, session).await,
        Command::Fence(args) => fence::run(args, session).await,
        Command::Lock(args) => lock::lock(args, session).await,
        Command::Unlock(args) => lock::unlock(args, session).await,
    }
}

async fn register(args: RegisterArgs, session: &mut Session) -> Outcome {
    let info = target::kind("node")?;
    let object = object(&args);
    kind::admit(&object)
        .map_err(|violations| CliError::Usage { message: violations.to_string(), hint: None })?;
    match session.client.create(info, None, &object, Mode::Store).await {
        Ok(_) => session.ui.note(&format!("node/{} registered", args.name)),
        Err(error) if error.class() == Class::Conflict => {
            let present = session.client.get(info, None, &args.name).await?;
            // Running it again makes a new token; another kind under the same name is a mistake.
            if present["spec"]["kind"] != object["spec"]["kind"] {
                return Err(error);
            }
            session
                .ui
                .note(&format!("node/{} is registered already; it stays as it is", args.name));
        }
        Err(error) => return Err(error),
    }
    let answer = make(&args.terms, Some(&args.name), session).await?;
    let token = secret(&answer, session)?;
    session.ui.note(&format!("On the robot or server, within {}:\n", args.terms.ttl()));
    session.ui.line(&join_command(
        &session.client.server,
        &token,
        &args.name,
        args.kind.as_flag(),
    ))?;
    Ok(exit::OK)
}

fn object(args: &RegisterArgs) -> Value {
    let kind = match args.kind {
        NodeKind::Robot => "Robot",
        NodeKind::Cloud => "Cloud",
    };
    let mut metadata = json!({"name": args.name});
    if !args.labels.is_empty() {
        let labels: Map<String, Value> =
            args.labels.iter().map(|(k, v)| (k.clone(), v.as_str().into())).collect();
        metadata["labels"] = labels.into();
    }
    let mut spec = json!({"kind": kind});
    if let Some(speed) = args.speed {
        spec["speed"] = speed.into();
    }
    json!({"apiVersion": muster_api::API_VERSION, "kind": "Node", "metadata": metadata, "spec": spec})
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::Fake;

    #[tokio::test]
    async fn registering_prints_the_join_command_and_may_be_repeated() {
        let fake = Fake::new();
        let made = json!({"metadata": {"name": "ab"}, "status": {"token": "TOKEN", "used": 0}});
        fake.answer("POST /apis/muster.dev/v1alpha1/jointokens", made);
        let line =
            ["node", "register", "r1", "--kind", "robot", "--speed", "0.5", "--label", "area=lab"];
        for _ in 0..2 {
            assert_eq!(
                fake.run(&line).await,
                (
                    exit::OK,
                    "muster agent --join https://fake:7443 --token TOKEN --name r1 --kind robot\n"
                        .to_owned()
                )
            );
        }
        let node = fake.object("nodes/r1").expect("registered");
        assert_eq!(node["spec"], json!({"kind": "Robot", "speed": 0.5}));
        assert_eq!(node["metadata"]["labels"], json!({"area": "lab"}));
        let other = fake.try_run(&["node", "register", "r1", "--kind", "cloud"]).await;
        assert_eq!(other.expect_err("another kind").class().exit(), exit::CONFLICT);
        let bad = fake.try_run(&["node", "register", "R_1", "--kind", "cloud"]).await;
        assert_eq!(bad.expect_err("not a name").class().exit(), exit::USAGE);
    }
}
