//! The stock Python client, and schemathesis, which reads the OpenAPI documents and sends what they allow and what they
//! do not.

use std::path::{Path, PathBuf};
use std::process::Command;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use kube::config::Kubeconfig;
use muster_tests::{AgentOptions, Cluster};

/// The newest client, and the oldest that is tried.
const NEW: &str = "python";
const OLD: &str = "python-30";

fn program(environment: &str, name: &str) -> PathBuf {
    let target = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target");
    let python = target.join(environment).join("bin").join(name);
    assert!(python.exists(), "{} is missing; tests/run makes it", python.display());
    python
}

fn run(command: &mut Command) -> String {
    let output = command.output().expect("it starts");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}\n{errors}");
    text
}

#[tokio::test(flavor = "multi_thread")]
async fn the_python_client_is_a_client() {
    works_with(NEW).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_older_python_client_is_a_client() {
    works_with(OLD).await;
}

async fn works_with(environment: &str) {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud-1")).await;
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/stock.py");
    let mut command = Command::new(program(environment, "python"));
    let said = run(command.arg(script).env("KUBECONFIG", cluster.kubeconfig()));
    assert_eq!(said, "custom_objects\ndynamic_client\ncore\nprograms\nwatch_goes_on\n");
}

/// Nothing that is sent is answered by a 5xx, and the controller is there afterwards.
#[tokio::test(flavor = "multi_thread")]
async fn no_request_that_the_documents_suggest_is_a_fault() {
    let cluster = Cluster::start().await;
    let config = Kubeconfig::read_from(cluster.kubeconfig()).expect("the admin's");
    let config = serde_json::to_value(config).expect("YAML is JSON");
    let file = |pointer: &str| {
        let data = config.pointer(pointer).and_then(|data| data.as_str()).expect("inline");
        let path = cluster.dir().join(pointer.rsplit('/').next().expect("a name"));
        std::fs::write(&path, STANDARD.decode(data).expect("base64")).expect("our own file");
        path
    };
    let ca = file("/clusters/0/cluster/certificate-authority-data");
    let certificate = file("/users/0/user/client-certificate-data");
    let key = file("/users/0/user/client-key-data");
    let hooks = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/hooks.py");
    for group in [
        "apis/muster.dev/v1alpha1",
        "api/v1",
        "apis/authentication.k8s.io/v1",
        "apis/authorization.k8s.io/v1",
        "apis/metrics.k8s.io/v1beta1",
    ] {
        let url = format!("https://{}/openapi/v3/{group}", cluster.address());
        let mut command = Command::new(program(NEW, "schemathesis"));
        command
            .current_dir(cluster.dir())
            .args(["run", &url, "--url", &format!("https://{}", cluster.address())])
            .args(["--checks", "not_a_server_error", "--phases", "fuzzing"])
            .args([
                "--max-examples",
                "5",
                "--seed",
                "1",
                "--request-timeout",
                "20",
                // One thread: what it makes of patterns keeps Python's lock for longer than a handshake may take.
                "--workers",
                "1",
            ])
            .args(["--generation-database", "none", "--suppress-health-check", "all"])
            // What follows is asked to end.
            .env("SCHEMATHESIS_HOOKS", &hooks)
            .arg("--tls-verify")
            .arg(&ca)
            .arg("--request-cert")
            .arg(&certificate)
            .arg("--request-cert-key")
            .arg(&key);
        run(&mut command);
    }
    cluster.get("/version").await;
}
