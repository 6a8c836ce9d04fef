//! `muster estop`: stops robots at once, and lets them move again.
//!
//! It asks nothing before it acts, and says of each robot whether it stands: what is not known to stand is not called
//! stopped. It is no safety device; the button on the robot is.

use std::time::Duration;

use futures::future::join_all;
use muster_api::condition::{ACTUATORS_FENCED, ConditionStatus};
use muster_api::kind::node::estop::{EStopStatus, EStopTier, ORDERED};
use muster_api::kind::node::{Node, NodeKind, NodeStatus};
use serde_json::{Value, json};
use tokio::time::Instant;

use super::{FirstError, Outcome};
use crate::client::{Client, Mode, Selection};
use crate::error::{Class, CliError};
use crate::session::Session;
use crate::target;

/// Between two looks whether a robot stands.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// `muster estop`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The robots, NAME or node/NAME
    #[arg(value_name = "NODE", required_unless_present = "all", conflicts_with = "all")]
    nodes: Vec<String>,
    /// Every robot
    #[arg(long)]
    all: bool,
    /// Cut the motors' power, too
    #[arg(long, conflicts_with = "release")]
    cut: bool,
    /// Let them move again; also what was stopped by a button on the robot that is not pressed any more
    #[arg(long)]
    release: bool,
    /// How long to look whether a robot does it
    #[arg(long, value_name = "DURATION", default_value = "5s", value_parser = crate::args::span)]
    timeout: muster_api::duration::Span,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let mut names: Vec<String> = Vec::new();
    for word in &args.nodes {
        names.push(target::one(word, "node")?.name.unwrap_or_default().to_owned());
    }
    if args.all {
        names = robots(&session.client).await?;
    }
    let tier = match (args.release, args.cut) {
        (true, _) => EStopTier::None,
        (false, true) => EStopTier::Cut,
        (false, false) => EStopTier::Settle,
    };
    let until = Instant::now() + args.timeout.as_duration();
    let client = &session.client;
    let stops = names.iter().map(async |name| {
        let done = order(client, name, tier).await;
        (
            name,
            match done {
                Ok(()) => confirmed(client, name, tier, until).await,
                Err(error) => Err(error),
            },
        )
    });
    let mut errors = FirstError::default();
    for (name, stands) in join_all(stops).await {
        match stands {
            Ok(line) => session.ui.line(&format!("node/{name} {line}"))?,
            Err(error) if names.len() == 1 => return Err(error),
            Err(error) => errors.note(error, &session.ui)?,
        }
    }
    Ok(errors.exit())
}

async fn robots(client: &Client) -> Result<Vec<String>, CliError> {
    let list = client.list(target::kind("node")?, None, &Selection::default()).await?;
    let items = list.items.iter();
    let robots =
        items.filter(|node| node.pointer("/spec/kind").is_some_and(|kind| kind == "Robot"));
    Ok(robots
        .filter_map(|node| Some(node.pointer("/metadata/name")?.as_str()?.to_owned()))
        .collect())
}

async fn read(client: &Client, name: &str) -> Result<Node, CliError> {
    let node: Value = client.get(target::kind("node")?, None, name).await?;
    serde_json::from_value(node).map_err(|error| CliError::Failed {
        what: format!("node/{name} cannot be read: {error}"),
        hint: None,
    })
}

/// Writes what is decided. A stop is written whatever else is.
async fn order(client: &Client, name: &str, tier: EStopTier) -> Result<(), CliError> {
    if tier.is_none() {
        return release(client, name).await;
    }
    let now = jiff::Timestamp::now().to_string();
    let patch = json!({"metadata": {"annotations": {ORDERED: now}}, "spec": {"estop": tier}});
    client.patch(target::kind("node")?, None, name, &patch, Mode::Store).await.map(drop)
}

/// A release names the newest stop of the robot's own that is known, and counts only while nobody has decided anything else
/// about the stop: one that came after stays.
async fn release(client: &Client, name: &str) -> Result<(), CliError> {
    let seen = read(client, name).await?;
    let number = |node: &Node| Some(node.status.as_ref()?.estop.as_ref()?.number);
    let decided = |node: &Node| {
        let ordered = node.metadata.annotations.as_ref().and_then(|all| all.get(ORDERED).cloned());
        (node.spec.estop, ordered, number(node))
    };
    let mut node = seen.clone();
    loop {
        let patch = json!({
            "metadata": {"resourceVersion": node.metadata.resource_version},
            "spec": {"estop": Value::Null, "estopRelease": number(&seen)},
        });
        match client.patch(target::kind("node")?, None, name, &patch, Mode::Store).await {
            Err(error) if error.class() == Class::Conflict => {}
            done => return done.map(drop),
        }
        node = read(client, name).await?;
        if decided(&node) != decided(&seen) {
            return Err(CliError::Failed {
                what: format!("node/{name} is not released: somebody has stopped it meanwhile"),
                hint: Some("look why, and release it then".to_owned()),
            });
        }
    }
}

/// Looks until the robot says that it is so.
async fn confirmed(
    client: &Client,
    name: &str,
    tier: EStopTier,
    until: Instant,
) -> Result<String, CliError> {
    loop {
        let node = read(client, name).await?;
        if let Some(line) = verdict(&node, tier)? {
            return Ok(line);
        }
        if Instant::now() >= until {
            return Err(in_vain(name, &node, tier));
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

/// What to say, once it is known; an error when it will never be so.
fn verdict(node: &Node, tier: EStopTier) -> Result<Option<String>, CliError> {
    let name = node.metadata.name.as_deref().unwrap_or_default();
    if node.spec.kind == NodeKind::Cloud {
        return Err(CliError::usage(format!("node/{name} is no robot")));
    }
    let status = node.status.as_ref();
    let Some(estop) = status.filter(|s| s.is_ready()).and_then(|s| s.estop.as_ref()) else {
        return Ok(None);
    };
    Ok(match tier {
        EStopTier::None if estop.tier.is_none() => Some("released".to_owned()),
        EStopTier::None => None,
        // A driver that is not there has not heard it.
        tier if estop.tier >= tier && fenced(status) => Some(format!("stopped ({})", estop.tier)),
        _ => None,
    })
}

/// Every driver is there, behind the gate.
fn fenced(status: Option<&NodeStatus>) -> bool {
    let condition = status.and_then(|status| status.condition(ACTUATORS_FENCED));
    condition.is_some_and(|condition| condition.status == ConditionStatus::True)
}

fn in_vain(name: &str, node: &Node, tier: EStopTier) -> CliError {
    let status = node.status.as_ref();
    let ready = status.is_some_and(NodeStatus::is_ready);
    let estop = status.and_then(|status| status.estop.as_ref());
    let (why, hint) = match (ready, estop) {
        (false, _) => ("its agent is not heard", "it is told as soon as it is; stop it by hand"),
        (true, None) => (
            "no gate stands before its drivers",
            "stop it by hand; its drivers belong under `gate` in agent.yaml",
        ),
        (true, Some(_)) if tier.is_none() => ("it is still stopped", "look at what still stops it"),
        (true, Some(_)) if !fenced(status) => {
            ("a driver is not there to hear it (see ActuatorsFenced)", "stop it by hand")
        }
        (true, Some(_)) => ("its gate has not said that it stands", "stop it by hand"),
    };
    let still: Vec<String> = estop.map(said).unwrap_or_default();
    let still = if still.is_empty() { String::new() } else { format!(" ({})", still.join(", ")) };
    let done = if tier.is_none() { "released" } else { "stopped" };
    CliError::Failed {
        what: format!("node/{name} is not known to be {done}: {why}{still}"),
        hint: Some(hint.to_owned()),
    }
}

fn said(estop: &EStopStatus) -> Vec<String> {
    estop.demands.iter().map(|demand| format!("{} by {}", demand.tier, demand.source)).collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::{Fake, node};

    fn robot(name: &str, estop: &serde_json::Value) -> serde_json::Value {
        let ready = json!([{"type": "Ready", "status": "True"}, {"type": "ActuatorsFenced", "status": "True"}]);
        node(name, json!({"conditions": ready, "estop": estop}))
    }

    async fn refused(fake: &Fake, line: &[&str]) -> String {
        let error = fake.try_run(line).await.expect_err("it is not so");
        error.to_string()
    }

    #[tokio::test]
    async fn what_is_not_known_to_stand_is_not_called_stopped() {
        let fake = Fake::new();
        fake.put("nodes/r1", robot("r1", &json!({"tier": "Settle", "number": 4})));
        fake.put("nodes/r2", robot("r2", &json!(null)));
        let said = fake.run(&["estop", "r1", "--timeout", "0s"]).await;
        assert_eq!(said, (exit::OK, "node/r1 stopped (Settle)\n".to_owned()));
        let spec = |name: &str| fake.object(name).expect("there")["spec"].clone();
        assert_eq!(spec("nodes/r1")["estop"], "Settle");
        let said = refused(&fake, &["estop", "r1", "--cut", "--timeout", "0s"]).await;
        assert!(said.contains("has not said that it stands"), "{said}");
        let said = refused(&fake, &["estop", "r2", "--timeout", "0s"]).await;
        assert!(said.contains("no gate stands before its drivers"), "{said}");
        // All of them are told, also when one does not answer.
        let said = fake.run(&["estop", "--all", "--timeout", "0s"]).await;
        assert_ne!(said.0, exit::OK);
        assert_eq!(said.1, "node/r1 stopped (Settle)\n");
        assert_eq!(
            (&spec("nodes/r1")["estop"], &spec("nodes/r2")["estop"]),
            (&json!("Settle"), &json!("Settle"))
        );
    }

    #[tokio::test]
    async fn a_release_names_the_newest_stop_that_is_known() {
        let fake = Fake::new();
        let by = json!([{"source": "button on the robot", "tier": "Cut"}]);
        fake.put("nodes/r1", robot("r1", &json!({"tier": "Cut", "number": 4, "demands": by})));
        let said = refused(&fake, &["estop", "r1", "--release", "--timeout", "0s"]).await;
        assert!(said.contains("Cut by button on the robot"), "{said}");
        let spec = fake.object("nodes/r1").expect("there")["spec"].clone();
        assert_eq!((spec.get("estop"), &spec["estopRelease"]), (None, &json!(4)));
    }

    #[tokio::test]
    async fn a_release_does_not_take_back_what_somebody_decides_meanwhile() {
        let fake = Fake::new();
        fake.put("nodes/r1", robot("r1", &json!({"tier": "None", "number": 4})));
        let release = ["estop", "r1", "--release", "--timeout", "0s"];
        fake.meanwhile(|node| {
            node["metadata"]["annotations"] = json!({"muster.dev/estop-ordered": "now"})
        });
        let said = refused(&fake, &release).await;
        assert!(said.contains("somebody has stopped it meanwhile"), "as far as before: {said}");
        fake.meanwhile(|node| node["spec"]["estop"] = json!("Cut"));
        let said = refused(&fake, &release).await;
        assert!(said.contains("somebody has stopped it meanwhile"), "{said}");
        assert_eq!(fake.object("nodes/r1").expect("there")["spec"]["estop"], "Cut");
        fake.meanwhile(|node| node["metadata"]["labels"] = json!({"room": "lab"}));
        assert_eq!(fake.run(&release).await, (exit::OK, "node/r1 released\n".to_owned()));
    }
}
