//! `muster wait`: until objects are as said.

use std::collections::BTreeMap;
use std::str::FromStr;

use muster_api::duration::Span;
use muster_api::kind::KindInfo;
use serde_json::Value;
use tokio::time::Instant;

use super::Outcome;
use super::gone::{Doomed, until_gone};
use crate::args::{Select, span};
use crate::client::Selection;
use crate::error::CliError;
use crate::exit;
use crate::output::objects::full_name;
use crate::session::Session;
use crate::successor;
use crate::target::{self, Named};
use crate::watch::{Change, Follow, merged};

/// `muster wait`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// KIND NAME…, KIND/NAME…, or KIND with -l or --all
    #[arg(value_name = "OBJECT", required = true)]
    objects: Vec<String>,
    /// phase=PHASE, condition=NAME[=STATUS], jsonpath={.PATH}[=VALUE], or delete; a task is Ready when it runs and its
    /// readiness probe, if it has one, succeeds
    #[arg(long, value_name = "WHAT")]
    r#for: Wanted,
    /// How long at most
    #[arg(long, value_name = "TIME", default_value = "30s", value_parser = span)]
    timeout: Span,
    #[command(flatten)]
    select: Select,
    /// Every object of the kind in the namespace
    #[arg(long)]
    all: bool,
}

/// What is waited for.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Wanted {
    Delete,
    Phase(String),
    Condition {
        r#type: String,
        status: String,
    },
    /// The value at the path as text; none: it is there.
    JsonPath {
        path: Vec<Step>,
        value: Option<String>,
        /// As it was written.
        text: String,
    },
}

/// A step of a JSON path.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Step {
    Key(String),
    Index(usize),
}

/// Phases of the kinds that have them: tasks, and namespaces.
const PHASES: [&str; 10] = [
    "Pending",
    "Bound",
    "Starting",
    "Running",
    "Stopping",
    "Succeeded",
    "Failed",
    "Unknown",
    "Active",
    "Terminating",
];

impl FromStr for Wanted {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (what, rest) = text.split_once('=').unwrap_or((text, ""));
        match what {
            "delete" if rest.is_empty() => Ok(Wanted::Delete),
            "phase" => {
                let known = PHASES.iter().find(|p| p.eq_ignore_ascii_case(rest));
                known
                    .map(|p| Wanted::Phase((*p).to_owned()))
                    .ok_or_else(|| format!("{rest:?} is not a phase; one of {}", PHASES.join(", ")))
            }
            "condition" if !rest.is_empty() => {
                let (r#type, status) = rest.split_once('=').unwrap_or((rest, "True"));
                Ok(Wanted::Condition { r#type: r#type.to_owned(), status: status.to_owned() })
            }
            "jsonpath" => {
                let (path, after) = rest
                    .split_once('}')
                    .ok_or("write jsonpath={.path} or jsonpath={.path}=value")?;
                let value = match after.strip_prefix('=') {
                    Some(value) => Some(value.to_owned()),
                    None if after.is_empty() => None,
                    None => return Err(format!("{after:?} after the path; write {{.path}}=value")),
                };
                let path = steps(path.strip_prefix('{').unwrap_or(path))?;
                Ok(Wanted::JsonPath { path, value, text: rest.to_owned() })
            }
            _ => Err(
                "write phase=Running, condition=Ready, jsonpath={.status.phase}=Running or delete"
                    .to_owned(),
            ),
        }
    }
}

/// Reads `.a.b[0]['c.d']`.
fn steps(path: &str) -> Result<Vec<Step>, String> {
    let bad =
        || format!("{path:?} is not a path; write .status.phase, .items[0] or .labels['a.b']");
    let mut steps = Vec::new();
    let mut rest = path;
    while !rest.is_empty() {
        if let Some(inner) = rest.strip_prefix('[') {
            let (inside, after) = inner.split_once(']').ok_or_else(bad)?;
            let quoted = inside.strip_prefix('\'').and_then(|i| i.strip_suffix('\''));
            steps.push(match quoted {
                Some(key) => Step::Key(key.to_owned()),
                None => Step::Index(inside.parse().map_err(|_| bad())?),
            });
            rest = after;
        } else {
            let after = rest.strip_prefix('.').ok_or_else(bad)?;
            let end = after.find(['.', '[']).unwrap_or(after.len());
            let (key, after) = after.split_at(end);
            if key.is_empty() {
                return Err(bad());
            }
            steps.push(Step::Key(key.to_owned()));
            rest = after;
        }
    }
    if steps.is_empty() { Err(bad()) } else { Ok(steps) }
}

impl Wanted {
    fn holds(&self, info: &KindInfo, object: &Value) -> bool {
        match self {
            Wanted::Delete => false,
            Wanted::Condition { r#type, status } if info.kind == "Task" => {
                // A task has no list of conditions; the one that it has is in its status.
                let is = if is_ready(object) { "True" } else { "False" };
                r#type.eq_ignore_ascii_case(READY) && status.eq_ignore_ascii_case(is)
            }
            Wanted::Phase(phase) => {
                object.pointer("/status/phase").is_some_and(|p| p == phase.as_str())
            }
            Wanted::Condition { r#type, status } => {
                let conditions = object.pointer("/status/conditions").and_then(Value::as_array);
                conditions.into_iter().flatten().any(|c| {
                    let is = |field: &str, text: &str| {
                        c[field].as_str().is_some_and(|t| t.eq_ignore_ascii_case(text))
                    };
                    is("type", r#type) && is("status", status)
                })
            }
            Wanted::JsonPath { path, value, .. } => {
                let found = path.iter().try_fold(object, |at, step| match step {
                    Step::Key(key) => at.get(key),
                    Step::Index(index) => at.get(index),
                });
                match (found, value) {
                    (None | Some(Value::Null), _) => false,
                    (Some(_), None) => true,
                    (Some(Value::String(text)), Some(value)) => text == value,
                    (Some(other), Some(value)) => {
                        *value == serde_json::to_string(other).unwrap_or_default()
                    }
                }
            }
        }
    }

    /// Whether it can never hold any more: a task that has ended gets no other phase.
    fn is_hopeless(&self, info: &KindInfo, object: &Value) -> bool {
        let ended =
            object.pointer("/status/phase").is_some_and(|p| p == "Succeeded" || p == "Failed");
        let needs_life = matches!(self, Wanted::Phase(_) | Wanted::Condition { .. });
        info.kind == "Task" && ended && needs_life && !self.holds(info, object)
    }

    fn text(&self) -> String {
        match self {
            Wanted::Delete => "deleted".to_owned(),
            Wanted::Phase(phase) => phase.clone(),
            Wanted::Condition { r#type, status } => format!("{type}={status}"),
            Wanted::JsonPath { text, .. } => format!("at {text}"),
        }
    }
}

/// The condition that every task has.
const READY: &str = "Ready";

/// Whether a task serves: it runs, and its probes, if it has some, say so.
fn is_ready(object: &Value) -> bool {
    let runs = object.pointer("/status/phase").is_some_and(|p| p == "Running");
    runs && object.pointer("/status/ready").is_none_or(|r| r != false)
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let objects = find(&args, session).await?;
    if objects.is_empty() {
        return match args.r#for {
            Wanted::Delete => Ok(exit::OK),
            _ => Err(CliError::usage("there are no objects to wait for")),
        };
    }
    if args.r#for == Wanted::Delete {
        let titles: Vec<String> = objects.iter().map(|d| full_name(d.info, &d.object)).collect();
        until_gone(objects, Some(args.timeout.as_duration()), session).await?;
        for title in titles {
            session.ui.line(&format!("{title} is gone"))?;
        }
        return Ok(exit::OK);
    }
    until_holds(&args, objects, session).await
}

/// The objects as they are now. Each named one must exist, unless its end is waited for.
async fn find(args: &Args, session: &mut Session) -> Result<Vec<Doomed>, CliError> {
    let selection = args.select.selection();
    let mut found = Vec::new();
    for Named { info, name } in target::parse(&args.objects)? {
        let namespace = Some(session.namespace.as_str());
        match name {
            Some(name) => match session.client.get(info, namespace, name).await {
                Ok(object) => found.push(Doomed::new(info, object)),
                Err(error) if error.is_not_found() && args.r#for == Wanted::Delete => {}
                Err(error) => return Err(error),
            },
            None if args.all || !selection.is_empty() => {
                let list = session.client.list(info, namespace, &selection).await?;
                found.extend(list.items.into_iter().map(|o| Doomed::new(info, o)));
            }
            None => {
                return Err(CliError::Usage {
                    message: format!("say which {} to wait for", info.plural),
                    hint: Some(
                        "name them, select them with -l, or mean all of them with --all".to_owned(),
                    ),
                });
            }
        }
    }
    Ok(found)
}

async fn until_holds(args: &Args, objects: Vec<Doomed>, session: &mut Session) -> Outcome {
    let wanted = &args.r#for;
    let mut left: BTreeMap<String, Doomed> =
        objects.into_iter().map(|d| (d.uid.clone(), d)).collect();
    let follow = |d: &Doomed| {
        let name = d.object.pointer("/metadata/name").and_then(Value::as_str).unwrap_or_default();
        Follow::new(&session.client, d.info, d.namespace.as_deref(), Selection::name(name))
    };
    let mut changes = merged(left.values().map(follow));
    let mut progress = session.ui.progress();
    let started = Instant::now();
    let deadline = started + args.timeout.as_duration();
    while !left.is_empty() {
        let Ok(change) = tokio::time::timeout_at(deadline, changes.recv()).await else {
            progress.end(false);
            return Err(timed_out(&left, wanted, started.elapsed()));
        };
        let (object, gone) = match change? {
            Change::Applied(object) => (object, false),
            Change::Deleted(object) => (object, true),
            Change::Synced => continue,
        };
        if successor::is_tried_again(&object) {
            // The next object of its name is waited for.
            continue;
        }
        let Some((uid, before)) = successor::claim(&mut left, &object) else { continue };
        before.iter().for_each(|before| progress.drop_row(before));
        let Some(awaited) = left.get_mut(&uid) else { continue };
        let title = full_name(awaited.info, &object);
        if gone || wanted.is_hopeless(awaited.info, &object) {
            progress.end(false);
            return Err(ended(&title, &object, gone, wanted));
        }
        if wanted.holds(awaited.info, &object) {
            progress.drop_row(&uid);
            left.remove(&uid);
            session.ui.line(&format!("{title} is {}", wanted.text()))?;
            continue;
        }
        let phase = object.pointer("/status/phase").and_then(Value::as_str);
        let now = phase.map(|p| format!(" (now {p})")).unwrap_or_default();
        progress.show(&uid, &format!("{title} is not yet {}{now}", wanted.text()));
        awaited.object = object;
    }
    progress.end(false);
    Ok(exit::OK)
}

fn ended(title: &str, object: &Value, gone: bool, wanted: &Wanted) -> CliError {
    let text = |p: &str| object.pointer(p).and_then(Value::as_str).unwrap_or_default();
    let what = match gone {
        true => format!("{title} was deleted before it was {}", wanted.text()),
        false => format!(
            "{title} ended as {} {}; it will not be {} any more",
            text("/status/phase"),
            text("/status/reason"),
            wanted.text()
        ),
    };
    let hint = (!gone).then(|| {
        format!("`muster why {title}` tells how it ended, `muster logs {title}` what it wrote")
    });
    CliError::Ended { what: what.replace(" ;", ";"), hint }
}

fn timed_out(
    left: &BTreeMap<String, Doomed>,
    wanted: &Wanted,
    after: std::time::Duration,
) -> CliError {
    let titles: Vec<String> = left.values().map(|d| full_name(d.info, &d.object)).collect();
    let task = left.values().find(|d| d.info.kind == "Task");
    CliError::Timeout {
        what: format!("{} to be {}", titles.join(", "), wanted.text()),
        after,
        hint: task.map(|d| {
            format!("`muster why {}` says what it waits for", full_name(d.info, &d.object))
        }),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::fake::{Fake, task};

    #[test]
    fn what_is_waited_for_is_read() {
        let key = |k: &str| Step::Key(k.to_owned());
        assert_eq!("delete".parse(), Ok(Wanted::Delete));
        assert_eq!("phase=running".parse(), Ok(Wanted::Phase("Running".to_owned())));
        assert_eq!(
            "condition=Ready".parse(),
            Ok(Wanted::Condition { r#type: "Ready".to_owned(), status: "True".to_owned() })
        );
        assert_eq!(
            "jsonpath={.status.a[0]['b.c']}=x=y".parse(),
            Ok(Wanted::JsonPath {
                path: vec![key("status"), key("a"), Step::Index(0), key("b.c")],
                value: Some("x=y".to_owned()),
                text: "{.status.a[0]['b.c']}=x=y".to_owned(),
            })
        );
        for bad in [
            "",
            "phase",
            "phase=Dancing",
            "condition",
            "jsonpath=x",
            "jsonpath={}",
            "jsonpath={.a}b",
            "deleted",
        ] {
            bad.parse::<Wanted>().expect_err(bad);
        }
    }

    #[test]
    fn paths_and_conditions_are_looked_up() {
        let object = json!({"status": {"phase": "Running", "free": {"cpu": 2},
            "conditions": [{"type": "Ready", "status": "False"}]}});
        let node = muster_api::kind::find_by_word("node").expect("served");
        let holds = |text: &str| text.parse::<Wanted>().expect(text).holds(node, &object);
        assert!(holds("jsonpath={.status.phase}=Running"));
        assert!(holds("jsonpath={.status.free.cpu}=2"));
        assert!(holds("jsonpath={.status.free}"));
        assert!(!holds("jsonpath={.status.none}"));
        assert!(!holds("condition=Ready"));
        assert!(holds("condition=ready=false"));
        assert!(holds("phase=Running"));
    }

    #[tokio::test]
    async fn until_a_phase_comes_or_can_no_longer_come() {
        let fake = Fake::new();
        fake.put("tasks/default/a", task("a", json!({"phase": "Pending"})));
        let (done, ()) =
            tokio::join!(fake.run(&["wait", "task/a", "--for=phase=Running"]), async {
                tokio::time::sleep(std::time::Duration::from_millis(30)).await;
                fake.edit("tasks/default/a", |o| o["status"]["phase"] = "Running".into());
            });
        assert_eq!(done, (exit::OK, "task/a is Running\n".to_owned()));
        let error = fake
            .try_run(&["wait", "task/a", "--for=phase=Succeeded", "--timeout", "50ms"])
            .await
            .expect_err("it goes on");
        assert_eq!(error.class().exit(), exit::TIMEOUT);
        fake.edit("tasks/default/a", |o| o["status"]["phase"] = "Failed".into());
        let error = fake
            .try_run(&["wait", "task/a", "--for=phase=Succeeded"])
            .await
            .expect_err("it failed");
        assert_eq!(error.class().exit(), exit::TASK_ENDED);
        assert!(error.to_string().contains("ended as Failed"), "{error}");
    }

    #[tokio::test]
    async fn a_task_that_is_tried_elsewhere_is_waited_for_under_its_next_uid() {
        let fake = Fake::new();
        let put = |uid: &str, status: Value| {
            let mut object = task("a", status);
            object["metadata"]["uid"] = uid.into();
            object["spec"]["reschedule"] = json!({"maxAttempts": 2});
            fake.put("tasks/default/a", object);
        };
        let failed = |used: u32, earlier: Value| json!({"phase": "Failed", "node": "n", "reason": "Error", "attemptsUsed": used, "earlier": earlier});
        let earlier = json!([{"uid": "one", "node": "n", "attempts": 1}]);
        for (end, code) in [("Succeeded", exit::OK), ("Failed", exit::TASK_ENDED)] {
            put("one", json!({"phase": "Running", "node": "n"}));
            let wait = fake.try_run(&["wait", "task/a", "--for=phase=Succeeded"]);
            let (done, ()) = tokio::join!(wait, async {
                tokio::time::sleep(std::time::Duration::from_millis(30)).await;
                put("one", failed(0, json!([])));
                fake.remove("tasks/default/a");
                put("two", json!({"phase": "Pending", "attemptsUsed": 1, "earlier": earlier}));
                let mut status = failed(1, earlier.clone());
                status["phase"] = end.into();
                put("two", status);
            });
            let came = done.map_or_else(|error| error.class().exit(), |(code, _)| code);
            assert_eq!(came, code, "{end}");
            fake.remove("tasks/default/a");
        }
    }

    #[test]
    fn a_task_is_ready_when_it_runs_and_its_probes_say_so() {
        let task = muster_api::kind::find_by_word("task").expect("served");
        let holds = |text: &str, status: &Value| {
            text.parse::<Wanted>().expect(text).holds(task, &json!({"status": status}))
        };
        for (status, ready) in [
            (json!({"phase": "Running"}), true),
            (json!({"phase": "Running", "ready": true}), true),
            (json!({"phase": "Running", "ready": false}), false),
            (json!({"phase": "Starting", "ready": false}), false),
            (json!({"phase": "Bound"}), false),
        ] {
            assert_eq!(holds("condition=Ready", &status), ready, "{status}");
            assert_eq!(holds("condition=ready=false", &status), !ready, "{status}");
            assert!(!holds("condition=Available", &status), "a task has none of that name");
        }
        let ended = json!({"status": {"phase": "Failed"}});
        assert!("condition=Ready".parse::<Wanted>().expect("good").is_hopeless(task, &ended));
    }

    #[tokio::test]
    async fn until_it_is_gone() {
        let fake = Fake::new();
        assert_eq!(fake.run(&["wait", "task/a", "--for=delete"]).await.0, exit::OK);
        fake.put("tasks/default/a", task("a", json!({})));
        let (done, ()) = tokio::join!(fake.run(&["wait", "task/a", "--for=delete"]), async {
            while !fake.requests().iter().any(|request| request.contains("watch=true")) {
                tokio::time::sleep(std::time::Duration::from_millis(1)).await;
            }
            fake.remove("tasks/default/a");
        });
        assert_eq!(done, (exit::OK, "task/a is gone\n".to_owned()));
    }
}
