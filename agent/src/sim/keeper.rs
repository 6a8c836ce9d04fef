//! The agent's side: a simulator is kept alive and says where its robot is. One of an earlier life of the agent goes on if its
//! world is the same, and is ended otherwise.

use std::fs::{self, File};
use std::os::unix::fs::DirBuilderExt as _;
use std::path::PathBuf;
use std::process::Child;
use std::sync::Arc;
use std::time::Duration;

use muster_failpoint::Failpoint;
use rustix::process::{Pid, Signal};
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::net::UnixStream;
use tokio::sync::watch;

use super::robot::Said;
use super::settings::Settings;
use super::{LOG, STATE, VERB, WORLD};
use crate::companion::{self, Kept};
use crate::durable::{self, FileError, Keep};
use crate::runtime::process::Reexec;

/// A simulator that has not said anything for this long is stuck: it speaks every second.
const STUCK: Duration = Duration::from_secs(5);

/// Keeps one simulator.
#[derive(Debug)]
pub(crate) struct Simulator {
    world: Vec<u8>,
    digest: String,
    dir: PathBuf,
    program: PathBuf,
    said: watch::Sender<Option<Said>>,
}

impl Simulator {
    /// A keeper of the simulator in `dir`; nothing is started yet.
    pub(crate) fn new(settings: &Settings, dir: PathBuf, reexec: &Reexec) -> Simulator {
        let world = serde_json::to_vec(settings).unwrap_or_default();
        let digest = companion::digest(&world);
        Simulator {
            world,
            digest,
            dir,
            program: reexec.program.clone(),
            said: watch::Sender::default(),
        }
    }

    /// What it said last; none: it is not there.
    pub(crate) fn said(&self) -> watch::Receiver<Option<Said>> {
        self.said.subscribe()
    }

    /// Keeps a simulator until dropped; the simulator stays.
    pub(crate) async fn run(self: Arc<Simulator>) {
        companion::keep(&*self).await;
    }

    /// Hears it until it is gone; whether it has said anything.
    async fn listen(&self, stream: UnixStream) -> bool {
        let peer = stream.peer_cred().ok().and_then(|peer| peer.pid()).and_then(Pid::from_raw);
        let end = || {
            // Gone already: that is what was wanted.
            peer.map(|pid| rustix::process::kill_process(pid, Signal::KILL))
        };
        let mut lines = BufReader::new(stream).lines();
        let mut heard = false;
        loop {
            let line = match tokio::time::timeout(STUCK, lines.next_line()).await {
                Ok(Ok(Some(line))) => line,
                Ok(_) => return heard,
                Err(_) => {
                    tracing::error!("the simulator is stuck; it is ended");
                    end();
                    return heard;
                }
            };
            match serde_json::from_str::<Said>(&line) {
                Ok(said) if said.world == self.digest => {
                    self.said.send_if_modified(|known| {
                        let changes = known.as_ref() != Some(&said);
                        *known = Some(said);
                        changes
                    });
                }
                Ok(_) | Err(_) => {
                    tracing::info!("the simulator has another world; it is ended");
                    end();
                    return true;
                }
            }
            heard = true;
        }
    }
}

impl Kept for Simulator {
    const NAME: &str = "simulator";
    const START_AGAIN: Duration = Duration::from_secs(1);

    fn socket(&self) -> PathBuf {
        self.dir.join(STATE)
    }

    fn start(&self) -> Result<Child, FileError> {
        let dir = &self.dir;
        // Nobody but the agent and the gate comes to the robot.
        let made = fs::DirBuilder::new().recursive(true).mode(0o700).create(dir);
        made.map_err(FileError::at("make", dir))?;
        durable::write(Failpoint::SimWorld, &dir.join(WORLD), &self.world, 0o600, Keep::Crash)?;
        let path = dir.join(LOG);
        let log = File::create(&path).map_err(FileError::at("open", &path))?;
        companion::start(&self.program, VERB, dir, log)
            .map_err(FileError::at("start a simulator for", dir))
    }

    async fn attend(&self, stream: UnixStream) -> bool {
        let heard = self.listen(stream).await;
        self.said.send_replace(None);
        tracing::warn!("the simulator is gone");
        heard
    }

    fn has_failed(&self) {
        tracing::error!(log = %self.dir.join(LOG).display(), "the simulator ended");
    }
}
