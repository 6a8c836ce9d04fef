//! `muster plan`: what applying manifests would do, decided by the real scheduler on a copy of what
//! it knows. Exit code 0: nothing; 1: there are changes; 255: no plan could be made.

mod index;
mod sets;

use std::path::PathBuf;

use muster_api::id::Epoch;
use muster_api::kind::lease::LeaseSpec;
use muster_api::kind::task::NodeRefusal;
use serde::Deserialize;
use serde_json::{Value, json};

use super::Outcome;
use super::apply::{self, Action, Step};
use super::why::refusal_table;
use crate::client::{Client, Mode, group_path};
use crate::error::{Class, CliError, Refusal};
use crate::exit;
use crate::manifests::{self, Manifest};
use crate::merge::FieldChange;
use crate::output::human;
use crate::output::objects::{Format, document};
use crate::output::style::Styles;
use crate::session::Session;
use crate::target;

/// `muster plan`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A manifest, a directory of them, or - for standard input; may be given several times
    #[arg(short, long = "filename", value_name = "FILE|DIR|-", required = true)]
    filename: Vec<PathBuf>,
    /// Print what the controller says, for programs
    #[arg(short, long, value_enum, value_name = "FORMAT")]
    output: Option<Format>,
}

/// What `POST …/plan` answers.
#[derive(Debug, Deserialize)]
struct Plan {
    #[serde(default)]
    changes: Vec<PlannedChange>,
    #[serde(default)]
    placements: Vec<Placement>,
    #[serde(default)]
    waits: Vec<Wait>,
    #[serde(default)]
    preemptions: Vec<Preemption>,
    #[serde(default)]
    sets: Vec<sets::Set>,
    #[serde(default)]
    revision: String,
    /// See [`index`].
    #[serde(default)]
    index: String,
}

#[derive(Debug, Deserialize)]
struct PlannedChange {
    action: What,
    kind: String,
    #[serde(default)]
    namespace: Option<String>,
    name: String,
    #[serde(default)]
    fields: Vec<PlannedField>,
}

#[derive(Debug, Deserialize)]
struct PlannedField {
    path: String,
    #[serde(default)]
    from: Option<Value>,
    #[serde(default)]
    to: Option<Value>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "camelCase")]
enum What {
    Create,
    Update,
    Unchanged,
}

#[derive(Debug, Deserialize)]
struct Placement {
    namespace: String,
    name: String,
    node: String,
    #[serde(default)]
    score: Option<f64>,
    #[serde(default)]
    leases: Vec<PlannedLease>,
}

#[derive(Debug, Deserialize)]
struct PlannedLease {
    group: String,
    epoch: Epoch,
}

#[derive(Debug, Deserialize)]
struct Preemption {
    namespace: String,
    name: String,
    node: String,
    victims: Vec<String>,
    /// Those that pass on with their end.
    #[serde(default)]
    leases: Vec<String>,
}

impl Preemption {
    /// `would end on r1: lab/x; takes over r1.body`.
    fn text(&self) -> String {
        let mut text = format!("would end on {}: {}", self.node, self.victims.join(", "));
        if !self.leases.is_empty() {
            text.push_str(&format!("; takes over {}", self.leases.join(", ")));
        }
        text
    }
}

#[derive(Debug, Deserialize)]
struct Wait {
    namespace: String,
    name: String,
    #[serde(default)]
    why: Vec<NodeRefusal>,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let manifests = manifests::load(&args.filename, &session.namespace, session.namespace_given)?;
    let steps = apply::look_at_all(&session.client, manifests).await?;
    apply::rehearse(&session.client, &steps).await?;
    let (answer, plan) = ask(&session.client, &steps).await?;
    match args.output {
        Some(format @ (Format::Yaml | Format::Json)) => {
            session.ui.print(&document(&answer, format)?)?;
        }
        _ => {
            let text = render(&plan, &session.ui.styles);
            session.ui.print(&text)?;
        }
    }
    let changes = plan.changes.iter().any(|c| c.action != What::Unchanged);
    Ok(if changes { exit::FAILURE } else { exit::OK })
}

/// What the controller is asked about: manifests, and a set that is changed as it would be afterwards, with what others have
/// set of it.
async fn objects(client: &Client, steps: &[Step]) -> Result<Vec<Value>, CliError> {
    let mut objects = Vec::new();
    for step in steps {
        let changed = matches!(step.action, Action::Patch { .. });
        objects.push(match changed && step.manifest.info.kind == "TaskSet" {
            true => apply::perform(client, step, Mode::DryRun).await?,
            false => step.manifest.admitted.clone(),
        });
    }
    Ok(objects)
}

/// The controller's answer with what apply would change, and the same to be looked at.
async fn ask(client: &Client, steps: &[Step]) -> Result<(Value, Plan), CliError> {
    let objects = objects(client, steps).await?;
    let uri = group_path("plan");
    let mut answer: Value = client.post_json(&uri, &json!({ "objects": objects })).await?;
    // The controller plans placements; which fields apply would change, only apply's own rules say.
    answer["changes"] = steps.iter().map(change).collect();
    let requests = steps.iter().filter_map(|step| match &step.action {
        Action::Create(object) => Some(object),
        Action::Patch { patch, .. } => Some(patch),
        Action::Nothing(_) => None,
    });
    answer["index"] = index::of(&answer, &requests.collect::<Vec<_>>()).into();
    let plan = serde_json::from_value(answer.clone()).map_err(|source| CliError::Answer {
        server: client.server.clone(),
        request: format!("POST {uri}"),
        source,
    })?;
    Ok((answer, plan))
}

/// Whether applying would do what a plan with this index said, and as of which revision; if not, what it would do now.
pub(super) async fn check(
    session: &Session,
    steps: &[Step],
    index: &str,
) -> Result<String, CliError> {
    let (_, plan) = ask(&session.client, steps).await?;
    if plan.index == index {
        return Ok(plan.revision);
    }
    let now = render(&plan, &Styles::default());
    Err(CliError::Refused(Box::new(Refusal {
        class: Class::Conflict,
        reason: "PlanOutdated".to_owned(),
        message: format!(
            "the cluster or the manifests have changed since the plan {index}; nothing was stored. Now:\n{now}"
        ),
        causes: Vec::new(),
        hint: Some(format!("`muster apply --check-index {}` applies this", plan.index)),
    })))
}

fn change(step: &Step) -> Value {
    let none: &[FieldChange] = &[];
    let (action, fields) = match &step.action {
        Action::Create(_) => ("create", none),
        Action::Patch { fields, .. } if !fields.is_empty() => ("update", &fields[..]),
        Action::Patch { .. } | Action::Nothing(_) => ("unchanged", none),
    };
    let fields: Vec<Value> =
        fields.iter().map(|f| json!({"path": f.path, "from": f.from, "to": f.to})).collect();
    let Manifest { info, namespace, name, .. } = &step.manifest;
    json!({
        "action": action, "kind": info.kind, "namespace": namespace, "name": name, "fields": fields,
    })
}

/// A line a change, with where the task would go or what would keep it from going anywhere.
fn render(plan: &Plan, styles: &Styles) -> String {
    let mut text = String::new();
    for change in plan.changes.iter().filter(|c| c.action != What::Unchanged) {
        let (sign, paint) = match change.action {
            What::Create => ("+", styles.good),
            What::Update | What::Unchanged => ("~", styles.warn),
        };
        let kind = target::kind(&change.kind)
            .map_or_else(|_| change.kind.to_lowercase(), |i| i.singular.to_owned());
        let place = change.namespace.as_ref().map(|ns| format!(" in {ns}")).unwrap_or_default();
        text.push_str(&format!("{} {kind}/{}{place}", paint.paint(sign), change.name));
        let is_it = |namespace: &str, name: &str| {
            change.kind == "Task"
                && change.namespace.as_deref() == Some(namespace)
                && change.name == name
        };
        if let Some(placement) = plan.placements.iter().find(|p| is_it(&p.namespace, &p.name)) {
            text.push_str(&placed(placement));
        }
        text.push('\n');
        for field in &change.fields {
            text.push_str(&format!("    {}\n", describe(field)));
        }
        let mut rooms = plan.preemptions.iter();
        if let Some(room) = rooms.find(|p| is_it(&p.namespace, &p.name) && !p.victims.is_empty()) {
            text.push_str(&format!("    {}\n", styles.bad.paint(room.text())));
        }
        if change.kind == "TaskSet" {
            text.push_str(&sets::render(plan, change, styles));
        }
        if let Some(wait) = plan.waits.iter().find(|w| is_it(&w.namespace, &w.name)) {
            text.push_str(&format!("    {}\n", styles.warn.paint("would wait:")));
            for line in refusal_table(&wait.why).text(styles).lines() {
                text.push_str(&format!("    {line}\n"));
            }
        }
    }
    text.push_str(&summary(plan));
    text
}

fn describe(field: &PlannedField) -> String {
    let text = |value: &Option<Value>| value.as_ref().map(|v| human::plain(&v.to_string()));
    match (text(&field.from), text(&field.to)) {
        (None, to) => format!("{}: set to {}", field.path, to.unwrap_or_default()),
        (Some(from), None) => format!("{}: {from} is removed", field.path),
        (Some(from), Some(to)) => format!("{}: {from} → {to}", field.path),
    }
}

fn placed(placement: &Placement) -> String {
    let mut text = format!(" → {}", placement.node);
    if let Some(score) = placement.score {
        text.push_str(&format!(", score {score:.2}"));
    }
    for lease in &placement.leases {
        let name = LeaseSpec::object_name(&placement.node, &lease.group);
        text.push_str(&format!(", lease {name} epoch {}", lease.epoch));
    }
    text
}

fn summary(plan: &Plan) -> String {
    let of = |action| plan.changes.iter().filter(|c| c.action == action).count();
    let (create, update, same) = (of(What::Create), of(What::Update), of(What::Unchanged));
    if create + update == 0 {
        return format!("Nothing to do: {} as the manifests say.\n", human::count(same, "object"));
    }
    let mut text = format!("\nPlan: {create} to create, {update} to change, {same} unchanged.");
    let (placed, waits) = (plan.placements.len(), plan.waits.len());
    if placed + waits > 0 {
        text.push_str(&format!(
            " {placed} of {} would be placed at once.",
            human::count(placed + waits, "new task")
        ));
    }
    if !plan.revision.is_empty() {
        text.push_str(&format!(" As of revision {}.", plan.revision));
    }
    text.push_str(&format!(
        "\nIndex: {}; `muster apply --check-index` with it refuses when it is no longer this.\n",
        plan.index
    ));
    text
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::Fake;

    const PLAN: &str = "POST /apis/muster.dev/v1alpha1/plan";

    fn manifest(dir: &tempfile::TempDir) -> String {
        let path = dir.path().join("t.yaml");
        let task = |name: &str| {
            format!(
                "apiVersion: muster.dev/v1alpha1\nkind: Task\nmetadata: {{name: {name}}}\nspec: {{priority: 2, run: {{process: {{command: [x]}}}}}}\n"
            )
        };
        std::fs::write(&path, format!("{}---\n{}", task("a"), task("b"))).expect("written");
        path.display().to_string()
    }

    /// The text with a word for the index, and the index.
    fn without_index(text: &str) -> (String, String) {
        let index = text.split_once("Index: ").and_then(|(_, rest)| rest.split_once(';'));
        let index = index.expect("a plan has an index").0.to_owned();
        (text.replace(&index, "INDEX"), index)
    }

    #[tokio::test]
    async fn a_plan_is_applied_as_it_was_or_not_at_all() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = manifest(&dir);
        let fake = Fake::new();
        let plan = |node: &str| {
            let place = |name: &str| json!({"namespace": "default", "name": name, "node": node, "leases": []});
            json!({"placements": [place("a"), place("b")], "revision": "7"})
        };
        fake.answer(PLAN, plan("r1"));
        let (_, index) = without_index(&fake.run(&["plan", "-f", &path]).await.1);
        fake.answer(PLAN, plan("r2"));
        let refused = fake.try_run(&["apply", "-f", &path, "--check-index", &index]).await;
        let text = refused.expect_err("it would be something else").to_string();
        assert!(text.contains("+ task/a in default → r2") && text.contains(&index), "{text}");
        assert_eq!(fake.object("tasks/default/a"), None, "nothing was stored");
        fake.answer(PLAN, plan("r1"));
        let (code, text) = fake.run(&["apply", "-f", &path, "--check-index", &index]).await;
        assert_eq!(code, exit::OK, "{text}");
        assert!(fake.object("tasks/default/a").is_some());
    }

    #[tokio::test]
    async fn the_exit_code_says_whether_there_are_changes() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = manifest(&dir);
        let fake = Fake::new();
        let lease = json!({"group": "body", "epoch": 4});
        let refusal = json!({"node": "r1", "reason": "LeaseHeld", "message": "held"});
        fake.answer(PLAN, json!({
            "placements": [{"namespace": "default", "name": "a", "node": "r1", "score": 2.345, "leases": [lease]}],
            "waits": [{"namespace": "default", "name": "b", "why": [refusal]}],
            "revision": "7",
        }));
        let (code, text) = fake.run(&["plan", "-f", &path]).await;
        assert_eq!(code, exit::FAILURE);
        let (text, index) = without_index(&text);
        assert_eq!(
            text,
            "+ task/a in default → r1, score 2.35, lease r1.body epoch 4\n\
             + task/b in default\n    would wait:\n    NODE   REFUSED BY   WHY\n    r1     LeaseHeld    held\n\
             \nPlan: 2 to create, 0 to change, 0 unchanged. 1 of 2 new tasks would be placed at once. As of revision 7.\n\
             Index: INDEX; `muster apply --check-index` with it refuses when it is no longer this.\n"
        );
        assert_eq!(fake.object("tasks/default/a"), None, "a plan stores nothing");
        fake.answer(PLAN, json!({"revision": "8"}));
        fake.run(&["apply", "-f", &path]).await;
        let nothing = "Nothing to do: 2 objects as the manifests say.\n".to_owned();
        assert_eq!(fake.run(&["plan", "-f", &path]).await, (exit::OK, nothing));
        fake.edit("tasks/default/a", |o| o["spec"]["priority"] = json!(9));
        let (code, text) = fake.run(&["plan", "-f", &path]).await;
        assert_eq!(code, exit::FAILURE);
        let (text, other) = without_index(&text);
        assert_ne!(other, index);
        assert_eq!(
            text,
            "~ task/a in default\n    spec.priority: 9 → 2\n\n\
             Plan: 0 to create, 1 to change, 1 unchanged. As of revision 8.\n\
             Index: INDEX; `muster apply --check-index` with it refuses when it is no longer this.\n"
        );
    }

    #[tokio::test]
    async fn what_is_sent_has_its_namespace_and_defaults() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = manifest(&dir);
        let fake = Fake::new();
        fake.answer(PLAN, json!({}));
        fake.run(&["plan", "-f", &path, "-n", "lab"]).await;
        let body = fake.last_body();
        assert_eq!(body["objects"][0]["metadata"]["namespace"], "lab");
        assert_eq!(body["objects"][0]["spec"]["restartPolicy"], "Never");
    }
}
