//! `muster drain`: cordon a node, then end the tasks on it, each within its grace.
//!
//! A task is one run: nobody starts it again elsewhere unless something owns it. Drain says which
//! tasks these are, and which of them drive the robot, before it waits. A
//! robot in the middle of a mission is waited for first.

use std::time::Duration;

use muster_api::duration::Span;
use muster_api::kind::node::Node;
use muster_api::kind::task::Task;
use serde_json::Value;
use tokio::time::Instant;

use super::gone::{Doomed, until_gone};
use super::{Outcome, cordon};
use crate::args::span;
use crate::client::{Deletion, Selection};
use crate::error::CliError;
use crate::exit;
use crate::output::human;
use crate::session::Session;
use crate::target;
use crate::watch::{Change, Follow};

/// `muster drain`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The node, NAME or node/NAME
    node: String,
    /// Seconds between asking a task to end and killing it, instead of its own
    #[arg(long, value_name = "SECONDS")]
    grace_period: Option<u32>,
    /// Wait this long at most [default: for ever]
    #[arg(long, value_name = "TIME", value_parser = span)]
    timeout: Option<Span>,
    /// End tasks in the middle of a mission too
    #[arg(long)]
    ignore_mission_lock: bool,
    /// Only say what would be ended
    #[arg(long)]
    dry_run: bool,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let node = target::one(&args.node, "node")?.name.unwrap_or_default();
    if args.dry_run {
        session.client.get(target::kind("node")?, None, node).await?;
    } else {
        cordon::set(node, true, session).await?;
    }
    if !args.dry_run && !args.ignore_mission_lock {
        until_unlocked(node, args.timeout.map(|t| t.as_duration()), session).await?;
    }
    let tasks = tasks_on(node, session).await?;
    if tasks.is_empty() {
        session.ui.line(&format!("node/{node} runs no tasks"))?;
        return Ok(exit::OK);
    }
    announce(&tasks, args.dry_run, session)?;
    if args.dry_run {
        return Ok(exit::OK);
    }
    for doomed in &tasks {
        let name = name(&doomed.object);
        let namespace = doomed.namespace.as_deref();
        let how =
            Deletion { grace: args.grace_period, uid: Some(&doomed.uid), ..Deletion::default() };
        let deleted = session.client.delete(doomed.info, namespace, &name, how);
        match deleted.await {
            Ok(_) => {}
            // It ended by itself meanwhile.
            Err(error) if error.is_not_found() => {}
            Err(error) => return Err(error),
        }
    }
    let count = tasks.len();
    until_gone(tasks, args.timeout.map(|t| t.as_duration()), session).await?;
    session.ui.line(&format!("node/{node} is drained: {} ended", human::count(count, "task")))?;
    Ok(exit::OK)
}

/// Waits until the node is on no mission: it is cordoned, so no new one begins there.
async fn until_unlocked(
    node: &str,
    most: Option<Duration>,
    session: &mut Session,
) -> Result<(), CliError> {
    let started = Instant::now();
    let mut follow =
        Follow::new(&session.client, target::kind("node")?, None, Selection::name(node));
    let mut told = None;
    loop {
        let change = match most {
            Some(most) => tokio::time::timeout_at(started + most, follow.next()).await,
            None => Ok(follow.next().await),
        };
        let Ok(change) = change else {
            return Err(CliError::Timeout {
                what: format!("the mission on node/{node} to end"),
                after: started.elapsed(),
                hint: Some("--ignore-mission-lock ends its tasks all the same".to_owned()),
            });
        };
        let lock = match change? {
            Change::Applied(object) => {
                serde_json::from_value::<Node>(object).ok().and_then(|node| node.mission_lock())
            }
            Change::Deleted(_) => None,
            Change::Synced => continue,
        };
        let Some(lock) = lock else { return Ok(()) };
        if told.as_ref() != Some(&lock) {
            session.ui.line(&format!(
                "waiting for the mission of {} on node/{node}: {}",
                lock.holder, lock.reason
            ))?;
            told = Some(lock);
        }
    }
}

/// What holds something of the node, in every namespace.
async fn tasks_on(node: &str, session: &Session) -> Result<Vec<Doomed>, CliError> {
    let info = target::kind("task")?;
    let on = Selection { labels: None, fields: Some(format!("status.node={node}")) };
    let list = session.client.list(info, None, &on).await?;
    let holds = |object: &Value| {
        serde_json::from_value::<Task>(object.clone())
            .is_ok_and(|t| t.status.is_some_and(|s| s.phase.holds_node()))
    };
    Ok(list.items.into_iter().filter(holds).map(|o| Doomed::new(info, o)).collect())
}

fn announce(tasks: &[Doomed], dry: bool, session: &mut Session) -> Result<(), CliError> {
    for doomed in tasks {
        let text = |p: &str| doomed.object.pointer(p).and_then(Value::as_str).unwrap_or_default();
        let verb = if dry { "would end" } else { "ending" };
        let mut line =
            format!("{verb} task/{} in {}", name(&doomed.object), text("/metadata/namespace"));
        if doomed.object.pointer("/status/lease").is_some() {
            line.push_str(&format!(", which holds the lease {}", text("/status/lease/name")));
        }
        session.ui.line(&line)?;
    }
    let owned = |d: &&Doomed| {
        let owners = d.object.pointer("/metadata/ownerReferences").and_then(Value::as_array);
        owners.is_some_and(|o| !o.is_empty())
    };
    let alone = tasks.iter().filter(|d| !owned(d)).count();
    if alone > 0 {
        session.ui.warn(&format!(
            "nothing starts {} of these again elsewhere: no other object owns {}",
            alone,
            if alone == 1 { "it" } else { "them" }
        ));
    }
    Ok(())
}

fn name(object: &Value) -> String {
    object.pointer("/metadata/name").and_then(Value::as_str).unwrap_or_default().to_owned()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::{Fake, node, task};

    #[tokio::test]
    async fn cordons_ends_and_waits_for_what_is_on_the_node() {
        let fake = Fake::new();
        fake.put("nodes/r1", node("r1", json!({})));
        fake.put(
            "tasks/default/a",
            task(
                "a",
                json!({"phase": "Running", "node": "r1", "lease": {"name": "r1.body", "epoch": 1}}),
            ),
        );
        fake.put("tasks/default/done", task("done", json!({"phase": "Succeeded", "node": "r1"})));
        fake.put("tasks/default/other", task("other", json!({"phase": "Running", "node": "r2"})));
        let (_, text) = fake.run(&["drain", "r1", "--dry-run"]).await;
        assert_eq!(text, "would end task/a in default, which holds the lease r1.body\n");
        assert!(fake.object("tasks/default/a").is_some());
        assert_eq!(
            fake.run(&["drain", "r1"]).await,
            (exit::OK, "node/r1 cordoned\nending task/a in default, which holds the lease r1.body\nnode/r1 is drained: 1 task ended\n".to_owned())
        );
        assert!(fake.object("tasks/default/a").is_none());
        assert!(
            fake.object("tasks/default/done").is_some()
                && fake.object("tasks/default/other").is_some()
        );
        assert_eq!(
            fake.run(&["drain", "r1"]).await.1,
            "node/r1 is cordoned already\nnode/r1 runs no tasks\n"
        );
    }
}
