//! A program inside a running container, and the container's network: for its checks.

use std::fs::File;
use std::time::Duration;

use bollard::Docker;
use bollard::exec::{StartExecOptions, StartExecResults};
use bollard::models::ExecConfig;
use futures::StreamExt;
use futures::future::BoxFuture;
use rustix::process::Pid;

use super::inspect::{self, Seen};
use crate::runtime::process::kill_session;
use crate::runtime::{Executed, KEPT_WORDS, Reached, RuntimeError};

/// What a shell, and the engine, return for a program that cannot be executed, and for one that is not there.
const NOT_STARTED: [i64; 2] = [126, 127];

pub(super) fn failed<E: std::error::Error + Send + Sync + 'static>(error: E) -> RuntimeError {
    RuntimeError::new("run a program in a container", error)
}

/// How long the engine may take to say which process a program is that is to be killed.
const KILLED_WITHIN: Duration = Duration::from_secs(2);

/// Kills a program with its session. The engine has no word for that: it says which process of this node it is,
/// as soon as it has started it, and made it the leader of its session.
pub(super) async fn kill(docker: &Docker, id: &str) {
    let killed = async {
        loop {
            let Ok(seen) = docker.inspect_exec(id).await else { return };
            // Over: its number may be another process's by now.
            if seen.running == Some(false) && seen.exit_code.is_some() {
                return;
            }
            let pid = seen.pid.and_then(|pid| i32::try_from(pid).ok()).and_then(Pid::from_raw);
            if let Some(pid) = pid {
                // Threads of the agent wait for nothing, and this may.
                let _ = tokio::task::spawn_blocking(move || kill_session(pid)).await;
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    if tokio::time::timeout(KILLED_WITHIN, killed).await.is_err() {
        tracing::warn!(exec = id, "a program in a container may live on until its container ends");
    }
}

pub(super) async fn exec(
    docker: &Docker,
    container: &str,
    argv: &[String],
    until: BoxFuture<'_, ()>,
) -> Result<Executed, RuntimeError> {
    let config = ExecConfig {
        attach_stdout: Some(true),
        attach_stderr: Some(true),
        cmd: Some(argv.to_vec()),
        ..ExecConfig::default()
    };
    let id = docker.create_exec(container, config).await.map_err(failed)?.id;
    let mut said = Vec::new();
    let over = tokio::select! {
        // As of a process: an answer that is there counts.
        biased;
        over = listen(docker, &id, &mut said) => Some(over?),
        () = until => None,
    };
    match over {
        Some(None) => {}
        Some(Some(words)) => return Ok(Executed::NotStarted(words)),
        None => {
            kill(docker, &id).await;
            return Ok(Executed::Cut { said: text(&said) });
        }
    }
    let code = docker.inspect_exec(&id).await.map_err(failed)?.exit_code.unwrap_or(-1);
    let said = text(&said);
    if not_started(code, &said) {
        return Ok(Executed::NotStarted(said));
    }
    Ok(Executed::Ended { code: i32::try_from(code).unwrap_or(-1), said })
}

/// The engine says in the program's own words that there is none.
fn not_started(code: i64, said: &str) -> bool {
    NOT_STARTED.contains(&code) && said.contains("OCI runtime exec failed")
}

fn text(said: &[u8]) -> String {
    String::from_utf8_lossy(said).into_owned()
}

/// Starts it and listens until it has ended; returns the engine's words when it could not be started.
async fn listen(
    docker: &Docker,
    id: &str,
    said: &mut Vec<u8>,
) -> Result<Option<String>, RuntimeError> {
    let started = docker.start_exec(id, None::<StartExecOptions>).await;
    let mut output = match started {
        Ok(StartExecResults::Attached { output, .. }) => output,
        Ok(StartExecResults::Detached) => return Ok(None),
        Err(error) => {
            return match inspect::refusal(&error) {
                Some((400, words)) => Ok(Some(words)),
                _ => Err(failed(error)),
            };
        }
    };
    while let Some(part) = output.next().await {
        let part = part.map_err(failed)?.into_bytes();
        let room = KEPT_WORDS.saturating_sub(said.len());
        said.extend_from_slice(&part[..part.len().min(room)]);
    }
    Ok(None)
}

/// The network namespace of a running container.
pub(super) async fn network(docker: &Docker, container: &str) -> Result<Reached, RuntimeError> {
    let what = "enter a container's network";
    let seen = inspect::inspect(docker, container).await;
    let Some(Seen::Running { pid, .. }) = seen.map_err(|error| RuntimeError::new(what, error))?
    else {
        return Err(RuntimeError::new(what, "it does not run"));
    };
    let namespace = File::open(format!("/proc/{pid}/ns/net"));
    Ok(Reached::Inside(namespace.map_err(|error| RuntimeError::new(what, error))?.into()))
}
