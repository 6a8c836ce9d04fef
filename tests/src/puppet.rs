//! Frameworks for tests: `tests/frameworks/puppet.py` on the Python SDK, one process a framework; and its executor,
//! `worker.py`.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::Stdio;

use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader, Lines};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};

use crate::Cluster;
use crate::wait::DEADLINE;

/// The Python that has the SDK: `tests/run` makes it.
///
/// # Panics
///
/// When it is not there.
#[must_use]
pub fn python() -> PathBuf {
    let python = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../target/python/bin/python"));
    assert!(python.exists(), "{} is missing; tests/run makes it", python.display());
    python
}

/// A running framework.
#[derive(Debug)]
pub struct Puppet {
    name: String,
    child: Child,
    stdin: ChildStdin,
    lines: Lines<BufReader<ChildStdout>>,
    /// What it holds, as it last said.
    pub holding: BTreeMap<String, Value>,
    /// The newest state of each of its tasks, by name.
    pub states: BTreeMap<String, String>,
    /// Its id.
    pub id: String,
}

impl Puppet {
    /// Starts a framework and waits until it is registered. `info` is `{"name": …}` with what puppet.py knows.
    pub async fn start(cluster: &Cluster, info: Value) -> Puppet {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/frameworks/puppet.py");
        let name = info["name"].as_str().unwrap_or_default().to_owned();
        let mut child = Command::new(python())
            .arg(script)
            .arg(info.to_string())
            .arg(cluster.kubeconfig())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .expect("python runs");
        let stdin = child.stdin.take().expect("it is piped");
        let lines = BufReader::new(child.stdout.take().expect("it is piped")).lines();
        let (holding, states) = (BTreeMap::new(), BTreeMap::new());
        let mut puppet = Puppet { name, child, stdin, lines, holding, states, id: String::new() };
        puppet
            .event("registered", |e| e["event"] == "registered" || e["event"] == "reregistered")
            .await;
        puppet
    }

    /// Its process.
    #[must_use]
    pub fn pid(&self) -> u32 {
        self.child.id().expect("it runs")
    }

    /// Has it do something.
    pub async fn order(&mut self, order: Value) {
        let line = format!("{order}\n");
        self.stdin.write_all(line.as_bytes()).await.expect("it listens");
    }

    /// Has it launch tasks, `(node, name, spec)` each, in one call; what came of it.
    pub async fn launch(&mut self, tasks: &[(&str, &str, Value)]) -> Value {
        let tasks: Vec<Value> = tasks
            .iter()
            .map(|(node, name, spec)| json!({"node": node, "name": name, "spec": spec}))
            .collect();
        self.order(json!({"do": "launch", "tasks": tasks})).await;
        self.event("an answer", |e| e["event"] == "launched" || e["event"] == "refused").await
    }

    /// The next event that `wanted` takes; what it says of offers and tasks on the way is kept.
    pub async fn event(&mut self, what: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        let mut seen = Vec::new();
        let waited = tokio::time::timeout(DEADLINE, async {
            loop {
                let line = self.lines.next_line().await.expect("it can be read");
                let line = line.unwrap_or_else(|| panic!("{} ended; it said {seen:#?}", self.name));
                let event: Value = serde_json::from_str(&line).expect("a JSON line");
                self.take_in(&event);
                if wanted(&event) {
                    return event;
                }
                seen.push(line);
            }
        });
        let waited = waited.await;
        waited.unwrap_or_else(|_| panic!("{}: no {what} within {DEADLINE:?}", self.name))
    }

    fn take_in(&mut self, event: &Value) {
        let text = |field: &str| event[field].as_str().unwrap_or_default().to_owned();
        match event["event"].as_str() {
            Some("registered") => self.id = text("id"),
            Some("holding") => {
                let offers = event["offers"].as_object().into_iter().flatten();
                self.holding = offers.map(|(node, offer)| (node.clone(), offer.clone())).collect();
            }
            Some("update") => drop(self.states.insert(text("name"), text("state"))),
            _ => {}
        }
    }

    /// Waits until it holds offers that `wanted` takes.
    pub async fn holds(&mut self, what: &str, wanted: impl Fn(&BTreeMap<String, Value>) -> bool) {
        while !wanted(&self.holding) {
            let what = format!("{what}; it holds {:#?}", self.holding);
            self.event(&what, |e| e["event"] == "holding").await;
        }
    }

    /// Waits until it was told that a task is in a state.
    pub async fn hears(&mut self, task: &str, state: &str) {
        while self.states.get(task).is_none_or(|s| s != state) {
            let what = format!("{task} {state}; it heard {:?}", self.states);
            self.event(&what, |e| e["event"] == "update").await;
        }
    }

    /// Kills it with SIGKILL.
    pub async fn kill(&mut self) {
        self.child.kill().await.expect("it runs");
    }
}
