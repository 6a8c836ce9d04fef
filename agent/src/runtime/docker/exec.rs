//! A program inside a running container, and the container's network: for its checks.

use std::fs::File;

use bollard::Docker;
use bollard::exec::{StartExecOptions, StartExecResults};
use bollard::models::ExecConfig;
use futures::StreamExt;
use futures::future::BoxFuture;
use rustix::process::{Pid, Signal};

use super::inspect::{self, Seen};
use crate::runtime::process::attempt::Process;
use crate::runtime::process::scan;
use crate::runtime::{Executed, KEPT_WORDS, Reached, RuntimeError};

/// What a shell, and the engine, return for a program that cannot be executed, and for one that is not there.
const NOT_STARTED: [i64; 2] = [126, 127];

fn failed<E: std::error::Error + Send + Sync + 'static>(error: E) -> RuntimeError {
    RuntimeError::new("run a program in a container", error)
}

/// The engine ends no program that it runs in a container: its processes are found on this node, and killed here.
struct Whole(Option<Process>);

impl Whole {
    /// The group of the program: the engine makes it the leader of its session.
    fn of(pid: Option<i64>) -> Whole {
        Whole(
            pid.and_then(|pid| i32::try_from(pid).ok())
                .filter(|pid| *pid > 0)
                .and_then(scan::process),
        )
    }
}

impl Drop for Whole {
    fn drop(&mut self) {
        if let Some(process) = self.0.filter(|process| scan::is_alive(*process))
            && let Some(pid) = Pid::from_raw(process.pid)
        {
            // Gone already: nothing to kill.
            let _ = rustix::process::kill_process_group(pid, Signal::KILL);
        }
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
    // Cancel-safe: dropped whole, and what runs is killed by `Whole`.
    tokio::select! {
        over = listen(docker, &id, &mut said) => match over? {
            Some(words) => return Ok(Executed::NotStarted(words)),
            None => {}
        },
        () = until => return Ok(Executed::Cut { said: text(&said) }),
    }
    let code = docker.inspect_exec(&id).await.map_err(failed)?.exit_code.unwrap_or(-1);
    let said = text(&said);
    // The engine says in the program's own words that there is none.
    if NOT_STARTED.contains(&code) && said.contains("OCI runtime exec failed") {
        return Ok(Executed::NotStarted(said));
    }
    Ok(Executed::Ended { code: i32::try_from(code).unwrap_or(-1), said })
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
    let _whole = Whole::of(docker.inspect_exec(id).await.map_err(failed)?.pid);
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
