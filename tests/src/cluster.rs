//! Starting, killing and restarting the daemons.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::time::Instant;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use http::Request;
use kube::config::{KubeConfigOptions, Kubeconfig};
use kube::{Api, Client, Config};
use muster_api::kind::lease::Lease;
use muster_api::kind::node::Node;
use muster_api::kind::task::{Task, TaskStatus};
use muster_api::phase::TaskPhase;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::netns::Namespace;
use crate::{kernel, wait};

const API: &str = "/apis/muster.dev/v1alpha1";

/// A cluster of real processes. When it is dropped, every process of it is killed, those of its
/// tasks included, however the test ended.
#[derive(Debug)]
pub struct Cluster {
    dir: TempDir,
    controller: Option<Child>,
    agents: BTreeMap<String, Agent>,
    /// Taken from the kernel at the first start and kept for restarts.
    listen: String,
    /// Of the controller, beside those that every test's has.
    flags: Vec<String>,
    /// The controller's, where a test has said so.
    data_dir: PathBuf,
    /// Variables of the next start of each daemon, by its name.
    variables: BTreeMap<String, BTreeMap<String, String>>,
}

#[derive(Debug)]
struct Agent {
    options: AgentOptions,
    process: Option<Child>,
}

/// How an agent is started.
#[derive(Debug, Clone)]
pub struct AgentOptions {
    /// The node's name.
    pub name: String,
    /// Everything else, as on the command line.
    pub flags: Vec<String>,
    /// Where it keeps its data; none: beside the other agents'.
    pub data_dir: Option<PathBuf>,
    /// Whose network it has; none: the caller's.
    pub namespace: Option<Arc<Namespace>>,
}

impl AgentOptions {
    /// A robot with a kinect and a base at a fixed place, metres.
    #[must_use]
    pub fn robot(name: &str, x: f64, y: f64) -> Self {
        let flags = [
            "--kind",
            "robot",
            "--sr-res",
            "kinect:ImageGen;kinect:LaserGen",
            "--ar-res",
            "base:Drive;arm:Grasp",
        ];
        AgentOptions { flags: flags.map(str::to_owned).to_vec(), ..AgentOptions::bare(name) }
            .flag("--position", &format!("static:{x},{y}"))
    }

    /// One that says nothing of itself.
    #[must_use]
    pub fn bare(name: &str) -> Self {
        AgentOptions { name: name.to_owned(), flags: Vec::new(), data_dir: None, namespace: None }
    }

    /// A cloud server.
    #[must_use]
    pub fn cloud(name: &str) -> Self {
        AgentOptions::bare(name).flag("--kind", "cloud")
    }

    /// Adds a flag.
    #[must_use]
    pub fn flag(mut self, flag: &str, value: &str) -> Self {
        self.flags.extend([flag.to_owned(), value.to_owned()]);
        self
    }
}

/// A binary that was built with this test.
///
/// # Panics
///
/// When it is not there.
#[must_use]
pub fn binary(name: &str) -> PathBuf {
    built(name, "bins")
}

/// An example of the Rust SDK that was built with this test.
///
/// # Panics
///
/// When it is not there.
#[must_use]
pub fn example(name: &str) -> PathBuf {
    built(&format!("examples/{name}"), "examples")
}

fn built(path: &str, what: &str) -> PathBuf {
    let own = std::env::current_exe().expect("whoever runs has a path");
    let dir = own.parent().expect("a directory");
    // Tests are in target/PROFILE/deps, what they are about beside that.
    let profile = if dir.ends_with("deps") { dir.parent().expect("PROFILE") } else { dir };
    let path = profile.join(path);
    assert!(
        path.exists(),
        "{} is missing; `cargo build --workspace --{what}` makes it (tests/run does)",
        path.display()
    );
    path
}

impl Cluster {
    /// A controller without nodes.
    pub async fn start() -> Self {
        Self::start_with(&[]).await
    }

    /// The same, with flags of the controller's.
    pub async fn start_with(flags: &[&str]) -> Self {
        Self::start_at("127.0.0.1:0", flags).await
    }

    /// The same, at an address of the calling thread's namespace.
    pub async fn start_at(listen: &str, flags: &[&str]) -> Self {
        let mut cluster = Self::prepare(flags);
        listen.clone_into(&mut cluster.listen);
        cluster.start_controller().await;
        cluster
    }

    /// The same before the first start of the controller.
    #[must_use]
    pub fn prepare(flags: &[&str]) -> Self {
        // Both TLS providers may be linked in; the one that is meant must be said.
        drop(rustls::crypto::ring::default_provider().install_default());
        let dir = TempDir::with_prefix("muster-test-").expect("a temporary directory");
        Cluster {
            controller: None,
            agents: BTreeMap::new(),
            listen: "127.0.0.1:0".to_owned(),
            flags: flags.iter().map(|&flag| flag.to_owned()).collect(),
            data_dir: dir.path().join("controller"),
            variables: BTreeMap::new(),
            dir,
        }
    }

    /// Gives the daemon of this name (`controller`, or an agent's) a variable from its next start on, or takes it away.
    pub fn set_variable(&mut self, daemon: &str, name: &str, value: Option<&str>) {
        let all = self.variables.entry(daemon.to_owned()).or_default();
        match value {
            Some(value) => drop(all.insert(name.to_owned(), value.to_owned())),
            None => drop(all.remove(name)),
        }
    }

    /// Adds a flag of the controller's for its next start.
    pub fn add_flag(&mut self, flag: &str, value: &str) {
        self.flags.extend([flag.to_owned(), value.to_owned()]);
    }

    /// The directory with everything that the cluster writes.
    #[must_use]
    pub fn dir(&self) -> &Path {
        self.dir.path()
    }

    /// The admin's kubeconfig.
    #[must_use]
    pub fn kubeconfig(&self) -> PathBuf {
        self.dir.path().join("kubeconfig")
    }

    fn log(&self, name: &str) -> Stdio {
        let path = self.dir.path().join(format!("{name}.log"));
        File::options()
            .create(true)
            .append(true)
            .open(path)
            .expect("a log in the test's directory")
            .into()
    }

    /// Leaves everything where it is, also when the cluster ends.
    pub fn keep(&mut self) -> &Path {
        self.dir.disable_cleanup(true);
        self.dir.path()
    }

    /// What a daemon wrote.
    #[must_use]
    pub fn log_of(&self, name: &str) -> String {
        fs::read_to_string(self.dir.path().join(format!("{name}.log"))).unwrap_or_default()
    }

    /// Starts the controller (again, on the same port and data); returns when it is ready.
    pub async fn start_controller(&mut self) {
        let begun = Instant::now();
        let url = loop {
            self.spawn_controller();
            if let Some(url) = self.controller_ready().await {
                break url;
            }
            self.await_controller();
            // While it was away its port may have been given to whoever asked for any. No other end is passed over.
            let log = self.log_of("controller");
            let taken = log.lines().last().is_some_and(|line| line.contains("already in use"));
            assert!(taken && begun.elapsed() < wait::DEADLINE, "it does not start: {log}");
        };
        url.trim_start_matches("https://").clone_into(&mut self.listen);
    }

    /// Starts the controller's process, and does not wait for it to be ready.
    pub fn spawn_controller(&mut self) {
        assert!(self.controller.is_none(), "the controller runs");
        let child = Command::new(binary("muster-controller"))
            .args(["--listen", &self.listen, "--data-dir"])
            .arg(&self.data_dir)
            .arg("--kubeconfig")
            .arg(self.kubeconfig())
            .args(&self.flags)
            .envs(self.variables.get("controller").into_iter().flatten())
            .stdin(Stdio::null())
            .stdout(self.log("controller"))
            .stderr(self.log("controller"))
            .spawn()
            .expect("the controller starts");
        self.controller = Some(child);
    }

    /// Where the controller keeps its data.
    #[must_use]
    pub fn data_dir(&self) -> &Path {
        &self.data_dir
    }

    /// Where it does from its next start on.
    pub fn set_data_dir(&mut self, dir: PathBuf) {
        self.data_dir = dir;
    }

    /// Waits until the controller is ready, and gives its address; `None`: it has ended.
    async fn controller_ready(&self) -> Option<String> {
        let pid = self.controller_pid();
        wait::until("ready", || async {
            if kernel::start_time(pid).is_none() {
                return Ok(None);
            }
            let client = self.try_client().await?;
            let request = Request::get("/readyz").body(Vec::new()).expect("a request");
            client
                .request_text(request)
                .await
                .map_err(|e| format!("{e}: {}", self.log_of("controller")))?;
            Ok(Some(self.server_url()))
        })
        .await
    }

    fn server_url(&self) -> String {
        let kubeconfig =
            Kubeconfig::read_from(self.kubeconfig()).expect("written before it is ready");
        kubeconfig.clusters[0].cluster.as_ref().and_then(|c| c.server.clone()).expect("a server")
    }

    /// Where the controller listens.
    ///
    /// # Panics
    ///
    /// When it was never ready.
    #[must_use]
    pub fn address(&self) -> std::net::SocketAddr {
        self.listen.parse().expect("the kernel's choice")
    }

    /// The controller's process.
    #[must_use]
    pub fn controller_pid(&self) -> u32 {
        self.controller.as_ref().expect("it runs").id()
    }

    /// An agent's process.
    #[must_use]
    pub fn agent_pid(&self, name: &str) -> u32 {
        self.agents[name].process.as_ref().expect("it runs").id()
    }

    /// Kills the controller as a power cut would end it.
    pub fn kill_controller(&mut self) {
        let mut child = self.controller.take().expect("the controller runs");
        child.kill().expect("SIGKILL");
        child.wait().expect("it is ours");
    }

    /// Waits for the end of a daemon that ends by itself, and says how it did.
    pub async fn ended(&mut self, daemon: &str) -> ExitStatus {
        let process = match daemon {
            "controller" => &mut self.controller,
            agent => &mut self.agents.get_mut(agent).expect("an agent of this cluster").process,
        };
        let status = wait::until("ended", || {
            let ended = process.as_mut().expect("it runs").try_wait().expect("it is ours");
            std::future::ready(ended.ok_or_else(|| format!("{daemon} runs")))
        })
        .await;
        *process = None;
        status
    }

    /// Waits for the end of a controller that was told to end.
    pub fn await_controller(&mut self) {
        let mut child = self.controller.take().expect("the controller runs");
        child.wait().expect("it is ours");
    }

    async fn try_client(&self) -> Result<Client, String> {
        Client::try_from(self.try_config().await?).map_err(|e| e.to_string())
    }

    async fn try_config(&self) -> Result<Config, String> {
        let kubeconfig = Kubeconfig::read_from(self.kubeconfig()).map_err(|e| e.to_string())?;
        let options = KubeConfigOptions::default();
        let config = Config::from_custom_kubeconfig(kubeconfig, &options).await;
        config.map_err(|e| e.to_string())
    }

    /// What a client of the admin's is made of, for one on another runtime.
    pub async fn client_config(&self) -> Config {
        self.try_config().await.expect("the kubeconfig is good")
    }

    /// A client with the admin's credential.
    pub async fn client(&self) -> Client {
        self.try_client().await.expect("the kubeconfig is good")
    }

    /// A join token.
    pub async fn token(&self) -> String {
        let answer = self.post(&format!("{API}/jointokens"), &json!({})).await;
        answer.pointer("/status/token").and_then(Value::as_str).expect("a token").to_owned()
    }

    /// POST as the admin; the answer's JSON.
    pub async fn post(&self, path: &str, body: &Value) -> Value {
        let (client, body) = (self.client().await, serde_json::to_vec(body).expect("JSON"));
        let told = wait::until("an answer to a write", || async {
            let request = Request::post(path).header("content-type", "application/json");
            let request = request.body(body.clone()).expect("a request");
            match client.request::<Value>(request).await {
                // Nothing was written: a busy disk. Every client tries that again.
                Err(kube::Error::Api(status)) if status.code == 503 => Err(status.message),
                told => Ok(told),
            }
        })
        .await;
        told.expect("the controller takes it")
    }

    /// GET as the admin; the answer's JSON.
    pub async fn get(&self, path: &str) -> Value {
        let request = Request::get(path).body(Vec::new()).expect("a request");
        self.client().await.request(request).await.expect("the controller answers")
    }

    /// A counter of the controller, of all its labels together; 0: it has not counted yet.
    pub async fn counter(&self, name: &str) -> u64 {
        let request = Request::get("/metrics").body(Vec::new()).expect("a request");
        let text = self.client().await.request_text(request).await.expect("metrics");
        let own = text.lines().filter(|line| {
            line.strip_prefix(name).is_some_and(|rest| rest.starts_with(['{', ' ']))
        });
        let values = own.filter_map(|line| line.rsplit(' ').next()?.parse::<u64>().ok());
        values.sum()
    }

    /// Messages between frameworks and executors that have passed the controller.
    pub async fn messages(&self) -> u64 {
        self.counter("muster_framework_messages_total").await
    }

    /// TLS with the admin's certificate, for a protocol that is not HTTP.
    pub fn admin_tls(&self, protocol: &[u8]) -> rustls::ClientConfig {
        // Of one file, which is replaced whole.
        let config = fs::read_to_string(self.kubeconfig()).expect("the controller's own");
        let read = |field: &str| {
            let value = config.lines().find_map(|line| line.trim().strip_prefix(field));
            STANDARD.decode(value.expect(field).trim()).expect("base64")
        };
        let ca = read("certificate-authority-data:");
        let (certificate, key) = (read("client-certificate-data:"), read("client-key-data:"));
        let mut roots = rustls::RootCertStore::empty();
        roots.add(CertificateDer::from_pem_slice(&ca).expect("a CA")).expect("a CA");
        let certificate = CertificateDer::from_pem_slice(&certificate).expect("a certificate");
        let key = PrivateKeyDer::from_pem_slice(&key).expect("a key");
        let mut config = rustls::ClientConfig::builder()
            .with_root_certificates(roots)
            .with_client_auth_cert(vec![certificate], key)
            .expect("a pair");
        config.alpn_protocols = vec![protocol.to_vec()];
        config
    }

    /// The log of a task of the default namespace.
    pub async fn task_log(&self, task: &str) -> String {
        self.try_task_log(task).await.expect("a log")
    }

    /// The same inside a wait. A node that is not heard for a moment refuses it.
    ///
    /// # Errors
    ///
    /// What the controller says when there is none now.
    pub async fn try_task_log(&self, task: &str) -> Result<String, String> {
        let request = Request::get(format!("{API}/namespaces/default/tasks/{task}/log"));
        let request = request.body(Vec::new()).expect("a request");
        self.client().await.request_text(request).await.map_err(|error| error.to_string())
    }

    /// Joins an agent; returns when its node is ready.
    pub async fn join(&mut self, options: AgentOptions) {
        let token = self.token().await;
        let name = options.name.clone();
        self.enlist(options);
        self.spawn_agent(&name, Some(&token));
        self.node_ready(&name).await;
    }

    /// Makes an agent known, and does not start it.
    pub fn enlist(&mut self, options: AgentOptions) {
        self.agents.insert(options.name.clone(), Agent { options, process: None });
    }

    /// Starts an agent's process, and does not wait for its node.
    pub fn spawn_agent(&mut self, name: &str, token: Option<&str>) {
        let options = self.agents[name].options.clone();
        let mut command = Command::new(binary("muster-agent"));
        command
            .args(["--join", &format!("https://{}", self.listen), "--name", name])
            .arg("--data-dir")
            .arg(options.data_dir.unwrap_or_else(|| self.dir.path().join(name)))
            .args(&options.flags)
            .envs(self.variables.get(name).into_iter().flatten())
            .stdin(Stdio::null())
            .stdout(self.log(name))
            .stderr(self.log(name));
        if let Some(token) = token {
            command.args(["--token", token]);
        }
        let child = match options.namespace {
            Some(namespace) => namespace.run(move || command.spawn()),
            None => command.spawn(),
        };
        let child = child.expect("the agent starts");
        self.agents.get_mut(name).expect("known").process = Some(child);
    }

    /// Kills an agent as a power cut would end it; what it runs goes on.
    pub fn kill_agent(&mut self, name: &str) {
        let agent = self.agents.get_mut(name).expect("an agent of this cluster");
        let mut child = agent.process.take().expect("it runs");
        child.kill().expect("SIGKILL");
        child.wait().expect("it is ours");
    }

    /// Starts a killed agent again, without a token; returns when its node is ready by its word.
    pub async fn restart_agent(&mut self, name: &str) {
        let node = self.nodes().await.get(name).await.expect("it has joined");
        let before = node.status.and_then(|status| status.incarnation);
        self.spawn_agent(name, None);
        // Of the one that was killed the node may still be called ready.
        let back = |n: Option<&Node>| {
            n.and_then(|n| n.status.as_ref())
                .is_some_and(|s| s.is_ready() && s.incarnation != before)
        };
        wait::object(self.nodes().await, name, "ready again", back).await;
    }

    /// Changes a flag of an agent's command line, for its next start.
    pub fn set_flag(&mut self, name: &str, from: &str, to: &str) {
        let agent = self.agents.get_mut(name).expect("an agent of this cluster");
        let flag =
            agent.options.flags.iter_mut().find(|flag| *flag == from).expect("it has this flag");
        to.clone_into(flag);
    }

    /// Waits until a node is ready.
    pub async fn node_ready(&self, name: &str) -> Node {
        let ready =
            |n: Option<&Node>| n.and_then(|n| n.status.as_ref()).is_some_and(|s| s.is_ready());
        let node = wait::object(self.nodes().await, name, "ready", ready).await;
        node.expect("it is ready, so it is there")
    }

    /// Nodes.
    pub async fn nodes(&self) -> Api<Node> {
        Api::all(self.client().await)
    }

    /// Leases.
    pub async fn leases(&self) -> Api<Lease> {
        Api::all(self.client().await)
    }

    /// Tasks of the default namespace.
    pub async fn tasks(&self) -> Api<Task> {
        Api::namespaced(self.client().await, "default")
    }

    /// Creates a task of the default namespace.
    pub async fn create(&self, name: &str, spec: Value) -> Task {
        let object = json!({
            "apiVersion": muster_api::API_VERSION,
            "kind": "Task",
            "metadata": { "name": name },
            "spec": spec,
        });
        let task: Task = serde_json::from_value(object).expect("a task");
        self.tasks().await.create(&Default::default(), &task).await.expect("the task is taken")
    }

    /// Waits until a task's status satisfies `condition`.
    pub async fn task(
        &self,
        name: &str,
        what: &str,
        condition: impl Fn(&TaskStatus) -> bool,
    ) -> Task {
        let holds = |t: Option<&Task>| t.and_then(|t| t.status.as_ref()).is_some_and(&condition);
        wait::object(self.tasks().await, name, what, holds)
            .await
            .expect("it has a status, so it is there")
    }

    /// Waits until a task is in a phase.
    pub async fn phase(&self, name: &str, phase: TaskPhase) -> Task {
        self.task(name, phase.as_str(), |s| s.phase == phase).await
    }

    /// Deletes a task and waits until it is gone.
    pub async fn delete(&self, name: &str) {
        let api = self.tasks().await;
        api.delete(name, &Default::default()).await.expect("it is there");
        wait::object(api, name, "gone", |t| t.is_none()).await;
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        let children = self.controller.take().into_iter();
        for mut child in children.chain(self.agents.values_mut().filter_map(|a| a.process.take())) {
            // It may have ended by itself; either way it is gone afterwards.
            drop(child.kill());
            drop(child.wait());
        }
        // Tasks outlive their agents by design.
        let own = [self.dir.path().to_owned()].into_iter();
        let elsewhere = self.agents.values().filter_map(|agent| agent.options.data_dir.clone());
        for dir in own.chain(elsewhere) {
            end_all(&dir.display().to_string());
        }
        if std::thread::panicking() {
            for name in ["controller"].into_iter().chain(self.agents.keys().map(String::as_str)) {
                eprintln!("--- {name} ---\n{}", self.log_of(name));
            }
        }
    }
}

/// Ends what names this directory: shims in their arguments, tasks in their environment.
fn end_all(dir: &str) {
    let tasks = fs::read_dir("/proc")
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|e| e.file_name().to_str()?.parse::<u32>().ok());
    let in_environment = tasks.filter(|pid| {
        fs::read(format!("/proc/{pid}/environ"))
            .is_ok_and(|e| String::from_utf8_lossy(&e).contains(dir))
    });
    for pid in kernel::with_command(dir).into_iter().chain(in_environment) {
        kernel::kill(pid);
    }
}
