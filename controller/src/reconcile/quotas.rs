//! Writes into the status of Quota objects what their namespaces have, from the scheduler's ledger, and what they ask
//! for, from the door.
//!
//! As with `books`: a picture for people and clients, a moment behind. Counting goes over every reservation, so the
//! scheduler counts at most once in `EVERY`, and what has not changed is not written.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use muster_api::kind::quota::{QUOTA_NAME, Quota, QuotaStatus};
use muster_controller_core::cluster::Cluster;
use tokio::sync::Notify;
use tokio::time::Instant;

use super::RETRY;
use crate::context::Context;
use crate::objects::{self, QUOTAS};
use crate::store::{Key, Op, StoreError};

/// Between two counts. Who looks at a quota does not see the difference.
const EVERY: Duration = Duration::from_millis(250);

/// The newest count, if it is not written yet.
#[derive(Debug, Default)]
pub struct Counts {
    due: Mutex<Option<BTreeMap<Arc<str>, QuotaStatus>>>,
    changed: Notify,
}

impl Counts {
    fn put(&self, count: BTreeMap<Arc<str>, QuotaStatus>) {
        *self.due.lock().unwrap_or_else(PoisonError::into_inner) = Some(count);
        self.changed.notify_one();
    }

    fn take(&self) -> Option<BTreeMap<Arc<str>, QuotaStatus>> {
        self.due.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Counts that could not be written; a newer one wins.
    fn put_back(&self, count: BTreeMap<Arc<str>, QuotaStatus>) {
        self.due.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(count);
        self.changed.notify_one();
    }
}

/// The scheduler's side: when to count.
#[derive(Debug)]
pub(super) struct Counter {
    counts: Arc<Counts>,
    /// Something changed since the last count.
    stale: bool,
    next: Instant,
}

impl Counter {
    pub(super) fn new(counts: Arc<Counts>) -> Self {
        Counter { counts, stale: false, next: Instant::now() }
    }

    pub(super) fn changed(&mut self) {
        self.stale = true;
    }

    /// Counts if it is due. Says when it will be.
    pub(super) fn work(&mut self, cluster: &Cluster) -> Option<Instant> {
        if !self.stale || !cluster.has_quotas() {
            return None;
        }
        let now = Instant::now();
        if now < self.next {
            return Some(self.next);
        }
        (self.stale, self.next) = (false, now + EVERY);
        self.counts.put(cluster.accounts().of_quotas(cluster));
        None
    }
}

/// Writes counts as they come.
pub async fn run(context: Arc<Context>, counts: Arc<Counts>) {
    loop {
        counts.changed.notified().await;
        let Some(count) = counts.take() else { continue };
        let mut failed = BTreeMap::new();
        for (namespace, status) in count {
            if let Err(error) = write(&context, &namespace, &status).await {
                tracing::warn!(%namespace, error = crate::app::chain(&error), "a quota's status is not written");
                failed.insert(namespace, status);
            }
        }
        if !failed.is_empty() {
            tokio::time::sleep(RETRY).await;
            counts.put_back(failed);
        }
    }
}

async fn write(context: &Context, namespace: &str, status: &QuotaStatus) -> Result<(), StoreError> {
    let key = Key::namespaced(QUOTAS, namespace, QUOTA_NAME);
    let requested = context.door.requested(&context.store, namespace);
    let status = &QuotaStatus { requested, ..status.clone() };
    objects::change(&context.store, &key, |stored, object: Quota| {
        if object.status.as_ref() == Some(status) {
            return None;
        }
        Some(vec![Op::status(stored, &Some(status))])
    })
    .await
    .map(drop)
}
