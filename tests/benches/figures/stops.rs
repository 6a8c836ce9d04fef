//! From what should stop a robot until its driver reads the stop: the holder is killed, the holder is silent, the agent is
//! killed, the gate is killed, a button on the robot, a person through the controller.
//!
//! The driver is this process, at the other end of the gate's socket; the holder commands it twenty times a second. The
//! floor is a byte to a process and back over a Unix socket: what the machine itself takes at that moment.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use kube::api::{Patch, PatchParams};
use muster_api::kind::node::Node;
use muster_api::phase::TaskPhase;
use muster_tests::puppet::python;
use muster_tests::{AgentOptions, Cluster, kernel, wait};
use serde_json::json;

use crate::stats::{Samples, figure, millis};

/// Of each. The agent's and the gate's begin anew each time.
const ROUNDS: usize = 50;

/// Longer than any stop.
const PATIENCE: Duration = Duration::from_secs(20);

/// What the driver reads, and when.
struct Driver(Receiver<(Instant, String)>);

impl Driver {
    fn listen(path: &Path) -> Driver {
        let listener = UnixListener::bind(path).expect("a short path");
        let (say, heard) = channel();
        // They end with this process.
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let say = say.clone();
                std::thread::spawn(move || {
                    for line in BufReader::new(stream).lines().map_while(Result::ok) {
                        if say.send((Instant::now(), line)).is_err() {
                            return;
                        }
                    }
                });
            }
        });
        Driver(heard)
    }

    /// When the next stop, or the next command, was read.
    fn next(&self, stop: bool) -> Instant {
        loop {
            let (at, line) = self.0.recv_timeout(PATIENCE).expect("the driver hears something");
            if (line == "stop") == stop {
                return at;
            }
        }
    }

    /// Drives, then does what should stop the robot; returns how long that took.
    fn round(&self, begin: impl FnOnce()) -> Duration {
        while self.0.try_recv().is_ok() {}
        self.next(false);
        let begun = Instant::now();
        begin();
        self.next(true).saturating_duration_since(begun)
    }
}

/// What a round trip over a Unix socket takes.
fn floor() -> Samples {
    let (mut here, mut there) = UnixStream::pair().expect("a pair");
    std::thread::spawn(move || {
        let mut byte = [0];
        while there.read_exact(&mut byte).is_ok() && there.write_all(&byte).is_ok() {}
    });
    let mut samples = Samples::default();
    for _ in 0..ROUNDS * 10 {
        let begin = Instant::now();
        here.write_all(b"x").expect("it reads");
        here.read_exact(&mut [0]).expect("it answers");
        samples.push(begin.elapsed());
    }
    samples
}

struct Robot {
    cluster: Cluster,
    data: PathBuf,
    button: PathBuf,
    driver: Driver,
    token: String,
    lease: String,
}

impl Robot {
    async fn start() -> Robot {
        let mut cluster = Cluster::start().await;
        let dir = cluster.dir().to_owned();
        let (socket, config, button) =
            (dir.join("driver"), dir.join("agent.yaml"), dir.join("button"));
        let driver = Driver::listen(&socket);
        let gate = json!({"gate": {
            "drivers": [{"actuators": ["base:Drive", "arm:Grasp"], "unix": socket, "stop": "stop"}],
            "estop": [{"name": "button", "file": button}],
        }});
        std::fs::write(&config, gate.to_string()).expect("the directory is there");
        let options = AgentOptions::robot("robot", 0.0, 0.0);
        cluster.join(options.flag("--config", &config.display().to_string())).await;
        let run = json!({"process": {"command": ["sleep", "100000"]}});
        let holder = json!({"resources": {"actuators": ["base:Drive"]}, "run": run});
        let task = cluster.create("holder", holder).await;
        cluster.phase("holder", TaskPhase::Running).await;
        let uid = task.metadata.uid.expect("set by the server");
        let data = dir.join("robot");
        let record = std::fs::read(data.join("tasks").join(uid).join("task.json"));
        let record: serde_json::Value =
            serde_json::from_slice(&record.expect("the agent's record")).expect("JSON");
        let text = |field: &str| record.pointer(field).and_then(|v| v.as_str()).map(str::to_owned);
        let (token, lease) = (text("/token"), text("/assignment/lease"));
        Robot {
            cluster,
            data,
            button,
            driver,
            token: token.expect("every task has one"),
            lease: lease.expect("it holds the robot"),
        }
    }

    /// Commands the robot twenty times a second, as the task.
    fn holder(&self) -> Child {
        Command::new(python())
            .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/frameworks/drive.py"))
            .env("MUSTER_TASK", "holder")
            .env("MUSTER_GATE_SOCKET", self.data.join("gate/tasks/socket"))
            .env("MUSTER_GATE_TOKEN", &self.token)
            .env("MUSTER_LEASE", &self.lease)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("python starts")
    }

    fn gate_pid(&self) -> u32 {
        let pid = std::fs::read_to_string(self.data.join("gate/lock")).expect("a gate runs");
        pid.trim().parse().expect("its pid")
    }

    fn killed_holders(&self) -> Samples {
        let mut samples = Samples::default();
        for _ in 0..ROUNDS {
            let mut holder = self.holder();
            samples.push(self.driver.round(|| holder.kill().expect("it runs")));
            holder.wait().expect("it is ours");
        }
        samples
    }

    /// Frozen, which is what a cut link looks like: nothing is closed, nothing comes.
    fn silent_holders(&self) -> Samples {
        let mut samples = Samples::default();
        for _ in 0..ROUNDS {
            let mut holder = self.holder();
            samples.push(self.driver.round(|| kernel::freeze(holder.id(), true)));
            holder.kill().expect("it runs");
            holder.wait().expect("it is ours");
        }
        samples
    }

    async fn killed_agents(&mut self) -> Samples {
        let mut samples = Samples::default();
        for _ in 0..ROUNDS {
            let cluster = &mut self.cluster;
            samples.push(self.driver.round(|| cluster.kill_agent("robot")));
            self.cluster.restart_agent("robot").await;
        }
        samples
    }

    fn killed_gates(&self) -> Samples {
        let mut samples = Samples::default();
        for _ in 0..ROUNDS {
            samples.push(self.driver.round(|| kernel::kill(self.gate_pid())));
        }
        samples
    }

    async fn buttons(&self) -> Samples {
        let mut samples = Samples::default();
        for _ in 0..ROUNDS {
            let press = || std::fs::write(&self.button, "settle").expect("the directory is there");
            samples.push(self.driver.round(press));
            std::fs::remove_file(&self.button).expect("it was written");
            self.release().await;
        }
        samples
    }

    async fn persons(&self) -> Samples {
        let mut samples = Samples::default();
        let nodes = self.cluster.nodes().await;
        for _ in 0..ROUNDS {
            while self.driver.0.try_recv().is_ok() {}
            self.driver.next(false);
            let begin = Instant::now();
            let patch = Patch::Merge(json!({"spec": {"estop": "Settle"}}));
            nodes.patch("robot", &PatchParams::default(), &patch).await.expect("it is there");
            samples.push(self.driver.next(true).saturating_duration_since(begin));
            self.release().await;
        }
        samples
    }

    /// A person releases the stop, once the robot has told of it.
    async fn release(&self) {
        let nodes = self.cluster.nodes().await;
        let told = async |stopped: bool| {
            let is = |node: Option<&Node>| {
                let estop = node.and_then(|n| n.status.as_ref()).and_then(|s| s.estop.as_ref());
                estop.is_some_and(|estop| estop.tier.is_none() != stopped)
            };
            wait::object(nodes.clone(), "robot", "told of the stop", is).await
        };
        let estop = told(true).await.and_then(|node| node.status).and_then(|status| status.estop);
        let number = estop.map(|estop| estop.number);
        let patch = Patch::Merge(json!({"spec": {"estop": null, "estopRelease": number}}));
        nodes.patch("robot", &PatchParams::default(), &patch).await.expect("it is there");
        told(false).await;
    }
}

pub(crate) async fn all() {
    let floor = floor();
    floor.line("a byte there and back");
    let mut robot = Robot::start().await;
    let aim = |name: &str, samples: &Samples, aim: &str| {
        samples.line(name);
        let p99 = samples.quantile(0.99);
        figure(&format!("{name}, p99"), millis(p99), " ms", aim);
    };
    aim("the holder is killed", &robot.killed_holders(), "250 ms");
    aim("the holder is silent", &robot.silent_holders(), "250 ms");
    let mut holder = robot.holder();
    aim("the agent is killed", &robot.killed_agents().await, "250 ms");
    aim("the gate is killed", &robot.killed_gates(), "250 ms");
    aim("a button on the robot", &robot.buttons().await, "10 ms");
    aim("a person, by the controller", &robot.persons().await, "50 ms");
    holder.kill().expect("it runs");
    holder.wait().expect("it is ours");
}
