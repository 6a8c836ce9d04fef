//! The double: the same front over memory, for tests of everything above the store.
//!
//! A [`Disk`] outlives the stores that are opened on it, as a file outlives its controller. A batch is on it whole or not
//! at all, some time before it is answered: whoever is killed in between does not know which.

use std::collections::{BTreeMap, HashSet};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures::FutureExt as _;
use futures::future::BoxFuture;
use tokio_util::sync::CancellationToken;

use super::backend::{Backend, BackendError, Batch, Row};
use super::state::RingLimits;
use super::{Change, Event, Store, Writer, writer};

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

/// What is kept when the store is gone.
#[derive(Debug, Clone, Default)]
pub struct Disk {
    kept: Arc<Mutex<Kept>>,
    failures: Failures,
}

#[derive(Debug, Default)]
struct Kept {
    rows: BTreeMap<u64, Row>,
    compacted: u64,
    last: u64,
    /// How long a commit takes until it is on the disk, and from then until it is answered.
    latency: (Duration, Duration),
    /// Only every so many commits is synced.
    synced_every: u64,
    commits: u64,
    synced: u64,
}

impl Disk {
    /// How its commits fail.
    #[must_use]
    pub fn failures(&self) -> &Failures {
        &self.failures
    }

    /// From now on a commit takes so long until it is on the disk, and so much longer until it is answered.
    pub fn set_latency(&self, until_kept: Duration, until_answered: Duration) {
        self.kept().latency = (until_kept, until_answered);
    }

    /// Plants a fault, to see that somebody finds it: only every so many commits is synced, and what came after that is gone
    /// for the next who opens it.
    pub fn sync_every(&self, commits: u64) {
        self.kept().synced_every = commits;
    }

    /// Forgets what is not the newest of its object any more, as a compaction does that takes in everything that is synced.
    pub fn compact(&self) {
        let mut kept = self.kept();
        let through = kept.synced;
        let mut there = HashSet::new();
        let of = |row: &Row| (row.resource.clone(), row.namespace.clone(), row.name.clone());
        let old = kept.rows.iter().rev().filter(|(revision, row)| {
            let newest = there.insert(of(row));
            **revision <= through && (!newest || row.deleted)
        });
        let old: Vec<u64> = old.map(|(revision, _)| *revision).collect();
        old.iter().for_each(|revision| drop(kept.rows.remove(revision)));
        kept.compacted = kept.compacted.max(through);
    }

    /// The store as it is on the disk, and its writer to run. One at a time: who opens a second one has killed the first.
    ///
    /// # Panics
    /// When the rows contradict each other, which no batch that was kept whole brings about.
    pub async fn open(&self) -> (Store, Writer) {
        self.kept().lose_unsynced();
        writer::open(Box::new(self.clone()), RingLimits::DEFAULT)
            .await
            .expect("a disk in memory loads what was committed to it")
    }

    fn kept(&self) -> MutexGuard<'_, Kept> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Kept {
    fn lose_unsynced(&mut self) {
        self.rows.split_off(&(self.synced + 1));
        self.last = self.synced;
    }

    fn take(&mut self, batch: &Batch<'_>) {
        for event in batch.events {
            self.last = event.revision();
            self.rows.insert(event.revision(), row(event));
        }
        self.commits += 1;
        if self.synced_every < 2 || self.commits.is_multiple_of(self.synced_every) {
            self.synced = self.last;
        }
        if let Some(compaction) = batch.compaction {
            self.compacted = compaction.through;
            for revision in &compaction.garbage {
                self.rows.remove(revision);
            }
        }
    }
}

fn row(event: &Event) -> Row {
    let key = &event.object.key;
    Row {
        revision: event.revision(),
        resource: key.resource.as_str().to_owned(),
        namespace: key.namespace().unwrap_or_default().to_owned(),
        name: key.name.to_string(),
        uid: event.object.uid.to_string(),
        deleted: event.change == Change::Delete,
        value: String::from_utf8_lossy(&event.object.bytes).into_owned(),
    }
}

impl Backend for Disk {
    fn load<'a>(
        &'a mut self,
        sink: &'a mut (dyn FnMut(Row) + Send),
    ) -> BoxFuture<'a, Result<u64, BackendError>> {
        let kept = self.kept();
        kept.rows.values().cloned().for_each(sink);
        let compacted = kept.compacted;
        async move { Ok(compacted) }.boxed()
    }

    fn commit<'a>(&'a mut self, batch: Batch<'a>) -> BoxFuture<'a, Result<(), BackendError>> {
        let take = |left: &AtomicU32| {
            left.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |left| left.checked_sub(1))
        };
        let lost = take(&self.failures.lost).is_ok();
        let failed = lost || take(&self.failures.unheard).is_ok();
        let (until_kept, until_answered) = self.kept().latency;
        async move {
            pass(until_kept).await;
            if !lost {
                self.kept().take(&batch);
            }
            pass(until_answered).await;
            if failed { Err(BackendError::Injected) } else { Ok(()) }
        }
        .boxed()
    }

    fn last_revision(&mut self) -> BoxFuture<'_, Result<u64, BackendError>> {
        let last = self.kept().last;
        async move { Ok(last) }.boxed()
    }
}

async fn pass(time: Duration) {
    if !time.is_zero() {
        tokio::time::sleep(time).await;
    }
}

/// An empty store in memory, and its writer to run.
pub async fn open() -> (Store, Writer, Failures) {
    let disk = Disk::default();
    let (store, writer) = disk.open().await;
    (store, writer, disk.failures)
}

/// An empty store in memory whose writer already runs; it ends with the last handle. For tests.
pub async fn start() -> Store {
    start_failing().await.0
}

/// The same, with what makes its commits fail.
pub async fn start_failing() -> (Store, Failures) {
    let (store, writer, failures) = open().await;
    // Owned by the store: it ends when the last handle is dropped.
    drop(tokio::spawn(writer.run(CancellationToken::new())));
    (store, failures)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::{Key, Op, Precondition, Resource, Stored};
    use super::*;

    #[tokio::test]
    async fn what_was_compacted_is_what_it_was() {
        let key = |name: &str| Key::cluster(Resource::new("nodes"), name);
        let disk = Disk::default();
        let (store, writer) = disk.open().await;
        let runs = tokio::spawn(writer.run(CancellationToken::new()));
        for name in ["a", "b"] {
            let object = json!({"metadata": {"name": name, "uid": name}});
            store.apply_one(Op::create(key(name), object)).await.unwrap();
        }
        let gone = Op::Delete { key: key("b"), precondition: Precondition::Any };
        store.apply_one(gone).await.unwrap();
        let (before, revision) = (store.get(&key("a")).unwrap(), store.revision());
        drop(store);
        runs.await.unwrap();
        disk.compact();
        assert_eq!(disk.kept().rows.len(), 1);
        let (store, _writer) = disk.open().await;
        assert_eq!(store.revision(), revision);
        assert_eq!(store.get(&key("a")).unwrap().bytes, before.bytes);
        assert!(store.get(&key("b")).is_none());
    }

    fn object(n: u64) -> serde_json::Value {
        json!({"metadata": {"name": "a", "uid": "a"}, "n": n})
    }

    #[tokio::test(start_paused = true)]
    async fn what_the_disk_has_is_known_soon_also_when_nobody_writes() {
        let (store, failures) = start_failing().await;
        let mut watcher = store.watch_all(0).unwrap();
        failures.mislead_next(1);
        let key = Key::cluster(Resource::new("nodes"), "a");
        store.create(key.clone(), object(0)).await.unwrap_err();
        let seen = tokio::time::timeout(Duration::from_secs(60), watcher.next()).await;
        assert_eq!(seen.expect("nobody has to write for it").unwrap().len(), 1);
        assert!(store.get(&key).is_some());
    }

    #[tokio::test]
    async fn an_update_leaves_as_it_is_only_what_the_disk_has() {
        let (store, failures) = start_failing().await;
        let key = Key::cluster(Resource::new("nodes"), "a");
        store.create(key.clone(), object(0)).await.unwrap();
        let set = async |n: u64| {
            let write = |_: &Stored, value: serde_json::Value| {
                Ok::<_, std::convert::Infallible>((value["n"] != n).then(|| object(n)))
            };
            store.update(&key, write).await
        };
        failures.mislead_next(1);
        set(1).await.unwrap_err();
        assert_eq!(set(0).await.unwrap().value()["n"], 0);
        store.settled().await.unwrap();
        assert_eq!(store.get(&key).unwrap().value()["n"], 0);
    }
}
