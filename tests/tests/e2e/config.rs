//! ConfigMaps and Secrets reach tasks, stay as they are for an attempt, and a Secret's value is nowhere but there.

use std::path::{Path, PathBuf};

use muster_api::kind::task::TaskStatus;
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, Puppet, docker, kernel, wait};
use serde_json::{Value, json};

const CORE: &str = "/api/v1/namespaces/default";
/// Its value as text and as base64 must never be found.
const PASSWORD: &str = "hunter2-very-secret-value";
const PASSWORD_BASE64: &str = "aHVudGVyMi12ZXJ5LXNlY3JldC12YWx1ZQ";

async fn config_map(cluster: &Cluster, name: &str, data: Value) {
    let object = json!({
        "apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": name}, "data": data,
    });
    cluster.post(&format!("{CORE}/configmaps"), &object).await;
}

async fn secret(cluster: &Cluster, name: &str, texts: Value) {
    let object = json!({
        "apiVersion": "v1", "kind": "Secret", "metadata": {"name": name}, "stringData": texts,
    });
    let stored = cluster.post(&format!("{CORE}/secrets"), &object).await;
    assert!(stored.get("stringData").is_none(), "{stored}");
}

/// A merge patch of a ConfigMap or a Secret.
async fn patch(cluster: &Cluster, path: &str, patch: &Value) {
    let request = http::Request::patch(format!("{CORE}/{path}"))
        .header("content-type", "application/merge-patch+json")
        .body(serde_json::to_vec(patch).expect("JSON"))
        .expect("a request");
    let _: Value = cluster.client().await.request(request).await.expect("it is patched");
}

/// Waits until a task runs and has written `wanted`.
async fn says(cluster: &Cluster, task: &str, wanted: &str) {
    cluster.phase(task, TaskPhase::Running).await;
    wait::until(&format!("{task} says {wanted:?}"), || async {
        let log = cluster.try_task_log(task).await?;
        if log.contains(wanted) { Ok(()) } else { Err(log) }
    })
    .await;
}

fn reasons(status: &TaskStatus) -> Vec<(&str, &str)> {
    status.why.iter().map(|why| (&*why.node, &*why.reason)).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_waits_for_what_it_names_and_gets_it_as_environment_and_files() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    let script = "echo A=$A B=$B C=$C P=$X_password N=${N-unset}; cat conf/app.yaml; \
                  cat $MUSTER_FILES_DIR/keys/pw; stat -c 'mode=%a' keys/pw; exec sleep 1000";
    let run = json!({
        "command": ["sh", "-c", script],
        "env": [
            {"name": "B", "value": "plain"},
            {"name": "C", "valueFrom": {"configMapKeyRef": {"name": "settings", "key": "A"}}},
            {"name": "N", "valueFrom": {"configMapKeyRef": {"name": "none", "key": "n", "optional": true}}},
        ],
        "envFrom": [{"configMapRef": {"name": "settings"}}, {"prefix": "X_", "secretRef": {"name": "login"}}],
        "files": [
            {"configMap": "settings", "mountPath": "conf", "items": [{"key": "app.yaml", "path": "app.yaml"}]},
            {"secret": "login", "mountPath": "keys", "items": [{"key": "password", "path": "pw"}]},
        ],
    });
    cluster.create("t", json!({"run": {"process": run}, "gracePeriodSeconds": 0})).await;
    let held =
        |reason: &'static str| move |s: &TaskStatus| s.why.iter().any(|w| w.reason == reason);
    let task = cluster.task("t", "held", held("SecretNotFound")).await;
    let status = task.status.expect("it waits");
    assert_eq!(status.phase, TaskPhase::Pending);
    assert_eq!(reasons(&status), [("", "ConfigMapNotFound"), ("", "SecretNotFound")]);
    let path = "/apis/muster.dev/v1alpha1/namespaces/default/tasks/t/why";
    let why = cluster.get(path).await;
    assert_eq!(why["why"][0]["reason"], "ConfigMapNotFound", "{why}");

    config_map(&cluster, "settings", json!({"A": "1", "B": "2"})).await;
    cluster.task("t", "a key is missing", held("ConfigMapKeyNotFound")).await;
    patch(&cluster, "configmaps/settings", &json!({"data": {"app.yaml": "speed: 3\n"}})).await;
    secret(&cluster, "login", json!({"password": PASSWORD})).await;
    cluster.phase("t", TaskPhase::Running).await;
    says(&cluster, "t", "mode=400").await;
    let log = cluster.task_log("t").await;
    let first = format!("A=1 B=plain C=1 P={PASSWORD} N=unset");
    assert!(log.contains(&first) && log.contains("speed: 3"), "{log}");

    // The files are gone with the task.
    let uid = cluster.phase("t", TaskPhase::Running).await.metadata.uid.expect("set");
    let pid = kernel::with_env("MUSTER_UID", &uid).first().expect("it runs").pid;
    let dir = env_of(pid, "MUSTER_FILES_DIR");
    assert!(dir.join("keys/pw").exists(), "{}", dir.display());
    cluster.delete("t").await;
    wait::until("files are removed", || async {
        if dir.exists() { Err(dir.display().to_string()) } else { Ok(()) }
    })
    .await;
}

fn env_of(pid: u32, name: &str) -> PathBuf {
    let text = std::fs::read(format!("/proc/{pid}/environ")).expect("it runs");
    let text = String::from_utf8_lossy(&text).into_owned();
    let found = text.split('\0').find_map(|v| v.strip_prefix(name)?.strip_prefix('='));
    PathBuf::from(found.expect("it is set"))
}

#[tokio::test(flavor = "multi_thread")]
async fn an_attempt_keeps_its_values_and_the_next_gets_new_ones_also_without_a_controller() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    config_map(&cluster, "settings", json!({"A": "one"})).await;
    let again = cluster.dir().join("again");
    // Says what it has each time that it is asked to, and ends when the file tells it.
    let script = format!(
        "echo attempt $MUSTER_ATTEMPT has $A $(cat conf/A); until [ -e {0}-$MUSTER_ATTEMPT ]; do sleep 0.05; done; \
         echo attempt $MUSTER_ATTEMPT still $A $(cat conf/A)",
        again.display()
    );
    let run = json!({
        "command": ["sh", "-c", script],
        "envFrom": [{"configMapRef": {"name": "settings"}}],
        "files": [{"configMap": "settings", "mountPath": "conf"}],
    });
    let spec = json!({"run": {"process": run}, "restartPolicy": "Always", "gracePeriodSeconds": 0});
    let uid = cluster.create("t", spec).await.metadata.uid.expect("set by the server");
    says(&cluster, "t", "attempt 1 has one one").await;

    // The agent has the new values on its disk before it needs them.
    let sealed = cluster.dir().join(format!("robot/tasks/{uid}/config.sealed"));
    let before = std::fs::read(&sealed).expect("it was given something");
    patch(&cluster, "configmaps/settings", &json!({"data": {"A": "two"}})).await;
    wait::until("the agent has the new values", || async {
        let now = std::fs::read(&sealed).map_err(|e| e.to_string())?;
        if now == before { Err("not yet".to_owned()) } else { Ok(()) }
    })
    .await;
    let status = cluster.phase("t", TaskPhase::Running).await.status.expect("it runs");
    assert_eq!(status.attempt, 1, "a change disturbs nothing that runs");

    // Nobody to ask: controller and agent are gone, and only the agent comes back.
    cluster.kill_controller();
    cluster.kill_agent("robot");
    cluster.spawn_agent("robot", None);
    std::fs::write(format!("{}-1", again.display()), "").expect("the test's directory");
    let logs = cluster.dir().join(format!("robot/tasks/{uid}/attempts"));
    let said = |attempt: u32, wanted: &'static str| {
        let path = logs.join(attempt.to_string()).join("log");
        move || {
            let log = std::fs::read_to_string(&path).unwrap_or_default();
            async move { if log.contains(wanted) { Ok(()) } else { Err(log) } }
        }
    };
    wait::until("attempt 1 ended as it began", said(1, "attempt 1 still one one")).await;
    wait::until("attempt 2 has the new values", said(2, "attempt 2 has two two")).await;

    // Gone altogether: the next attempt has the last values.
    cluster.start_controller().await;
    cluster.node_ready("robot").await;
    let api = format!("{CORE}/configmaps/settings");
    let request = http::Request::delete(api).body(Vec::new()).expect("a request");
    let _: Value = cluster.client().await.request(request).await.expect("it is deleted");
    std::fs::write(format!("{}-2", again.display()), "").expect("the test's directory");
    wait::until("attempt 3 has the last values", said(3, "attempt 3 has two two")).await;
}

/// Every file below a directory that holds one of the texts.
fn files_with(dir: &Path, texts: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).into_iter().flatten().flatten() {
        let (path, kind) = (entry.path(), entry.file_type().expect("it is there"));
        if kind.is_dir() {
            found.extend(files_with(&path, texts));
        } else if kind.is_file() {
            let bytes = std::fs::read(&path).unwrap_or_default();
            let has = |text: &&str| bytes.windows(text.len()).any(|w| w == text.as_bytes());
            found.extend(texts.iter().any(has).then_some(path));
        }
    }
    found
}

#[tokio::test(flavor = "multi_thread")]
async fn the_value_of_a_secret_is_in_no_file_log_event_or_description() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("robot", 0.0, 0.0)).await;
    secret(&cluster, "login", json!({"password": PASSWORD, "other": "x"})).await;
    patch(&cluster, "secrets/login", &json!({"stringData": {"other": "y"}})).await;
    let run = json!({
        "command": ["sh", "-c", "test -n \"$P\" && test -s keys/password && echo ready; exec sleep 1000"],
        "env": [{"name": "P", "valueFrom": {"secretKeyRef": {"name": "login", "key": "password"}}}],
        "files": [{"secret": "login", "mountPath": "keys"}],
    });
    let uid = cluster
        .create("t", json!({"run": {"process": run}, "gracePeriodSeconds": 0}))
        .await
        .metadata
        .uid
        .expect("set");
    says(&cluster, "t", "ready").await;
    // Another life of each, so that everything that is ever read back has been written and read.
    cluster.kill_agent("robot");
    cluster.restart_agent("robot").await;

    let texts = [PASSWORD, PASSWORD_BASE64];
    let found = files_with(cluster.dir(), &texts);
    assert!(found.is_empty(), "store, logs or the agent's directory: {found:?}");
    let pid = kernel::with_env("MUSTER_UID", &uid).first().expect("it runs").pid;
    assert!(env_of(pid, "P").as_os_str() == PASSWORD, "it has its variable");
    for line in kernel::with_command(&cluster.dir().display().to_string()) {
        let line = std::fs::read(format!("/proc/{line}/cmdline")).unwrap_or_default();
        assert!(!String::from_utf8_lossy(&line).contains(PASSWORD));
    }
    let told = [
        cluster.get(&format!("{CORE}/events")).await.to_string(),
        cluster.get("/apis/muster.dev/v1alpha1/namespaces/default/tasks").await.to_string(),
        cluster.get("/apis/muster.dev/v1alpha1/nodes").await.to_string(),
        muster(&cluster, &["describe", "secret", "login"]),
        muster(&cluster, &["describe", "task", "t"]),
        muster(&cluster, &["get", "secrets"]),
    ];
    for text in &told {
        assert!(texts.iter().all(|secret| !text.contains(secret)), "{text}");
    }
    assert!(told[3].contains("password") && told[3].contains("25 bytes"), "{}", told[3]);
    let yaml = muster(&cluster, &["get", "secret", "login", "-o", "yaml"]);
    assert!(yaml.contains(PASSWORD_BASE64), "{yaml}");

    // The key is rotated, and the store is still read.
    cluster.kill_controller();
    let keys = cluster.dir().join("controller/encryption.key");
    let old = std::fs::read_to_string(&keys).expect("made at the first start");
    let new = "MDEyMzQ1Njc4OTAxMjM0NTY3ODkwMTIzNDU2Nzg5MDE=";
    std::fs::write(&keys, format!("{new}\n{old}")).expect("it is ours");
    cluster.start_controller().await;
    cluster.kill_controller();
    std::fs::write(&keys, new).expect("it is ours");
    cluster.start_controller().await;
    let yaml = muster(&cluster, &["get", "secret", "login", "-o", "yaml"]);
    assert!(yaml.contains(PASSWORD_BASE64), "{yaml}");
    assert!(files_with(&cluster.dir().join("controller"), &texts).is_empty());
}

fn muster(cluster: &Cluster, args: &[&str]) -> String {
    let mut command = std::process::Command::new(muster_tests::cluster::binary("muster"));
    let output = command.args(args).env("MUSTER_CONFIG", cluster.kubeconfig()).output();
    let output = output.expect("it runs");
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_container_sees_files_at_their_places_and_has_its_variables() {
    docker::image();
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud")).await;
    config_map(&cluster, "settings", json!({"A": "1"})).await;
    secret(&cluster, "login", json!({"password": PASSWORD})).await;
    let script = "echo A=$A P=$P; cat /etc/app/A; echo; cat /keys/a/pw; echo; \
                  (echo x > /etc/app/B) 2>/dev/null || echo read only; exec sleep 1000";
    let run = json!({
        "image": docker::IMAGE, "command": ["sh", "-c", script], "network": "None", "pullPolicy": "Never",
        "env": [{"name": "P", "valueFrom": {"secretKeyRef": {"name": "login", "key": "password"}}}],
        "envFrom": [{"configMapRef": {"name": "settings"}}],
        "files": [
            {"configMap": "settings", "mountPath": "/etc/app"},
            {"secret": "login", "mountPath": "/keys", "items": [{"key": "password", "path": "a/pw"}]},
        ],
    });
    let spec = json!({"run": {"container": run}, "gracePeriodSeconds": 0});
    cluster.create("t", spec).await;
    says(&cluster, "t", "read only").await;
    let log = cluster.task_log("t").await;
    assert!(log.contains(&format!("A=1 P={PASSWORD}\n1\n{PASSWORD}\n")), "{log}");
    let found = files_with(cluster.dir(), &[PASSWORD, PASSWORD_BASE64]);
    assert!(found.is_empty(), "{found:?}");
    cluster.delete("t").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_launch_of_a_framework_that_names_nothing_that_is_there_is_refused() {
    let mut cluster = Cluster::start().await;
    // A node may find Docker after it is ready: then what it offers is offered anew.
    let robot = AgentOptions::robot("robot", 0.0, 0.0).flag("--docker-socket", "none");
    cluster.join(robot).await;
    let mut framework = Puppet::start(&cluster, json!({"name": "one"})).await;
    framework.holds("the robot", |offers| offers.contains_key("robot")).await;
    let from = json!([{"secretRef": {"name": "login"}}]);
    let spec = json!({"run": {"process": {"command": ["true"], "envFrom": from}}});
    let refused = framework.launch(&[("robot", "t", spec.clone())]).await;
    assert_eq!(refused["event"], "refused", "{refused}");
    assert!(refused.to_string().contains("SecretNotFound"), "{refused}");
    secret(&cluster, "login", json!({"password": PASSWORD})).await;
    framework.holds("the robot again", |offers| offers.contains_key("robot")).await;
    let launched = framework.launch(&[("robot", "t", spec)]).await;
    assert_eq!(launched["event"], "launched", "{launched}");
}
