//! The golden script: `$ command` lines, each with what it prints (standard output, then standard error) and, when it is
//! not 0, its exit code. `$1.27 command` needs a kubectl of that version; of older ones than 1.30 only success and failure
//! are compared, because their words differ. A command that only looks is given again for a while until it is right: other
//! tasks write what it shows.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use muster_tests::{AgentOptions, Cluster};
use serde_json::Value;

use crate::redact::redact;

/// What another task writes may come some moments after what was waited for.
const PATIENCE: Duration = Duration::from_secs(30);
/// Between two looks.
const LOOK: Duration = Duration::from_millis(500);

/// Verbs that only look.
const LOOKS: [&str; 5] = ["get", "describe", "logs", "top", "events"];

struct Step {
    since: u64,
    command: String,
    expected: String,
}

fn here() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/kubectl")
}

fn read(text: &str) -> Vec<Step> {
    let mut steps: Vec<Step> = Vec::new();
    for line in text.lines() {
        if let Some(rest) = line.strip_prefix('$')
            && let Some((since, command)) = rest.split_once(' ')
        {
            let since = since.strip_prefix("1.").and_then(|minor| minor.parse().ok()).unwrap_or(0);
            steps.push(Step { since, command: command.to_owned(), expected: String::new() });
        } else if let Some(step) = steps.last_mut() {
            step.expected.push_str(line);
            step.expected.push('\n');
        }
    }
    steps
}

/// The minor version of the kubectl in the PATH.
fn kubectl() -> u64 {
    let output = Command::new("kubectl").args(["version", "--client", "-o", "json"]).output();
    let output = output.expect("kubectl is installed (tests/run does)");
    let version: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let minor = version["clientVersion"]["minor"].as_str().unwrap_or_default();
    minor.trim_end_matches('+').parse().expect("a number")
}

/// The command changes nothing, and ends by itself: the same one later is the same question.
fn only_looks(command: &str) -> bool {
    let looks = |call: &str| {
        let call = call.strip_prefix("-n lab ").unwrap_or(call);
        LOOKS.contains(&call.split(' ').next().unwrap_or_default())
    };
    // Every kubectl of a pipe counts.
    let mut calls = command.split("kubectl ").skip(1).peekable();
    let follows = command.contains(" -w") || command.contains("timeout ");
    calls.peek().is_some() && calls.all(looks) && !follows
}

fn run(command: &str, dir: &Path, cluster: &Cluster) -> (bool, String) {
    let output = Command::new("sh")
        .args(["-c", command])
        .current_dir(dir)
        .env("KUBECONFIG", cluster.kubeconfig())
        // Its cache of discovery is by server, and servers of tests come and go.
        .env("HOME", dir)
        .env_remove("EDITOR")
        .output()
        .expect("a shell");
    let mut text = String::from_utf8_lossy(&output.stdout).into_owned();
    text.push_str(&String::from_utf8_lossy(&output.stderr));
    let mut text = redact(&text, &dir.display().to_string());
    match output.status.code() {
        Some(0) => {}
        code => write!(text, "\nexit {}", code.unwrap_or(-1)).expect("a String"),
    }
    // kubectl pads lines; what is kept in a file does not.
    let lines: Vec<&str> = text.lines().map(str::trim_end).collect();
    (output.status.success(), lines.join("\n").trim_matches('\n').to_owned())
}

/// The kubeconfig of somebody who may do next to nothing: the agent of a node.
fn of_node(cluster: &Cluster, node: &str) -> String {
    let admins = std::fs::read_to_string(cluster.kubeconfig()).expect("the admin's");
    let file = |name: &str| cluster.dir().join(node).join("pki").join(name).display().to_string();
    let mut config = String::new();
    for line in admins.lines() {
        let key = line.split(':').next().unwrap_or_default();
        let own = match key.trim() {
            "client-certificate-data" => file("node.crt"),
            "client-key-data" => file("node.key"),
            _ => {
                writeln!(config, "{line}").expect("a String");
                continue;
            }
        };
        writeln!(config, "{}: {own}", key.replace("-data", "")).expect("a String");
    }
    config
}

#[tokio::test(flavor = "multi_thread")]
async fn stock_kubectl_says_what_the_script_says() {
    let mut cluster = Cluster::start().await;
    let size = |options: AgentOptions| options.flag("--cpu", "2").flag("--memory", "4Gi");
    cluster.join(size(AgentOptions::robot("robot-1", 1.0, 2.0))).await;
    cluster.join(size(AgentOptions::cloud("cloud-1"))).await;
    let dir = cluster.dir().join("kubectl");
    std::fs::create_dir(&dir).expect("a directory of the test's own");
    for file in std::fs::read_dir(here().join("files")).expect("the manifests") {
        let file = file.expect("a file").path();
        std::fs::copy(&file, dir.join(file.file_name().expect("a name"))).expect("a copy");
    }
    std::fs::write(dir.join("node.kubeconfig"), of_node(&cluster, "cloud-1"))
        .expect("the test's own");
    let path = here().join("session.txt");
    let text = std::fs::read_to_string(&path).expect("the script");
    let (minor, writes) = (kubectl(), std::env::var("MUSTER_GOLDEN").is_ok_and(|v| v == "write"));
    let (mut written, mut wrong) = (String::new(), String::new());
    for step in read(&text) {
        let since = if step.since == 0 { String::new() } else { format!("1.{}", step.since) };
        writeln!(written, "${since} {}", step.command).expect("a String");
        if step.since > minor {
            continue;
        }
        // Before 1.27 kubectl reads only OpenAPI v2 and validates by it.
        let says = |word: &&str| step.command.contains(&format!(" {word} "));
        let sends = ["apply", "create", "replace"].iter().any(says) && !says(&"auth");
        let old = minor < 27 && sends;
        let command = match old {
            true => format!("{} --validate=false", step.command),
            false => step.command.clone(),
        };
        let lines: Vec<&str> = step.expected.lines().map(str::trim_end).collect();
        let expected = lines.join("\n");
        let expected = expected.trim_end();
        let fails = expected.lines().last().is_some_and(|line| line.starts_with("exit "));
        let right = |passed: bool, said: &str| {
            if minor < 30 { passed != fails } else { said == expected }
        };
        // What follows from a step that is wrong is not waited for.
        let again = only_looks(&command) && !writes && wrong.is_empty();
        let begun = Instant::now();
        let (mut passed, mut said) = run(&command, &dir, &cluster);
        while again && !right(passed, &said) && begun.elapsed() < PATIENCE {
            tokio::time::sleep(LOOK).await;
            (passed, said) = run(&command, &dir, &cluster);
        }
        writeln!(written, "{said}\n").expect("a String");
        if !right(passed, &said) {
            writeln!(wrong, "$ {command}\n--- expected\n{expected}\n--- said\n{said}")
                .expect("a String");
        }
    }
    // Whoever reads a failure wants what differs, not the logs after it.
    drop(cluster);
    if writes {
        std::fs::write(&path, written).expect("the script is ours");
    } else {
        assert!(wrong.is_empty(), "{wrong}");
    }
}
