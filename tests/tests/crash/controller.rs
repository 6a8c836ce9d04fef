//! The controller: its first start, what it stores, and what it writes down of who stored it.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::OpenOptions;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Output};

use http::Request;
use kube::Client;
use muster_api::phase::TaskPhase;
use muster_failpoint::{Failpoint, Moment, VARIABLE};
use muster_tests::cluster::binary;
use muster_tests::{AgentOptions, Cluster, wait};
use serde_json::{Value, json};

use crate::crash::{Crash, files, moments, nothing_half};

const MAPS: &str = "/api/v1/namespaces/default/configmaps";
const TASKS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/tasks";

/// One start after the other, each of which gets a step further on what the one before has left.
pub(crate) async fn first_start(points: &[Failpoint]) {
    for point in points {
        let mut cluster = Cluster::prepare(&[]);
        die_at(&mut cluster, *point).await;
        cluster.start_controller().await;
        nothing_half(cluster.dir()).await;
        cluster.join(AgentOptions::cloud("cloud").flag("--docker-socket", "none")).await;
        let secret = json!({
            "apiVersion": "v1", "kind": "Secret", "metadata": {"name": "s"}, "stringData": {"a": "b"},
        });
        cluster.post("/api/v1/namespaces/default/secrets", &secret).await;
        if *point == Failpoint::ServerPair {
            // The same while there is a pair that does not do any more.
            cluster.kill_controller();
            cluster.add_flag("--advertise", "127.0.0.1");
            cluster.add_flag("--advertise", "another.example");
            die_at(&mut cluster, *point).await;
        } else {
            cluster.kill_controller();
        }
        cluster.start_controller().await;
        nothing_half(cluster.dir()).await;
        let secret = cluster.get("/api/v1/namespaces/default/secrets/s").await;
        assert_eq!(secret["data"]["a"], "Yg==", "{point:?}");
        cluster.node_ready("cloud").await;
    }
}

async fn die_at(cluster: &mut Cluster, point: Failpoint) {
    for moment in moments(&[point]) {
        let crash = Crash::at(cluster, "controller", moment, 1);
        cluster.spawn_controller();
        crash.of_daemon(cluster).await;
    }
}

/// What a client was told.
#[derive(Debug, Default)]
struct Told {
    /// Path of an object, and its uid.
    acknowledged: BTreeMap<String, String>,
}

impl Told {
    /// Every creation has a line of its own.
    fn stand_once_in<'a>(&self, lines: impl IntoIterator<Item = &'a Value>) {
        let lines: Vec<&Value> = lines.into_iter().collect();
        for (path, uid) in &self.acknowledged {
            let of = |line: &&&Value| line["verb"] == "create" && line["uid"] == **uid;
            assert_eq!(lines.iter().filter(of).count(), 1, "{path} {uid}");
        }
    }
}

/// Creates objects one after the other, and tries each again until it is known to be there.
async fn write(client: &Client, round: usize, dir: &Path, told: &mut Told) {
    for n in 0..6 {
        let name = format!("r{round}-{n}");
        let map = json!({
            "apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": name}, "data": {"n": "1"},
        });
        let script = format!("echo $MUSTER_UID >> {}/ran", dir.display());
        let task = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Task", "metadata": {"name": name},
            "spec": {"run": {"process": {"command": ["sh", "-c", script]}}},
        });
        for (path, object) in [(MAPS, map), (TASKS, task)] {
            let body = serde_json::to_vec(&object).expect("JSON");
            let uid = wait::until("created", async || {
                let request = Request::post(path).header("content-type", "application/json");
                let request = request.body(body.clone()).expect("a request");
                match client.request::<Value>(request).await {
                    Ok(made) => Ok(made["metadata"]["uid"].as_str().map(str::to_owned)),
                    // Stored, and the answer was lost with the controller.
                    Err(kube::Error::Api(status)) if status.code == 409 => Ok(None),
                    Err(error) => Err(error.to_string()),
                }
            })
            .await;
            if let Some(uid) = uid {
                told.acknowledged.insert(format!("{path}/{name}"), uid);
            }
        }
    }
}

/// Writes, while the controller dies at each of these and is started again.
async fn written(cluster: &mut Cluster, crashes: &[(Moment, u32)]) -> Told {
    let (mut told, dir) = (Told::default(), cluster.dir().to_owned());
    cluster.join(AgentOptions::cloud("cloud").flag("--docker-socket", "none")).await;
    for (round, (moment, nth)) in crashes.iter().enumerate() {
        let crash = Crash::at(cluster, "controller", *moment, *nth);
        cluster.kill_controller();
        cluster.spawn_controller();
        let client = cluster.client().await;
        let nurse = async {
            crash.of_daemon(cluster).await;
            cluster.start_controller().await;
        };
        tokio::join!(write(&client, round, &dir, &mut told), nurse);
    }
    told
}

pub(crate) async fn commits(points: &[Failpoint]) {
    let mut cluster = Cluster::prepare(&[]);
    // What it stores by itself, at its first start.
    for point in points {
        die_at(&mut cluster, *point).await;
    }
    cluster.start_controller().await;
    let crashes: Vec<(Moment, u32)> =
        moments(points).into_iter().flat_map(|moment| [1, 4, 9].map(|nth| (moment, nth))).collect();
    let told = written(&mut cluster, &crashes).await;
    for (path, uid) in &told.acknowledged {
        let object = cluster.get(path).await;
        assert_eq!(object["metadata"]["uid"].as_str(), Some(&**uid), "{path}");
    }
    let mut uids = Vec::new();
    for round in 0..crashes.len() {
        for n in 0..6 {
            let task = cluster.phase(&format!("r{round}-{n}"), TaskPhase::Succeeded).await;
            assert_eq!(task.status.expect("set").attempt, 1);
            uids.extend(task.metadata.uid);
        }
    }
    let ran = std::fs::read_to_string(cluster.dir().join("ran")).expect("they ran");
    let mut ran: Vec<&str> = ran.lines().collect();
    ran.sort_unstable();
    uids.sort_unstable();
    assert_eq!(ran, uids, "each ran once");
}

pub(crate) async fn audit_lines(points: &[Failpoint]) {
    let mut cluster = Cluster::start().await;
    let crashes: Vec<(Moment, u32)> =
        moments(points).into_iter().flat_map(|moment| [1, 3].map(|nth| (moment, nth))).collect();
    let told = written(&mut cluster, &crashes).await;
    assert!(told.acknowledged.len() >= crashes.len() * 10, "{told:?}");
    told.stand_once_in(&lines(&cluster.dir().join("controller/audit/audit.jsonl")));
}

fn lines(log: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(log).expect("it is written");
    text.lines().map(|line| serde_json::from_str(line).expect("a whole line")).collect()
}

/// The present file is full at each of these. What stood in it stays, and is not pushed further than it must.
pub(crate) async fn audit_rotation(points: &[Failpoint]) {
    const FULL: usize = 64 << 20;
    let mut cluster = Cluster::start().await;
    let (mut told, dir) = (Told::default(), cluster.dir().join("controller/audit"));
    let moments = moments(points);
    for (round, moment) in moments.iter().enumerate() {
        let crash = Crash::at(&mut cluster, "controller", *moment, 1);
        cluster.kill_controller();
        std::fs::create_dir_all(&dir).expect("it is ours");
        let mut log = OpenOptions::new()
            .append(true)
            .create(true)
            .open(dir.join("audit.jsonl"))
            .expect("it is there");
        writeln!(log, "{}", json!({"round": round, "fills": "x".repeat(FULL)}))
            .expect("there is room");
        drop(log);
        cluster.spawn_controller();
        let (client, place) = (cluster.client().await, cluster.dir().to_owned());
        let nurse = async {
            crash.of_daemon(&mut cluster).await;
            cluster.start_controller().await;
        };
        tokio::join!(write(&client, round, &place, &mut told), nurse);
    }
    // The newest one first.
    let mut names = vec!["audit.jsonl".to_owned()];
    names.extend((1..=moments.len()).map(|number| format!("audit.jsonl.{number}")));
    let lines = names.iter().map(|name| lines(&dir.join(name)));
    let lines: Vec<Vec<Value>> = lines.collect();
    for (round, lines) in lines[1..].iter().rev().enumerate() {
        let rounds: Vec<&Value> = lines.iter().filter_map(|line| line.get("round")).collect();
        assert_eq!(rounds, [round]);
    }
    assert_eq!(
        files(&dir).iter().filter(|path| path.to_string_lossy().contains("audit.jsonl")).count(),
        names.len()
    );
    told.stand_once_in(lines.iter().flatten());
}

/// A newer key in front of the one that a Secret was sealed with.
pub(crate) async fn reseal(points: &[Failpoint]) {
    let mut cluster = Cluster::start().await;
    let secret = json!({
        "apiVersion": "v1", "kind": "Secret", "metadata": {"name": "s"}, "stringData": {"a": "b"},
    });
    cluster.post("/api/v1/namespaces/default/secrets", &secret).await;
    cluster.kill_controller();
    let keys = cluster.dir().join("controller/encryption.key");
    let old = std::fs::read_to_string(&keys).expect("it is made");
    let new = "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=\n";
    std::fs::write(&keys, format!("{new}{old}")).expect("it is ours");
    for moment in moments(points) {
        let crash = Crash::at(&mut cluster, "controller", moment, 1);
        cluster.spawn_controller();
        crash.of_daemon(&mut cluster).await;
    }
    cluster.start_controller().await;
    cluster.kill_controller();
    // Nothing needs the old key any more, and nothing that it opens is left.
    std::fs::write(&keys, new).expect("it is ours");
    cluster.start_controller().await;
    let secret = cluster.get("/api/v1/namespaces/default/secrets/s").await;
    assert_eq!(secret["data"]["a"], "Yg==");
    let sealed = sealed(&cluster.dir().join("controller"));
    assert_eq!(sealed.len(), 1, "{sealed:?}");
}

/// The ids of keys in the store's files.
fn sealed(data: &Path) -> BTreeSet<String> {
    let mut ids = BTreeSet::new();
    for file in files(data).into_iter().filter(|path| path.is_file()) {
        let text = std::fs::read(&file).expect("it is ours");
        let text = String::from_utf8_lossy(&text).into_owned();
        ids.extend(
            text.split("sealed:v1:").skip(1).filter_map(|rest| Some(rest.get(..16)?.to_owned())),
        );
    }
    ids
}

pub(crate) async fn compaction(points: &[Failpoint]) {
    for moment in moments(points) {
        let dir = tempfile::TempDir::with_prefix("muster-test-").expect("a temporary directory");
        let (store, died) = (dir.path().join("store.db"), dir.path().join("died"));
        let writer = |target: Option<String>| -> Output {
            let mut command = Command::new(binary("store-writer"));
            command.arg(&store).envs(target.map(|target| (VARIABLE, target)));
            command.output().expect("it starts")
        };
        let before = writer(Some(format!("{moment}:1:{}", died.display())));
        assert!(died.exists() && before.status.code().is_none(), "{moment}: {before:?}");
        let after = writer(None);
        assert!(after.status.success(), "{moment}: {after:?}");
        assert_eq!(newest(&after, "has"), newest(&before, "put"), "{moment}");
        assert!(!newest(&before, "put").is_empty());
    }
}

/// The newest revision of each object of which the store said so.
fn newest(output: &Output, word: &str) -> BTreeMap<String, u64> {
    let text = String::from_utf8_lossy(&output.stdout);
    let lines = text.lines().filter_map(|line| line.strip_prefix(word)?.trim().split_once(' '));
    lines.map(|(name, revision)| (name.to_owned(), revision.parse().expect("a number"))).collect()
}
