//! Programs that clients run in tasks: their streams, their ends, and what becomes of them when their task or their client
//! is gone.

use std::io::{Read as _, Write as _};
use std::process::{Child, Command, Stdio};

use futures::SinkExt as _;
use k8s_openapi::api::core::v1::Pod;
use kube::Api;
use kube::api::{AttachParams, TerminalSize};
use muster_api::phase::TaskPhase;
use muster_tests::cluster::binary;
use muster_tests::kernel::{self, Process};
use muster_tests::{AgentOptions, Cluster, docker, wait};
use serde_json::json;
use tokio::io::AsyncReadExt as _;

use crate::cli::muster;

/// A mebibyte that is not the same everywhere.
fn mebibyte() -> Vec<u8> {
    (0..1_u32 << 18).flat_map(|n| n.wrapping_mul(2_654_435_761).to_le_bytes()).collect()
}

fn start(cluster: &Cluster, args: &[&str]) -> Child {
    Command::new(binary("muster"))
        .args(args)
        .env("MUSTER_CONFIG", cluster.kubeconfig())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("muster starts")
}

/// Sends a mebibyte through `cat` in the task and back, both at once; its end comes by the end of the input.
fn echoes(cluster: &Cluster, task: &str) {
    let mut child = start(cluster, &["exec", "-i", task, "--", "cat"]);
    let (mut stdin, mut stdout) =
        (child.stdin.take().expect("piped"), child.stdout.take().expect("piped"));
    let sent = mebibyte();
    let sends = std::thread::spawn(move || stdin.write_all(&mebibyte()).expect("it is read"));
    let mut came = Vec::new();
    stdout.read_to_end(&mut came).expect("it is there");
    sends.join().expect("all was sent");
    assert!(came == sent, "{} of {} bytes came back, or others", came.len(), sent.len());
    assert!(child.wait().expect("it is ours").success());
}

/// The processes whose arguments hold this word, those that pass it on not counted.
fn running(word: &str) -> Vec<Process> {
    let all = kernel::with_command(word).into_iter();
    let own = |pid: &u32| {
        let text = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        text.starts_with(b"sleep\0")
    };
    all.filter(own)
        .map(|pid| Process { pid, start: kernel::start_time(pid).unwrap_or(0) })
        .collect()
}

async fn gone(word: &str) {
    wait::until("gone", || async {
        match running(word) {
            left if left.is_empty() => Ok(()),
            left => Err(format!("{left:?}")),
        }
    })
    .await;
}

async fn there(word: &str) {
    wait::until("there", || async {
        match running(word).is_empty() {
            false => Ok(()),
            true => Err("not yet".to_owned()),
        }
    })
    .await;
}

/// What holds in every task.
async fn is_entered(cluster: &Cluster, task: &str) {
    let command = ["exec", task, "--", "sh", "-c", "echo out; echo err >&2; exit 7"];
    let (code, out, err) = muster(cluster, &command);
    assert_eq!((code, out.as_str(), err.as_str()), (7, "out\n", "err\n"));
    let (code, out, _) = muster(cluster, &["exec", task, "--", "sh", "-c", "kill -9 $$"]);
    assert_eq!((code, out.as_str()), (137, ""));
    let (_, out, err) = muster(cluster, &["exec", task, "--", "sh", "-c", "echo $GIVEN; cat"]);
    assert_eq!(out, "a value\n", "its variables, and the end of input at once: {err}");
    let (code, out, err) = muster(cluster, &["exec", task, "--", "no-such-program"]);
    assert_ne!(code, 0);
    // An engine says it in the program's place.
    assert!(format!("{out}{err}").contains("no-such-program"), "{out} {err}");
    echoes(cluster, task);

    let pods: Api<Pod> = Api::namespaced(cluster.client().await, "default");
    let terminal = AttachParams::interactive_tty();
    let script = "until test \"$(stty size)\" = '43 132'; do sleep 0.1; done; read go && test -t 1 && echo a terminal";
    let mut shell = pods.exec(task, ["sh", "-c", script], &terminal).await.expect("it begins");
    let mut sizes = shell.terminal_size().expect("a terminal has one");
    sizes.send(TerminalSize { width: 132, height: 43 }).await.expect("it is taken");
    let mut stdin = shell.stdin().expect("asked for");
    tokio::io::AsyncWriteExt::write_all(&mut stdin, b"go\n").await.expect("it is taken");
    let mut text = String::new();
    let mut stdout = shell.stdout().expect("asked for");
    let reads = tokio::time::timeout(wait::DEADLINE, stdout.read_to_string(&mut text));
    reads.await.expect("it learns its size").expect("text");
    assert!(text.contains("a terminal"), "{text:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_program_runs_in_a_process_task_as_the_task_does() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud").flag("--docker-socket", "none")).await;
    let run = json!({"process": {"command": ["sleep", "1000"], "env": [{"name": "GIVEN", "value": "a value"}]}});
    let spec = json!({"run": run, "resources": {"cpu": "200m"}, "gracePeriodSeconds": 0});
    cluster.create("t", spec).await;
    let task = cluster.phase("t", TaskPhase::Running).await;
    is_entered(&cluster, "t").await;

    // Its group is the task's: so are its limits.
    let uid = task.metadata.uid.expect("a uid");
    let own = kernel::with_env("MUSTER_UID", &uid);
    let group = std::fs::read_to_string(format!("/proc/{}/cgroup", own[0].pid)).expect("it runs");
    let (_, theirs, _) = muster(&cluster, &["exec", "t", "--", "cat", "/proc/self/cgroup"]);
    assert_eq!(theirs, group);
    let (_, theirs, _) = muster(&cluster, &["exec", "t", "--", "pwd"]);
    let work = std::fs::read_link(format!("/proc/{}/cwd", own[0].pid)).expect("it runs");
    assert_eq!(theirs.trim(), work.to_str().expect("text"));
    let events = cluster.get("/api/v1/namespaces/default/events").await;
    let told =
        events["items"].as_array().into_iter().flatten().any(|event| {
            event["reason"] == "Exec" && event["message"] == "admin runs \"cat\" in it"
        });
    assert!(told, "{events:#}");

    // A client that does not read holds up nobody else; when it is gone, so is its program, all of it.
    let mut slow = start(&cluster, &["exec", "t", "--", "sh", "-c", "sleep 4011 & yes"]);
    there("4011").await;
    echoes(&cluster, "t");
    slow.kill().expect("it is ours");
    slow.wait().expect("it is ours");
    gone("4011").await;
    // The same of one that writes what nobody reads.
    let mut pushes = start(&cluster, &["exec", "-i", "t", "--", "sleep", "4012"]);
    let mut stdin = pushes.stdin.take().expect("piped");
    let full = std::thread::spawn(move || while stdin.write_all(&[0; 65536]).is_ok() {});
    there("4012").await;
    pushes.kill().expect("it is ours");
    pushes.wait().expect("it is ours");
    full.join().expect("it ended");
    gone("4012").await;

    // With the task goes what runs in it.
    let last = start(&cluster, &["exec", "t", "--", "sleep", "4013"]);
    there("4013").await;
    cluster.delete("t").await;
    assert!(running("4013").is_empty(), "what is gone has no processes");
    let output = last.wait_with_output().expect("it is ours");
    // By SIGTERM or by SIGKILL, whichever came first.
    assert!(matches!(output.status.code(), Some(137 | 143)), "{output:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_program_runs_in_a_container_task() {
    docker::image();
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud")).await;
    let container = json!({
        "image": docker::IMAGE, "command": ["sh", "-c", "while :; do echo tick; sleep 0.1; done"],
        "env": [{"name": "GIVEN", "value": "a value"}], "network": "None", "pullPolicy": "Never",
    });
    cluster.create("t", json!({"run": {"container": container}, "gracePeriodSeconds": 0})).await;
    cluster.phase("t", TaskPhase::Running).await;
    is_entered(&cluster, "t").await;

    let pods: Api<Pod> = Api::namespaced(cluster.client().await, "default");
    let mut attached =
        pods.attach("t", &AttachParams::default().stderr(false)).await.expect("it begins");
    let mut line = [0; 5];
    attached.stdout().expect("asked for").read_exact(&mut line).await.expect("it writes");
    assert_eq!(&line, b"tick\n");
    drop(attached);

    let mut leaves = start(&cluster, &["exec", "t", "--", "sh", "-c", "sleep 4021 & sleep 4022"]);
    there("4022").await;
    leaves.kill().expect("it is ours");
    leaves.wait().expect("it is ours");
    gone("4021").await;
    gone("4022").await;
    let last = start(&cluster, &["exec", "t", "--", "sleep", "4023"]);
    there("4023").await;
    cluster.delete("t").await;
    assert!(running("4023").is_empty(), "what is gone has no processes");
    let output = last.wait_with_output().expect("it is ours");
    // By SIGTERM or by SIGKILL, whichever came first.
    assert!(matches!(output.status.code(), Some(137 | 143)), "{output:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_entered_says_why() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud").flag("--docker-socket", "none")).await;
    let refused = |task: &str, words: &[&str]| {
        let (code, _, err) = muster(&cluster, &["exec", task, "--", "true"]);
        assert!(words.iter().all(|word| err.contains(word)), "{code}: {err}");
        code
    };
    assert_eq!(refused("none", &["\"none\" not found"]), 3);
    cluster.create("over", json!({"run": {"process": {"command": ["true"]}}})).await;
    cluster.phase("over", TaskPhase::Succeeded).await;
    assert_eq!(refused("over", &["it is Succeeded"]), 5);
    let nowhere =
        json!({"run": {"process": {"command": ["true"]}}, "placement": {"node": "nobody"}});
    cluster.create("waits", nowhere).await;
    assert_eq!(refused("waits", &["it is Pending"]), 5);

    cluster.create("t", json!({"run": {"process": {"command": ["sh", "-c", "while :; do echo tick; sleep 0.1; done"]}}, "gracePeriodSeconds": 0})).await;
    cluster.phase("t", TaskPhase::Running).await;
    let pods: Api<Pod> = Api::namespaced(cluster.client().await, "default");
    let params = AttachParams::default().stderr(false);
    let mut attached = pods.attach("t", &params).await.expect("it begins");
    let mut line = [0; 5];
    attached.stdout().expect("asked for").read_exact(&mut line).await.expect("it writes");
    assert_eq!(&line, b"tick\n");
    let writes = pods.attach("t", &AttachParams::interactive_tty().tty(false)).await;
    let said = writes.err().map(|error| error.to_string()).unwrap_or_default();
    assert!(said.contains("no standard input"), "{said}");

    // So many at once, and no more; there is room again when one has ended.
    let mut all = Vec::new();
    for n in 1..=31_usize {
        all.push(start(&cluster, &["exec", "t", "--", "sleep", "4031"]));
        if n.is_multiple_of(4) || n == 31 {
            // A machine of two cores is not to be asked for more handshakes at once than it makes in time.
            wait::until("so many", || async {
                match running("4031").len() {
                    m if m == n => Ok(()),
                    m => Err(format!("{m} of {n}")),
                }
            })
            .await;
        }
    }
    // 31 programs, and the one that is attached.
    let (code, _, err) = muster(&cluster, &["exec", "t", "--", "true"]);
    assert!(code != 0 && err.contains("clients run 32 programs"), "{code}: {err}");
    for child in &mut all {
        child.kill().expect("it is ours");
        child.wait().expect("it is ours");
    }
    wait::until("room", || async {
        match muster(&cluster, &["exec", "t", "--", "true"]) {
            (0, _, _) => Ok(()),
            (_, _, err) => Err(err),
        }
    })
    .await;
    drop(attached);
    cluster.kill_agent("cloud");
    wait::until("out of reach", || async {
        match muster(&cluster, &["exec", "t", "--", "true"]) {
            (_, _, err) if err.contains("Unknown") || err.contains("cannot be reached") => Ok(()),
            (code, _, err) => Err(format!("{code}: {err}")),
        }
    })
    .await;
}
