//! `muster logs`: what a task wrote, streamed from its node.

use muster_api::duration::Span;

use super::Outcome;
use crate::args::span;
use crate::client::{path, with_query};
use crate::exit;
use crate::session::Session;
use crate::target;

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
    let mut stream = session.client.stream(&with_query(&format!("{of}/log"), &pairs)).await?;
    while let Some(bytes) = stream.next_bytes().await? {
        session.ui.print_bytes(&bytes)?;
    }
    Ok(exit::OK)
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
