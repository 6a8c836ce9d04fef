//! The agent's side: a gate is kept alive, knows what the controller grants, and says how it stands.
//!
//! Level-triggered: all that is wanted is said at the start of each connection and at each change. A gate of an earlier life of
//! the agent goes on if it was set up in the same way, and is ended otherwise.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};
use std::process::Child;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use muster_api::condition::{ACTUATORS_FENCED, Condition};
use muster_api::id::TaskUid;
use muster_api::kind::node::estop::{EStopDemand, EStopStatus, EStopTier};
use muster_api::name::FunctionName;
use muster_api::wire::gate::v1 as proto;
use muster_failpoint::Failpoint;
use tokio::net::UnixStream;
use tokio::sync::watch;

use super::settings::{self, Settings};
use super::{AGENT_SOCKET, LOG, TASKS_DIR, VERB};
use crate::companion::{self, Kept};
use crate::driver::chain;
use crate::durable::{self, FileError, Keep};
use crate::executor::frame;
use crate::runtime::process::Reexec;

/// The agent says what it wants at least so often; see `hall`'s `STUCK`.
const SAY_EVERY: Duration = Duration::from_secs(1);

/// An agent that goes down in order is back within this, or the robot is stopped: the time of an upgrade.
const LEAVES_FOR: Duration = Duration::from_secs(10);

/// Who holds the robot when a person does: no task has such a uid.
const PERSON: &str = "person";

/// How a gate is set up, in short.
pub(super) fn digest(settings: &Settings) -> String {
    let text = serde_json::to_vec(settings).unwrap_or_default();
    companion::digest(&text)
}

/// A task that may connect.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Seat {
    token: String,
    /// The epoch of the robot's lease, when it is granted to this task.
    epoch: Option<u64>,
}

/// What is wanted of the gate.
#[derive(Debug, Default)]
struct Wanted {
    id: u64,
    seats: BTreeMap<TaskUid, Seat>,
    /// None: not heard yet.
    estop: Option<u32>,
    release: u64,
    /// The newest grant to a person: those of tasks count after it.
    fence: u64,
    /// The person holds it still.
    held: bool,
    leaves: bool,
}

impl Wanted {
    fn message(&self) -> proto::Wanted {
        let seat = |(task, seat): (&TaskUid, &Seat)| proto::Seat {
            task: task.to_string(),
            token: seat.token.clone(),
        };
        // Two tasks have a lease while one of them ends. The newer grant counts.
        let granted = self.seats.iter().filter_map(|(task, seat)| Some((seat.epoch?, task)));
        let granted = granted.filter(|(epoch, _)| *epoch > self.fence).max();
        let person = || self.held.then(|| proto::Holder { task: PERSON.into(), epoch: self.fence });
        proto::Wanted {
            id: self.id,
            seats: self.seats.iter().map(seat).collect(),
            grant: granted
                .map(|(epoch, task)| proto::Holder { task: task.to_string(), epoch })
                .or_else(person),
            estop: self.estop,
            release: self.release,
            leaves_for_ms: if self.leaves {
                LEAVES_FOR.as_millis().try_into().unwrap_or(0)
            } else {
                0
            },
            fence: self.fence,
        }
    }
}

/// How the gate stands.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Standing {
    /// Nobody stands before the drivers while it is `None`.
    pub(crate) status: Option<proto::Status>,
}

impl Standing {
    /// Whether every actuator is behind the gate, and every driver is there.
    pub(crate) fn fenced(&self, actuators: &[FunctionName]) -> Condition {
        let no = |reason, message| Condition::new(ACTUATORS_FENCED, false, reason, message);
        let Some(status) = &self.status else {
            return no("GateDown", "the gate is being started; the robot stands".to_owned());
        };
        let missing = status.drivers.iter().find(|driver| !driver.error.is_empty());
        if let Some(driver) = missing {
            let moves = driver.actuators.join(", ");
            return no(
                "DriverDown",
                format!("the driver of {moves} is not there: {}", driver.error),
            );
        }
        let driven = |actuator: &&FunctionName| {
            status.drivers.iter().flat_map(|d| &d.actuators).all(|a| *a != actuator.to_string())
        };
        match actuators.iter().find(driven) {
            Some(actuator) => no(
                "NoDriver",
                format!("no driver of {actuator} is behind the gate; its commands are not checked"),
            ),
            None => Condition::new(ACTUATORS_FENCED, true, "Gate", String::new()),
        }
    }

    /// The task whose right to drive is given back.
    pub(crate) fn gives_back(&self) -> Option<TaskUid> {
        self.status.as_ref()?.gives_back.as_ref().map(|holder| TaskUid::new(holder.task.clone()))
    }

    /// The person's grant that counts, so that nobody else drives; 0: none.
    pub(crate) fn person_epoch(&self) -> u64 {
        let holder = self.status.as_ref().and_then(|status| status.holder.as_ref());
        holder.filter(|holder| holder.task == PERSON).map_or(0, |holder| holder.epoch)
    }

    /// What stops the robot.
    pub(crate) fn estop(&self) -> Option<EStopStatus> {
        let estop = self.status.as_ref()?.estop.as_ref()?;
        let demand = |demand: &proto::Demand| EStopDemand {
            source: demand.source.clone(),
            tier: EStopTier::from_number(demand.tier),
        };
        Some(EStopStatus {
            tier: EStopTier::from_number(estop.tier),
            number: estop.number,
            demands: estop.demands.iter().map(demand).collect(),
        })
    }
}

/// Keeps one gate.
#[derive(Debug)]
pub(crate) struct Keeper {
    settings: Settings,
    dir: PathBuf,
    program: PathBuf,
    wanted: Mutex<Wanted>,
    /// The newest that is wanted.
    newest: watch::Sender<u64>,
    standing: watch::Sender<Standing>,
}

impl Keeper {
    /// A keeper of the gate in `dir`; nothing is started yet.
    pub(crate) fn new(settings: Settings, dir: PathBuf, reexec: &Reexec) -> Keeper {
        Keeper {
            settings,
            dir,
            program: reexec.program.clone(),
            wanted: Mutex::default(),
            newest: watch::Sender::default(),
            standing: watch::Sender::default(),
        }
    }

    /// Where tasks find their socket.
    pub(crate) fn tasks_dir(&self) -> PathBuf {
        self.dir.join(TASKS_DIR)
    }

    fn change(&self, change: impl FnOnce(&mut Wanted) -> bool) {
        let mut wanted: MutexGuard<'_, Wanted> =
            self.wanted.lock().unwrap_or_else(PoisonError::into_inner);
        if change(&mut wanted) {
            wanted.id += 1;
            self.newest.send_replace(wanted.id);
        }
    }

    /// Processes of the task may live: it may connect, and drive if the lease is its own.
    pub(crate) fn seat(&self, task: &TaskUid, token: &str, epoch: Option<u64>) {
        let seat = Seat { token: token.to_owned(), epoch };
        self.change(|wanted| wanted.seats.insert(task.clone(), seat.clone()) != Some(seat));
    }

    /// Nothing of the task lives.
    pub(crate) fn unseat(&self, task: &TaskUid) {
        self.change(|wanted| wanted.seats.remove(task).is_some());
    }

    /// What the controller demands: a tier (0 none, 1 settle, 2 cut), and up to which stop a person has released the robot.
    pub(crate) fn demand(&self, estop: u32, release: u64) {
        self.change(|wanted| {
            let before = (wanted.estop, wanted.release);
            (wanted.estop, wanted.release) = (Some(estop), release.max(wanted.release));
            before != (wanted.estop, wanted.release)
        });
    }

    /// A person was granted the actuators with this number, and holds them still or has returned them. Numbers only grow.
    pub(crate) fn person(&self, fence: u64, held: bool) {
        self.change(|wanted| {
            let before = (wanted.fence, wanted.held);
            if fence >= wanted.fence {
                (wanted.fence, wanted.held) = (fence, held && fence > 0);
            }
            before != (wanted.fence, wanted.held)
        });
    }

    /// How it stands, and its changes.
    pub(crate) fn standing(&self) -> watch::Receiver<Standing> {
        self.standing.subscribe()
    }

    /// Returns when the gate counts everything that is wanted now. Cancel-safe.
    pub(crate) async fn settled(&self) {
        let wanted = *self.newest.borrow();
        let counts = |standing: &Standing| {
            standing.status.as_ref().is_some_and(|status| status.wanted >= wanted)
        };
        // Closed: never, this holds its sender.
        let _ = self.standing.subscribe().wait_for(counts).await;
    }

    /// The agent goes down in order: the robot may go on for the time of an upgrade.
    pub(crate) async fn leave(&self) {
        self.change(|wanted| !std::mem::replace(&mut wanted.leaves, true));
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
            let mine = digest(&self.settings);
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
            &self.settings,
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

#[cfg(test)]
mod tests {
    use super::*;

    fn granted(wanted: &Wanted) -> Option<(String, u64)> {
        wanted.message().grant.map(|holder| (holder.task, holder.epoch))
    }

    #[test]
    fn what_was_granted_before_a_person_counts_no_more() {
        let mut wanted = Wanted::default();
        let seat = |epoch| Seat { token: String::new(), epoch: Some(epoch) };
        wanted.seats.insert(TaskUid::new("a"), seat(4));
        assert_eq!(granted(&wanted), Some(("a".to_owned(), 4)));
        (wanted.fence, wanted.held) = (5, true);
        assert_eq!(granted(&wanted), Some((PERSON.to_owned(), 5)));
        wanted.held = false;
        assert_eq!(granted(&wanted), None, "it is nobody's: the task does not get it back");
        assert_eq!(wanted.message().fence, 5, "the gate keeps it for an agent that forgets it");
        wanted.seats.insert(TaskUid::new("b"), seat(6));
        assert_eq!(granted(&wanted), Some(("b".to_owned(), 6)));
    }
}
