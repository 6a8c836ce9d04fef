//! Stock kubectl with a user's token.

use std::path::Path;
use std::process::Command;

use muster_tests::Cluster;
use muster_tests::cluster::binary;

fn kubectl(config: &Path, args: &[&str]) -> (i32, String) {
    let run = Command::new("kubectl").arg("--kubeconfig").arg(config).args(args).output();
    let run = run.expect("kubectl is installed (tests/run does)");
    let said = [run.stdout, run.stderr].concat();
    let said = String::from_utf8_lossy(&said).trim().to_owned();
    (run.status.code().expect("it was not killed"), said)
}

#[tokio::test(flavor = "multi_thread")]
async fn kubectl_with_a_token_may_what_the_role_says() {
    let cluster = Cluster::start().await;
    let access = cluster.dir().join("access.yaml");
    let text = "apiVersion: muster.dev/v1alpha1\nkind: Access\nmetadata: {name: ada}\nspec: {role: developer, namespaces: [default], subjects: [{name: ada}]}\n";
    std::fs::write(&access, text).expect("the directory is there");
    let admin = cluster.kubeconfig();
    let applied = kubectl(&admin, &["apply", "-f", access.to_str().expect("text")]);
    assert_eq!(applied, (0, "access.muster.dev/ada created".to_owned()));
    let made = Command::new(binary("muster"))
        .args(["token", "create", "--user", "ada", "--as-kubeconfig"])
        .env("MUSTER_CONFIG", &admin)
        .output()
        .expect("muster starts");
    let config = cluster.dir().join("ada.config");
    std::fs::write(&config, made.stdout).expect("the directory is there");
    for (line, expected) in [
        (&["auth", "can-i", "create", "tasks.muster.dev"][..], "yes"),
        (&["auth", "can-i", "create", "pods/exec"], "yes"),
        (&["auth", "can-i", "create", "tasks.muster.dev", "-n", "hall"], "no"),
        (&["auth", "can-i", "delete", "nodes.muster.dev"], "no"),
    ] {
        let (_, said) = kubectl(&config, line);
        assert!(
            said.lines().any(|said| said.split(' ').next() == Some(expected)),
            "{line:?}: {said}"
        );
    }
    let (code, said) = kubectl(&config, &["auth", "can-i", "--list"]);
    assert!(code == 0 && said.contains("tasks.muster.dev"), "{said}");
    let (code, said) = kubectl(&config, &["get", "tasks"]);
    assert_eq!((code, said.as_str()), (0, "No resources found in default namespace."));
    let (code, said) = kubectl(&config, &["get", "accesses"]);
    assert!(code != 0 && said.contains("User \"ada\" cannot list resource \"accesses\""), "{said}");
    let (_, said) = kubectl(&admin, &["auth", "can-i", "*", "*"]);
    assert_eq!(said.lines().last(), Some("yes"));
}
