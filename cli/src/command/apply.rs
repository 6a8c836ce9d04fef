//! `muster apply`: objects become what manifests say. Four steps, so that bad input is refused whole:
//!
//! 1. read and check every document ([`crate::manifests`]): nothing is sent when one is wrong;
//! 2. look at what is stored and work out the change of each;
//! 3. let the controller check every change without storing it (only it knows what may not change);
//! 4. store them: namespaces, nodes, then the rest, more important tasks first; with `--check-index` all in one commit
//!    ([`super::transaction`]).

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::path::PathBuf;

use futures::{StreamExt as _, TryStreamExt as _};
use kube::core::Status;
use muster_api::duration::Span;
use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::{FirstError, Outcome, plan, settle, transaction};
use crate::args::span;
use crate::client::{Client, Mode, group_path};
use crate::error::CliError;
use crate::manifests::{self, Manifest};
use crate::merge::{FieldChange, LAST_APPLIED, field_changes, project, three_way};
use crate::output::objects::{Format, Group, serialize};
use crate::output::ui::Ui;
use crate::session::Session;

/// Looks and rehearsals in flight at once: none of them depends on another.
const AT_ONCE: usize = 16;

/// `muster apply`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A manifest, a directory of them, or - for standard input; may be given several times
    #[arg(short, long = "filename", value_name = "FILE|DIR|-", required = true)]
    filename: Vec<PathBuf>,
    /// Let the controller check everything, and store nothing
    #[arg(long)]
    dry_run: bool,
    /// Store everything in one commit, and only while it is still what `muster plan` said under this index
    #[arg(long, value_name = "INDEX")]
    check_index: Option<String>,
    /// Wait until every task runs, has ended, or says why it waits
    #[arg(long, conflicts_with = "dry_run")]
    wait: bool,
    /// With --wait: how long at most
    #[arg(long, value_name = "TIME", default_value = "5m", value_parser = span, requires = "wait")]
    timeout: Span,
    /// Print the objects instead of what was done
    #[arg(short, long, value_enum, value_name = "FORMAT")]
    output: Option<Format>,
}

/// What one manifest means for what is stored.
#[derive(Debug, Clone)]
pub(super) enum Action {
    Create(Value),
    /// No fields: only the recorded manifest differs, which says the same in other words.
    Patch {
        patch: Value,
        fields: Vec<FieldChange>,
        /// Of the object that was looked at.
        revision: String,
    },
    /// It says this already.
    Nothing(Value),
}

/// A manifest and its change.
pub(super) struct Step {
    pub(super) manifest: Manifest,
    pub(super) action: Action,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let manifests = manifests::load(&args.filename, &session.namespace, session.namespace_given)?;
    let client = &session.client;
    let mut steps = look_at_all(client, manifests).await?;
    // One object is checked and stored by one request anyway.
    if args.dry_run || steps.len() > 1 || args.check_index.is_some() {
        rehearse(client, &steps).await?;
    }
    let mode = if args.dry_run { Mode::DryRun } else { Mode::Store };
    steps.sort_by_key(rank);
    let (applied, failed) = match &args.check_index {
        Some(index) if mode == Mode::Store => {
            let done = transaction::apply(session, steps, index).await?;
            (tell(session, done, args.output)?, crate::exit::OK)
        }
        Some(index) => {
            plan::check(session, &steps, index).await?;
            store(session, steps, mode, args.output).await?
        }
        None => store(session, steps, mode, args.output).await?,
    };
    if failed != crate::exit::OK || !args.wait {
        return Ok(failed);
    }
    let tasks = applied.iter().filter(|(m, _)| m.info.kind == "Task").map(|(_, object)| object);
    settle::until_settled(tasks, args.timeout.as_duration(), session).await
}

/// Step 2.
pub(super) async fn look_at_all(
    client: &Client,
    manifests: Vec<Manifest>,
) -> Result<Vec<Step>, CliError> {
    futures::stream::iter(manifests)
        .map(|manifest| look(client, manifest))
        .buffered(AT_ONCE)
        .try_collect()
        .await
}

async fn look(client: &Client, manifest: Manifest) -> Result<Step, CliError> {
    let namespace = manifest.namespace.as_deref();
    let current = client.find(manifest.info, namespace, &manifest.name).await?;
    let action = decide(&manifest, current);
    Ok(Step { manifest, action })
}

fn decide(manifest: &Manifest, current: Option<Value>) -> Action {
    let mut last = manifest.written.clone();
    if let Some(metadata) = last["metadata"].as_object_mut() {
        metadata.remove("resourceVersion");
        if let Some(annotations) = metadata.get_mut("annotations").and_then(Value::as_object_mut) {
            annotations.remove(LAST_APPLIED);
        }
        if metadata.get("annotations").is_some_and(|a| a.as_object().is_some_and(Map::is_empty)) {
            metadata.remove("annotations");
        }
    }
    let secret = manifest.info.kind == "Secret";
    if secret {
        // Which keys it had is all that the next apply needs to know.
        hide_values(&mut last["data"]);
    }
    let annotation = Value::from(last.to_string());
    let Some(current) = current else {
        let mut object = manifest.written.clone();
        if let Some(metadata) = object["metadata"].as_object_mut() {
            metadata.remove("resourceVersion");
        }
        annotate(&mut object, annotation);
        return Action::Create(object);
    };
    let before = current
        .pointer("/metadata/annotations")
        .and_then(|all| all.get(LAST_APPLIED))
        .and_then(Value::as_str)
        .and_then(|text| serde_json::from_str::<Value>(text).ok());
    let mut wanted = project(&manifest.written, &manifest.admitted);
    annotate(&mut wanted, annotation);
    let patch = three_way(before.as_ref(), &wanted, &current);
    match patch.as_object().is_none_or(Map::is_empty) {
        true => Action::Nothing(current),
        false => {
            let mut fields = field_changes(&patch, &current);
            if secret {
                fields.iter_mut().filter(|f| f.path.starts_with("data")).for_each(hide_change);
            }
            let revision = current.pointer("/metadata/resourceVersion").and_then(Value::as_str);
            Action::Patch { fields, patch, revision: revision.unwrap_or_default().to_owned() }
        }
    }
}

fn hide_values(data: &mut Value) {
    if let Some(values) = data.as_object_mut() {
        values.values_mut().for_each(|value| *value = Value::from(""));
    }
}

/// That something of a Secret changed is shown, and not to what.
fn hide_change(change: &mut FieldChange) {
    for side in [&mut change.from, &mut change.to] {
        *side = side.take().map(|_| Value::from("(hidden)"));
    }
}

fn annotate(object: &mut Value, annotation: Value) {
    let annotations = &mut object["metadata"]["annotations"];
    if !annotations.is_object() {
        *annotations = json!({});
    }
    annotations[LAST_APPLIED] = annotation;
}

pub(super) async fn perform(client: &Client, step: &Step, mode: Mode) -> Result<Value, CliError> {
    let Manifest { info, namespace, name, .. } = &step.manifest;
    let namespace = namespace.as_deref();
    let done = match &step.action {
        Action::Create(object) => client.create(info, namespace, object, mode).await,
        Action::Patch { patch, .. } => client.patch(info, namespace, name, patch, mode).await,
        Action::Nothing(current) => Ok(current.clone()),
    };
    done.map_err(|error| not_by_manifest(error, &step.manifest))
}

/// Some kinds are made by what they stand for; the controller only says that it does not serve the verb.
fn not_by_manifest(error: CliError, manifest: &Manifest) -> CliError {
    let made = match manifest.info.kind {
        "Framework" => {
            "a Framework is made by the framework when it subscribes, and says there what it wants"
        }
        "Lease" => "a Lease is made by the controller when a robot with actuators joins",
        _ => return error,
    };
    match error {
        CliError::Refused(mut refusal) if refusal.reason == "MethodNotAllowed" => {
            refusal.message =
                format!("{} cannot be applied: {}", manifest.title(), refusal.message);
            refusal.hint = Some(made.to_owned());
            CliError::Refused(refusal)
        }
        other => other,
    }
}

/// Step 3. What the controller finds wrong is put at its place in the files.
pub(super) async fn rehearse(client: &Client, steps: &[Step]) -> Result<(), CliError> {
    // The controller cannot check an object in a namespace that this run is going to create.
    let made_here: BTreeSet<&str> = steps
        .iter()
        .filter(|s| s.manifest.info.kind == "Namespace" && matches!(s.action, Action::Create(_)))
        .map(|s| s.manifest.name.as_str())
        .collect();
    let checkable: Vec<&Step> = steps
        .iter()
        .filter(|s| s.manifest.namespace.as_deref().is_none_or(|ns| !made_here.contains(ns)))
        .collect();
    let results: Vec<Result<Value, CliError>> = futures::stream::iter(&checkable)
        .map(|step| perform(client, step, Mode::DryRun))
        .buffered(AT_ONCE)
        .collect()
        .await;
    let mut diagnostics = Vec::new();
    let mut other = None;
    for (step, result) in checkable.iter().zip(results) {
        for blamed in result.err().into_iter().flat_map(|e| step.manifest.blame(e)) {
            match blamed {
                Ok(diagnostic) => diagnostics.push(diagnostic),
                Err(error) => other = other.or(Some(error)),
            }
        }
    }
    match (diagnostics.is_empty(), other) {
        (false, _) => Err(CliError::Manifests(diagnostics)),
        (true, Some(error)) => Err(error),
        (true, None) => together(client, steps).await,
    }
}

/// What `POST …/check` answers.
#[derive(Debug, Deserialize)]
struct Together {
    refusals: Vec<TogetherRefusal>,
}

/// An object that would be refused after those before it.
#[derive(Debug, Deserialize)]
struct TogetherRefusal {
    index: usize,
    status: Status,
}

/// The rest of step 3: what passes alone may not pass after the others, in the order in which they are stored.
async fn together(client: &Client, steps: &[Step]) -> Result<(), CliError> {
    let new_task =
        |s: &&Step| s.manifest.info.kind == "Task" && matches!(s.action, Action::Create(_));
    if steps.iter().filter(new_task).count() < 2 {
        return Ok(());
    }
    let mut ordered: Vec<&Step> = steps.iter().collect();
    ordered.sort_by_key(|step| rank(step));
    let objects: Vec<&Value> = ordered.iter().map(|s| &s.manifest.admitted).collect();
    let answer = client.post_json(&group_path("check"), &json!({ "objects": objects })).await;
    let Together { refusals } = match answer {
        Ok(answer) => answer,
        // An older controller says it when they are stored.
        Err(error) if error.is_not_found() => return Ok(()),
        Err(error) => return Err(error),
    };
    let mut diagnostics = Vec::new();
    for TogetherRefusal { index, status } in refusals {
        let Some(step) = ordered.get(index) else { continue };
        for blamed in step.manifest.blame(client.refused(status)) {
            diagnostics.push(blamed?);
        }
    }
    if diagnostics.is_empty() { Ok(()) } else { Err(CliError::Manifests(diagnostics)) }
}

/// The order of storing: first what others refer to, then tasks as the scheduler would take them if
/// all came at once, so that what `plan` promised is what happens.
fn rank(step: &Step) -> (u8, Reverse<i64>) {
    let first = match step.manifest.info.kind {
        "Namespace" => 0,
        "Node" | "ConfigMap" | "Secret" | "Quota" | "Site" => 1,
        _ => 2,
    };
    let priority = step.manifest.admitted.pointer("/spec/priority").and_then(Value::as_i64);
    (first, Reverse(priority.unwrap_or(0)))
}

/// Step 4, one after the other: tasks that want the same robot get it in this order. An error leaves
/// the rest to be tried: the controller has checked all of it before, so what fails now fails for a
/// reason of its own.
async fn store(
    session: &mut Session,
    steps: Vec<Step>,
    mode: Mode,
    output: Option<Format>,
) -> Result<(Vec<(Manifest, Value)>, u8), CliError> {
    let single = steps.len() == 1;
    let mut errors = FirstError::default();
    let (mut applied, mut left) = (Vec::new(), Vec::new());
    for step in steps {
        match perform(&session.client, &step, mode).await {
            Ok(object) => {
                if output.is_none() {
                    session.ui.line(&sentence(&step, &object, mode))?;
                }
                applied.push((step.manifest, object));
            }
            Err(error) => {
                left.push(step.manifest.title());
                refuse(&step, error, single, &mut errors, &session.ui)?;
            }
        }
    }
    if !left.is_empty() && !applied.is_empty() && mode == Mode::Store {
        let stored: Vec<String> = applied.iter().map(|(m, _)| m.title()).collect();
        session.ui.note(&half_way(&stored, &left));
    }
    if let Some(format) = output {
        print(&mut session.ui, &applied, single, format)?;
    }
    Ok((applied, errors.exit()))
}

/// Says of objects that were stored together what was done.
fn tell(
    session: &mut Session,
    done: Vec<(Step, Value)>,
    output: Option<Format>,
) -> Result<Vec<(Manifest, Value)>, CliError> {
    let single = done.len() == 1;
    let mut applied = Vec::new();
    for (step, object) in done {
        if output.is_none() {
            session.ui.line(&sentence(&step, &object, Mode::Store))?;
        }
        applied.push((step.manifest, object));
    }
    if let Some(format) = output {
        print(&mut session.ui, &applied, single, format)?;
    }
    Ok(applied)
}

/// What there is now of objects that were checked together, when somebody else came in between.
fn half_way(stored: &[String], left: &[String]) -> String {
    format!("stored: {}; not stored: {}", stored.join(", "), left.join(", "))
}

fn refuse(
    step: &Step,
    error: CliError,
    single: bool,
    errors: &mut FirstError,
    ui: &Ui,
) -> Result<(), CliError> {
    let mut diagnostics = Vec::new();
    for blamed in step.manifest.blame(error) {
        match blamed {
            Ok(diagnostic) => diagnostics.push(diagnostic),
            Err(error) if single => return Err(error),
            Err(error) => {
                ui.note(&format!("{} was not applied", step.manifest.title()));
                errors.note(error, ui)?;
            }
        }
    }
    match diagnostics.is_empty() {
        true => Ok(()),
        false => errors.note(CliError::Manifests(diagnostics), ui),
    }
}

fn sentence(step: &Step, after: &Value, mode: Mode) -> String {
    let done = match &step.action {
        Action::Create(_) => "created",
        Action::Patch { fields, .. } if !fields.is_empty() => "configured",
        Action::Patch { .. } | Action::Nothing(_) => "unchanged",
    };
    let name =
        after.pointer("/metadata/name").and_then(Value::as_str).unwrap_or(&step.manifest.name);
    let suffix = if mode == Mode::DryRun { " (dry run)" } else { "" };
    format!("{}/{name} {done}{suffix}", step.manifest.info.singular)
}

fn print(
    ui: &mut Ui,
    applied: &[(Manifest, Value)],
    single: bool,
    format: Format,
) -> Result<(), CliError> {
    let group =
        |(m, object): &(Manifest, Value)| Group { info: m.info, objects: vec![object.clone()] };
    let groups: Vec<Group> = applied.iter().map(group).collect();
    match format {
        Format::Table | Format::Wide => {
            for group in groups {
                let table =
                    crate::output::objects::table(&group, format == Format::Wide, true, true);
                let text = table.text(&ui.styles);
                ui.print(&text)?;
            }
            Ok(())
        }
        Format::Yaml | Format::Json | Format::Name => ui.print(&serialize(groups, single, format)?),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::Fake;

    const TASK: &str = "apiVersion: muster.dev/v1alpha1
kind: Task
metadata:
  name: NAME
  labels: {a: b}
spec:
  priority: 3
  resources: {cpu: 0.5}
  run: {process: {command: [x]}}
";

    fn file(dir: &tempfile::TempDir, text: &str) -> String {
        let path = dir.path().join("m.yaml");
        std::fs::write(&path, text).expect("written");
        path.display().to_string()
    }

    #[tokio::test]
    async fn a_secret_is_compared_as_it_is_stored_and_its_manifest_kept_without_values() {
        let dir = tempfile::tempdir().expect("a directory");
        let fake = Fake::new();
        let apply = |data: &str| {
            let text = format!("{{apiVersion: v1, kind: Secret, metadata: {{name: s}}, {data}}}");
            let path = file(&dir, &text);
            let fake = fake.clone();
            async move { fake.run(&["apply", "-f", &path]).await.1 }
        };
        let both = "type: Opaque, stringData: {a: hunter2, b: x}";
        assert_eq!(apply(both).await, "secret/s created\n");
        let body = fake.last_body();
        assert_eq!(body["data"], json!({"a": "aHVudGVyMg==", "b": "eA=="}));
        let noted = body["metadata"]["annotations"].to_string();
        assert!(!noted.contains("hunter2") && !noted.contains("aHVudGVyMg"), "{noted}");
        assert_eq!(apply(both).await, "secret/s unchanged\n");
        // A key that is taken out of the manifest goes, and one that somebody else made stays.
        fake.edit("secrets/default/s", |o| o["data"]["c"] = json!("eQ=="));
        assert_eq!(apply("type: Opaque, data: {a: bmV3}").await, "secret/s configured\n");
        assert_eq!(fake.last_body()["data"], json!({"a": "bmV3", "b": null}));
    }

    #[tokio::test]
    async fn created_then_unchanged_then_configured() {
        let dir = tempfile::tempdir().expect("a directory");
        let fake = Fake::new();
        let apply = |text: String| {
            let path = file(&dir, &text);
            let fake = fake.clone();
            async move { fake.run(&["apply", "-f", &path]).await }
        };
        let text = TASK.replace("NAME", "one");
        assert_eq!(apply(text.clone()).await, (exit::OK, "task/one created\n".to_owned()));
        assert_eq!(apply(text.clone()).await, (exit::OK, "task/one unchanged\n".to_owned()));
        // Somebody else sets another field; it is none of the manifest's business.
        fake.edit("tasks/default/one", |o| o["spec"]["gracePeriodSeconds"] = json!(33));
        assert_eq!(apply(text.clone()).await.1, "task/one unchanged\n");
        let changed = text
            .replace("priority: 3\n", "")
            .replace("{a: b}", "{a: c}")
            .replace("  priority", " priority");
        let changed = changed.replace("spec:\n    resources", "spec:\n  resources");
        assert_eq!(apply(changed).await, (exit::OK, "task/one configured\n".to_owned()));
        let object = fake.object("tasks/default/one").expect("stored");
        assert_eq!(object["metadata"]["labels"], json!({"a": "c"}));
        assert_eq!(object["spec"].get("priority"), None, "said before, not said now");
        assert_eq!(object["spec"]["gracePeriodSeconds"], 33);
    }

    #[tokio::test]
    async fn nothing_is_stored_when_anything_is_wrong() {
        let dir = tempfile::tempdir().expect("a directory");
        let fake = Fake::new();
        let good = TASK.replace("NAME", "one");
        let path = file(
            &dir,
            &format!("{good}---\n{}", TASK.replace("NAME", "two").replace("0.5", "2core")),
        );
        let error = fake.try_run(&["apply", "-f", &path]).await.expect_err("refused");
        assert_eq!(error.class().exit(), exit::INVALID);
        let text = error.render(&crate::output::style::Styles::default());
        assert!(
            text.contains(&format!(
                "{path}:18:15: spec.resources.cpu: \"2core\" is not a quantity of cpu"
            )),
            "{text}"
        );
        assert_eq!(fake.requests(), Vec::<String>::new(), "nothing was even asked");
    }

    #[tokio::test]
    async fn what_only_the_controller_can_refuse_is_found_before_anything_is_stored() {
        let dir = tempfile::tempdir().expect("a directory");
        let fake = Fake::new();
        fake.refuse("two", "spec.run.process.command", "cannot change while the task exists");
        let path = file(
            &dir,
            &format!("{}---\n{}", TASK.replace("NAME", "one"), TASK.replace("NAME", "two")),
        );
        let error = fake.try_run(&["apply", "-f", &path]).await.expect_err("refused");
        let text = error.render(&crate::output::style::Styles::default());
        assert!(
            text.starts_with(&format!(
                "{path}:19:19: spec.run.process.command: cannot change while the task exists\n"
            )),
            "{text}"
        );
        assert_eq!(fake.object("tasks/default/one"), None);
    }

    #[tokio::test]
    async fn what_does_not_pass_together_is_said_at_its_place_and_nothing_is_stored() {
        let dir = tempfile::tempdir().expect("a directory");
        let fake = Fake::new();
        let two = TASK.replace("NAME", "two").replace("priority: 3", "priority: 9");
        let path = file(&dir, &format!("{}---\n{two}", TASK.replace("NAME", "one")));
        let cause = json!({"field": "spec.resources.cpu", "message": "asks for too much", "reason": "FieldValueForbidden"});
        let status = json!({"kind": "Status", "status": "Failure", "reason": "Invalid", "code": 422,
                            "message": "m", "details": {"causes": [cause]}});
        // More important tasks are stored first, so the second of them is the first of the file.
        let refusals = json!({"refusals": [{"index": 1, "status": status}]});
        let check = "POST /apis/muster.dev/v1alpha1/check";
        fake.answer(check, refusals);
        for verb in ["apply", "plan"] {
            let error = fake.try_run(&[verb, "-f", &path]).await.expect_err("refused");
            let text = error.render(&crate::output::style::Styles::default());
            let wanted = format!("{path}:8:15: spec.resources.cpu: asks for too much\n");
            assert!(text.starts_with(&wanted), "{text}");
            assert_eq!(fake.object("tasks/default/one"), None);
        }
        fake.answer(check, json!({"refusals": []}));
        let stored = "task/two created\ntask/one created\n";
        assert_eq!(fake.run(&["apply", "-f", &path]).await, (exit::OK, stored.to_owned()));
    }

    #[tokio::test]
    async fn who_is_refused_in_the_middle_hears_what_was_stored() {
        let dir = tempfile::tempdir().expect("a directory");
        let fake = Fake::new();
        fake.refuse_late("two", "spec.resources.cpu", "asks for more than is left");
        let path = file(
            &dir,
            &format!("{}---\n{}", TASK.replace("NAME", "one"), TASK.replace("NAME", "two")),
        );
        let (code, out) = fake.run(&["apply", "-f", &path]).await;
        assert_eq!((code, out.as_str()), (exit::INVALID, "task/one created\n"));
        assert!(fake.object("tasks/default/one").is_some());
        let titles = |names: &[&str]| names.iter().map(|n| format!("task/{n}")).collect::<Vec<_>>();
        assert_eq!(
            super::half_way(&titles(&["one"]), &titles(&["two", "three"])),
            "stored: task/one; not stored: task/two, task/three"
        );
    }

    #[tokio::test]
    async fn a_dry_run_stores_nothing() {
        let dir = tempfile::tempdir().expect("a directory");
        let fake = Fake::new();
        let path = file(&dir, &TASK.replace("NAME", "one"));
        let printed = fake.run(&["apply", "-f", &path, "--dry-run"]).await;
        assert_eq!(printed, (exit::OK, "task/one created (dry run)\n".to_owned()));
        assert_eq!(fake.object("tasks/default/one"), None);
    }

    #[tokio::test]
    async fn a_framework_is_not_made_by_a_manifest() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = file(
            &dir,
            "apiVersion: muster.dev/v1alpha1\nkind: Framework\nmetadata: {name: deliver}\nspec: {}\n",
        );
        let error = Fake::new().try_run(&["apply", "-f", &path]).await.expect_err("refused");
        assert_eq!(
            error.render(&crate::output::style::Styles::default()),
            "error: framework/deliver cannot be applied: create is not supported on frameworks.muster.dev\n\
             hint: a Framework is made by the framework when it subscribes, and says there what it wants\n"
        );
    }

    #[tokio::test]
    async fn namespaces_come_before_what_is_in_them() {
        let dir = tempfile::tempdir().expect("a directory");
        let fake = Fake::new();
        let text = format!(
            "{}---\napiVersion: v1\nkind: Namespace\nmetadata: {{name: lab}}\n",
            TASK.replace("NAME", "one").replace("  labels", "  namespace: lab\n  labels")
        );
        let path = file(&dir, &text);
        let printed = fake.run(&["apply", "-f", &path]).await;
        assert_eq!(printed, (exit::OK, "namespace/lab created\ntask/one created\n".to_owned()));
    }

    #[tokio::test]
    async fn waiting_says_whether_every_task_is_placed() {
        let dir = tempfile::tempdir().expect("a directory");
        let fake = Fake::new();
        let path = file(&dir, &TASK.replace("NAME", "one"));
        fake.on_create(|o| o["status"] = json!({"phase": "Running", "node": "r1"}));
        let (code, _) = fake.run(&["apply", "-f", &path, "--wait"]).await;
        assert_eq!(code, exit::OK);
        let path = file(&dir, &TASK.replace("NAME", "two"));
        fake.on_create(|o| o["status"] = json!({"phase": "Pending", "why": [{"node": "r1", "reason": "LeaseHeld", "message": "held"}]}));
        let (code, text) = fake.run(&["apply", "-f", &path, "--wait"]).await;
        assert_eq!(code, exit::NOT_PLACED);
        assert!(text.contains("task/two"), "{text}");
        fake.on_create(|o| {
            o["status"] = json!({"phase": "Failed", "node": "r1", "reason": "Error"})
        });
        let path = file(&dir, &TASK.replace("NAME", "three"));
        assert_eq!(fake.run(&["apply", "-f", &path, "--wait"]).await.0, exit::TASK_ENDED);
    }
}
