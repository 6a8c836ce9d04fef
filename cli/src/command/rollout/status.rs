//! `muster rollout status`: until a rollout is done or given up.

use muster_api::condition::{ConditionStatus, PROGRESSING};
use muster_api::duration::Span;
use muster_api::kind::taskset::{TaskSet, TaskSetStatus};
use tokio::time::Instant;

use super::super::Outcome;
use super::info;
use crate::args::span;
use crate::client::Selection;
use crate::error::CliError;
use crate::exit;
use crate::session::Session;
use crate::target;
use crate::watch::{Change, Follow};

/// `muster rollout status`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The set, NAME or taskset/NAME
    #[arg(value_name = "TASKSET")]
    set: String,
    /// Follow it; otherwise say how it is now
    #[arg(short, long, value_name = "BOOL", default_value_t = true, action = clap::ArgAction::Set, num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    watch: bool,
    /// Follow it this long at most [default: for ever]
    #[arg(long, value_name = "TIME", value_parser = span)]
    timeout: Option<Span>,
}

/// Where a rollout stands.
#[derive(Debug, PartialEq, Eq)]
enum Verdict {
    Done,
    Failed(String),
    Going(String),
}

fn verdict(set: &TaskSet) -> Verdict {
    let name = set.metadata.name.as_deref().unwrap_or_default();
    let nothing = TaskSetStatus::default();
    let status = set.status.as_ref().unwrap_or(&nothing);
    if status.observed_generation < set.metadata.generation.unwrap_or_default() {
        return Verdict::Going("Waiting for taskset spec update to be observed...".to_owned());
    }
    let said = status.condition(PROGRESSING);
    let (reason, message) = said.map_or(("", ""), |c| (&*c.reason, &*c.message));
    if said.is_some_and(|c| c.status == ConditionStatus::False) {
        return Verdict::Failed(format!("taskset/{name}: {reason}: {message}"));
    }
    if reason == "Complete" {
        return Verdict::Done;
    }
    let (updated, desired) = (status.updated_replicas, status.desired_replicas);
    let count = if updated < desired {
        format!("{updated} out of {desired} new tasks have been updated")
    } else {
        format!("{} of {updated} updated tasks are available", status.available_replicas)
    };
    let why = if message.is_empty() { String::new() } else { format!(" ({reason}: {message})") };
    Verdict::Going(format!("Waiting for taskset {name:?} rollout to finish: {count}...{why}"))
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let name = target::one(&args.set, "taskset")?.name.unwrap_or_default();
    let namespace = session.namespace.clone();
    // A set that does not exist is an error and nothing to wait for.
    session.client.get(info()?, Some(&namespace), name).await?;
    let started = Instant::now();
    let mut follow = Follow::new(&session.client, info()?, Some(&namespace), Selection::name(name));
    let mut last = String::new();
    loop {
        let next = follow.next();
        let change = match args.timeout {
            Some(timeout) => tokio::time::timeout_at(started + timeout.as_duration(), next).await,
            None => Ok(next.await),
        };
        let Ok(change) = change else {
            return Err(CliError::Timeout {
                what: format!("taskset/{name} to be rolled out"),
                after: started.elapsed(),
                hint: Some(last),
            });
        };
        let object = match change? {
            Change::Applied(object) => object,
            Change::Deleted(_) => {
                let what = format!("taskset/{name} was deleted");
                return Err(CliError::Failed { what, hint: None });
            }
            Change::Synced => continue,
        };
        let set: TaskSet = serde_json::from_value(object).map_err(|source| CliError::Answer {
            server: session.client.server.clone(),
            request: format!("watch of taskset/{name}"),
            source,
        })?;
        match verdict(&set) {
            Verdict::Done => {
                session.ui.line(&format!("taskset {name:?} successfully rolled out"))?;
                return Ok(exit::OK);
            }
            Verdict::Failed(what) => {
                let hint = Some(format!("`muster describe taskset/{name}` shows its tasks"));
                return Err(CliError::Failed { what, hint });
            }
            Verdict::Going(line) => {
                if line != last {
                    session.ui.line(&line)?;
                }
                last = line;
                if !args.watch {
                    return Ok(exit::OK);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use crate::exit;
    use crate::fake::{Fake, taskset};

    fn status(generation: i64, reason: &str, holds: &str) -> Value {
        json!({
            "observedGeneration": generation, "desiredReplicas": 3, "updatedReplicas": 1, "replicas": 3,
            "conditions": [{"type": "Progressing", "status": holds, "reason": reason, "message": "m"}],
        })
    }

    #[tokio::test]
    async fn it_is_followed_to_its_end() {
        let fake = Fake::new();
        fake.put("tasksets/default/x", taskset("x", status(1, "Complete", "True")));
        let (done, ()) = tokio::join!(fake.run(&["rollout", "status", "ts/x"]), async {
            tokio::task::yield_now().await;
            fake.put("tasksets/default/x", taskset("x", status(2, "Canary", "True")));
            tokio::task::yield_now().await;
            fake.put("tasksets/default/x", taskset("x", status(2, "Complete", "True")));
        });
        assert_eq!(done.0, exit::OK);
        assert!(done.1.ends_with("taskset \"x\" successfully rolled out\n"), "{}", done.1);
        fake.put("tasksets/default/x", taskset("x", status(2, "Canary", "True")));
        let (_, text) = fake.run(&["rollout", "status", "x", "--watch=false"]).await;
        assert_eq!(
            text,
            "Waiting for taskset \"x\" rollout to finish: 1 out of 3 new tasks have been updated... (Canary: m)\n"
        );
        let late = fake.try_run(&["rollout", "status", "x", "--timeout", "20ms"]).await;
        assert_eq!(late.expect_err("it goes on").class().exit(), exit::TIMEOUT);
        fake.put("tasksets/default/x", taskset("x", status(2, "RolledBack", "False")));
        let error = fake.try_run(&["rollout", "status", "x"]).await.expect_err("given up");
        assert_eq!(error.class().exit(), exit::FAILURE);
        assert_eq!(error.to_string(), "taskset/x: RolledBack: m");
        let none = fake.try_run(&["rollout", "status", "y"]).await.expect_err("none");
        assert_eq!(none.class().exit(), exit::NOT_FOUND);
    }
}
