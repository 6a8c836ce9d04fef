//! What a program and its client say to each other, and how much of it is under way: each side counts what the other has
//! not taken yet.

use std::sync::Arc;

use bytes::Bytes;
use muster_api::wire::agent::v1 as proto;
use proto::exec_output::Body as Say;
use tokio::sync::{Semaphore, mpsc};

use super::said;

/// Bytes under way in one direction: a few round trips of a fast network, and little memory.
pub(crate) const WINDOW: usize = 256 << 10;

/// The longest piece of output.
pub(crate) const CHUNK: usize = 32 << 10;

/// What is run beside an attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Invocation {
    pub(crate) argv: Vec<String>,
    /// The client has input for it; without, it finds the end of it at once.
    pub(crate) stdin: bool,
    /// It gets a terminal instead of three streams.
    pub(crate) tty: bool,
}

/// What a client says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Input {
    Data(Bytes),
    /// Nothing follows.
    End,
    /// Of its terminal, characters.
    Size {
        columns: u16,
        rows: u16,
    },
}

/// What came of a program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Ran {
    /// Its exit code, as a shell shows it.
    Ended(i32),
    /// It could not be started, by its own fault: why.
    NotStarted(String),
    /// It was killed, for its client or its task is gone.
    Cut,
}

/// Which of a program's streams.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stream {
    Stdout,
    Stderr,
}

/// The client's end of a program's streams.
#[derive(Debug)]
pub(crate) struct Ends {
    pub(crate) input: mpsc::UnboundedReceiver<Input>,
    pub(crate) room: Room,
    pub(crate) output: Outlet,
}

/// The client is gone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Gone;

/// Takes output for the client, as fast as the client takes it.
#[derive(Debug, Clone)]
pub(crate) struct Outlet {
    out: mpsc::Sender<proto::ExecOutput>,
    window: Arc<Semaphore>,
    stdout: bool,
    stderr: bool,
}

impl Outlet {
    pub(crate) fn new(out: mpsc::Sender<proto::ExecOutput>, order: &proto::Exec) -> Outlet {
        let window = Arc::new(Semaphore::new(WINDOW));
        Outlet { out, window, stdout: order.stdout, stderr: order.stderr }
    }

    /// Holds what the client would take at once, bytes.
    pub(crate) fn window(&self) -> Arc<Semaphore> {
        Arc::clone(&self.window)
    }

    /// Waits until the client takes it. A stream that it did not ask for is dropped.
    pub(crate) async fn send(&self, stream: Stream, mut data: Bytes) -> Result<(), Gone> {
        let wanted = match stream {
            Stream::Stdout => self.stdout,
            Stream::Stderr => self.stderr,
        };
        while wanted && !data.is_empty() {
            let piece = data.split_to(data.len().min(CHUNK));
            let size = u32::try_from(piece.len()).unwrap_or(u32::MAX);
            self.window.acquire_many(size).await.map_err(|_| Gone)?.forget();
            let body = match stream {
                Stream::Stdout => Say::Stdout(piece),
                Stream::Stderr => Say::Stderr(piece),
            };
            self.out.send(said(body)).await.map_err(|_| Gone)?;
        }
        Ok(())
    }
}

/// Room for input that the program has not taken.
#[derive(Debug, Clone)]
pub(crate) struct Room {
    out: mpsc::Sender<proto::ExecOutput>,
    free: Arc<Semaphore>,
}

impl Room {
    pub(crate) fn new(out: mpsc::Sender<proto::ExecOutput>) -> Room {
        Room { out, free: Arc::new(Semaphore::new(WINDOW)) }
    }

    /// False: the sender does not keep to the window.
    pub(crate) fn takes(&self, bytes: usize) -> bool {
        let permits = u32::try_from(bytes).unwrap_or(u32::MAX);
        self.free.try_acquire_many(permits).map(tokio::sync::SemaphorePermit::forget).is_ok()
    }

    /// The program has taken so much, or never will.
    pub(crate) async fn taken(&self, bytes: usize) {
        self.free.add_permits(bytes);
        let bytes = u32::try_from(bytes).unwrap_or(u32::MAX);
        // Closed: the client is gone, which its program is told in another way.
        let _ = self.out.send(said(Say::Taken(bytes))).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn order() -> proto::Exec {
        proto::Exec { stdout: true, ..proto::Exec::default() }
    }

    #[tokio::test]
    async fn output_waits_for_a_client_that_is_slow_and_knows_when_it_is_gone() {
        let (out, mut queue) = mpsc::channel(64);
        let outlet = Outlet::new(out, &order());
        outlet.send(Stream::Stderr, Bytes::from_static(b"nobody asked")).await.unwrap();
        outlet.send(Stream::Stdout, Bytes::from(vec![0; WINDOW])).await.unwrap();
        let more = outlet.clone();
        let more =
            tokio::spawn(
                async move { more.send(Stream::Stdout, Bytes::from_static(b"more")).await },
            );
        let mut seen = 0;
        while seen < WINDOW {
            let Some(Say::Stdout(data)) = queue.recv().await.unwrap().body else { panic!() };
            assert!(data.len() <= CHUNK);
            seen += data.len();
        }
        tokio::task::yield_now().await;
        assert!(queue.try_recv().is_err(), "nothing passes before the client has taken some");
        outlet.window().add_permits(4);
        assert!(queue.recv().await.is_some());
        assert_eq!(more.await.unwrap(), Ok(()));
        drop(queue);
        outlet.window().add_permits(1);
        assert_eq!(outlet.send(Stream::Stdout, Bytes::from_static(b"x")).await, Err(Gone));
    }

    #[tokio::test]
    async fn a_sender_that_does_not_keep_to_the_window_is_seen() {
        let (out, mut queue) = mpsc::channel(4);
        let room = Room::new(out);
        assert!(room.takes(WINDOW));
        assert!(!room.takes(1));
        room.taken(10).await;
        assert_eq!(queue.recv().await.unwrap().body, Some(Say::Taken(10)));
        assert!(room.takes(10) && !room.takes(1));
    }
}
