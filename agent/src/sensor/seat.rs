//! One task's sockets, for as long as processes of an attempt of it may exist: one for each function that it asked for and that
//! has a source. While it is there, the sources are wanted.
//!
//! ```text
//! sensors/                 the agent's alone to write; a container sees it, and cannot write either
//!   status.json            {"kinect:ImageGen": {"state": "Failing", "why": "…"}}
//!   kinect/ImageGen        a socket
//! ```

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use futures::future::select_all;
use muster_agent_core::sensor::source::Standing;
use muster_api::name::FunctionName;
use muster_failpoint::Failpoint;
use serde_json::json;
use tokio::net::UnixListener;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio_util::task::AbortOnDropHandle;

use super::Sensors;
use super::channel::{Channel, Stand};
use super::talk::{self, Owner};
use crate::durable::{self, Keep};
use crate::socket;

/// How the sources stand, for those who do not connect.
const STATUS: &str = "status.json";

/// Connections at once to one function, of one task.
const MOST: usize = 128;

/// The sockets of a task. Dropped: nobody listens any more, connections end, and its sources are wanted by others only.
#[derive(Debug)]
pub(crate) struct Seat {
    /// Whose it is.
    pub(crate) attempt: u32,
    _serving: Vec<AbortOnDropHandle<()>>,
}

impl Seat {
    /// Listens in `dir`; what an earlier life of the agent left there is replaced.
    pub(crate) fn open(
        sensors: &Sensors,
        dir: &Path,
        functions: &[FunctionName],
        owner: Owner,
    ) -> io::Result<Seat> {
        let attempt = owner.id.attempt;
        make(dir)?;
        let owner = Arc::new(owner);
        let asked = functions.iter().filter_map(|function| sensors.channels.get(function));
        let channels: Vec<Arc<Channel>> = asked.cloned().collect();
        let mut serving = Vec::new();
        for channel in &channels {
            let path = dir.join(channel.function().path());
            if let Some(parent) = path.parent() {
                make(parent)?;
            }
            // The task may be another user's, and in a container anybody's: the kernel and the token say who it is.
            let listener = socket::listen(&path, 0o666)?;
            let door = talk::Door {
                channel: Arc::clone(channel),
                owner: Arc::clone(&owner),
                life: sensors.life.clone(),
            };
            serving.push(AbortOnDropHandle::new(tokio::spawn(serve(listener, Arc::new(door)))));
        }
        let status = tell(dir.join(STATUS), channels);
        serving.push(AbortOnDropHandle::new(tokio::spawn(status)));
        Ok(Seat { attempt, _serving: serving })
    }
}

/// Passable, not listable, and the agent's.
fn make(dir: &Path) -> io::Result<()> {
    match fs::DirBuilder::new().mode(0o711).create(dir) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        made => made,
    }
}

async fn serve(listener: UnixListener, door: Arc<talk::Door>) {
    let _wanted = door.channel.want();
    let mut talks = JoinSet::new();
    loop {
        // Cancel-safe: a listener and a join.
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) if talks.len() < MOST => {
                    talks.spawn(talk::talk(stream, Arc::clone(&door)));
                }
                Ok(_) => tracing::warn!(id = %door.owner.id, "too many readers of a sensor"),
                Err(error) => {
                    tracing::warn!(id = %door.owner.id, %error, "a sensor's socket");
                    // Out of descriptors, most likely: not in a tight loop.
                    tokio::time::sleep(Duration::from_secs(1)).await;
                }
            },
            Some(_) = talks.join_next() => {}
        }
    }
}

/// Keeps the file with how the sources stand.
async fn tell(path: PathBuf, channels: Vec<Arc<Channel>>) {
    let mut stands: Vec<watch::Receiver<Stand>> =
        channels.iter().map(|channel| channel.stand()).collect();
    loop {
        let of = |(channel, stand): (&Arc<Channel>, &mut watch::Receiver<Stand>)| {
            let (state, why) = match &stand.borrow_and_update().standing {
                Standing::Idle | Standing::Starting => ("Starting", None),
                Standing::Delivering => ("Delivering", None),
                Standing::Failing(why) => ("Failing", Some(why.clone())),
            };
            (channel.function().to_string(), json!({"state": state, "why": why}))
        };
        let status: BTreeMap<String, _> = channels.iter().zip(&mut stands).map(of).collect();
        let (path, text) = (path.clone(), json!(status).to_string());
        let write = move || {
            durable::write(
                Failpoint::SensorStatus,
                &path,
                format!("{text}\n").as_bytes(),
                0o644,
                Keep::Crash,
            )
        };
        if let Ok(Err(error)) = tokio::task::spawn_blocking(write).await {
            tracing::warn!(%error, "a task is not told how its sensors stand");
        }
        if stands.is_empty() {
            return;
        }
        // Closed: the agent ends.
        if select_all(stands.iter_mut().map(|stand| Box::pin(stand.changed()))).await.0.is_err() {
            return;
        }
    }
}
