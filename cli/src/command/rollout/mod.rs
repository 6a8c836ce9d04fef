//! `muster rollout`: the change of a set's template, in kubectl's words.

mod history;
mod status;

use jiff::Timestamp;
use muster_api::kind::KindInfo;
use muster_api::kind::taskset::RESTARTED_AT;
use muster_api::kind::taskset_revision::TaskSetRevision;
use serde_json::{Value, json};

use super::{FirstError, Outcome};
use crate::client::{Mode, Selection};
use crate::error::CliError;
use crate::exit;
use crate::merge::three_way;
use crate::session::Session;
use crate::target;

/// `muster rollout`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Follow a rollout until it is done or given up
    Status(status::Args),
    /// Go back to an old template
    Undo(UndoArgs),
    /// Show the templates that a set has had
    History(history::Args),
    /// Change nothing for now
    Pause(Sets),
    /// Go on with what was paused
    Resume(Sets),
    /// Start every task anew, as a rollout
    Restart(Sets),
}

/// Sets.
#[derive(Debug, clap::Args)]
pub(crate) struct Sets {
    /// The sets, NAME or taskset/NAME
    #[arg(value_name = "TASKSET", required = true)]
    sets: Vec<String>,
}

/// `muster rollout undo`.
#[derive(Debug, clap::Args)]
pub(crate) struct UndoArgs {
    /// The set, NAME or taskset/NAME
    #[arg(value_name = "TASKSET")]
    set: String,
    /// Which one, by its number in the history [default: the one before]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    to_revision: u64,
}

pub(crate) async fn run(command: Command, session: &mut Session) -> Outcome {
    match command {
        Command::Status(args) => status::run(args, session).await,
        Command::History(args) => history::run(args, session).await,
        Command::Undo(args) => undo(args, session).await,
        Command::Pause(args) => each(args, session, Change::Pause(true)).await,
        Command::Resume(args) => each(args, session, Change::Pause(false)).await,
        Command::Restart(args) => each(args, session, Change::Restart).await,
    }
}

/// What is done to each set.
#[derive(Debug, Clone, Copy)]
enum Change {
    Pause(bool),
    Restart,
}

async fn each(args: Sets, session: &mut Session, change: Change) -> Outcome {
    let mut errors = FirstError::default();
    for word in &args.sets {
        let name = target::one(word, "taskset")?.name.unwrap_or_default();
        match one(name, session, change).await {
            Ok(()) => {}
            Err(error) if args.sets.len() == 1 => return Err(error),
            Err(error) => errors.note(error, &session.ui)?,
        }
    }
    Ok(errors.exit())
}

async fn one(name: &str, session: &mut Session, change: Change) -> Result<(), CliError> {
    let present = get(name, session).await?;
    let is_paused =
        present.pointer("/spec/rollout/paused").and_then(Value::as_bool).unwrap_or(false);
    let failed = |what: String, hint: Option<String>| Err(CliError::Failed { what, hint });
    let (patch, done) = match change {
        Change::Pause(true) if is_paused => {
            return failed(format!("taskset/{name} is already paused"), None);
        }
        Change::Pause(false) if !is_paused => {
            return failed(format!("taskset/{name} is not paused"), None);
        }
        Change::Pause(true) => (json!({"spec": {"rollout": {"paused": true}}}), "paused"),
        // Absent is the normal form of false.
        Change::Pause(false) => (json!({"spec": {"rollout": {"paused": null}}}), "resumed"),
        Change::Restart if is_paused => {
            let hint = format!("`muster rollout resume taskset/{name}` first");
            return failed(format!("taskset/{name} is paused and restarts nothing"), Some(hint));
        }
        Change::Restart => {
            let now = Timestamp::now().to_string();
            let metadata = json!({"annotations": {RESTARTED_AT: now}});
            (json!({"spec": {"template": {"metadata": metadata}}}), "restarted")
        }
    };
    session.client.patch(info()?, Some(&session.namespace), name, &patch, Mode::Store).await?;
    session.ui.line(&format!("taskset/{name} {done}"))
}

async fn undo(args: UndoArgs, session: &mut Session) -> Outcome {
    let name = target::one(&args.set, "taskset")?.name.unwrap_or_default();
    let present = get(name, session).await?;
    if present.pointer("/spec/rollout/paused") == Some(&Value::Bool(true)) {
        return Err(CliError::Failed {
            what: format!("taskset/{name} is paused and cannot be rolled back"),
            hint: Some(format!("`muster rollout resume taskset/{name}` first")),
        });
    }
    let revisions = revisions(name, &present, session).await?;
    let wanted = match args.to_revision {
        0 => revisions.iter().rev().nth(1),
        number => revisions.iter().find(|r| r.spec.revision == number),
    };
    let Some(wanted) = wanted else {
        let what = match args.to_revision {
            0 => format!("taskset/{name} has had no other template"),
            number => format!("taskset/{name} has no revision {number}"),
        };
        let hint = Some(format!("`muster rollout history taskset/{name}` shows what there is"));
        return Err(CliError::Failed { what, hint });
    };
    let template = serde_json::to_value(&wanted.spec.template).unwrap_or_default();
    let current = present.pointer("/spec/template").cloned().unwrap_or_default();
    let change = three_way(Some(&current), &template, &current);
    if change.as_object().is_some_and(serde_json::Map::is_empty) {
        let number = wanted.spec.revision;
        session
            .ui
            .line(&format!("taskset/{name} skipped rollback (revision {number} is what it has)"))?;
        return Ok(exit::OK);
    }
    let patch = json!({"spec": {"template": change}});
    session.client.patch(info()?, Some(&session.namespace), name, &patch, Mode::Store).await?;
    session.ui.line(&format!("taskset/{name} rolled back"))?;
    Ok(exit::OK)
}

fn info() -> Result<&'static KindInfo, CliError> {
    target::kind("taskset")
}

async fn get(name: &str, session: &Session) -> Result<Value, CliError> {
    session.client.get(info()?, Some(&session.namespace), name).await
}

/// The revisions of a set, oldest first.
async fn revisions(
    name: &str,
    set: &Value,
    session: &Session,
) -> Result<Vec<TaskSetRevision>, CliError> {
    let labels = Some(format!("{}={name}", muster_api::kind::taskset::SET_LABEL));
    let selection = Selection { labels, fields: None };
    let kind = target::kind("tasksetrevision")?;
    let list = session.client.list(kind, Some(&session.namespace), &selection).await?;
    let uid = set.pointer("/metadata/uid").and_then(Value::as_str).unwrap_or_default();
    let mine = |r: &TaskSetRevision| {
        r.metadata.owner_references.iter().flatten().any(|owner| owner.uid == uid)
    };
    let read = list.items.into_iter().filter_map(|o| serde_json::from_value(o).ok());
    let mut revisions: Vec<TaskSetRevision> = read.filter(mine).collect();
    revisions.sort_by_key(|r| r.spec.revision);
    Ok(revisions)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use crate::exit;
    use crate::fake::{Fake, taskset};

    fn revision(name: &str, number: u64, command: &str) -> Value {
        json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "TaskSetRevision",
            "metadata": {
                "name": name, "namespace": "default", "labels": {"muster.dev/taskset": "x"},
                "ownerReferences": [{"apiVersion": "a", "kind": "TaskSet", "name": "x", "uid": "u", "controller": true}],
                "annotations": {"kubernetes.io/change-cause": format!("to {command}")},
            },
            "spec": {"revision": number, "template": {"spec": {
                "run": {"process": {"command": [command]}}, "restartPolicy": "Always",
            }}},
        })
    }

    fn fake() -> Fake {
        let fake = Fake::new();
        let mut set = taskset(
            "x",
            json!({"updateRevision": "x-b", "currentRevision": "x-a",
            "rolledBackFrom": {"revision": "x-b", "to": "x-a", "reason": "Crashed", "message": "m", "at": "2026-01-02T03:04:05Z"}}),
        );
        set["metadata"]["uid"] = "u".into();
        set["spec"]["template"] = revision("x-b", 2, "new")["spec"]["template"].clone();
        set["spec"]["template"]["metadata"] = json!({"annotations": {"a": "b"}});
        fake.put("tasksets/default/x", set);
        fake.put("tasksetrevisions/default/x-a", revision("x-a", 1, "old"));
        fake.put("tasksetrevisions/default/x-b", revision("x-b", 2, "new"));
        fake
    }

    #[tokio::test]
    async fn undo_brings_the_template_before_back_whole() {
        let fake = fake();
        let done = fake.run(&["rollout", "undo", "ts/x"]).await;
        assert_eq!(done, (exit::OK, "taskset/x rolled back\n".to_owned()));
        let template =
            fake.object("tasksets/default/x").expect("there")["spec"]["template"].clone();
        assert_eq!(template["spec"]["run"]["process"]["command"], json!(["old"]));
        assert_eq!(template.get("metadata"), None, "what only the new one said is gone");
        let again = fake.run(&["rollout", "undo", "x", "--to-revision=1"]).await.1;
        assert_eq!(again, "taskset/x skipped rollback (revision 1 is what it has)\n");
        let none = fake.try_run(&["rollout", "undo", "x", "--to-revision=7"]).await;
        assert_eq!(none.expect_err("none").class().exit(), exit::FAILURE);
    }

    #[tokio::test]
    async fn pause_resume_and_restart() {
        let fake = fake();
        assert_eq!(fake.run(&["rollout", "pause", "ts/x"]).await.1, "taskset/x paused\n");
        for line in
            [["rollout", "pause", "ts/x"], ["rollout", "restart", "x"], ["rollout", "undo", "x"]]
        {
            let error = fake.try_run(&line).await.expect_err("paused");
            assert_eq!(error.class().exit(), exit::FAILURE);
        }
        assert_eq!(fake.run(&["rollout", "resume", "ts/x"]).await.1, "taskset/x resumed\n");
        let set = fake.object("tasksets/default/x").expect("there");
        assert_eq!(set["spec"]["rollout"].get("paused"), None);
        assert_eq!(fake.run(&["rollout", "restart", "x"]).await.1, "taskset/x restarted\n");
        let set = fake.object("tasksets/default/x").expect("there");
        let notes = &set["spec"]["template"]["metadata"]["annotations"];
        assert!(notes["muster.dev/restartedAt"].is_string() && notes["a"] == "b", "{notes}");
    }

    #[tokio::test]
    async fn history_says_what_was_and_what_became_of_it() {
        let fake = fake();
        assert_eq!(
            fake.run(&["rollout", "history", "ts/x"]).await.1,
            "taskset/x\n\
             REVISION   NAME   CHANGE-CAUSE   STATE\n\
             1          x-a    to old         last good\n\
             2          x-b    to new         template, given up\n"
        );
        let (_, text) = fake.run(&["rollout", "history", "ts/x", "--revision=1"]).await;
        assert!(
            text.starts_with("taskset/x with revision #1\n") && text.contains("- old"),
            "{text}"
        );
    }
}
