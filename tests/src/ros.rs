//! A real ROS 1 of Debian's, on a port and in a directory of its own.

use std::net::TcpListener;
use std::path::Path;
use std::process::Stdio;

use muster_ros1::node::MasterState;
use muster_ros1::{Node, NodeOptions};
use tempfile::TempDir;
use tokio::io::{AsyncBufReadExt as _, BufReader, Lines};
use tokio::process::{Child, ChildStdout, Command};

use crate::kernel;
use crate::wait::{self, DEADLINE};

/// A `roscore`, and the programs that talk to it. When it is dropped, every process of it is killed.
#[derive(Debug)]
pub struct Ros {
    dir: TempDir,
    port: u16,
}

/// Waits until a node of ours has registered.
///
/// # Panics
///
/// When it takes too long.
pub async fn registered(node: &Node) {
    let mut state = node.state();
    let known = state.wait_for(|state| *state == MasterState::Registered);
    drop(tokio::time::timeout(DEADLINE, known).await.expect("in time").expect("the node is there"));
}

/// A program of ROS's, its output line by line.
#[derive(Debug)]
pub struct Program {
    child: Child,
    lines: Lines<BufReader<ChildStdout>>,
    what: String,
}

impl Ros {
    /// Starts a roscore; returns when its master answers.
    pub async fn start() -> Ros {
        let mut ros =
            Ros { dir: TempDir::with_prefix("muster-ros-").expect("a directory"), port: 0 };
        // A port of the kernel's choice may be another's before the master has it: then there is another choice.
        for _ in 0..3 {
            let free =
                TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a free port");
            ros.port = free.port();
            if ros.try_start_core().await {
                return ros;
            }
            ros.kill_core();
        }
        panic!("no roscore; its log: {}", ros.log());
    }

    /// The same programs with another master, on this port of the loopback.
    #[must_use]
    pub fn with_master(port: u16) -> Ros {
        Ros { dir: TempDir::with_prefix("muster-ros-").expect("a directory"), port }
    }

    /// Starts the killed roscore again, on the same port.
    pub async fn start_core(&self) {
        // A process that was killed may hold the port for a moment.
        for _ in 0..3 {
            if self.try_start_core().await {
                return;
            }
            self.kill_core();
        }
        panic!("no roscore; its log: {}", self.log());
    }

    async fn try_start_core(&self) -> bool {
        let log = std::fs::File::create(self.dir.path().join("roscore.log")).expect("a log");
        let mut core = self.command("roscore");
        core.args(["-p", &self.port.to_string()])
            .stdout(log.try_clone().expect("a file"))
            .stderr(log);
        // It is killed with all that it starts, or when `self` is dropped.
        core.env("MUSTER_TEST_ROLE", "core").kill_on_drop(false);
        let mut child = core.spawn().expect("roscore is installed (tests/run does it)");
        wait::until("a master", || {
            let (ended, log) = (child.try_wait().is_ok_and(|status| status.is_some()), self.log());
            // `rosout` is started last.
            let ready = log.contains("started core service [/rosout]");
            std::future::ready(if ended || ready { Ok(ready && !ended) } else { Err(log) })
        })
        .await
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.dir.path().join("roscore.log")).unwrap_or_default()
    }

    /// Kills the master and what roscore started with it, as a power cut would.
    pub fn kill_core(&self) {
        let home = self.dir.path().display().to_string();
        let all = kernel::with_env("ROS_HOME", &home);
        let core = kernel::with_env("MUSTER_TEST_ROLE", "core");
        for process in all.iter().filter(|p| core.contains(p)) {
            kernel::kill(process.pid);
        }
    }

    /// The master's address.
    #[must_use]
    pub fn master(&self) -> String {
        format!("http://127.0.0.1:{}", self.port)
    }

    /// A node of ours in this graph, which may not have registered yet.
    ///
    /// # Panics
    ///
    /// When it cannot start.
    pub async fn node(&self, name: &str) -> Node {
        let options = NodeOptions {
            name: name.to_owned(),
            master: Some(self.master()),
            host: Some("127.0.0.1".to_owned()),
            ..NodeOptions::default()
        };
        Node::start(options).await.expect("a node starts without a master")
    }

    /// Where it writes.
    #[must_use]
    pub fn dir(&self) -> &Path {
        self.dir.path()
    }

    /// A program with this ROS's environment.
    #[must_use]
    pub fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command
            .env("ROS_MASTER_URI", self.master())
            .env("ROS_IP", "127.0.0.1")
            .env("ROS_HOME", self.dir.path())
            .env("ROS_LOG_DIR", self.dir.path().join("log"))
            .env("PYTHONUNBUFFERED", "1")
            .env_remove("ROS_HOSTNAME")
            .env_remove("ROS_NAMESPACE")
            .stdin(Stdio::null())
            .kill_on_drop(true);
        command
    }

    /// Runs a program to its end; what it printed.
    ///
    /// # Panics
    ///
    /// When it fails.
    pub async fn output(&self, program: &str, arguments: &[&str]) -> String {
        let run = self.command(program).args(arguments).output();
        let output = tokio::time::timeout(DEADLINE, run)
            .await
            .expect("it ends in time")
            .expect("it is installed");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{program} {arguments:?}: {text}\n{said}");
        text
    }

    /// Starts a program.
    #[must_use]
    pub fn spawn(&self, program: &str, arguments: &[&str]) -> Program {
        self.spawn_with(program, arguments, &[])
    }

    fn spawn_with(
        &self,
        program: &str,
        arguments: &[&str],
        environment: &[(&str, &str)],
    ) -> Program {
        let what = format!("{program} {arguments:?}");
        let mut child = self
            .command(program)
            .args(arguments)
            .envs(environment.iter().copied())
            .stdout(Stdio::piped())
            .spawn()
            .expect("it is installed");
        let lines = BufReader::new(child.stdout.take().expect("it is piped")).lines();
        Program { child, lines, what }
    }

    /// Starts a script of `tests/ros`, on Debian's Python.
    #[must_use]
    pub fn script(&self, name: &str, arguments: &[&str]) -> Program {
        self.script_with(name, arguments, &[])
    }

    /// The same with variables of its environment.
    #[must_use]
    pub fn script_with(
        &self,
        name: &str,
        arguments: &[&str],
        environment: &[(&str, &str)],
    ) -> Program {
        let path = format!("{}/ros/{name}", env!("CARGO_MANIFEST_DIR"));
        let all: Vec<&str> = [&*path].into_iter().chain(arguments.iter().copied()).collect();
        self.spawn_with("/usr/bin/python3", &all, environment)
    }
}

impl Drop for Ros {
    fn drop(&mut self) {
        for process in kernel::with_env("ROS_HOME", &self.dir.path().display().to_string()) {
            kernel::kill(process.pid);
        }
    }
}

impl Program {
    /// The next line.
    ///
    /// # Panics
    ///
    /// When none comes in time.
    pub async fn line(&mut self) -> String {
        let line = tokio::time::timeout(DEADLINE, self.lines.next_line()).await;
        let line = line.unwrap_or_else(|_| panic!("{}: no line within {DEADLINE:?}", self.what));
        line.expect("it can be read").unwrap_or_else(|| panic!("{} ended", self.what))
    }

    /// The next line that `wanted` takes.
    pub async fn line_with(&mut self, wanted: &str) -> String {
        loop {
            let line = self.line().await;
            if line.contains(wanted) {
                return line;
            }
        }
    }

    /// Its process.
    #[must_use]
    pub fn pid(&self) -> u32 {
        self.child.id().expect("it runs")
    }

    /// Kills it with SIGKILL.
    pub async fn kill(&mut self) {
        self.child.kill().await.expect("it runs");
    }
}
