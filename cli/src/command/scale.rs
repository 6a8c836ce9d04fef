//! `muster scale`: how many tasks sets have, through the scale subresource, as kubectl does it.

use serde_json::{Value, json};

use super::{FirstError, Outcome};
use crate::client::path;
use crate::error::CliError;
use crate::session::Session;
use crate::target::{self, Named};

/// `muster scale`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The sets, NAME or taskset/NAME
    #[arg(value_name = "TASKSET", required = true)]
    sets: Vec<String>,
    /// How many tasks there should be
    #[arg(long, value_name = "N")]
    replicas: u32,
    /// Only when there should be this many now
    #[arg(long, value_name = "N")]
    current_replicas: Option<u32>,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let mut errors = FirstError::default();
    for word in &args.sets {
        let named = target::one(word, "taskset")?;
        match scale(&named, &args, session).await {
            Ok(()) => {}
            Err(error) if args.sets.len() == 1 => return Err(error),
            Err(error) => errors.note(error, &session.ui)?,
        }
    }
    Ok(errors.exit())
}

async fn scale(named: &Named<'_>, args: &Args, session: &mut Session) -> Result<(), CliError> {
    let name = named.name.unwrap_or_default();
    let uri = format!("{}/scale", path(named.info, Some(&session.namespace), Some(name)));
    let mut patch = json!({"spec": {"replicas": args.replicas}});
    if let Some(expected) = args.current_replicas {
        let present: Value = session.client.get_json(&uri).await?;
        let is = present.pointer("/spec/replicas").and_then(Value::as_u64).unwrap_or(0);
        if is != u64::from(expected) {
            return Err(CliError::Failed {
                what: format!("taskset/{name} should have {is} tasks, not {expected}"),
                hint: Some(
                    "it is not scaled; leave --current-replicas out to do it anyway".to_owned(),
                ),
            });
        }
        patch["metadata"] = json!({"resourceVersion": present["metadata"]["resourceVersion"]});
    }
    session.client.patch_path(&uri, &patch).await?;
    session.ui.line(&format!("taskset/{name} scaled"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::Fake;

    const SCALE: &str = "/apis/muster.dev/v1alpha1/namespaces/default/tasksets/x/scale";

    #[tokio::test]
    async fn the_number_is_patched_and_may_be_checked_first() {
        let fake = Fake::new();
        let scale = json!({"metadata": {"resourceVersion": "7"}, "spec": {"replicas": 2}});
        for method in ["GET", "PATCH"] {
            fake.answer(&format!("{method} {SCALE}"), scale.clone());
        }
        let line = ["scale", "taskset/x", "--replicas=5", "--current-replicas=2"];
        assert_eq!(fake.run(&line).await, (exit::OK, "taskset/x scaled\n".to_owned()));
        let body = json!({"spec": {"replicas": 5}, "metadata": {"resourceVersion": "7"}});
        assert_eq!(fake.last_body(), body);
        let line = ["scale", "ts/x", "--replicas=5", "--current-replicas=3"];
        let error = fake.try_run(&line).await.expect_err("another number");
        assert_eq!(error.class().exit(), exit::FAILURE);
        assert_eq!(error.to_string(), "taskset/x should have 2 tasks, not 3");
    }
}
