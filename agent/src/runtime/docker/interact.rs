//! A program inside a running container for a client, and what a container writes for one that attaches.

use std::path::Path;
use std::time::Duration;

use bollard::Docker;
use bollard::models::ExecConfig;
use bollard::query_parameters::ResizeExecOptionsBuilder;
use futures::future::BoxFuture;
use http::StatusCode;
use tokio::io::{AsyncWrite, AsyncWriteExt as _};

use super::exec::{failed, kill};
use super::hijack::{self, HijackError, Hijacked};
use crate::exec::ends::{Ends, Input, Invocation, Outlet, Ran, Room};
use crate::runtime::RuntimeError;

/// The engine writes down how a program ended a moment after its streams have, or later when its disk is busy.
const KNOWN_WITHIN: Duration = Duration::from_secs(30);

/// How often the engine is told a terminal's size, as its own client does.
const RESIZES: u32 = 10;

/// What a terminal makes of the end of its client's input.
const END_OF_TRANSMISSION: &[u8] = &[4];

pub(super) async fn interact(
    (docker, socket): (&Docker, &Path),
    container: &str,
    invocation: &Invocation,
    ends: Ends,
    mut until: BoxFuture<'_, ()>,
) -> Result<Ran, RuntimeError> {
    let config = ExecConfig {
        attach_stdin: Some(invocation.stdin),
        attach_stdout: Some(true),
        attach_stderr: Some(true),
        tty: Some(invocation.tty),
        cmd: Some(invocation.argv.clone()),
        ..ExecConfig::default()
    };
    let id = docker.create_exec(container, config).await.map_err(failed)?.id;
    let body = format!(r#"{{"Detach":false,"Tty":{}}}"#, invocation.tty);
    let started = hijack::hijack(socket, &format!("/exec/{id}/start"), body).await;
    let mut stream = match started {
        Ok(started) => started,
        Err(HijackError::Refused { code: StatusCode::BAD_REQUEST, message }) => {
            return Ok(Ran::NotStarted(message));
        }
        Err(error) => return Err(failed(error)),
    };
    let Hijacked { output, input, .. } = &mut stream;
    let Ends { input: said, room, output: outlet } = ends;
    let feed = Feed { docker, id: &id, terminal: invocation.tty, room: &room };
    let passed = tokio::select! {
        passed = hijack::pass(output, !invocation.tty, &outlet) => Some(passed),
        () = feed.run(input, said) => None,
        () = &mut until => None,
    };
    let Some(passed) = passed else {
        kill(docker, &id).await;
        return Ok(Ran::Cut);
    };
    passed.map_err(failed)?;
    let code = tokio::select! {
        code = exit_code(docker, &id) => code,
        () = until => None,
    };
    Ok(code.map_or(Ran::Cut, Ran::Ended))
}

/// The exit code of a program whose streams have ended; none: the engine does not know it, as of one that was killed with
/// its container.
async fn exit_code(docker: &Docker, id: &str) -> Option<i32> {
    let known = async {
        loop {
            let seen = docker.inspect_exec(id).await.ok()?;
            if let Some(code) = seen.exit_code {
                return i32::try_from(code).ok();
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(KNOWN_WITHIN, known).await.ok().flatten()
}

/// The client's input on its way to the program.
struct Feed<'a> {
    docker: &'a Docker,
    id: &'a str,
    terminal: bool,
    room: &'a Room,
}

impl Feed<'_> {
    /// Ends when the client is gone.
    async fn run(
        &self,
        to: &mut (impl AsyncWrite + Unpin),
        mut said: tokio::sync::mpsc::UnboundedReceiver<Input>,
    ) {
        let mut takes = true;
        while let Some(input) = said.recv().await {
            match input {
                Input::Data(data) => {
                    // What a program does not want to read is dropped.
                    takes = takes && to.write_all(&data).await.is_ok();
                    self.room.taken(data.len()).await;
                }
                Input::End if self.terminal => drop(to.write_all(END_OF_TRANSMISSION).await),
                // The other direction goes on.
                Input::End => drop(to.shutdown().await),
                Input::Size { columns, rows } if self.terminal => {
                    self.resize(columns, rows).await;
                }
                Input::Size { .. } => {}
            }
        }
    }
}

impl Feed<'_> {
    /// The first size comes before the engine has started the program, which it then does not know: asked a few times. A size
    /// that is not taken is a picture that is not nice.
    async fn resize(&self, columns: u16, rows: u16) {
        for _ in 0..RESIZES {
            let size = ResizeExecOptionsBuilder::new().w(columns.into()).h(rows.into()).build();
            if self.docker.resize_exec(self.id, size).await.is_ok() {
                return;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }
}

/// What a container writes from now on, until it ends.
pub(super) async fn attach(
    socket: &Path,
    container: &str,
    output: &Outlet,
) -> Result<(), RuntimeError> {
    let path = format!("/containers/{container}/attach?stream=1&stdout=1&stderr=1");
    let attached = hijack::hijack(socket, &path, String::new()).await;
    let what = "follow a container";
    let mut attached = attached.map_err(|error| RuntimeError::new(what, error))?;
    let passed = hijack::pass(&mut attached.output, true, output).await;
    passed.map_err(|error| RuntimeError::new(what, error))
}
