//! The cluster that is broken: a controller and three agents as processes, a namespace and a wire for each agent, disks that
//! can be full, clocks that can be wrong.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use kube::{Api, Client};
use muster_api::kind::node::Node;
use muster_tests::netns::{Namespace, ip};
use muster_tests::wire::Wire;
use muster_tests::{AgentOptions, Cluster, docker, kernel};
use serde_json::json;
use tempfile::TempDir;

use crate::fault::Fault;
use crate::report::Report;
use crate::residents;

/// Where the controller is, whatever becomes of it; agents find it over their wires.
const ADDRESS: &str = "10.99.0.1";
/// What makes dates as a file says, from Debian's package `libfaketime`; below `/usr/lib/ARCH-linux-gnu`.
const CLOCK: &str = "faketime/libfaketimeMT.so.1";
/// How long a request may take before it is asked anew.
pub(crate) const PATIENCE: Duration = Duration::from_secs(2);
/// Nothing takes so long, on any machine; what does is a fault.
pub(crate) const DEADLINE: Duration = Duration::from_secs(60);

/// Everything.
pub(crate) struct House {
    pub(crate) cluster: Cluster,
    pub(crate) machines: Vec<Machine>,
    /// Where programs write down that they run.
    pub(crate) witness: PathBuf,
    /// The controller's disk and clock.
    pub(crate) disk: Disk,
    pub(crate) clock: Clock,
    pub(crate) client: Client,
    /// Creating and starting a container takes the engine so long without anybody else.
    pub(crate) container: Duration,
}

/// What an agent has.
pub(crate) struct Machine {
    pub(crate) name: &'static str,
    pub(crate) wire: Wire,
    pub(crate) disk: Option<Disk>,
    pub(crate) clock: Clock,
    /// What the driver behind its gate has heard; a robot's.
    pub(crate) heard: Option<PathBuf>,
}

/// A small file system in memory.
#[derive(Debug)]
pub(crate) struct Disk(TempDir);

impl Disk {
    fn new() -> Disk {
        let dir = TempDir::with_prefix("muster-test-disk-").expect("a directory");
        let made = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=96m,mode=0755", "muster"])
            .arg(dir.path())
            .status();
        assert!(made.expect("mount").success(), "root may mount a tmpfs");
        Disk(dir)
    }

    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }

    /// Not a byte is left.
    pub(crate) fn fill(&self) {
        let mut file = fs::File::create(self.filler()).expect("there is room still");
        let mut piece = vec![0; 1 << 20];
        while !piece.is_empty() {
            if file.write_all(&piece).is_err() {
                piece.truncate(piece.len() / 2);
            }
        }
    }

    pub(crate) fn empty(&self) {
        let _ = fs::remove_file(self.filler());
    }

    fn filler(&self) -> PathBuf {
        self.0.path().join("filler")
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0.path()).status();
    }
}

/// A date that can be moved while others keep time by the monotonic clock.
#[derive(Debug)]
pub(crate) struct Clock(PathBuf);

impl Clock {
    fn new(path: PathBuf) -> Clock {
        let clock = Clock(path);
        clock.set(0);
        clock
    }

    /// The date is off by so many seconds, from now on.
    pub(crate) fn set(&self, seconds: i64) {
        let new = self.0.with_extension("new");
        fs::write(&new, format!("{seconds:+}\n")).expect("the directory is there");
        fs::rename(&new, &self.0).expect("the same directory");
    }

    fn env(&self) -> [(&'static str, String); 4] {
        [
            ("LD_PRELOAD", library()),
            ("FAKETIME_TIMESTAMP_FILE", self.0.display().to_string()),
            ("FAKETIME_CACHE_DURATION", "1".to_owned()),
            ("FAKETIME_DONT_FAKE_MONOTONIC", "1".to_owned()),
        ]
    }
}

fn library() -> String {
    let dirs = fs::read_dir("/usr/lib").expect("Debian has it").flatten();
    let found = dirs.map(|dir| dir.path().join(CLOCK)).find(|path| path.exists());
    let found = found.expect("Debian's libfaketime is installed (tests/run does)");
    found.display().to_string()
}

impl House {
    pub(crate) async fn build() -> House {
        docker::image();
        ip(&format!("addr add {ADDRESS}/32 dev lo"));
        let mut cluster = Cluster::start_at(&format!("{ADDRESS}:0"), &[]).await;
        let (disk, clock) = (Disk::new(), Clock::new(cluster.dir().join("controller.clock")));
        for (name, value) in clock.env() {
            cluster.set_variable("controller", name, Some(&value));
        }
        cluster.kill_controller();
        move_data(&mut cluster, disk.path().join("controller"));
        cluster.start_controller().await;
        let witness = cluster.dir().join("witness");
        for dir in ["locks", "starts"] {
            fs::create_dir_all(witness.join(dir)).expect("the test's directory");
        }
        let client = cluster.client().await;
        let container = Duration::ZERO;
        let mut house =
            House { cluster, machines: Vec::new(), witness, disk, clock, client, container };
        house.add(AgentOptions::robot("robot-1", 0.0, 0.0), None).await;
        house.add(AgentOptions::robot("robot-2", 5.0, 0.0), Some(Disk::new())).await;
        house.add(AgentOptions::cloud("cloud-1"), None).await;
        house
    }

    async fn add(&mut self, options: AgentOptions, disk: Option<Disk>) {
        let name: &'static str = match options.name.as_str() {
            "robot-1" => "robot-1",
            "robot-2" => "robot-2",
            _ => "cloud-1",
        };
        let number = u8::try_from(self.machines.len() + 1).expect("a few");
        let namespace = Arc::new(Namespace::new(name));
        let wire = Wire::lay(number, &namespace);
        let clock = Clock::new(self.cluster.dir().join(format!("{name}.clock")));
        let mut options = options.flag("--cpu", "4").flag("--memory", "4Gi");
        let heard = options.flags.iter().any(|flag| flag == "robot").then(|| {
            let heard = self.cluster.dir().join(format!("{name}.heard"));
            let drivers = json!([{
                "actuators": ["base:Drive", "arm:Grasp"],
                "exec": ["sh", "-c", format!("exec cat >> {}", heard.display())],
                "stop": "stop",
            }]);
            let config = self.cluster.dir().join(format!("{name}.yaml"));
            // JSON is YAML.
            let text = json!({"gate": {"drivers": drivers}}).to_string();
            fs::write(&config, text).expect("the directory is there");
            options = options.clone().flag("--config", &config.display().to_string());
            heard
        });
        for (variable, value) in clock.env() {
            self.cluster.set_variable(name, variable, Some(&value));
        }
        options.data_dir = disk.as_ref().map(|disk| disk.path().join("agent"));
        options.namespace = Some(namespace);
        self.cluster.join(options).await;
        self.machines.push(Machine { name, wire, disk, clock, heard });
    }

    pub(crate) fn machine(&self, name: &str) -> &Machine {
        self.machines.iter().find(|m| m.name == name).expect("one of the three")
    }

    /// Where an agent keeps its data.
    pub(crate) fn data_dir(&self, machine: &Machine) -> PathBuf {
        let disk = machine.disk.as_ref().map(|disk| disk.path().join("agent"));
        disk.unwrap_or_else(|| self.cluster.dir().join(machine.name))
    }

    /// The controller's data is copied, the copy is what counts from its next start on, and the old is gone.
    pub(crate) fn move_controller(&mut self) {
        let old = self.cluster.data_dir().to_owned();
        let new =
            self.disk.path().join(if old.ends_with("controller") { "copy" } else { "controller" });
        move_data(&mut self.cluster, new);
    }

    /// Measures what a container takes without anybody else.
    pub(crate) fn time_container(&mut self) {
        self.container = time_container();
    }

    pub(crate) fn nodes(&self) -> Api<Node> {
        Api::all(self.client.clone())
    }

    /// Whether the controller takes a node for ready; none: it does not answer.
    pub(crate) async fn is_ready(&self, node: &str) -> Option<bool> {
        let node = tokio::time::timeout(PATIENCE, self.nodes().get(node)).await.ok()?.ok()?;
        Some(node.status.is_some_and(|status| status.is_ready()))
    }

    /// Waits until every node is ready and its agent answers through the controller; gives how long that took, and says it
    /// of a fault that ended at the beginning.
    pub(crate) async fn settle(&mut self, report: &mut Report, fault: Option<Fault>) {
        let begun = Instant::now();
        for machine in &self.machines {
            while !self.answers(machine.name).await {
                if begun.elapsed() > DEADLINE {
                    report.broken(format!(
                        "{}: not ready {DEADLINE:?} after {fault:?}",
                        machine.name
                    ));
                    return;
                }
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        }
        if let Some(fault) = fault {
            report.recovered(fault, begun.elapsed());
        }
    }

    /// Its agent answers what only it can know.
    async fn answers(&self, node: &str) -> bool {
        if self.is_ready(node).await != Some(true) {
            return false;
        }
        let log = residents::keeps(node);
        let path = format!("/apis/muster.dev/v1alpha1/namespaces/default/tasks/{log}/log");
        let request = http::Request::get(path).body(Vec::new()).expect("a request");
        let asked = tokio::time::timeout(PATIENCE, self.client.request_text(request)).await;
        asked.is_ok_and(|answer| answer.is_ok())
    }

    /// What was written stays for whoever looks for the cause.
    pub(crate) fn keep(&mut self) {
        println!("what the daemons wrote is in {}", self.cluster.keep().display());
    }
}

fn move_data(cluster: &mut Cluster, to: PathBuf) {
    let from = cluster.data_dir().to_owned();
    let copied = Command::new("cp").arg("-a").arg(&from).arg(&to).status();
    assert!(copied.expect("cp").success(), "there is room for a copy");
    fs::remove_dir_all(&from).expect("it is ours");
    cluster.set_data_dir(to);
}

/// The floor of what a container can take, now: of three, the middle one.
fn time_container() -> Duration {
    let mut times: Vec<Duration> = (0..3)
        .map(|_| {
            let begun = Instant::now();
            let ran = Command::new("docker")
                .args(["run", "--rm", "--network", "none", docker::IMAGE, "true"])
                .status();
            assert!(ran.expect("the docker client").success(), "the engine runs a container");
            begun.elapsed()
        })
        .collect();
    times.sort();
    times[1]
}

/// Processes whose command line has all of these.
pub(crate) fn processes(words: &[&str]) -> Vec<u32> {
    let mut found = kernel::with_command(words[0]);
    found.retain(|pid| {
        let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let line = String::from_utf8_lossy(&line).into_owned();
        words.iter().all(|word| line.contains(word))
    });
    found
}
