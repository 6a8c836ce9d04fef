//! The command as people use it, against a real cluster: what it prints where, and its exit codes.

use std::path::Path;
use std::process::{Command, Output};

use kube::Api;
use muster_api::kind::quota::Quota;
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, cluster::binary, wait};
use serde_json::json;

fn manifests() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../manifests")
}

/// Runs `muster`; the exit code, what it wrote to stdout, and to stderr.
pub(crate) fn muster(cluster: &Cluster, args: &[&str]) -> (i32, String, String) {
    let output: Output = Command::new(binary("muster"))
        .args(args)
        .env("MUSTER_CONFIG", cluster.kubeconfig())
        .env("NO_COLOR", "1")
        .output()
        .expect("muster starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code().expect("it was not killed"), text(&output.stdout), text(&output.stderr))
}

#[tokio::test(flavor = "multi_thread")]
async fn broken_manifests_store_nothing_and_say_where() {
    let cluster = Cluster::start().await;
    let dir = manifests().join("invalid");
    for entry in std::fs::read_dir(&dir).expect("of the tree").flatten() {
        let path = entry.path();
        if path.extension().is_none_or(|e| e != "yaml") {
            continue;
        }
        let (code, out, err) = muster(&cluster, &["apply", "-f", path.to_str().expect("text")]);
        assert_eq!((code, out.as_str()), (5, ""), "{}: {err}", path.display());
        // The golden text's lines carry only the file's name; the command says the path as given.
        let golden =
            std::fs::read_to_string(path.with_extension("txt")).expect("each has a golden text");
        for line in golden.lines() {
            let rest = line.split_once(".yaml").expect("a place").1;
            assert!(err.contains(rest), "{} lacks {rest:?}: {err}", path.display());
        }
    }
    let everything = ["get", "tasks,nodes", "-A", "-o", "name"];
    assert_eq!(muster(&cluster, &everything).1, "");
    let (_, namespaces, _) = muster(&cluster, &["get", "namespaces", "-o", "name"]);
    assert_eq!(
        namespaces, "namespace/default\n",
        "the good document beside a bad one is not stored either"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn from_plan_to_delete() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 3.0, 4.0)).await;
    let manifest = cluster.dir().join("drive.yaml");
    let driver = |name: &str| {
        format!(
            "apiVersion: muster.dev/v1alpha1\nkind: Task\nmetadata: {{name: {name}}}\nspec:\n  gracePeriodSeconds: 0\n  \
             placement: {{at: {{x: 0, y: 0}}, within: 10}}\n  resources: {{cpu: 100m, actuators: ['base:Drive']}}\n  \
             run: {{process: {{command: [sh, -c, 'echo at the wheel; sleep 1000']}}}}\n"
        )
    };
    std::fs::write(&manifest, format!("{}---\n{}", driver("first"), driver("second")))
        .expect("writable");
    let file = manifest.to_str().expect("text");

    let (code, plan, _) = muster(&cluster, &["plan", "-f", file]);
    assert_eq!(code, 1, "there is something to do: {plan}");
    assert!(
        plan.contains("first") && plan.contains("robot") && plan.contains("LeaseHeld"),
        "{plan}"
    );
    assert_eq!(muster(&cluster, &["get", "tasks", "-o", "name"]).1, "", "a plan changes nothing");

    let index = plan.split_once("Index: ").and_then(|(_, rest)| rest.split_once(';'));
    let index = index.expect("a plan has an index").0;
    let (code, _, err) = muster(&cluster, &["apply", "-f", file, "--check-index", "000000000000"]);
    assert!(code != 0 && err.contains("have changed since the plan 000000000000"), "{err}");
    assert_eq!(muster(&cluster, &["get", "tasks", "-o", "name"]).1, "", "nothing was stored");
    let (code, out, err) = muster(&cluster, &["apply", "-f", file, "--check-index", index]);
    assert_eq!((code, out.as_str()), (0, "task/first created\ntask/second created\n"), "{err}");
    let (code, out, _) = muster(&cluster, &["apply", "-f", file]);
    assert_eq!((code, out.as_str()), (0, "task/first unchanged\ntask/second unchanged\n"));
    assert_eq!(muster(&cluster, &["plan", "-f", file]).0, 0, "nothing to do");

    let (code, _, err) =
        muster(&cluster, &["wait", "task/first", "--for", "phase=Running", "--timeout", "60s"]);
    assert_eq!(code, 0, "{err}");
    cluster.task("second", "refused", |s| !s.why.is_empty()).await;
    let set = cluster.dir().join("set.yaml");
    let template = "{spec: {priority: 9, placement: {at: {x: 0, y: 0}}, resources: {actuators: ['base:Drive']}, run: {process: {command: [x]}}}}";
    let text = format!(
        "apiVersion: muster.dev/v1alpha1\nkind: TaskSet\nmetadata: {{name: urgent}}\nspec: {{replicas: 1, template: {template}}}\n"
    );
    std::fs::write(&set, text).expect("writable");
    let (code, plan, _) = muster(&cluster, &["plan", "-f", set.to_str().expect("text")]);
    let lost = "would end on robot: default/first; takes over robot.body";
    assert!(code == 1 && plan.contains("+ task/urgent-0") && plan.contains(lost), "{plan}");
    let (_, why, _) = muster(&cluster, &["why", "task/second"]);
    assert!(
        why.contains("robot") && why.contains("LeaseHeld") && why.contains("default/first"),
        "{why}"
    );
    let (_, table, _) = muster(&cluster, &["get", "tk"]);
    let row = table.lines().find(|l| l.starts_with("first")).expect("a row");
    assert!(
        row.contains("Running")
            && row.contains("robot")
            && row.contains("5.0")
            && row.contains("AR-CR"),
        "{table}"
    );
    let (_, described, _) = muster(&cluster, &["describe", "node", "robot"]);
    assert!(described.contains("kinect:ImageGen") && described.contains("first"), "{described}");
    // It runs a moment before it says it.
    wait::until("its log", || async {
        let (_, log, err) = muster(&cluster, &["logs", "first"]);
        if log == "at the wheel\n" { Ok(()) } else { Err(format!("{log:?} {err}")) }
    })
    .await;

    assert_eq!(muster(&cluster, &["get", "task", "none"]).0, 3, "not found");
    assert_eq!(muster(&cluster, &["delete", "task", "first"]).0, 0);
    cluster.phase("second", TaskPhase::Running).await;
    let (code, _, err) = muster(&cluster, &["delete", "-f", file]);
    assert_eq!(code, 3, "one of them is gone already: {err}");
    assert_eq!(muster(&cluster, &["get", "tasks", "-o", "name"]).1, "");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_controller_that_is_not_there_is_said_with_the_next_step() {
    let mut cluster = Cluster::start().await;
    cluster.kill_controller();
    let (code, out, err) = muster(&cluster, &["get", "nodes"]);
    assert_eq!((code, out.as_str()), (6, ""), "{err}");
    assert!(err.contains("https://127.0.0.1:") && err.contains("kubeconfig"), "{err}");
}

/// What a quota lets in one by one and not together is refused whole, at its place.
#[tokio::test(flavor = "multi_thread")]
async fn manifests_that_exceed_a_quota_together_store_nothing() {
    let cluster = Cluster::start().await;
    let quota = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Quota", "metadata": {"name": "default"},
        "spec": {"hard": {"cpu": "1"}},
    });
    cluster.post("/apis/muster.dev/v1alpha1/namespaces/default/quotas", &quota).await;
    let task = |name: &str, cpu: &str| {
        format!(
            "apiVersion: muster.dev/v1alpha1\nkind: Task\nmetadata: {{name: {name}}}\nspec:\n  \
             resources:\n    cpu: {cpu}\n  run: {{process: {{command: [sleep, '1000']}}}}\n"
        )
    };
    let manifest = cluster.dir().join("three.yaml");
    let text = [task("a", "400m"), task("b", "500m"), task("c", "300m")].join("---\n");
    std::fs::write(&manifest, text).expect("writable");
    let file = manifest.to_str().expect("text");
    // A plan's low codes say whether there are changes.
    for (verb, refused) in [("apply", 5), ("plan", 255)] {
        let (code, _, err) = muster(&cluster, &[verb, "-f", file]);
        assert_eq!(code, refused, "{err}");
        let place = format!("{file}:22:5: spec.resources.cpu: asks for 300m cpu");
        assert!(err.contains(&place) && err.contains("alone it would pass"), "{err}");
        assert_eq!(muster(&cluster, &["get", "tasks", "-o", "name"]).1, "");
    }
    let text = [task("a", "400m"), task("b", "500m"), task("c", "100m")].join("---\n");
    std::fs::write(&manifest, text).expect("writable");
    assert_eq!(muster(&cluster, &["apply", "-f", file]).0, 0);
}

/// What a namespace has stands beside what it may have, for declared tasks as they come and go.
#[tokio::test(flavor = "multi_thread")]
async fn a_quota_says_what_is_used() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    let quota = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Quota", "metadata": {"name": "default"},
        "spec": {"hard": {"cpu": "1500m", "leases": 2}},
    });
    let path = "/apis/muster.dev/v1alpha1/namespaces/default/quotas";
    cluster.post(path, &quota).await;
    let is = |cpu: u64, leases: u64| {
        let has = move |quota: Option<&Quota>| {
            let used = quota.and_then(|q| q.status.as_ref()).map(|status| status.used.clone());
            used.is_some_and(|used| (used.cpu.0, used.leases) == (cpu, leases))
        };
        let cluster = &cluster;
        async move {
            let api = Api::<Quota>::namespaced(cluster.client().await, "default");
            wait::object(api, "default", &format!("{cpu} cpu, {leases} leases"), has).await
        }
    };
    is(0, 0).await;
    let resources = json!({"cpu": "300m", "memory": "64Mi", "actuators": ["base:Drive"]});
    let run = json!({"process": {"command": ["sleep", "1000"]}});
    let spec = json!({"resources": resources, "run": run, "gracePeriodSeconds": 0});
    cluster.create("driver", spec).await;
    let status = is(300, 1).await.and_then(|quota| quota.status).expect("it has one");
    assert_eq!(status.hard.leases, Some(2));
    let (_, table, _) = muster(&cluster, &["get", "quotas"]);
    for cell in ["0.3/1.5", "64Mi/-", "1/2"] {
        assert!(table.contains(cell), "{cell} is not in\n{table}");
    }
    cluster.delete("driver").await;
    is(0, 0).await;
}
