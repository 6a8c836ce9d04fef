//! `muster delete`: by name, by selector, by manifest.

use std::path::PathBuf;

use clap::ArgAction;
use muster_api::duration::Span;
use muster_api::kind::KindInfo;
use muster_api::kind::framework::FRAMEWORK_LABEL;
use serde_json::Value;

use super::gone::{Doomed, until_gone};
use super::{FirstError, Outcome};
use crate::args::{Select, span};
use crate::client::Deletion;
use crate::error::CliError;
use crate::manifests;
use crate::output::human;
use crate::output::objects::full_name;
use crate::session::Session;
use crate::target::{self, Named};

/// `muster delete`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// KIND NAME…, KIND/NAME…, or KIND with -l or --all; with a framework go its session and its tasks
    #[arg(value_name = "OBJECT", required_unless_present = "filename")]
    objects: Vec<String>,
    /// What manifests name: a file, a directory, or - for standard input
    #[arg(short, long, value_name = "FILE|DIR|-", conflicts_with_all = ["objects", "selector", "all"])]
    filename: Vec<PathBuf>,
    #[command(flatten)]
    select: Select,
    /// Every object of the kind in the namespace
    #[arg(long, conflicts_with_all = ["selector", "field_selector"])]
    all: bool,
    /// Seconds between asking a task to end and killing it, instead of its own
    #[arg(long, value_name = "SECONDS", conflicts_with = "now")]
    grace_period: Option<u32>,
    /// Without grace
    #[arg(long)]
    now: bool,
    /// Wait until they are gone
    #[arg(long, value_name = "BOOL", default_value_t = true, action = ArgAction::Set, num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    wait: bool,
    /// Wait this long at most [default: for ever]
    #[arg(long, value_name = "TIME", value_parser = span)]
    timeout: Option<Span>,
    /// What becomes of what the objects own, the tasks of a set for example
    #[arg(long, value_enum, default_value_t, value_name = "HOW")]
    cascade: Cascade,
    /// That an object does not exist is no error
    #[arg(long)]
    ignore_not_found: bool,
}

/// `--cascade`, in kubectl's words.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
enum Cascade {
    /// It goes as well, in its own time
    #[default]
    Background,
    /// It goes first
    Foreground,
    /// It stays
    Orphan,
}

impl Cascade {
    fn policy(self) -> Option<&'static str> {
        match self {
            // What happens when nothing is said.
            Cascade::Background => None,
            Cascade::Foreground => Some("Foreground"),
            Cascade::Orphan => Some("Orphan"),
        }
    }
}

/// One object to delete.
struct Victim {
    info: &'static KindInfo,
    namespace: Option<String>,
    name: String,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let victims = victims(&args, session).await?;
    if victims.is_empty() {
        session.ui.note("there is nothing to delete");
        return Ok(crate::exit::OK);
    }
    let grace = if args.now { Some(0) } else { args.grace_period };
    let mut errors = FirstError::default();
    let mut doomed = Vec::new();
    for victim in &victims {
        match end(victim, grace, args.cascade, session).await {
            Ok(one) => {
                session.ui.line(&sentence(victim, &one))?;
                doomed.push(one);
            }
            Err(error) if error.is_not_found() && args.ignore_not_found => {}
            Err(error) if victims.len() == 1 => return Err(error),
            Err(error) => errors.note(error, &session.ui)?,
        }
    }
    if args.wait {
        until_gone(doomed, args.timeout.map(|t| t.as_duration()), session).await?;
    }
    Ok(errors.exit())
}

async fn victims(args: &Args, session: &mut Session) -> Result<Vec<Victim>, CliError> {
    if !args.filename.is_empty() {
        let all = manifests::load(&args.filename, &session.namespace, session.namespace_given)?;
        // What was made last is ended first: objects before the namespaces they are in.
        let victim =
            |m: manifests::Manifest| Victim { info: m.info, namespace: m.namespace, name: m.name };
        return Ok(all.into_iter().rev().map(victim).collect());
    }
    let namespace = session.namespace.clone();
    let selection = args.select.selection();
    let mut victims = Vec::new();
    for Named { info, name } in target::parse(&args.objects)? {
        let namespace = info.namespaced.then(|| namespace.clone());
        match name {
            Some(_) if args.all || !selection.is_empty() => {
                return Err(CliError::usage("a name goes with neither a selector nor --all"));
            }
            Some(name) => victims.push(Victim { info, namespace, name: name.to_owned() }),
            None if !args.all && selection.is_empty() => {
                return Err(CliError::Usage {
                    message: format!("say which {} to delete", info.plural),
                    hint: Some(
                        "name them, select them with -l, or mean all of them with --all".to_owned(),
                    ),
                });
            }
            None => {
                let list = session.client.list(info, namespace.as_deref(), &selection).await?;
                let name = |o: &Value| {
                    o.pointer("/metadata/name").and_then(Value::as_str).map(str::to_owned)
                };
                victims.extend(list.items.iter().filter_map(name).map(|name| Victim {
                    info,
                    namespace: namespace.clone(),
                    name,
                }));
            }
        }
    }
    Ok(victims)
}

fn sentence(victim: &Victim, doomed: &Doomed) -> String {
    let name = full_name(victim.info, &doomed.object);
    let tasks = doomed.object.pointer("/status/tasks").and_then(Value::as_u64).unwrap_or(0);
    match (victim.info.kind, usize::try_from(tasks)) {
        ("Framework", Ok(tasks @ 1..)) => {
            let tasks = human::count(tasks, "task");
            format!("{name} deleted; with it {tasks} (-l {FRAMEWORK_LABEL}={})", victim.name)
        }
        _ => format!("{name} deleted"),
    }
}

async fn end(
    victim: &Victim,
    grace: Option<u32>,
    cascade: Cascade,
    session: &Session,
) -> Result<Doomed, CliError> {
    let Victim { info, namespace, name } = victim;
    let namespace = namespace.as_deref();
    let object = session.client.get(info, namespace, name).await?;
    let doomed = Doomed::new(info, object);
    let how = Deletion { grace, uid: Some(&doomed.uid), propagation: cascade.policy() };
    session.client.delete(info, namespace, name, how).await?;
    Ok(doomed)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::{Fake, framework, task};

    #[tokio::test]
    async fn by_name_selector_and_all() {
        let fake = Fake::new();
        for name in ["a", "b", "c", "d"] {
            fake.put(&format!("tasks/default/{name}"), task(name, json!({})));
        }
        assert_eq!(
            fake.run(&["delete", "task/a", "task/b"]).await,
            (exit::OK, "task/a deleted\ntask/b deleted\n".to_owned())
        );
        assert_eq!(
            fake.try_run(&["delete", "task/a"]).await.expect_err("gone").class().exit(),
            exit::NOT_FOUND
        );
        assert_eq!(fake.run(&["delete", "task/a", "--ignore-not-found"]).await.0, exit::OK);
        assert_eq!(
            fake.try_run(&["delete", "tasks"]).await.expect_err("which?").class().exit(),
            exit::USAGE
        );
        assert_eq!(
            fake.run(&["delete", "tasks", "--all"]).await.1,
            "task/c deleted\ntask/d deleted\n"
        );
    }

    #[tokio::test]
    async fn a_framework_goes_with_its_tasks() {
        let fake = Fake::new();
        let there = json!({"connected": true, "tasks": 2});
        fake.put("frameworks/default/deliver", framework("deliver", there));
        fake.put("frameworks/default/idle", framework("idle", json!({})));
        assert_eq!(
            fake.run(&["delete", "framework", "deliver", "idle"]).await,
            (
                exit::OK,
                "framework/deliver deleted; with it 2 tasks (-l muster.dev/framework=deliver)\n\
                 framework/idle deleted\n"
                    .to_owned()
            )
        );
        assert_eq!(fake.object("frameworks/default/deliver"), None);
    }

    #[tokio::test]
    async fn it_waits_until_they_are_gone_or_the_time_is_up() {
        let fake = Fake::new();
        fake.put(
            "tasks/default/a",
            task(
                "a",
                json!({"phase": "Running", "node": "r1", "lease": {"name": "r1.body", "epoch": 3}}),
            ),
        );
        fake.hold("tasks/default/a");
        let error =
            fake.try_run(&["delete", "task/a", "--timeout", "200ms"]).await.expect_err("held");
        assert_eq!(error.class().exit(), exit::TIMEOUT);
        assert!(
            error.to_string().contains("task/a is ending: Running on r1, holds r1.body (epoch 3)"),
            "{error}"
        );
        assert_eq!(fake.run(&["delete", "task/a", "--wait=false"]).await.0, exit::OK);
        let asked = fake.requests().len();
        let (done, ()) = tokio::join!(fake.run(&["delete", "task/a"]), async {
            while !fake.requests()[asked..].iter().any(|request| request.starts_with("DELETE")) {
                tokio::time::sleep(std::time::Duration::from_millis(1)).await;
            }
            fake.remove("tasks/default/a");
        });
        assert_eq!(done.0, exit::OK);
    }
}
