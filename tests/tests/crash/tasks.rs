//! A task that drives, with values and a file of a Secret, from its creation until nothing of it is left.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use kube::Api;
use muster_api::kind::lease::Lease;
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_failpoint::{Failpoint, Moment, Step, VARIABLE};
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::{Value, json};

use crate::crash::{Crash, directories, files, moments, nothing_half};

/// What the Secret says.
const PASSWORD: &str = "hunter2";

/// How the task comes to its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    /// Its program ends by itself.
    Exit,
    /// It is deleted while it runs.
    Order,
    /// Its shim is killed, and its next attempt ends by itself.
    LostShim,
}

/// At each write of a task's record, as far as every task has so many.
pub(crate) async fn records(points: &[Failpoint]) {
    let mut robot = Robot::join().await;
    for moment in moments(points) {
        robot.crash(moment, 1, End::Exit).await;
    }
    for nth in 2..=4 {
        for step in [Step::Written, Step::After] {
            robot.crash(Moment(Failpoint::TaskRecord, step), nth, End::Exit).await;
        }
    }
    robot.nothing_left().await;
}

pub(crate) async fn to_its_end(points: &[Failpoint]) {
    all(points, End::Exit).await;
}

pub(crate) async fn stopped(points: &[Failpoint]) {
    all(points, End::Order).await;
}

pub(crate) async fn shim_lost(points: &[Failpoint]) {
    all(points, End::LostShim).await;
}

async fn all(points: &[Failpoint], end: End) {
    let mut robot = Robot::join().await;
    for moment in moments(points) {
        robot.crash(moment, 1, end).await;
    }
    robot.nothing_left().await;
}

/// A robot, and what was seen of its tasks so far.
struct Robot {
    cluster: Cluster,
    /// Of the newest lease.
    epoch: u64,
    tasks: u32,
    uids: BTreeSet<String>,
    /// Where its agent makes control groups.
    groups: Vec<PathBuf>,
}

impl Robot {
    async fn join() -> Robot {
        let mut cluster = Cluster::start().await;
        let options = AgentOptions::robot("robot", 0.0, 0.0).flag("--docker-socket", "none");
        cluster.join(options).await;
        let secret = json!({
            "apiVersion": "v1", "kind": "Secret", "metadata": {"name": "login"},
            "stringData": {"PASSWORD": PASSWORD},
        });
        cluster.post("/api/v1/namespaces/default/secrets", &secret).await;
        let identity = std::fs::read(cluster.dir().join("robot/agent.json")).expect("it has one");
        let identity: Value = serde_json::from_slice(&identity).expect("JSON");
        let identity = identity["id"].as_str().expect("a text");
        let mut groups = directories(Path::new("/sys/fs/cgroup"));
        groups.retain(|group| group.ends_with(identity));
        assert!(!groups.is_empty(), "{identity}");
        Robot { cluster, epoch: 0, tasks: 0, uids: BTreeSet::new(), groups }
    }

    /// One task, and one crash on its way.
    async fn crash(&mut self, moment: Moment, nth: u32, end: End) {
        let cluster = &mut self.cluster;
        let crash = Crash::at(cluster, "robot", moment, nth);
        cluster.kill_agent("robot");
        cluster.spawn_agent("robot", None);
        self.tasks += 1;
        let life = Life {
            name: format!("t{}", self.tasks),
            dir: cluster.dir().join(format!("t{}", self.tasks)),
            data: cluster.dir().join("robot"),
            tasks: cluster.tasks().await,
            leases: cluster.leases().await,
        };
        std::fs::create_dir(&life.dir).expect("a new directory");
        let created = cluster.create(&life.name, life.spec()).await;
        let uid = created.metadata.uid.expect("set by the server");
        let (epoch, ()) = tokio::join!(life.whole(&uid, end), crash.nurse(cluster));
        assert!(epoch > self.epoch, "{moment}: {epoch} after {}", self.epoch);
        self.epoch = epoch;
        let mut left = self.groups.iter().flat_map(|group| directories(group));
        let left = left.find(|group| group.to_string_lossy().contains(&uid));
        assert_eq!(left, None, "{moment}");
        self.uids.insert(uid);
    }

    /// Nothing of any task is left, on disk or in memory, nor half of a file.
    async fn nothing_left(&self) {
        let data = self.cluster.dir().join("robot");
        nothing_half(&data).await;
        let all = files(&data).into_iter().chain(files(Path::new("/run/muster")));
        let of_task = |path: &PathBuf| {
            let path = path.to_string_lossy();
            self.uids.iter().any(|uid| path.contains(uid))
        };
        assert_eq!(all.into_iter().find(of_task), None);
    }
}

/// One task's life, as its user sees it and as its program writes it down.
struct Life {
    name: String,
    /// Where its program writes.
    dir: PathBuf,
    /// The agent's.
    data: PathBuf,
    tasks: Api<Task>,
    leases: Api<Lease>,
}

impl Life {
    fn spec(&self) -> Value {
        let dir = self.dir.display();
        // Whatever it leaves behind holds the lock.
        let script = format!(
            "exec 9> {dir}/lock; flock -n 9 || echo $MUSTER_ATTEMPT >> {dir}/overlaps; \
             echo $MUSTER_ATTEMPT $PASSWORD $(cat keys/password) $MUSTER_LEASE >> {dir}/runs; \
             until [ -e {dir}/end ]; do sleep 0.1; done"
        );
        json!({
            "resources": {"cpu": "100m", "memory": "64Mi", "actuators": ["base:Drive"]},
            "run": {"process": {
                "command": ["sh", "-c", script],
                "envFrom": [{"secretRef": {"name": "login"}}],
                "files": [{"secret": "login", "mountPath": "keys",
                    "items": [{"key": "PASSWORD", "path": "password"}]}],
            }},
            "restartPolicy": "OnFailure",
            "gracePeriodSeconds": 5,
        })
    }

    /// The attempts that its program began, in order.
    fn attempts(&self) -> Vec<u32> {
        let text = std::fs::read_to_string(self.dir.join("runs")).unwrap_or_default();
        let whole = text.lines().map(|line| {
            let words: Vec<&str> = line.split(' ').collect();
            assert_eq!(words.get(1..3), Some(&[PASSWORD; 2][..]), "{line}");
            words[0].parse().expect("a number")
        });
        whole.collect()
    }

    /// Until nothing of it is left. The epoch of its lease.
    async fn whole(&self, uid: &str, end: End) -> u64 {
        let runs = |task: Option<&Task>| phase(task) == Some(TaskPhase::Running);
        wait::object(self.tasks.clone(), &self.name, "running", runs).await;
        wait::until("a line of its program's", async || {
            if self.attempts().is_empty() { Err(String::new()) } else { Ok(()) }
        })
        .await;
        for process in kernel::with_env("MUSTER_UID", uid) {
            let variables = std::fs::read(format!("/proc/{}/environ", process.pid));
            let variables = String::from_utf8_lossy(&variables.unwrap_or_default()).into_owned();
            assert!(!variables.contains(VARIABLE), "no program is told where to die");
        }
        let lease = self.leases.get("robot.body").await.expect("it is there");
        let status = lease.status.expect("set");
        let held = status.holder.as_ref().map(|holder| holder.name.clone());
        assert_eq!(held.as_deref(), Some(&*self.name), "{status:?}");
        if end == End::LostShim {
            self.kill_shim(uid).await;
        }
        if end != End::Order {
            std::fs::write(self.dir.join("end"), "").expect("its directory is there");
            let ended = |task: Option<&Task>| phase(task).is_some_and(TaskPhase::is_terminal);
            let task = wait::object(self.tasks.clone(), &self.name, "ended", ended).await;
            let told = task.and_then(|task| task.status).expect("it has ended");
            assert_eq!((told.phase, told.exit_code), (TaskPhase::Succeeded, Some(0)), "{told:?}");
        }
        self.tasks.delete(&self.name, &Default::default()).await.expect("it is there");
        self.gone(uid).await;
        status.epoch.0
    }

    async fn kill_shim(&self, uid: &str) {
        let attempts = self.data.join("tasks").join(uid).join("attempts");
        let pid = wait::until("a shim", async || {
            let text = std::fs::read(attempts.join("1/begun.json")).map_err(|e| e.to_string())?;
            let begun: Value = serde_json::from_slice(&text).map_err(|e| e.to_string())?;
            begun["shim"]["pid"].as_u64().ok_or_else(|| begun.to_string())
        })
        .await;
        kernel::kill(u32::try_from(pid).expect("a process number"));
    }

    /// Waits until the task is gone, and what its node had of it; and holds what it did against what it may do.
    async fn gone(&self, uid: &str) {
        wait::object(self.tasks.clone(), &self.name, "gone", |task| task.is_none()).await;
        let dir = self.data.join("tasks").join(uid);
        wait::until("gone from its node", async || {
            if dir.exists() { Err(dir.display().to_string()) } else { Ok(()) }
        })
        .await;
        assert_eq!(kernel::with_env("MUSTER_UID", uid), [], "{}", self.name);
        let attempts = self.attempts();
        let each_once = attempts.windows(2).all(|pair| pair[0] < pair[1]);
        assert!(each_once, "{}: {attempts:?}", self.name);
        assert!(!self.dir.join("overlaps").exists(), "{}: {attempts:?}", self.name);
        let lease = self.leases.get("robot.body").await.expect("it is there");
        assert!(lease.status.is_some_and(|status| status.holder.is_none()), "{}", self.name);
    }
}

fn phase(task: Option<&Task>) -> Option<TaskPhase> {
    Some(task?.status.as_ref()?.phase)
}
