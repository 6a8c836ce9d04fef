//! `muster exec`: a program in a running task, with this terminal or these pipes as its own; over the endpoint that kubectl
//! uses.

use std::io::{IsTerminal as _, Read as _, Write as _};

use bytes::{Bytes, BytesMut};
use futures::stream::{SplitSink, SplitStream};
use futures::{SinkExt as _, StreamExt as _};
use kube::core::Status;
use kube::core::response::StatusSummary;
use muster_api::kind::projected::POD;
use rustix::termios::{OptionalActions, Termios, tcgetattr, tcgetwinsize, tcsetattr};
use serde_json::json;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::mpsc;
use tokio_tungstenite::tungstenite::Message;

use super::Outcome;
use crate::client::{Socket, path, with_query};
use crate::error::CliError;
use crate::session::Session;
use crate::{exit, target};

const STDIN: u8 = 0;
const STDOUT: u8 = 1;
const STDERR: u8 = 2;
const ERROR: u8 = 3;
const RESIZE: u8 = 4;
const CLOSE: u8 = 255;

/// What is read of standard input at once.
const CHUNK: usize = 32 << 10;

/// `muster exec`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The task, NAME or task/NAME
    task: String,
    /// Pass standard input on
    #[arg(short = 'i', long)]
    stdin: bool,
    /// Give it a terminal, when this is one
    #[arg(short, long)]
    tty: bool,
    /// The program and its arguments, behind --
    #[arg(last = true, required = true, value_name = "COMMAND")]
    command: Vec<String>,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let named = target::one(&args.task, "task")?;
    let tty = args.tty && args.stdin && std::io::stdin().is_terminal();
    if args.tty && !tty {
        session.ui.note("no terminal for it: this is none, or -i is not there");
    }
    let flag = |on: bool| if on { "true" } else { "false" };
    let mut pairs = vec![
        ("stdin", flag(args.stdin)),
        ("stdout", "true"),
        ("stderr", flag(!tty)),
        ("tty", flag(tty)),
    ];
    pairs.extend(args.command.iter().map(|word| ("command", word.as_str())));
    let of = path(&POD, Some(&session.namespace), named.name);
    let socket = session.client.connect(&with_query(&format!("{of}/exec"), &pairs)).await?;
    let resized = signal(SignalKind::window_change()).map_err(CliError::Output)?;
    let raw = tty.then(Raw::begin).flatten();
    let (mut to, mut from) = socket.split();
    let input = args.stdin.then(read_stdin);
    let ended = tokio::select! {
        ended = outward(&mut from, session) => ended,
        () = inward(&mut to, input, raw.is_some().then_some(resized)) => Ok(None),
    };
    drop(raw);
    match ended? {
        Some(status) => code(status, session),
        None => Err(CliError::Failed {
            what: "the connection broke before the program had ended".to_owned(),
            hint: Some("it is killed when nobody is there; run it again".to_owned()),
        }),
    }
}

/// The program's exit code is that of this command.
fn code(status: Status, session: &Session) -> Outcome {
    if status.status == Some(StatusSummary::Success) {
        return Ok(exit::OK);
    }
    let causes = status.details.iter().flat_map(|details| &details.causes);
    let code =
        causes.filter(|cause| cause.reason == "ExitCode").find_map(|c| c.message.parse().ok());
    match code {
        Some(code) => Ok(code),
        None => Err(session.client.refused(status)),
    }
}

/// Prints what the program writes, until it has ended.
async fn outward(
    from: &mut SplitStream<Socket>,
    session: &mut Session,
) -> Result<Option<Status>, CliError> {
    while let Some(Ok(message)) = from.next().await {
        let Message::Binary(mut data) = message else { continue };
        if data.len() < 2 {
            continue;
        }
        match data.split_to(1)[0] {
            STDOUT => session.ui.print_bytes(&data)?,
            // Nobody reads it: the program goes on all the same.
            STDERR => drop(std::io::stderr().write_all(&data)),
            ERROR => {
                return serde_json::from_slice(&data).map(Some).map_err(|source| {
                    let (server, request) = (session.client.server.clone(), "exec".to_owned());
                    CliError::Answer { server, request, source }
                });
            }
            _ => {}
        }
    }
    Ok(None)
}

/// Passes input and sizes on. Ends when the connection does.
async fn inward(
    to: &mut SplitSink<Socket, Message>,
    mut input: Option<mpsc::Receiver<Bytes>>,
    mut resized: Option<Signal>,
) {
    if resized.is_some() && to.send(size()).await.is_err() {
        return;
    }
    loop {
        let message = tokio::select! {
            // Cancel safe, both: what was not received stays.
            data = next(&mut input) => match data {
                Some(data) => framed(STDIN, &data),
                None => {
                    input = None;
                    framed(CLOSE, &[STDIN])
                }
            },
            () = next_size(&mut resized) => size(),
        };
        if to.send(message).await.is_err() {
            return;
        }
    }
}

async fn next(input: &mut Option<mpsc::Receiver<Bytes>>) -> Option<Bytes> {
    match input {
        Some(input) => input.recv().await,
        None => std::future::pending().await,
    }
}

async fn next_size(resized: &mut Option<Signal>) {
    match resized {
        Some(resized) => drop(resized.recv().await),
        None => std::future::pending().await,
    }
}

fn size() -> Message {
    let size = tcgetwinsize(rustix::stdio::stdin()).ok();
    let (columns, rows) = size.map_or((80, 24), |size| (size.ws_col, size.ws_row));
    framed(RESIZE, json!({"Width": columns, "Height": rows}).to_string().as_bytes())
}

fn framed(channel: u8, data: &[u8]) -> Message {
    let mut message = BytesMut::with_capacity(data.len() + 1);
    message.extend_from_slice(&[channel]);
    message.extend_from_slice(data);
    Message::Binary(message.freeze())
}

/// By a thread that ends with the process: whoever waits for a terminal cannot be told that it is over.
fn read_stdin() -> mpsc::Receiver<Bytes> {
    let (sender, receiver) = mpsc::channel(4);
    std::thread::spawn(move || {
        let mut buffer = vec![0; CHUNK];
        while let Ok(n @ 1..) = std::io::stdin().lock().read(&mut buffer) {
            if sender.blocking_send(Bytes::copy_from_slice(&buffer[..n])).is_err() {
                return;
            }
        }
    });
    receiver
}

/// The terminal, every key passed on as it is pressed. As it was when this is dropped.
struct Raw(Termios);

impl Raw {
    fn begin() -> Option<Raw> {
        let before = tcgetattr(rustix::stdio::stdin()).ok()?;
        let mut raw = before.clone();
        raw.make_raw();
        tcsetattr(rustix::stdio::stdin(), OptionalActions::Now, &raw).ok()?;
        Some(Raw(before))
    }
}

impl Drop for Raw {
    fn drop(&mut self) {
        // A terminal that is gone needs no care.
        let _ = tcsetattr(rustix::stdio::stdin(), OptionalActions::Now, &self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_begin_with_their_channel() {
        assert_eq!(framed(STDIN, b"ab"), Message::Binary(Bytes::from_static(b"\0ab")));
    }
}
