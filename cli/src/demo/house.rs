//! The processes of the demo and the directory that all of them write in.
//!
//! Order of the end: tasks (by deleting them, so that agents end them as they should), agents,
//! controller, control groups, directory. Each step has a deadline, and what outlives it is killed: only processes that
//! this demo started, known by their pids or by the PATH that begins in the demo's own directory.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;
use tokio::process::{Child, Command};
use tokio::time::timeout;

use super::DemoError;
use super::api::Api;
use super::groups;
use super::scenario::{NODES, NodePlan};
use crate::error::CliError;

/// A controller makes its certificates and its store, an agent joins: a second at most on a machine
/// that is not too busy.
const START_LIMIT: Duration = Duration::from_secs(30);
/// The manifests' grace is 3 s; the rest is for a busy machine.
const TASKS_LIMIT: Duration = Duration::from_secs(15);
/// A daemon ends within its own deadline of 5 s.
const DAEMON_LIMIT: Duration = Duration::from_secs(8);
/// How often what cannot be waited for is looked at.
pub(super) const LOOK: Duration = Duration::from_millis(50);
/// Lines of a log that an error shows.
const LOG_LINES: usize = 12;

/// The processes.
#[derive(Debug)]
pub(super) struct House {
    /// None when it was put away.
    dir: Option<TempDir>,
    program: PathBuf,
    controller: Option<Daemon>,
    agents: Vec<Daemon>,
    api: Option<Api>,
    /// The daemon that was found dead.
    dead: Option<String>,
    keep: bool,
}

#[derive(Debug)]
struct Daemon {
    name: String,
    child: Child,
}

impl House {
    /// A directory, and nothing in it but this program under the name that manifests use.
    pub(super) fn open(keep: bool) -> Result<Self, DemoError> {
        let system = |what| move |source| DemoError::System { what, source };
        let program = std::env::current_exe().map_err(system("find this program"))?;
        let dir = TempDir::with_prefix("muster-demo-").map_err(system("make a directory"))?;
        let bin = dir.path().join("bin");
        fs::create_dir(&bin)
            .and_then(|()| std::os::unix::fs::symlink(&program, bin.join("muster")))
            .map_err(system("link this program"))?;
        Ok(House {
            dir: Some(dir),
            program,
            controller: None,
            agents: Vec::new(),
            api: None,
            dead: None,
            keep,
        })
    }

    fn path(&self) -> &Path {
        self.dir.as_ref().map_or_else(|| Path::new(""), TempDir::path)
    }

    /// The admin's kubeconfig.
    pub(super) fn kubeconfig(&self) -> PathBuf {
        self.path().join("kubeconfig")
    }

    /// Starts a daemon, in a process group of its own: Ctrl-C on a terminal is for the demo alone.
    fn spawn(&self, name: &str, command: &mut Command) -> Result<Daemon, DemoError> {
        let system = |what| move |source| DemoError::System { what, source };
        let log = File::create(self.log_path(name)).map_err(system("make a log"))?;
        let out = log.try_clone().map_err(system("make a log"))?;
        let bin = self.path().join("bin");
        let old = std::env::var_os("PATH").unwrap_or_default();
        let paths = std::iter::once(bin).chain(std::env::split_paths(&old));
        let path = std::env::join_paths(paths).unwrap_or(old);
        let child = command
            .env("PATH", path)
            .stdin(Stdio::null())
            .stdout(out)
            .stderr(log)
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .map_err(system("start a daemon"))?;
        Ok(Daemon { name: name.to_owned(), child })
    }

    fn log_path(&self, name: &str) -> PathBuf {
        self.path().join(format!("{name}.log"))
    }

    /// The last lines of the daemon that was found dead.
    pub(super) fn last_words(&self) -> Option<String> {
        let name = self.dead.as_ref()?;
        let text = fs::read_to_string(self.log_path(name)).unwrap_or_default();
        let lines: Vec<&str> = text.lines().collect();
        let end = lines[lines.len().saturating_sub(LOG_LINES)..].join("\n  ");
        Some(format!("the end of the {name}'s log:\n  {end}"))
    }

    /// An error when a daemon has ended.
    pub(super) fn all_alive(&mut self) -> Result<(), DemoError> {
        let daemons = self.controller.iter_mut().chain(&mut self.agents);
        let mut died = None;
        for daemon in daemons {
            if !matches!(daemon.child.try_wait(), Ok(None)) {
                died = Some(daemon.name.clone());
            }
        }
        match died {
            Some(name) => {
                self.dead = Some(name.clone());
                Err(DemoError::Died { name })
            }
            None => Ok(()),
        }
    }

    /// Starts the controller on a free port; returns when it answers.
    pub(super) async fn start_controller(&mut self) -> Result<Api, CliError> {
        let (data, kubeconfig) = (self.path().join("controller"), self.kubeconfig());
        let mut command = Command::new(&self.program);
        command.args(["controller", "--listen", "127.0.0.1:0", "--data-dir"]).arg(data);
        command.arg("--kubeconfig").arg(&kubeconfig);
        self.controller = Some(self.spawn("controller", &mut command)?);
        let begin = Instant::now();
        loop {
            self.all_alive()?;
            // It is written, whole, when the port is bound: it tells which one the kernel gave.
            if kubeconfig.exists()
                && let Ok(api) = Api::connect(&kubeconfig).await
                && api.is_ready().await
            {
                self.api = Some(api.clone());
                return Ok(api);
            }
            late(begin, START_LIMIT, "the controller to answer")?;
            tokio::time::sleep(LOOK).await;
        }
    }

    /// Starts an agent. Where the kernel cannot hold tasks to quotas (not root, no cgroups) they run all
    /// the same: the node says so in its conditions, and the demo in its first line.
    pub(super) fn start_agent(
        &mut self,
        plan: &NodePlan,
        server: &str,
        token: &str,
    ) -> Result<(), DemoError> {
        let mut command = Command::new(&self.program);
        command.args(["agent", "--join", server, "--name", plan.name, "--kind", plan.kind]);
        command.arg("--data-dir").arg(self.path().join(plan.name));
        command.args(["--cpu", plan.cpu, "--memory", plan.memory, "--docker-socket", "none"]);
        command.args(plan.flags).arg("--unenforced-quotas");
        // Not an argument: those of a process are for all to see.
        command.env("MUSTER_TOKEN", token);
        let daemon = self.spawn(plan.name, &mut command)?;
        self.agents.push(daemon);
        Ok(())
    }

    /// Waits until `done` gives something, for as long as all daemons live.
    pub(super) async fn wait<T>(
        &mut self,
        what: &str,
        limit: Duration,
        mut done: impl AsyncFnMut() -> Result<Option<T>, CliError>,
    ) -> Result<T, CliError> {
        let begin = Instant::now();
        loop {
            if let Some(found) = done().await? {
                return Ok(found);
            }
            self.all_alive()?;
            late(begin, limit, what)?;
            tokio::time::sleep(LOOK).await;
        }
    }

    /// Ends everything. Returns what could not be put in order.
    pub(super) async fn end(&mut self) -> Vec<String> {
        let mut left = Vec::new();
        if let Some(api) = self.api.take() {
            let ended = timeout(TASKS_LIMIT, end_tasks(&api)).await;
            if !matches!(ended, Ok(Ok(()))) {
                left.push("tasks could not be ended in order; they are killed".to_owned());
            }
        }
        for daemon in self.agents.drain(..).chain(self.controller.take()) {
            let name = daemon.name.clone();
            if !daemon.end().await {
                left.push(format!("the {name} did not end in time; it was killed"));
            }
        }
        self.put_away(&mut left);
        left
    }

    /// Kills what is left of tasks, and removes control groups and the directory.
    fn put_away(&mut self, left: &mut Vec<String>) {
        let Some(dir) = self.dir.take() else { return };
        let killed = kill_those_below(dir.path());
        if killed > 0 {
            left.push(format!("killed {killed} processes of tasks that had stayed"));
        }
        for group in NODES.iter().flat_map(|node| groups::of_agent(&dir.path().join(node.name))) {
            if let Err(error) = remove_when_empty(&group) {
                left.push(format!("the control group {} stays: {error}", group.display()));
            }
        }
        if self.keep {
            left.push(format!("logs and data stay in {}", dir.keep().display()));
        } else if let Err(error) = dir.close() {
            left.push(format!("the demo's directory stays: {error}"));
        }
    }
}

impl Drop for House {
    /// For a demo that is ended in a hurry. Daemons are killed by their own drop.
    fn drop(&mut self) {
        for daemon in self.agents.drain(..).chain(self.controller.take()) {
            drop(daemon);
        }
        self.put_away(&mut Vec::new());
    }
}

impl Daemon {
    /// Asks it to end. False: it had to be killed.
    async fn end(mut self) -> bool {
        let pid = self.child.id().and_then(|id| Pid::from_raw(id.cast_signed()));
        if let Some(pid) = pid {
            // It may have ended meanwhile; it is not reaped before `wait`, so the pid is still its own.
            let _ = kill_process(pid, Signal::TERM);
        }
        if timeout(DAEMON_LIMIT, self.child.wait()).await.is_ok() {
            return true;
        }
        let _ = self.child.kill().await;
        false
    }
}

/// A process that was killed just now is in its group until the kernel is done with it.
fn remove_when_empty(group: &Path) -> std::io::Result<()> {
    let begin = Instant::now();
    loop {
        match groups::remove(group) {
            Err(_) if begin.elapsed() < Duration::from_secs(1) => std::thread::sleep(LOOK),
            done => return done,
        }
    }
}

fn late(begin: Instant, limit: Duration, what: &str) -> Result<(), DemoError> {
    if begin.elapsed() < limit {
        return Ok(());
    }
    Err(DemoError::Late { what: what.to_owned(), after: limit })
}

/// Deletes every task and waits until none is left: then no process of one is left either.
async fn end_tasks(api: &Api) -> Result<(), CliError> {
    for name in api.task_names().await? {
        api.delete(&name).await?;
    }
    while !api.task_names().await?.is_empty() {
        tokio::time::sleep(LOOK).await;
    }
    Ok(())
}

/// Kills shims and tasks of agents that are gone. They have their agent's PATH, which begins in the
/// demo's directory; a person who looks at the demo from another shell has not.
fn kill_those_below(dir: &Path) -> usize {
    let mark = format!("PATH={}:", dir.join("bin").display());
    let mut killed = BTreeSet::new();
    // A shim may start a process while we look; one that has lost its shim starts none.
    for _ in 0..3 {
        for pid in pids() {
            let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
            let ours = environment.split(|b| *b == 0).any(|v| v.starts_with(mark.as_bytes()));
            if ours
                && let Some(pid) = Pid::from_raw(pid)
                && kill_process(pid, Signal::KILL).is_ok()
            {
                killed.insert(pid.as_raw_nonzero());
            }
        }
    }
    killed.len()
}

fn pids() -> Vec<i32> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_processes_of_the_demo_are_killed() {
        let house = House::open(false).unwrap();
        let dir = house.path().to_owned();
        let sleeper = |key: &str, value: String| {
            std::process::Command::new("/bin/sleep").arg("60").env(key, value).spawn().unwrap()
        };
        let mut ours = sleeper("PATH", format!("{}/bin:/bin", dir.display()));
        let mut visitor = sleeper("KUBECONFIG", house.kubeconfig().display().to_string());
        // The environment is there once the child has executed its program.
        let until = Instant::now() + Duration::from_secs(10);
        while kill_those_below(&dir) == 0 && Instant::now() < until {
            std::thread::yield_now();
        }
        assert!(!ours.wait().unwrap().success());
        assert!(visitor.try_wait().unwrap().is_none());
        visitor.kill().unwrap();
        visitor.wait().unwrap();
        drop(house);
        assert!(!dir.exists());
    }
}
