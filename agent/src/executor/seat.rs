//! One task's socket, for as long as processes of it may exist, and the connection on it.
//!
//! An idle seat is a descriptor and a small future. The newest connection that shows the token is
//! the executor; an older one is dropped.

use std::fs;
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use futures::future::{BoxFuture, FutureExt};
use futures::stream::{FuturesUnordered, StreamExt};
use muster_api::id::TaskUid;
use muster_api::secret::same;
use muster_api::wire::executor::v1 as proto;
use proto::call::Call as Said;
use tokio::net::{UnixListener, UnixStream};
use tokio_util::task::AbortOnDropHandle;

use super::desk::Desks;
use super::frame;
use crate::socket;

/// Who connects shows the token within this.
const SHOW_WITHIN: Duration = Duration::from_secs(10);

/// Connections that have not yet shown a token; more are refused.
const MOST_STRANGERS: usize = 8;

/// The socket of a task. Dropped: nobody listens any more.
#[derive(Debug)]
pub(crate) struct Seat {
    _serving: AbortOnDropHandle<()>,
}

impl Seat {
    /// Listens at `dir`/socket; what an earlier life of the agent left there is replaced.
    pub(crate) fn open(
        desks: Arc<Desks>,
        uid: TaskUid,
        dir: &Path,
        token: String,
    ) -> io::Result<Seat> {
        // Not the task's: whoever could write here could have the agent change the mode of a file.
        unless(io::ErrorKind::AlreadyExists, fs::DirBuilder::new().mode(0o711).create(dir))?;
        let path = dir.join(super::SOCKET);
        // The task may be another user's, and in a container anybody's: the token says who it is.
        let listener = socket::listen(&path, 0o666)?;
        let serving = tokio::spawn(serve(desks, uid, listener, token));
        Ok(Seat { _serving: AbortOnDropHandle::new(serving) })
    }
}

fn unless(harmless: io::ErrorKind, done: io::Result<()>) -> io::Result<()> {
    match done {
        Err(error) if error.kind() == harmless => Ok(()),
        done => done,
    }
}

async fn serve(desks: Arc<Desks>, uid: TaskUid, listener: UnixListener, token: String) {
    let mut strangers = FuturesUnordered::new();
    let mut connection: Option<BoxFuture<'static, ()>> = None;
    loop {
        // Cancel-safe: a listener, and futures that are owned here and polled in place.
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) if strangers.len() < MOST_STRANGERS => {
                    strangers.push(greet(stream, token.clone()).boxed());
                }
                Ok(_) => tracing::warn!(%uid, "too many connections to an executor's socket"),
                Err(error) => {
                    tracing::warn!(%uid, %error, "an executor's socket");
                    // Out of descriptors, most likely: not in a tight loop.
                    tokio::time::sleep(Duration::from_secs(1)).await;
                }
            },
            Some(greeted) = strangers.next() => match greeted {
                Ok((stream, register)) => {
                    // The former one ends first: it must not take the new one for itself.
                    drop(connection.take());
                    let (desks, uid) = (Arc::clone(&desks), uid.clone());
                    connection = Some(talk(desks, uid, stream, register).boxed());
                }
                Err(error) => tracing::warn!(%uid, %error, "a connection to an executor's socket"),
            },
            () = async { match &mut connection {
                Some(connection) => connection.await,
                None => std::future::pending().await,
            } } => connection = None,
        }
    }
}

async fn greet(mut stream: UnixStream, token: String) -> io::Result<(UnixStream, proto::Register)> {
    let refused = |text: &str| io::Error::new(io::ErrorKind::PermissionDenied, text.to_owned());
    let first = tokio::time::timeout(SHOW_WITHIN, frame::read(&mut stream)).await?;
    let Some(proto::Call { call: Some(Said::Register(register)) }) = first? else {
        return Err(refused("it did not register"));
    };
    if !same(register.token.as_bytes(), token.as_bytes()) {
        return Err(refused("it does not have the token"));
    }
    Ok((stream, register))
}

async fn talk(desks: Arc<Desks>, uid: TaskUid, stream: UnixStream, register: proto::Register) {
    let Some(out) = desks.connect(&uid) else { return };
    tracing::info!(%uid, works = register.tasks.len(), "an executor registered");
    let (mut from, mut to) = stream.into_split();
    let write = async {
        loop {
            let event = out.pop().await;
            frame::write(&mut to, &event).await?;
        }
    };
    let read = async {
        desks.registered(&uid, register).await;
        loop {
            // Whoever does not read the answers is not heard.
            out.room().await;
            let Some(call) = frame::read::<proto::Call, _>(&mut from).await? else {
                return Ok(());
            };
            match call.call {
                Some(Said::StatusUpdate(update)) => desks.updated(&uid, update).await,
                Some(Said::Message(message)) => desks.say(&uid, message.data),
                Some(Said::Register(_)) => tracing::warn!(%uid, "registers a second time"),
                None => tracing::warn!(%uid, "an executor says something newer than this agent"),
            }
        }
    };
    // Neither is polled again after the other has ended.
    let ended: io::Result<()> = tokio::select! {
        ended = read => ended,
        ended = write => ended,
    };
    if let Err(error) = ended {
        tracing::info!(%uid, %error, "an executor's connection");
    }
    desks.disconnected(&uid, &out);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens() {
        assert!(same(b"abc", b"abc"));
        for other in [&b"abd"[..], b"ab", b"abcd", b""] {
            assert!(!same(other, b"abc"));
        }
    }
}
