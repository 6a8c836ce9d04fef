//! Writes the scheduler's books into Node status: used, free, and who holds which lease.
//!
//! The scheduler's ledger is the truth for placing; this is its picture for people and clients,
//! a moment behind. Changes of one node between two passes are written once.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures::future::join_all;
use muster_api::kind::lease::{HolderKind, LeaseHolder};
use muster_api::kind::node::{Node, NodeLease, NodeStatus};
use muster_api::name::NodeName;
use muster_api::resource::Compute;
use muster_controller_core::ledger::NodeLedger;
use tokio::sync::Notify;

use super::RETRY;
use crate::context::Context;
use crate::objects;
use crate::store::Op;

/// Pages in one round. Binds and reports share the disk with them, and come first.
const ROUND: usize = 128;
/// Between two rounds. Who looks at a node does not see the difference; a task that is bound and ends at once,
/// and the first look at a fleet of thousands, cost the disk a fraction.
const PAUSE: Duration = Duration::from_millis(50);

/// The picture of one node's ledger.
#[derive(Debug, Clone, PartialEq)]
pub struct Page {
    used: Compute,
    free: Compute,
    leases: Vec<NodeLease>,
}

impl From<&NodeLedger> for Page {
    fn from(ledger: &NodeLedger) -> Self {
        let lease = |(name, group): (&str, &muster_controller_core::ledger::Group)| {
            let holder = group.holder.as_ref().map(|uid| {
                if let Some(person) = LeaseHolder::person_of(uid) {
                    return person;
                }
                let title =
                    ledger.reservation(uid).map(|r| r.title.to_string()).unwrap_or_default();
                let (namespace, name) = title.split_once('/').unwrap_or_default();
                LeaseHolder {
                    kind: HolderKind::Task,
                    namespace: namespace.to_owned(),
                    name: name.to_owned(),
                    uid: uid.clone(),
                }
            });
            NodeLease { group: name.to_owned(), epoch: group.epoch, holder }
        };
        Page {
            used: ledger.used().clone(),
            free: ledger.free(),
            leases: ledger.groups().map(lease).collect(),
        }
    }
}

impl Page {
    /// What is written is what is so.
    #[must_use]
    pub fn is_written(&self, status: Option<&NodeStatus>) -> bool {
        status
            .is_some_and(|s| s.used == self.used && s.free == self.free && s.leases == self.leases)
    }

    fn write(&self, status: &mut NodeStatus) {
        status.used = self.used.clone();
        status.free = self.free.clone();
        status.leases = self.leases.clone();
    }
}

/// Pages that are not written yet, the newest of each node.
#[derive(Debug, Default)]
pub struct Books {
    due: Mutex<BTreeMap<NodeName, Page>>,
    changed: Notify,
}

impl Books {
    /// Notes a page; an older one of the same node that was not written is dropped.
    pub fn put(&self, node: &NodeName, page: Page) {
        self.due.lock().unwrap_or_else(PoisonError::into_inner).insert(node.clone(), page);
        self.changed.notify_one();
    }

    fn take(&self) -> BTreeMap<NodeName, Page> {
        std::mem::take(&mut *self.due.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Pages that are not written after all; a newer one of the same node wins.
    fn put_back(&self, pages: Vec<(NodeName, Page)>) {
        let mut due = self.due.lock().unwrap_or_else(PoisonError::into_inner);
        for (node, page) in pages {
            due.entry(node).or_insert(page);
            self.changed.notify_one();
        }
    }
}

/// Writes pages as they come: the first round at once, then one after every pause.
pub async fn run(context: Arc<Context>, books: Arc<Books>) {
    loop {
        books.changed.notified().await;
        let mut pages = books.take().into_iter().peekable();
        while pages.peek().is_some() {
            let round = pages.by_ref().take(ROUND).map(|page| write(&context, page));
            let failed: Vec<_> = join_all(round).await.into_iter().flatten().collect();
            tokio::time::sleep(if failed.is_empty() { PAUSE } else { RETRY }).await;
            books.put_back(failed);
        }
    }
}

/// Gives the page back when the store failed.
async fn write(context: &Context, (node, page): (NodeName, Page)) -> Option<(NodeName, Page)> {
    let key = objects::node_key(node.as_str());
    let written = objects::change(&context.store, &key, |stored, mut object: Node| {
        if page.is_written(object.status.as_ref()) {
            return None;
        }
        page.write(object.status.get_or_insert_default());
        Some(vec![Op::status(stored, &object.status)])
    })
    .await;
    match written {
        Ok(_) => None,
        Err(error) => {
            tracing::warn!(node = %node, error = crate::app::chain(&error), "a node's books are not written");
            Some((node, page))
        }
    }
}
