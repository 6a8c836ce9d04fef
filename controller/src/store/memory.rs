//! The double: the same front over nothing durable, for tests of everything above the store.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use futures::FutureExt as _;
use futures::future::BoxFuture;
use tokio_util::sync::CancellationToken;

use super::backend::{Backend, BackendError, Batch, Row};
use super::state::RingLimits;
use super::{Store, Writer, writer};

/// Makes coming commits fail.
#[derive(Debug, Clone, Default)]
pub struct Failures {
    lost: Arc<AtomicU32>,
    unheard: Arc<AtomicU32>,
}

impl Failures {
    /// The next `commits` fail; nothing of them is kept.
    pub fn fail_next(&self, commits: u32) {
        self.lost.store(commits, Ordering::SeqCst);
    }

    /// The next `commits` take effect, and are reported as failed.
    pub fn mislead_next(&self, commits: u32) {
        self.unheard.store(commits, Ordering::SeqCst);
    }
}

#[derive(Debug, Default)]
struct Memory {
    last: u64,
    failures: Failures,
}

impl Backend for Memory {
    fn load<'a>(
        &'a mut self,
        _sink: &'a mut (dyn FnMut(Row) + Send),
    ) -> BoxFuture<'a, Result<u64, BackendError>> {
        async { Ok(0) }.boxed()
    }

    fn commit<'a>(&'a mut self, batch: Batch<'a>) -> BoxFuture<'a, Result<(), BackendError>> {
        let take = |left: &AtomicU32| {
            left.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |left| left.checked_sub(1))
        };
        let lost = take(&self.failures.lost).is_ok();
        if !lost {
            self.last = batch.events.last().map_or(self.last, super::Event::revision);
        }
        let failed = lost || take(&self.failures.unheard).is_ok();
        let result = if failed { Err(BackendError::Injected) } else { Ok(()) };
        async { result }.boxed()
    }

    fn last_revision(&mut self) -> BoxFuture<'_, Result<u64, BackendError>> {
        async { Ok(self.last) }.boxed()
    }
}

/// An empty store in memory, and its writer to run.
pub async fn open() -> (Store, Writer, Failures) {
    let failures = Failures::default();
    let backend = Memory { last: 0, failures: failures.clone() };
    let (store, writer) = writer::open(Box::new(backend), RingLimits::DEFAULT)
        .await
        .expect("an empty store loads nothing");
    (store, writer, failures)
}

/// An empty store in memory whose writer already runs; it ends with the last handle. For tests.
pub async fn start() -> Store {
    let (store, writer, _) = open().await;
    // Owned by the store: it ends when the last handle is dropped.
    drop(tokio::spawn(writer.run(CancellationToken::new())));
    store
}
