//! `muster logs`: what a task wrote, streamed from its node; with `--follow` from the next one, too, when it is tried there.

use muster_api::duration::Span;
use muster_api::kind::task::{Outlook, Task};

use super::Outcome;
use crate::args::span;
use crate::client::{Selection, path, with_query};
use crate::error::CliError;
use crate::exit;
use crate::session::Session;
use crate::successor;
use crate::target::{self, Named};
use crate::watch::{Change, Follow};

/// `muster logs`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The task, NAME or task/NAME
    task: String,
    /// Go on with what it writes from now on
    #[arg(short, long)]
    follow: bool,
    /// Only this many lines before the end
    #[arg(long, value_name = "LINES")]
    tail: Option<u64>,
    /// Only what it wrote since then
    #[arg(long, value_name = "TIME", value_parser = span)]
    since: Option<Span>,
    /// Of the attempt before the present one
    #[arg(short, long)]
    previous: bool,
    /// The time before each line
    #[arg(long)]
    timestamps: bool,
}

impl Args {
    fn pairs(&self) -> Vec<(&'static str, String)> {
        let flag = |name, on: bool| on.then(|| (name, "true".to_owned()));
        // A second that has begun counts: rather a line too many than one too few.
        let since = self.since.map(|s| s.as_duration().as_secs_f64().ceil() as u64);
        [
            flag("follow", self.follow),
            flag("previous", self.previous),
            flag("timestamps", self.timestamps),
            self.tail.map(|n| ("tailLines", n.to_string())),
            since.map(|s| ("sinceSeconds", s.max(1).to_string())),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let named = target::one(&args.task, "task")?;
    let of = path(named.info, Some(&session.namespace), named.name);
    let pairs = args.pairs();
    let pairs: Vec<(&str, &str)> = pairs.iter().map(|(k, v)| (*k, v.as_str())).collect();
    loop {
        let uid = match args.follow {
            true => uid_now(&named, session).await?,
            false => String::new(),
        };
        let uri = with_query(&format!("{of}/log"), &pairs);
        let mut stream = session.client.stream(&uri).await?;
        while let Some(bytes) = stream.next_bytes().await? {
            session.ui.print_bytes(&bytes)?;
        }
        if !args.follow || !goes_on_elsewhere(&named, &uid, session).await? {
            return Ok(exit::OK);
        }
    }
}

async fn uid_now(named: &Named<'_>, session: &Session) -> Result<String, CliError> {
    let name = named.name.unwrap_or_default();
    let object = session.client.get(named.info, Some(&session.namespace), name).await?;
    Ok(object["metadata"]["uid"].as_str().unwrap_or_default().to_owned())
}

/// After the log of `uid` has ended: waits until the task runs on another node, under another uid. False: it has ended for
/// good, or is gone.
async fn goes_on_elsewhere(
    named: &Named<'_>,
    uid: &str,
    session: &Session,
) -> Result<bool, CliError> {
    let name = named.name.unwrap_or_default();
    let mut changes =
        Follow::new(&session.client, named.info, Some(&session.namespace), Selection::name(name));
    let mut there = false;
    loop {
        let object = match changes.next().await? {
            Change::Applied(object) => object,
            Change::Deleted(object) if successor::is_tried_again(&object) => continue,
            Change::Deleted(_) => return Ok(false),
            Change::Synced if there => continue,
            Change::Synced => return Ok(false),
        };
        there = true;
        let Ok(task) = serde_json::from_value::<Task>(object) else { return Ok(false) };
        let status = task.status.clone().unwrap_or_default();
        let is_same = task.metadata.uid.as_deref() == Some(uid);
        if is_same && task.spec.reschedule.is_none() && status.stop.is_none() {
            // Nothing follows it.
            return Ok(false);
        }
        match task.outlook() {
            Outlook::Over(_) => return Ok(!is_same && status.attempt > 0),
            Outlook::Alive if !is_same && status.attempt > 0 => {
                let node = status.node.unwrap_or_default();
                session.ui.note(&format!("task/{name} goes on on {node}"));
                return Ok(true);
            }
            Outlook::Alive | Outlook::Again { .. } => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::exit;
    use crate::fake::Fake;

    #[tokio::test]
    async fn the_log_is_printed_as_it_is() {
        let fake = Fake::new();
        fake.answer_text(
            "GET /apis/muster.dev/v1alpha1/namespaces/default/tasks/t/log",
            "one\n\u{1b}[1mtwo",
        );
        let printed = fake.run(&["logs", "task/t", "--tail", "5", "--since", "1500ms", "-p"]).await;
        assert_eq!(printed, (exit::OK, "one\n\u{1b}[1mtwo".to_owned()));
        assert!(
            fake.requests()[0].ends_with("/log?previous=true&tailLines=5&sinceSeconds=2"),
            "{:?}",
            fake.requests()
        );
    }
}
