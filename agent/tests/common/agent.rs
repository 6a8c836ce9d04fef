//! Agents as real processes.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use super::controller::Controller;
use super::until;

/// A user without rights.
pub const NOBODY: u32 = 65_534;

/// An agent, and its data directory. Dropped: it is killed, and so is everything of its tasks.
pub struct Agent {
    child: Option<Child>,
    pub dir: tempfile::TempDir,
    pub args: Vec<String>,
    /// Run without the rights of root.
    nobody: bool,
}

impl Agent {
    /// A robot that has joined and said hello.
    #[track_caller]
    pub fn start(controller: &Controller) -> Agent {
        Self::start_with(controller, &[])
    }

    #[track_caller]
    pub fn start_with(controller: &Controller, args: &[&str]) -> Agent {
        let dir = tempfile::Builder::new().prefix("muster-agent-").tempdir().unwrap();
        Self::start_in(dir, controller, args)
    }

    /// An agent without the rights of root, and so without control groups.
    #[track_caller]
    pub fn start_as_nobody(controller: &Controller, args: &[&str]) -> Agent {
        let dir = tempfile::Builder::new().prefix("muster-agent-").tempdir().unwrap();
        std::os::unix::fs::chown(dir.path(), Some(NOBODY), Some(NOBODY)).unwrap();
        Self::start_in(dir, controller, args)
    }

    #[track_caller]
    pub fn start_in(dir: tempfile::TempDir, controller: &Controller, args: &[&str]) -> Agent {
        let mut all: Vec<String> =
            ["--kind", "robot", "--name", "robot-1"].map(str::to_owned).to_vec();
        if !args.contains(&"--docker-socket") {
            all.extend(["--docker-socket".to_owned(), "none".to_owned()]);
        }
        if !args.contains(&"--position") {
            all.extend(["--position".to_owned(), "static:1,2".to_owned()]);
        }
        all.extend([
            "--join".to_owned(),
            controller.url(),
            "--token".to_owned(),
            controller.token(),
        ]);
        all.extend(args.iter().map(|arg| (*arg).to_owned()));
        let nobody = std::os::unix::fs::MetadataExt::uid(&dir.path().metadata().unwrap()) != 0;
        let mut agent = Agent { child: None, dir, args: all, nobody };
        let before = controller.hellos().len();
        agent.spawn();
        controller.wait_hello(before + 1);
        agent
    }

    pub fn spawn(&mut self) {
        let mut command = if self.nobody {
            use std::os::unix::process::CommandExt;
            let mut command = command_of(&self.own_program(), self.dir.path(), &self.args);
            command.uid(NOBODY).gid(NOBODY);
            command
        } else {
            command(self.dir.path(), &self.args)
        };
        let child = command.spawn().unwrap();
        self.child = Some(child);
    }

    /// A copy of the program that everybody may run: the build may be in a home that is closed to others.
    fn own_program(&self) -> PathBuf {
        let program = self.dir.path().join("program");
        if !program.exists() {
            std::fs::copy(env!("CARGO_BIN_EXE_muster-agent"), &program).unwrap();
        }
        program
    }

    pub fn pid(&self) -> i32 {
        self.child.as_ref().unwrap().id().cast_signed()
    }

    /// SIGKILL, and gone.
    pub fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }

    /// SIGTERM; returns the exit code.
    pub fn terminate(&mut self) -> Option<i32> {
        let mut child = self.child.take().unwrap();
        // SAFETY: a signal to a child that is not reaped yet.
        unsafe { libc::kill(child.id().cast_signed(), libc::SIGTERM) };
        until("the agent's end", || child.try_wait().unwrap()).code()
    }

    pub fn task_dir(&self, uid: &str) -> PathBuf {
        self.dir.path().join("tasks").join(uid)
    }

    fn attempt_file(&self, uid: &str, attempt: u32, name: &str) -> Option<serde_json::Value> {
        let path = self.task_dir(uid).join("attempts").join(attempt.to_string()).join(name);
        serde_json::from_slice(&std::fs::read(path).ok()?).ok()
    }

    /// The pid of the program of an attempt.
    #[track_caller]
    pub fn main_pid(&self, uid: &str, attempt: u32) -> i32 {
        until("a started program", || {
            let started = self.attempt_file(uid, attempt, "started.json")?;
            Some(started["process"]["pid"].as_i64()?.try_into().unwrap())
        })
    }

    #[track_caller]
    pub fn shim_pid(&self, uid: &str, attempt: u32) -> i32 {
        until("a shim", || {
            let begun = self.attempt_file(uid, attempt, "begun.json")?;
            Some(begun["shim"]["pid"].as_i64()?.try_into().unwrap())
        })
    }

    /// The pid of the gate before the robot's drivers; 0 while there is none.
    pub fn gate_pid(&self) -> i32 {
        let pid = std::fs::read_to_string(self.dir.path().join("gate/lock")).unwrap_or_default();
        pid.trim().parse().unwrap_or(0)
    }

    /// What the agent has read, of files and of sockets. It reads with each heartbeat.
    pub fn bytes_read(&self) -> u64 {
        let io = std::fs::read_to_string(format!("/proc/{}/io", self.pid())).unwrap();
        io.lines().find_map(|line| line.strip_prefix("rchar: ")).unwrap().parse().unwrap()
    }

    /// The directory of an attempt's group for a controller.
    #[track_caller]
    pub fn group(&self, uid: &str, attempt: u32, controller: &str) -> PathBuf {
        let order = self.attempt_file(uid, attempt, "launch.json").unwrap();
        PathBuf::from(order["group"]["dirs"][controller].as_str().unwrap())
    }

    pub fn has_exit_record(&self, uid: &str, attempt: u32) -> bool {
        self.attempt_file(uid, attempt, "exit.json").is_some()
    }
}

pub fn command(data_dir: &Path, args: &[String]) -> Command {
    command_of(Path::new(env!("CARGO_BIN_EXE_muster-agent")), data_dir, args)
}

fn command_of(program: &Path, data_dir: &Path, args: &[String]) -> Command {
    let mut command = Command::new(program);
    command.args(args).arg("--data-dir").arg(data_dir);
    command.env("RUST_LOG", "muster_agent=debug,info").stdin(Stdio::null());
    command
}

impl Drop for Agent {
    fn drop(&mut self) {
        let id = std::fs::read(self.dir.path().join("agent.json"))
            .ok()
            .and_then(|text| serde_json::from_slice::<serde_json::Value>(&text).ok())
            .and_then(|identity| identity["id"].as_str().map(str::to_owned));
        self.kill();
        let gate = self.gate_pid();
        if gate > 0 && super::lives(gate) {
            // SAFETY: a signal to a process that this agent started, and that was just seen.
            unsafe { libc::kill(gate, libc::SIGKILL) };
        }
        // The tasks outlive their agent, so the test has to end them.
        for entry in std::fs::read_dir(self.dir.path().join("tasks")).into_iter().flatten() {
            let uid = entry.unwrap().file_name().into_string().unwrap();
            let attempts = self.task_dir(&uid).join("attempts");
            for attempt in std::fs::read_dir(attempts).into_iter().flatten() {
                let attempt: u32 = attempt.unwrap().file_name().to_str().unwrap().parse().unwrap();
                end(self, &uid, attempt);
            }
        }
        remove_roots(&id.unwrap_or_default());
    }
}

/// Takes away the empty groups of an agent that was killed.
fn remove_roots(id: &str) {
    let own = std::fs::read_to_string("/proc/self/cgroup").unwrap();
    for line in own.lines() {
        let fields: Vec<&str> = line.splitn(3, ':').collect();
        let base = format!("/sys/fs/cgroup/{}{}", fields[1], fields[2]);
        let _ = std::fs::remove_dir(Path::new(&base).join("muster").join(id));
    }
}

fn end(agent: &Agent, uid: &str, attempt: u32) {
    if agent.has_exit_record(uid, attempt) {
        return;
    }
    let Some(begun) = agent.attempt_file(uid, attempt, "begun.json") else { return };
    let shim: i32 = begun["shim"]["pid"].as_i64().unwrap().try_into().unwrap();
    let stop = agent.task_dir(uid).join("attempts").join(attempt.to_string()).join("stop.json");
    std::fs::write(stop, r#"{"graceMs":0}"#).unwrap();
    if super::lives(shim) {
        // SAFETY: a signal to a process that was just seen.
        unsafe { libc::kill(shim, libc::SIGUSR1) };
        until("the end of a shim", || (!super::lives(shim)).then_some(()));
    }
}
