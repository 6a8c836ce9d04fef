//! Starts, joins and ends everything. Nothing else spawns what outlives its caller.
//!
//! | task | owns | ends |
//! |---|---|---|
//! | main loop | supervisor | on shutdown |
//! | link | session, the node's face | dropped on shutdown |
//! | renewal | the certificate | dropped on shutdown |
//! | images | pulls before tasks need them | dropped on shutdown |
//! | topics | ROS nodes that count for probes | dropped on shutdown |
//! | simulator | the robot that is not there, and where it is | dropped on shutdown; its process stays |
//! | sensors | sources that tasks read | when they are told to, before the agent does |
//! | drivers | one task each | when their inbox closes; processes stay |

use std::fs::{self, File};
use std::os::fd::AsFd;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, Instant};

use muster_api::id::TaskUid;
use rustix::fs::FlockOperation;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

use crate::board::Board;
use crate::capacity;
use crate::checkpoint::Checkpoint;
use crate::clock;
use crate::config::{Args, Config, ConfigError, Identity, Kind};
use crate::contact::Contact;
use crate::driver::{Shared, chain};
use crate::durable::FileError;
use crate::executor::desk::Desks;
use crate::executor::direct::Door;
use crate::executor::work::WorkRuntime;
use crate::footprint;
use crate::gate;
use crate::gate::Standing;
use crate::gate::keeper::{Keeper, end_former};
use crate::given::files::Place;
use crate::images::Images;
use crate::link::dial::Dialer;
use crate::link::join::{self, Credentials, JoinError};
use crate::link::orders::Orders;
use crate::link::renewal::Renewal;
use crate::link::session::{Command, Link};
use crate::link::token::{Token, TokenError};
use crate::link::{Address, AddressError};
use crate::node::{Enforced, Facts, Node};
use crate::probe::topic::Topics;
use crate::ros::Ros;
use crate::runtime::Runtime;
use crate::runtime::cgroup::Kernel;
use crate::runtime::cgroup::hierarchy::Version;
use crate::runtime::docker::{DockerConfig, DockerRuntime};
use crate::runtime::process::{ProcessConfig, ProcessRuntime, Reexec};
use crate::sensor::Sensors;
use crate::sim;
use crate::sim::keeper::Simulator;
use crate::supervisor::Supervisor;

/// Why the agent does not run.
#[derive(Debug, thiserror::Error)]
pub enum AgentError {
    /// A setting makes no sense.
    #[error("the agent's settings are wrong")]
    Config(#[from] ConfigError),
    /// A setting is missing.
    #[error("{0} is missing")]
    Missing(&'static str),
    /// `--join` is no address.
    #[error("--join")]
    Address(#[from] AddressError),
    /// `--token` is no token.
    #[error("--token")]
    Token(#[from] TokenError),
    /// The data directory is another node's.
    #[error("{dir} belongs to the {what} {theirs:?}, not to {ours:?}")]
    OtherNode {
        /// The directory.
        dir: PathBuf,
        /// `node` or `kind`.
        what: &'static str,
        /// Whose it is.
        theirs: String,
        /// Who asked.
        ours: String,
    },
    /// Another agent runs on the data directory.
    #[error("another agent runs on {0}")]
    InUse(PathBuf),
    /// The data directory cannot be used.
    #[error("the data directory cannot be used")]
    Files(#[from] FileError),
    /// The controller does not let it in.
    #[error("this agent has not joined")]
    Join(#[from] JoinError),
    /// The system gives no event loop.
    #[error("failed to start")]
    Runtime(#[source] std::io::Error),
}

impl AgentError {
    /// What to do about it.
    #[must_use]
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            AgentError::Missing("--token") => {
                Some("this agent has not joined yet; `muster token create` makes a token")
            }
            AgentError::InUse(_) | AgentError::OtherNode { .. } => {
                Some("give each agent of a machine its own --data-dir")
            }
            AgentError::Join(JoinError::Refused { .. } | JoinError::WrongCa(_))
            | AgentError::Token(_) => Some("`muster token create` makes a new token"),
            _ => None,
        }
    }

    /// 2: the user's settings; 3: the controller says no; 1: anything else.
    #[must_use]
    pub fn exit_code(&self) -> u8 {
        match self {
            AgentError::Config(_)
            | AgentError::Missing(_)
            | AgentError::Address(_)
            | AgentError::Token(_)
            | AgentError::OtherNode { .. } => 2,
            AgentError::Join(_) => 3,
            AgentError::InUse(_) | AgentError::Files(_) | AgentError::Runtime(_) => 1,
        }
    }
}

/// Runs an agent until a signal ends it. Tasks stay.
pub fn run(args: Args, reexec: Reexec) -> ExitCode {
    footprint::keep_buffers();
    let done = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        // For short file work only; each thread costs memory on a robot.
        .max_blocking_threads(4)
        .build()
        .map_err(AgentError::Runtime)
        .and_then(|runtime| {
            runtime.block_on(async {
                let shutdown = CancellationToken::new();
                let until = shutdown.clone();
                tokio::select! {
                    done = serve(args, reexec, shutdown) => done,
                    // Cancels `serve` by its token, so that it ends in order.
                    () = signalled(until) => Ok(()),
                }
            })
        });
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}", chain(&error));
            if let Some(hint) = error.hint() {
                eprintln!("hint: {hint}");
            }
            ExitCode::from(error.exit_code())
        }
    }
}

/// Never resolves: it cancels, and lets `serve` be the one that ends.
async fn signalled(shutdown: CancellationToken) {
    use tokio::signal::unix::{SignalKind, signal};
    let (Ok(mut term), Ok(mut int)) =
        (signal(SignalKind::terminate()), signal(SignalKind::interrupt()))
    else {
        return std::future::pending().await;
    };
    tokio::select! {
        _ = term.recv() => {}
        _ = int.recv() => {}
    }
    shutdown.cancel();
    std::future::pending().await
}

/// Runs an agent until `shutdown`. Tasks stay.
///
/// # Errors
///
/// When it cannot start; once it runs, it runs.
pub async fn serve(
    args: Args,
    reexec: Reexec,
    shutdown: CancellationToken,
) -> Result<(), AgentError> {
    let config = args.resolve()?;
    make_data_dir(&config.data_dir)?;
    let _lock = lock(&config.data_dir)?;
    let mut identity = Identity::open(&config.data_dir)?;
    let (kind, address) = settle(&config, &mut identity)?;
    let Some(name) = identity.node.clone() else { return Err(AgentError::Missing("--name")) };
    let credentials = Credentials::at(&config.data_dir);
    let token: Option<Token> = config.token.as_deref().map(str::parse).transpose()?;
    match token {
        None if !credentials.exist() => return Err(AgentError::Missing("--token")),
        Some(token) if !credentials.exist() || !credentials.came_by(&token) => {
            match join::join(&address, &token, &name, kind, &credentials).await {
                Ok(()) => tracing::info!(node = %name, controller = %address, "joined"),
                // A token that was left in a start script must not keep a joined robot out.
                Err(error) if credentials.exist() => {
                    tracing::warn!(
                        error = chain(&error),
                        "going on with the credentials of before"
                    );
                }
                Err(error) => return Err(error.into()),
            }
        }
        _ => {}
    }
    credentials.settle()?;
    // Only now: a join that failed must not tie the directory to a name.
    identity.write(&config.data_dir)?;
    config.declared.keep(&config.data_dir)?;
    if !config.remembered.is_empty() {
        tracing::info!(flags = config.remembered.join(" "), "not given now; kept as given last");
    }

    let enforcer = enforcer(&identity.id).await;
    let enforced = match &enforcer {
        Ok(kernel) => Ok(Enforced {
            version: match kernel.hierarchy().version() {
                Version::V1 => 1,
                Version::V2 => 2,
            },
        }),
        Err(why) => Err(why.clone()),
    };
    let capacity = capacity::detect(config.cpu, config.memory);
    let checkpoint = Checkpoint::open(&config.data_dir)?;
    let records = checkpoint.read_all()?;
    let contact_file = config.data_dir.join("contact");
    let files = Place::find(&identity.id, checkpoint.tasks());
    files.sweep(&records.iter().map(|record| record.workload.uid.clone()).collect());
    let boot_id = clock::boot_id();
    let process = ProcessRuntime::new(
        ProcessConfig {
            tasks: checkpoint.tasks().to_owned(),
            files: files.clone(),
            reexec: reexec.clone(),
            contact: contact_file.clone(),
            log: config.log,
            unenforced: config.unenforced_quotas,
        },
        enforcer,
    );
    let docker = DockerRuntime::new(DockerConfig {
        socket: config.docker_socket.clone(),
        identity: identity.id.clone(),
        tasks: checkpoint.tasks().to_owned(),
        files: files.clone(),
        reexec: reexec.clone(),
        contact: contact_file.clone(),
    });
    let (sweeper, retiree) = (process.clone(), process.clone());
    if let Err(error) = tokio::task::spawn_blocking(move || sweeper.sweep()).await {
        tracing::error!(%error, "leftovers were not swept");
    }
    let contact = Arc::new(Contact::open(&contact_file, &boot_id)?);
    let gate_dir = config.data_dir.join(gate::DIR);
    let keeper = if config.gate.is_empty() {
        end_former(&gate_dir).await;
        None
    } else {
        let setup = config.gate.clone().set_up(&config.pose, name.as_str());
        Some(Arc::new(Keeper::new(setup, gate_dir, &reexec)))
    };
    let simulator = config.simulated.as_ref().map(|settings| {
        Arc::new(Simulator::new(settings, config.data_dir.join(sim::DIR), &reexec))
    });
    let desks = Arc::new(Desks::new(checkpoint.clone(), name.clone()));
    let works = WorkRuntime { desks: Arc::clone(&desks), contact: Arc::clone(&contact) };
    let topics = Arc::new(Topics::new(Ros::new(&config), &name));
    let sensors = Arc::new(Sensors::new(&config, &name));
    let shared = Arc::new(Shared {
        node: name,
        contact,
        desks,
        execs: Arc::default(),
        works: Arc::new(works) as Arc<dyn Runtime>,
        gate: keeper.clone(),
        sensors: Arc::clone(&sensors),
        images: Images::default(),
        topics,
        boot_id,
        checkpoint,
        files,
        board: Board::default(),
        process: Arc::new(process) as Arc<dyn Runtime>,
        docker: Arc::new(docker.clone()) as Arc<dyn Runtime>,
        allocatable_memory: capacity.allocatable.memory.0,
    });
    let facts = Facts { kind, capacity, enforced, address: host_name() };
    let node = Node::new(&config, facts, Arc::clone(&shared), simulator.as_deref());
    let (files, execs) = (shared.files.clone(), Arc::clone(&shared.execs));
    let mut supervisor = Supervisor::new(Arc::clone(&shared));
    tracing::info!(node = %shared.node, tasks = records.len(), "started");
    shared.restore(&records)?;
    supervisor.restore(records);

    let (commands, mut received) = mpsc::channel(16);
    let serving = credentials.serving(&shared.node)?;
    if serving.is_none() {
        tracing::info!(
            "this node's certificate is an older one: its messages pass the controller; a new token brings a new one"
        );
    }
    let serving = serving.map(|config| watch::Sender::new(Arc::new(config)));
    let shown = serving.as_ref().map(watch::Sender::subscribe);
    let door = Door::new(config.messages.clone(), shown, Arc::clone(&shared.desks));
    let client = watch::Sender::new(Arc::new(credentials.tls()?));
    let dialer = Dialer { address: address.clone(), tls: client.subscribe() };
    let renewal = Renewal {
        address,
        node: shared.node.clone(),
        kind,
        credentials,
        client,
        server: serving,
        shown: Vec::new(),
    };
    let _renewal = AbortOnDropHandle::new(tokio::spawn(renewal.run()));
    let orders = keeper.clone().map(|gate| Orders {
        dialer: dialer.clone(),
        gate,
        heard: watch::Sender::default(),
    });
    let link = Link {
        ordered: orders.as_ref().map(|orders| orders.heard.subscribe()),
        dialer,
        incarnation: uuid::Uuid::new_v4().to_string(),
        shared,
        commands,
    };
    let images = Arc::clone(&link.shared);
    let images =
        AbortOnDropHandle::new(tokio::spawn(
            async move { images.images.run(&*images.docker).await },
        ));
    let topics = Arc::clone(&link.shared.topics);
    let topics = AbortOnDropHandle::new(tokio::spawn(async move { topics.run().await }));
    let unread = CancellationToken::new();
    let reading = unread.clone();
    let reading = tokio::spawn(async move { sensors.run(reading).await });
    let engine = tokio::spawn(async move { docker.run().await });
    // Before the gate, which looks for its drivers.
    let simulator = simulator.map(|s| AbortOnDropHandle::new(tokio::spawn(s.run())));
    // It knows by now which tasks may live: what it says first does not take the robot from any of them.
    let gate = keeper.clone().map(|keeper| AbortOnDropHandle::new(tokio::spawn(keeper.run())));
    let _orders = orders.map(|orders| AbortOnDropHandle::new(tokio::spawn(orders.run())));
    let session = tokio::spawn(link.run(node, door));
    let mut standing = keeper.as_ref().map(|keeper| keeper.standing());
    let mut settled = false;
    loop {
        // Cancel-safe: receivers, a join and a token.
        tokio::select! {
            () = shutdown.cancelled() => break,
            command = received.recv() => match command {
                Some(Command::Assign(assignments)) => supervisor.assign(assignments),
                Some(Command::Contact) => {
                    supervisor.tick();
                    if !std::mem::replace(&mut settled, true) {
                        footprint::give_back();
                    }
                }
                // The link never ends by itself: it panicked. The tasks go on without it.
                None => {
                    tracing::error!("the link is gone; start this agent again");
                    shutdown.cancelled().await;
                    break;
                }
            },
            task = given_back(&mut standing) => supervisor.give_back(&task),
            () = supervisor.ended() => {}
        }
    }
    // Before the tasks' drivers go: the robot may go on meanwhile.
    if let Some(keeper) = &keeper {
        keeper.leave().await;
    }
    drop((gate, simulator, images, topics));
    // Its programs get the time to let their devices go.
    unread.cancel();
    session.abort();
    engine.abort();
    let _ = (session.await, engine.await);
    execs.end().await;
    supervisor.shut_down().await;
    let _ = reading.await;
    retiree.retire();
    files.retire();
    tracing::info!("the agent ends; its tasks stay");
    Ok(())
}

/// The next task whose right to drive the gate gives back. Cancel-safe: what was seen was returned.
async fn given_back(standing: &mut Option<watch::Receiver<Standing>>) -> TaskUid {
    if let Some(standing) = standing {
        while standing.changed().await.is_ok() {
            if let Some(task) = standing.borrow_and_update().gives_back() {
                return task;
            }
        }
    }
    // There is no gate, or its keeper has ended with the agent.
    std::future::pending().await
}

fn make_data_dir(dir: &Path) -> Result<(), FileError> {
    // Passable, not listable: tasks of other users have their work directories in it.
    fs::DirBuilder::new()
        .recursive(true)
        .mode(0o711)
        .create(dir)
        .map_err(FileError::at("make", dir))
}

/// An agent that was killed while it started a program is not gone before that program is executed: until then it has the
/// agent's files.
const LOCK_WITHIN: Duration = Duration::from_secs(2);
/// Between two tries.
const LOCK_AGAIN: Duration = Duration::from_millis(20);

fn lock(dir: &Path) -> Result<File, AgentError> {
    let path = dir.join("lock");
    let file = File::create(&path).map_err(FileError::at("open", &path))?;
    let tries_until = Instant::now() + LOCK_WITHIN;
    loop {
        match rustix::fs::flock(file.as_fd(), FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => return Ok(file),
            Err(rustix::io::Errno::WOULDBLOCK) if Instant::now() < tries_until => {
                std::thread::sleep(LOCK_AGAIN);
            }
            Err(rustix::io::Errno::WOULDBLOCK) => return Err(AgentError::InUse(dir.to_owned())),
            Err(errno) => return Err(FileError::at("lock", &path)(errno.into()).into()),
        }
    }
}

/// Settings against what the directory says; what is new goes into the identity.
fn settle(config: &Config, identity: &mut Identity) -> Result<(Kind, Address), AgentError> {
    let other = |what, theirs: &str, ours: &str| AgentError::OtherNode {
        dir: config.data_dir.clone(),
        what,
        theirs: theirs.to_owned(),
        ours: ours.to_owned(),
    };
    let name = config.name.as_ref().map(|name| name.as_str().to_owned());
    match (&identity.node, name) {
        (Some(theirs), Some(ours)) if *theirs != ours => return Err(other("node", theirs, &ours)),
        (None, None) => return Err(AgentError::Missing("--name")),
        (None, name) => identity.node = name,
        (Some(_), _) => {}
    }
    let kind = match (identity.kind, config.kind) {
        (Some(theirs), Some(ours)) if theirs != ours => {
            let text = |kind| if kind == Kind::Robot { "robot" } else { "cloud" };
            return Err(other("kind", text(theirs), text(ours)));
        }
        (None, None) => return Err(AgentError::Missing("--kind")),
        (Some(kind), _) | (None, Some(kind)) => kind,
    };
    identity.kind = Some(kind);
    // The controller may have moved: the newest address counts.
    let address = config.join.clone().or_else(|| identity.controller.clone());
    let address = address.ok_or(AgentError::Missing("--join"))?;
    let parsed = address.parse()?;
    identity.controller = Some(address);
    Ok((kind, parsed))
}

async fn enforcer(id: &str) -> Result<Kernel, String> {
    let id = id.to_owned();
    match tokio::task::spawn_blocking(move || Kernel::open(&id)).await {
        Ok(Ok(kernel)) => Ok(kernel),
        Ok(Err(error)) => Err(chain(&error)),
        Err(error) => Err(error.to_string()),
    }
}

fn host_name() -> String {
    rustix::system::uname().nodename().to_string_lossy().into_owned()
}
