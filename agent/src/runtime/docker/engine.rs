//! The connection to the engine: whether it is there, and what it says happened.

use std::collections::HashMap;
use std::future::Future;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use bollard::errors::Error;
use bollard::query_parameters::{EventsOptionsBuilder, ListContainersOptionsBuilder};
use bollard::{API_DEFAULT_VERSION, Docker};
use futures::StreamExt;
use muster_api::id::TaskUid;

use super::create::{LABEL_AGENT, LABEL_ATTEMPT, LABEL_UID};
use crate::driver::chain;
use crate::runtime::{AttemptId, RuntimeStatus};

/// How long the engine may take to begin an answer. A start on a slow disk takes seconds.
const ANSWER_SECONDS: u64 = 120;

/// First and longest pause between two looks for an engine that is away.
const PAUSE: (Duration, Duration) = (Duration::from_millis(200), Duration::from_secs(5));

#[derive(Debug)]
pub(super) struct Engine {
    socket: Option<PathBuf>,
    status: Mutex<RuntimeStatus>,
}

/// Why there is no client.
#[derive(Debug, thiserror::Error)]
pub(super) enum EngineError {
    #[error("this agent runs without Docker (--docker-socket none)")]
    Off,
    #[error("no Docker Engine answers at {socket}")]
    Away {
        socket: PathBuf,
        #[source]
        source: Error,
    },
}

impl Engine {
    pub(super) fn new(socket: Option<PathBuf>) -> Engine {
        let message = match &socket {
            Some(socket) => format!("no Docker Engine answered at {} yet", socket.display()),
            None => EngineError::Off.to_string(),
        };
        let status = RuntimeStatus { available: false, version: String::new(), message };
        Engine { socket, status: Mutex::new(status) }
    }

    pub(super) fn status(&self) -> RuntimeStatus {
        self.status.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set_status(&self, status: RuntimeStatus) {
        let mut now = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        if now.available != status.available {
            tracing::info!(available = status.available, message = %status.message, "docker");
        }
        *now = status;
    }

    /// Connections are made when they are used: this only fails when there is no socket.
    pub(super) fn client(&self) -> Result<Docker, EngineError> {
        let socket = self.socket.as_ref().ok_or(EngineError::Off)?;
        Docker::connect_with_unix(&socket.to_string_lossy(), ANSWER_SECONDS, API_DEFAULT_VERSION)
            .map_err(|source| EngineError::Away { socket: socket.clone(), source })
    }

    /// Follows the engine for ever. `wake` is told which container to look at, `None` for all.
    pub(super) async fn run<S: Future<Output = ()>>(
        &self,
        identity: &str,
        wake: impl Fn(Option<&AttemptId>),
        sweep: impl Fn() -> S,
    ) {
        if self.socket.is_none() {
            return std::future::pending().await;
        }
        let mut pause = PAUSE.0;
        let mut swept = false;
        loop {
            match self.connect().await {
                Ok(docker) => {
                    pause = PAUSE.0;
                    if !std::mem::replace(&mut swept, true) {
                        sweep().await;
                    }
                    self.follow(&docker, identity, &wake).await;
                }
                Err(message) => {
                    let version = String::new();
                    self.set_status(RuntimeStatus { available: false, version, message });
                }
            }
            tokio::time::sleep(pause).await;
            pause = (pause * 2).min(PAUSE.1);
        }
    }

    async fn connect(&self) -> Result<Docker, String> {
        let docker = self.client().map_err(|error| chain(&error))?;
        let version = docker.version().await.map_err(|error| chain(&error))?;
        let version = version.version.unwrap_or_default();
        self.set_status(RuntimeStatus { available: true, version, message: String::new() });
        Ok(docker)
    }

    async fn follow(&self, docker: &Docker, identity: &str, wake: &impl Fn(Option<&AttemptId>)) {
        let list = |values: &[&str]| values.iter().map(|value| (*value).to_owned()).collect();
        let filters: HashMap<String, Vec<String>> = HashMap::from([
            ("type".to_owned(), list(&["container"])),
            ("event".to_owned(), list(&["die", "destroy"])),
            ("label".to_owned(), vec![format!("{LABEL_AGENT}={identity}")]),
        ]);
        let options = EventsOptionsBuilder::new().filters(&filters).build();
        let mut events = docker.events(Some(options)).boxed();
        // The subscription is under way when this is first polled; what happened before it is found
        // by looking, once now and once a moment later, when it surely stands.
        wake(None);
        let mut settle = std::pin::pin!(tokio::time::sleep(Duration::from_millis(300)));
        let mut settled = false;
        loop {
            tokio::select! {
                event = events.next() => match event {
                    Some(Ok(event)) => {
                        let labels = event.actor.and_then(|actor| actor.attributes);
                        wake(labels.as_ref().and_then(attempt).as_ref());
                    }
                    Some(Err(_)) | None => return,
                },
                () = &mut settle, if !settled => {
                    settled = true;
                    wake(None);
                }
            }
        }
    }
}

fn attempt(labels: &HashMap<String, String>) -> Option<AttemptId> {
    let uid = TaskUid::new(labels.get(LABEL_UID)?.as_str());
    Some(AttemptId { uid, attempt: labels.get(LABEL_ATTEMPT)?.parse().ok()? })
}

/// Names and task uids of this agent's containers.
pub(super) async fn names(
    docker: &Docker,
    identity: &str,
    label: Option<&str>,
) -> Result<Vec<(String, String)>, Error> {
    let mut labels = vec![format!("{LABEL_AGENT}={identity}")];
    labels.extend(label.map(str::to_owned));
    let filters = HashMap::from([("label".to_owned(), labels)]);
    let options = ListContainersOptionsBuilder::new().all(true).filters(&filters).build();
    let found = docker.list_containers(Some(options)).await?;
    Ok(found
        .into_iter()
        .filter_map(|container| {
            let uid = container.labels?.get(LABEL_UID)?.clone();
            Some((container.id?, uid))
        })
        .collect())
}
