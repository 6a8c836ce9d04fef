//! People and programs with tokens: the command, programs in tasks, a framework; each may what its role says, until its token is
//! taken back.

use std::path::PathBuf;
use std::process::{Command, Output};

use muster_api::phase::TaskPhase;
use muster_tests::cluster::{self, binary};
use muster_tests::{AgentOptions, Cluster, wait};
use serde_json::json;

use crate::cli::muster;

const ROLES: &str = "
apiVersion: muster.dev/v1alpha1
kind: Access
metadata: {name: students}
spec: {role: developer, namespaces: [default], hostAccess: true, subjects: [{kind: Group, name: students}]}
---
apiVersion: muster.dev/v1alpha1
kind: Access
metadata: {name: guests}
spec: {role: viewer, subjects: [{kind: User, name: vera}]}
---
apiVersion: muster.dev/v1alpha1
kind: Access
metadata: {name: couriers}
spec: {role: framework, namespaces: [default], hostAccess: true, subjects: [{kind: User, name: courier}]}
";

/// The kubeconfig of a user, as `muster token create` prints it.
fn kubeconfig(cluster: &Cluster, user: &str, groups: &[&str]) -> PathBuf {
    let mut line = vec!["token", "create", "--user", user, "--as-kubeconfig", "--ttl", "1h"];
    for group in groups {
        line.extend(["--group", group]);
    }
    let (code, text, said) = muster(cluster, &line);
    assert_eq!(code, 0, "{said}");
    let path = cluster.dir().join(format!("{user}.config"));
    std::fs::write(&path, text).expect("the directory is there");
    path
}

fn as_user(config: &PathBuf, args: &[&str]) -> (i32, String, String) {
    let run = Command::new(binary("muster")).args(args).env("MUSTER_CONFIG", config).output();
    let Output { status, stdout, stderr } = run.expect("muster starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (status.code().expect("it was not killed"), text(&stdout), text(&stderr))
}

#[tokio::test(flavor = "multi_thread")]
async fn who_has_a_token_may_what_their_role_says() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::robot("tb-1", 3.0, 0.0).flag("--docker-socket", "none")).await;
    let file = cluster.dir().join("roles.yaml");
    std::fs::write(&file, ROLES).expect("the directory is there");
    let said = muster(&cluster, &["apply", "-f", file.to_str().expect("text")]);
    assert_eq!(said.0, 0, "{}", said.2);
    let (code, listed, _) = muster(&cluster, &["get", "access"]);
    assert!(code == 0 && listed.contains("group students"), "{listed}");
    let (_, told, _) = muster(&cluster, &["describe", "access", "students"]);
    assert!(told.contains("developer") && told.contains("group students"), "{told}");

    // A developer runs tasks, and programs in them; robots are not hers to write.
    let ada = kubeconfig(&cluster, "ada", &["students"]);
    let spec = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Task", "metadata": {"name": "t"},
        "spec": {"run": {"process": {"command": ["sleep", "1000"]}}, "gracePeriodSeconds": 0},
    });
    let task = cluster.dir().join("task.yaml");
    std::fs::write(&task, spec.to_string()).expect("the directory is there");
    let said = as_user(&ada, &["apply", "-f", task.to_str().expect("text")]);
    assert_eq!((said.0, said.1.as_str()), (0, "task/t created\n"), "{}", said.2);
    cluster.phase("t", TaskPhase::Running).await;
    let said = as_user(&ada, &["exec", "t", "--", "echo", "from ada"]);
    assert_eq!((said.0, said.1.as_str()), (0, "from ada\n"), "{}", said.2);
    let said = as_user(&ada, &["cordon", "tb-1"]);
    assert_eq!(said.0, 7, "{said:?}");
    assert!(said.2.contains("operator of the whole cluster may"), "{}", said.2);

    // A viewer looks.
    let vera = kubeconfig(&cluster, "vera", &[]);
    for (line, code) in [
        (&["get", "tasks"][..], 0),
        (&["get", "nodes"], 0),
        (&["logs", "t"], 0),
        (&["top", "tasks"], 0),
        (&["exec", "t", "--", "true"], 7),
        (&["delete", "task", "t"], 7),
        (&["get", "secrets"], 7),
        (&["lease", "take", "tb-1"], 7),
        (&["token", "list"], 7),
    ] {
        let said = as_user(&vera, line);
        assert_eq!(said.0, code, "{line:?}: {said:?}");
    }

    // A framework of the Rust SDK, with nothing but a token.
    let said = as_user(&ada, &["delete", "task", "t"]);
    assert_eq!(said.0, 0, "{}", said.2);
    let courier = kubeconfig(&cluster, "courier", &[]);
    let mut deliver = tokio::process::Command::new(cluster::example("deliver"));
    let deliver = deliver.arg("3,1").env("MUSTER_CONFIG", &courier).kill_on_drop(true);
    let ended = tokio::time::timeout(wait::DEADLINE, deliver.output()).await;
    let ended = ended.expect("it ends in time").expect("it runs");
    let text = String::from_utf8_lossy(&ended.stdout);
    assert!(ended.status.success() && text.contains("delivered"), "{text}");

    // It ends with its token.
    let (_, tokens, _) = muster(&cluster, &["token", "list", "--users", "-o", "name"]);
    assert_eq!(tokens.lines().count(), 3, "{tokens}");
    for token in tokens.lines() {
        let id = token.trim_start_matches("token/");
        assert_eq!(muster(&cluster, &["token", "delete", id]).0, 0);
    }
    let said = as_user(&vera, &["get", "tasks"]);
    assert!(said.0 == 7 && said.2.contains("taken back"), "{said:?}");
}
