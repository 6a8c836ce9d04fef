//! `muster apply --check-index`: what a plan said, in one commit or not at all.
//!
//! ```text
//!   plan again (as of revision R) ── is it that index? ──▶ POST …/transaction {R, every object}
//!        ▲                            └─ no: refused          │ 409: something was written since R
//!        └────────────────────── look again ◀────────────────┘
//! ```
//!
//! The controller stores all of it while nothing that a plan looks at was written since, and nothing otherwise. A cluster
//! that works is written all the time, mostly with what changes no plan: then the plan is made again, and compared again.

use kube::core::Status;
use serde::Deserialize;
use serde_json::{Value, json};

use super::apply::{Action, Step, look_at_all};
use super::plan;
use crate::client::{Client, group_path};
use crate::error::{Class, CliError, Refusal};
use crate::manifests::Manifest;
use crate::session::Session;

/// How often the plan is made again. A busy cluster lets every second or third try through.
const TRIES: usize = 64;

/// What `POST …/transaction` answers.
#[derive(Debug, Deserialize)]
struct Answer {
    #[serde(default)]
    objects: Vec<Value>,
    #[serde(default)]
    refusals: Vec<Refused>,
}

#[derive(Debug, Deserialize)]
struct Refused {
    index: usize,
    status: Status,
}

/// Applies steps in their order if they still are what the plan said under this index; each with its object afterwards.
pub(super) async fn apply(
    session: &Session,
    mut steps: Vec<Step>,
    index: &str,
) -> Result<Vec<(Step, Value)>, CliError> {
    for _ in 0..TRIES {
        let revision = plan::check(session, &steps, index).await?;
        if let Some(objects) = store(&session.client, &steps, &revision).await? {
            return Ok(steps.into_iter().zip(objects).collect());
        }
        let manifests = steps.into_iter().map(|step| step.manifest).collect();
        steps = look_at_all(&session.client, manifests).await?;
    }
    Err(CliError::Refused(Box::new(Refusal {
        class: Class::Conflict,
        reason: "Conflict".to_owned(),
        message: format!(
            "the cluster changed {TRIES} times while it was looked at; the plan is still {index}, and nothing was stored"
        ),
        causes: Vec::new(),
        hint: Some("try again, or apply without --check-index".to_owned()),
    })))
}

/// The objects as they were stored; none: something was written since `revision`.
async fn store(
    client: &Client,
    steps: &[Step],
    revision: &str,
) -> Result<Option<Vec<Value>>, CliError> {
    let requests: Vec<Value> = steps.iter().map(request).collect();
    let body = json!({ "revision": revision, "requests": requests });
    let answer = client.post_json(&group_path("transaction"), &body).await;
    let Answer { objects, refusals } = match answer {
        Ok(answer) => answer,
        Err(CliError::Refused(refusal)) if refusal.reason == "Conflict" => return Ok(None),
        Err(error) => return Err(error),
    };
    if refusals.iter().any(|refused| refused.status.code == 409) {
        return Ok(None);
    }
    let mut diagnostics = Vec::new();
    for Refused { index, status } in refusals {
        let Some(step) = steps.get(index) else { continue };
        for blamed in step.manifest.blame(client.refused(status)) {
            diagnostics.push(blamed?);
        }
    }
    if diagnostics.is_empty() { Ok(Some(objects)) } else { Err(CliError::Manifests(diagnostics)) }
}

fn request(step: &Step) -> Value {
    let Manifest { info, namespace, name, .. } = &step.manifest;
    let of = json!({
        "apiVersion": info.api_version(), "kind": info.kind, "namespace": namespace, "name": name,
    });
    match &step.action {
        Action::Create(object) => json!({ "create": object }),
        Action::Patch { patch, revision, .. } => {
            let mut patch = patch.clone();
            patch["metadata"]["resourceVersion"] = revision.clone().into();
            json!({ "patch": { "of": of, "patch": patch } })
        }
        Action::Nothing(current) => {
            let revision = &current["metadata"]["resourceVersion"];
            json!({ "check": { "of": of, "resourceVersion": revision } })
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::Fake;
    use crate::output::style::Styles;

    const PLAN: &str = "POST /apis/muster.dev/v1alpha1/plan";

    fn manifests(dir: &tempfile::TempDir, priority: u32) -> String {
        let task = |name: &str| {
            format!(
                "apiVersion: muster.dev/v1alpha1\nkind: Task\nmetadata: {{name: {name}}}\n\
                 spec: {{priority: {priority}, run: {{process: {{command: [x]}}}}}}\n"
            )
        };
        let path = dir.path().join("t.yaml");
        std::fs::write(&path, format!("{}---\n{}", task("a"), task("b"))).expect("written");
        path.display().to_string()
    }

    async fn index(fake: &Fake, path: &str) -> String {
        let (_, text) = fake.run(&["plan", "-f", path]).await;
        let index = text.split_once("Index: ").and_then(|(_, rest)| rest.split_once(';'));
        index.expect("a plan has an index").0.to_owned()
    }

    #[tokio::test]
    async fn everything_is_stored_by_one_request_when_the_cluster_stands_still_for_it() {
        let dir = tempfile::tempdir().expect("a directory");
        let (path, fake) = (manifests(&dir, 2), Fake::new());
        fake.answer(PLAN, json!({"revision": "7"}));
        let index = index(&fake, &path).await;
        fake.move_on(3);
        let before = fake.requests().len();
        let (code, text) = fake.run(&["apply", "-f", &path, "--check-index", &index]).await;
        assert_eq!((code, text.as_str()), (exit::OK, "task/a created\ntask/b created\n"));
        let sent = fake.requests().split_off(before);
        let times = |what: &str| sent.iter().filter(|r| r.contains(what)).count();
        assert_eq!((times("/transaction"), times("/plan")), (4, 4), "{sent:?}");
        let stored =
            |r: &&String| r.starts_with("POST") && r.contains("/tasks") && !r.contains("dryRun");
        assert_eq!(sent.iter().filter(stored).count(), 0, "{sent:?}");

        // One is changed, and one stays: both must be what they were.
        let path = manifests(&dir, 3);
        fake.edit("tasks/default/b", |o| o["spec"]["priority"] = json!(3));
        let index = self::index(&fake, &path).await;
        let (_, text) = fake.run(&["apply", "-f", &path, "--check-index", &index]).await;
        assert_eq!(text, "task/a configured\ntask/b unchanged\n");
        let body = fake.last_body();
        let version = body["requests"][0]["patch"]["patch"]["metadata"]["resourceVersion"].clone();
        assert!(version.is_string() && body["revision"] == "7", "{body}");
        assert!(
            body["requests"][1]["patch"].is_object() || body["requests"][1]["check"].is_object()
        );
    }

    #[tokio::test]
    async fn a_cluster_that_never_stands_still_is_told_of_and_what_is_refused_is_blamed() {
        let dir = tempfile::tempdir().expect("a directory");
        let (path, fake) = (manifests(&dir, 2), Fake::new());
        fake.answer(PLAN, json!({"revision": "7"}));
        let index = index(&fake, &path).await;
        fake.move_on(u32::MAX);
        let apply = ["apply", "-f", &path, "--check-index", &index];
        let error = fake.try_run(&apply).await.expect_err("it never stands still");
        assert!(error.to_string().contains("changed 64 times"), "{error}");
        fake.move_on(0);
        fake.refuse_late("b", "spec.priority", "is too much");
        let error = fake.try_run(&apply).await.expect_err("refused");
        let text = error.render(&Styles::default());
        assert!(text.starts_with(&format!("{path}:9:8: spec.priority: is too much")), "{text}");
        assert_eq!(fake.object("tasks/default/a"), None, "nothing was stored");
    }
}
