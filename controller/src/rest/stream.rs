//! Answers that last: bodies that are fed by a task each, a piece at a time.
//!
//! ```text
//!   source ──▶ task ──▶ one piece ──▶ body ──▶ hyper, while there is room on the way
//! ```
//!
//! hyper asks for a body's next piece only when the client takes what was sent. Whatever else is to end an answer (its time,
//! the controller's end, a history that is forgotten) would not be looked at while the client reads nothing, and what the
//! answer holds (a list's objects) would be held as long. So each has a task of its own, which ends when a piece is not taken
//! in time; and there is a number of places for them.

use std::convert::Infallible;
use std::io;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::body::Body;
use bytes::Bytes;
use futures::{Stream, StreamExt as _, stream};
use tokio::sync::{Semaphore, mpsc};
use tokio::time::timeout;
use tokio_util::task::TaskTracker;

use super::failure::Failure;

/// Answers that last at once. Each may hold two pieces, 128 KiB; the robots' agents need none.
const PLACES: usize = 4096;
/// Who has taken nothing of 64 KiB for so long reads no more.
const STALL: Duration = Duration::from_secs(30);

/// The answers that last.
#[derive(Debug)]
pub struct Streams {
    places: Arc<Semaphore>,
    tasks: TaskTracker,
}

impl Default for Streams {
    fn default() -> Self {
        Self { places: Arc::new(Semaphore::new(PLACES)), tasks: TaskTracker::new() }
    }
}

impl Streams {
    /// A body with what the source says. One that is cut off, because its reader reads no more or the source fails, ends with
    /// an error and not as if it were whole.
    pub(crate) fn feed<E: std::fmt::Display + Send>(
        &self,
        source: impl Stream<Item = Result<Bytes, E>> + Send + 'static,
    ) -> Result<Body, Failure> {
        let place = Arc::clone(&self.places).try_acquire_owned();
        let place = place.map_err(|_| Failure::too_many())?;
        let (sender, receiver) = mpsc::channel(1);
        let whole = Arc::new(AtomicBool::new(false));
        let done = Arc::clone(&whole);
        self.tasks.spawn(async move {
            let _place = place;
            if pass_on(source, &sender).await {
                done.store(true, Ordering::Release);
            }
            // After it is known whether it was all: who waits for a piece looks at once.
            drop(sender);
        });
        Ok(Body::from_stream(stream::unfold(Some((receiver, whole)), |body| async {
            let (mut receiver, whole) = body?;
            match receiver.recv().await {
                Some(piece) => Some((Ok(piece), Some((receiver, whole)))),
                None if whole.load(Ordering::Acquire) => None,
                None => Some((Err(io::Error::other("the answer was cut off")), None)),
            }
        })))
    }

    /// The same of a source that does not fail.
    pub(crate) fn follow(
        &self,
        source: impl Stream<Item = Bytes> + Send + 'static,
    ) -> Result<Body, Failure> {
        self.feed(source.map(Ok::<_, Infallible>))
    }

    /// Ready when every one has ended. No other begins meanwhile: the connections are closed.
    pub(crate) async fn ended(&self) {
        self.tasks.close();
        self.tasks.wait().await;
    }
}

/// Passes on what the source says; whether it was all of it.
async fn pass_on<E: std::fmt::Display>(
    source: impl Stream<Item = Result<Bytes, E>>,
    sender: &mpsc::Sender<Bytes>,
) -> bool {
    let mut source = pin!(source);
    loop {
        // The source is dropped with its reader: what it was about to say is nobody's.
        let piece = tokio::select! {
            () = sender.closed() => return false,
            piece = source.next() => piece,
        };
        match piece {
            None => return true,
            Some(Err(error)) => {
                tracing::debug!(%error, "an answer broke off");
                return false;
            }
            Some(Ok(piece)) => match timeout(STALL, sender.send(piece)).await {
                Ok(Ok(())) => {}
                Ok(Err(_)) => return false,
                Err(_) => {
                    metrics::counter!("muster_stalled_readers_total").increment(1);
                    return false;
                }
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use http_body_util::BodyExt as _;

    use super::*;

    fn pieces(count: usize) -> impl Stream<Item = Bytes> + Send + 'static {
        stream::iter((0..count).map(|i| Bytes::from(format!("{i} "))))
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn who_reads_gets_all_of_it() {
        let streams = Streams::default();
        let body = streams.follow(pieces(1000)).unwrap().collect().await.unwrap().to_bytes();
        assert!(body.starts_with(b"0 1 2 ") && body.ends_with(b"998 999 "));
        // However the end of the pieces and the reader's look for one more come together.
        for _ in 0..2_000 {
            let body = streams.follow(pieces(2)).unwrap().collect().await;
            assert_eq!(body.expect("it is whole").to_bytes(), "0 1 ");
        }
        streams.ended().await;
        assert_eq!(streams.places.available_permits(), PLACES);
    }

    #[tokio::test(start_paused = true)]
    async fn who_does_not_read_is_cut_off_and_holds_nothing() {
        let streams = Streams::default();
        let held = Arc::new(());
        let holds = Arc::clone(&held);
        let source = pieces(1000).map(move |piece| {
            let _ = &holds;
            piece
        });
        let mut body = streams.follow(source).unwrap();
        assert_eq!(body.frame().await.unwrap().unwrap().into_data().unwrap(), "0 ");
        let begin = tokio::time::Instant::now();
        // Only clocks are left, and they are not waited for.
        streams.ended().await;
        assert_eq!(begin.elapsed(), STALL);
        assert_eq!(Arc::strong_count(&held), 1, "what it was sent from is let go");
        assert_eq!(streams.places.available_permits(), PLACES);
        assert_eq!(body.frame().await.unwrap().unwrap().into_data().unwrap(), "1 ");
        assert!(body.frame().await.unwrap().is_err(), "it does not look whole");
        assert!(body.frame().await.is_none());
    }

    #[tokio::test]
    async fn what_nobody_reads_any_more_or_what_fails_ends() {
        let streams = Streams::default();
        drop(streams.follow(stream::pending()).unwrap());
        let failing = stream::iter([Ok(Bytes::from("a")), Err("it broke")]);
        let body = streams.feed(failing).unwrap().collect().await;
        assert!(body.is_err());
        let panics = stream::once(async { panic!("a fault") });
        assert!(streams.follow(panics).unwrap().collect().await.is_err());
        streams.ended().await;
    }

    #[tokio::test]
    async fn there_is_a_number_of_places() {
        let streams = Streams::default();
        let taken: Vec<Body> =
            (0..PLACES).map(|_| streams.follow(stream::pending()).unwrap()).collect();
        let late = streams.follow(pieces(1)).unwrap_err();
        assert_eq!(late.code(), 429);
        drop(taken);
        streams.ended().await;
        assert_eq!(streams.places.available_permits(), PLACES);
    }
}
