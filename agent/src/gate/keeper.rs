//! The agent's side: a gate is kept alive, knows what the controller grants, and says how it stands.
//!
//! Level-triggered: all that is wanted is said at the start of each connection and at each change. A gate of an earlier life of
//! the agent goes on if it was set up in the same way, and is ended otherwise.

use std::fs::{self, File};
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};
use std::process::Child;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use muster_api::id::TaskUid;
use muster_api::wire::agent::v1::NodeOrder;
use muster_api::wire::gate::v1 as proto;
use muster_failpoint::Failpoint;
use tokio::net::UnixStream;
use tokio::sync::watch;

use super::settings::{self, Setup};
use super::{AGENT_SOCKET, LOG, Standing, TASKS_DIR, VERB, Wanted};
use crate::companion::{self, Kept};
use crate::driver::chain;
use crate::durable::{self, FileError, Keep};
use crate::executor::frame;
use crate::runtime::process::Reexec;
use crate::view::Actuator;

/// The agent says what it wants at least so often; see `hall`'s `STUCK`.
const SAY_EVERY: Duration = Duration::from_secs(1);

/// How a gate is set up, in short.
pub(super) fn digest(setup: &Setup) -> String {
    let text = serde_json::to_vec(setup).unwrap_or_default();
    companion::digest(&text)
}

/// Keeps one gate.
#[derive(Debug)]
pub(crate) struct Keeper {
    setup: Setup,
    dir: PathBuf,
    program: PathBuf,
    wanted: Mutex<Wanted>,
    /// The newest that is wanted.
    newest: watch::Sender<u64>,
    standing: watch::Sender<Standing>,
}

impl Keeper {
    /// A keeper of the gate in `dir`; nothing is started yet.
    pub(crate) fn new(setup: Setup, dir: PathBuf, reexec: &Reexec) -> Keeper {
        Keeper {
            setup,
            dir,
            program: reexec.program.clone(),
            wanted: Mutex::default(),
            newest: watch::Sender::default(),
            standing: watch::Sender::default(),
        }
    }

    /// The drivers that are topics of ROS's.
    pub(crate) fn topics(&self) -> Vec<Actuator> {
        let actuator = |(topic, actuator)| Actuator { topic, actuator };
        self.setup.topics().map(actuator).collect()
    }

    /// Where tasks find their socket.
    pub(crate) fn tasks_dir(&self) -> PathBuf {
        self.dir.join(TASKS_DIR)
    }

    fn change(&self, change: impl FnOnce(&mut Wanted) -> bool) {
        let mut wanted: MutexGuard<'_, Wanted> =
            self.wanted.lock().unwrap_or_else(PoisonError::into_inner);
        if change(&mut wanted) {
            self.newest.send_replace(wanted.id());
        }
    }

    /// Processes of the task may live: it may connect, and drive if the lease is its own.
    pub(crate) fn seat(&self, task: &TaskUid, token: &str, epoch: Option<u64>) {
        self.change(|wanted| wanted.seat(task, token, epoch));
    }

    /// Nothing of the task lives.
    pub(crate) fn unseat(&self, task: &TaskUid) {
        self.change(|wanted| wanted.unseat(task));
    }

    /// What people decide about the robot.
    pub(crate) fn order(&self, order: &NodeOrder) {
        self.change(|wanted| wanted.order(order));
    }

    /// How it stands, and its changes.
    pub(crate) fn standing(&self) -> watch::Receiver<Standing> {
        self.standing.subscribe()
    }

    /// Returns when the gate counts everything that is wanted now. Cancel-safe.
    pub(crate) async fn settled(&self) {
        let wanted = *self.newest.borrow();
        let counts = |standing: &Standing| standing.counts(wanted);
        // Closed: never, this holds its sender.
        let _ = self.standing.subscribe().wait_for(counts).await;
    }

    /// The agent goes down in order: the robot may go on for the time of an upgrade.
    pub(crate) async fn leave(&self) {
        self.change(Wanted::leave);
        // A gate that does not answer stops the robot; nothing is lost by going.
        let _ = tokio::time::timeout(Duration::from_secs(1), self.settled()).await;
    }

    /// Keeps a gate until dropped; the gate stays.
    pub(crate) async fn run(self: Arc<Keeper>) {
        companion::keep(&*self).await;
    }

    async fn talk(&self, stream: UnixStream) -> std::io::Result<()> {
        let peer = stream.peer_cred()?.pid();
        let (mut from, mut to) = stream.into_split();
        let mut newest = self.newest.subscribe();
        let write = async {
            loop {
                newest.borrow_and_update();
                let message = self.wanted.lock().unwrap_or_else(PoisonError::into_inner).message();
                frame::write(&mut to, &message).await?;
                // Said again without a change, so that the gate knows that this agent is not stuck.
                let change = tokio::time::timeout(SAY_EVERY, newest.changed()).await;
                if matches!(change, Ok(Err(_))) {
                    return Ok(());
                }
            }
        };
        let read = async {
            let mine = digest(&self.setup);
            while let Some(status) = frame::read::<proto::Status, _>(&mut from).await? {
                if status.settings != mine {
                    // Another set-up: it stops the robot and ends, and the next one begins with a stop.
                    tracing::info!("the gate was set up in another way; it is ended");
                    end(peer);
                    return Ok(());
                }
                self.standing.send_if_modified(|standing| {
                    let new = Some(status);
                    let changes = standing.status != new;
                    standing.status = new;
                    changes
                });
            }
            Ok(())
        };
        // Neither is polled again after the other has ended.
        tokio::select! {
            ended = write => ended,
            ended = read => ended,
        }
    }
}

impl Kept for Keeper {
    const NAME: &str = "gate";
    const START_AGAIN: Duration = Duration::from_millis(200);

    fn socket(&self) -> PathBuf {
        self.dir.join(AGENT_SOCKET)
    }

    fn start(&self) -> Result<Child, FileError> {
        let dir = &self.dir;
        let tasks = self.tasks_dir();
        // Passable, not listable: tasks of other users find their socket.
        let made = fs::DirBuilder::new().recursive(true).mode(0o711).create(&tasks);
        made.map_err(FileError::at("make", &tasks))?;
        durable::write_json(
            Failpoint::GateSettings,
            &dir.join(settings::FILE),
            &self.setup,
            Keep::Crash,
        )?;
        let path = dir.join(LOG);
        let log = File::options().create(true).append(true).open(&path);
        let log = log.map_err(FileError::at("open", &path))?;
        companion::start(&self.program, VERB, dir, log)
            .map_err(FileError::at("start a gate for", dir))
    }

    async fn attend(&self, stream: UnixStream) -> bool {
        let ended = self.talk(stream).await;
        self.standing.send_replace(Standing::default());
        let error = ended.err().map(|error| chain(&error));
        tracing::warn!(error, "the gate is gone: the robot stands");
        true
    }
}

/// Ends a gate of an earlier set-up that may still run in `dir`: this agent has no drivers.
pub(crate) async fn end_former(dir: &Path) {
    if let Ok(stream) = UnixStream::connect(dir.join(AGENT_SOCKET)).await {
        tracing::info!("there are no drivers any more; the gate is ended");
        end(stream.peer_cred().ok().and_then(|peer| peer.pid()));
    }
}

fn end(gate: Option<i32>) {
    if let Some(pid) = gate.and_then(rustix::process::Pid::from_raw) {
        // Gone already: that is what was wanted.
        let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
    }
}
