//! Live poses: between whoever says where robots are, and whoever wants to know.
//!
//! ```text
//!   agents' sessions ─────────┐                              ┌─▶ reconcile::moves ─▶ cluster: tasks, offers
//!   PoseService, a stream each┴─▶ LivePoses (core::poses) ───┼─▶ rest::poses: lists and watches
//!   nodes (store) ──who there is──▶ behind one lock          └─▶ reconcile::checkpoints ─▶ Node.status.pose
//! ```
//!
//! Writers hold the lock for a batch, readers for a part of a round. Readers are told that something changed, not what:
//! each has a cursor, reads at its own pace, and finds every robot as it is then. Nothing of it is in the store but the
//! checkpoints; after a restart they stand in until poses come again.

mod nodes;
mod service;

use std::sync::{Mutex, MutexGuard};

use muster_api::name::NodeName;
use muster_api::pose::Pose;
use muster_controller_core::node_health::Monotonic;
use muster_controller_core::poses::{Cursor, Known, NotTaken, Poses};
use tokio::sync::watch;
use tokio::time::Instant;

pub use nodes::run;
pub use service::Service;

use super::lock;

/// The generated server side of the stream.
#[allow(clippy::all, clippy::allow_attributes, unreachable_pub, reason = "generated")]
pub(crate) mod proto {
    include!(concat!(env!("OUT_DIR"), "/muster.pose.v1.rs"));
}

/// Robots that a reader is shown before it lets the lock go: a few hundred microseconds.
const AT_ONCE: usize = 1024;

/// The newest pose of every robot, for everybody in the controller.
#[derive(Debug)]
pub struct LivePoses {
    table: Mutex<Poses>,
    /// The table's revision.
    changed: watch::Sender<u64>,
    /// The Node objects were looked at since the start; before that, "no such node" means nothing.
    filled: watch::Sender<bool>,
    started: Instant,
}

impl Default for LivePoses {
    fn default() -> Self {
        LivePoses {
            table: Mutex::default(),
            changed: watch::Sender::new(0),
            filled: watch::Sender::new(false),
            started: Instant::now(),
        }
    }
}

impl LivePoses {
    /// The time that poses are stamped with when they come.
    pub(crate) fn now(&self) -> Monotonic {
        self.started.elapsed()
    }

    fn table(&self) -> MutexGuard<'_, Poses> {
        lock(&self.table)
    }

    /// Changes the table, and tells readers if anything is new for them.
    fn write<T>(&self, change: impl FnOnce(&mut Poses, Monotonic) -> T) -> T {
        let now = self.now();
        let mut table = self.table();
        let before = table.revision();
        let result = change(&mut table, now);
        let after = table.revision();
        drop(table);
        if after != before {
            // Two writers may come here in the other order; the revision only grows.
            self.changed.send_modify(|revision| *revision = (*revision).max(after));
        }
        result
    }

    /// A robot's agent says where it is. The caller knows that the node is there, and that the agent speaks for it.
    ///
    /// # Errors
    ///
    /// Why the pose is not taken.
    pub fn say_own(&self, node: &NodeName, pose: &Pose) -> Result<(), NotTaken> {
        let taken = self.write(|table, now| table.put_own(node, pose.view(), now));
        metrics::counter!("muster_poses_total", "origin" => "agent").increment(1);
        taken
    }

    /// Ready when there is something that a reader at this cursor has not seen. Cancel safe.
    pub(crate) async fn beyond(changed: &mut watch::Receiver<u64>, cursor: &Cursor) {
        let seen = cursor.seen();
        if changed.wait_for(|revision| *revision > seen).await.is_err() {
            // The controller ends.
            std::future::pending().await
        }
    }

    /// Where a reader hears that something changed.
    pub(crate) fn subscribe(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// Shows everything that changed since the cursor; the lock is let go in between.
    pub(crate) fn read(&self, cursor: &mut Cursor, mut show: impl FnMut(Known<'_>)) {
        while self.table().read(cursor, AT_ONCE, &mut show) {}
    }

    /// As [`LivePoses::read`], at most `most` robots; true: there is more of this round.
    pub(crate) fn read_some(
        &self,
        cursor: &mut Cursor,
        most: usize,
        show: impl FnMut(Known<'_>),
    ) -> bool {
        self.table().read(cursor, most, show)
    }

    /// The newest pose of one robot, shown under the lock.
    pub(crate) fn get<T>(&self, node: &str, show: impl FnOnce(Known<'_>) -> T) -> Option<T> {
        self.table().get(node).map(show)
    }

    /// What somebody said of this node since the controller began.
    pub(crate) fn live(&self, node: &NodeName) -> Option<Pose> {
        self.table().live(node).cloned()
    }

    /// How long ago a pose came, milliseconds.
    pub(crate) fn age_ms(&self, heard: Monotonic) -> u64 {
        u64::try_from(self.now().saturating_sub(heard).as_millis()).unwrap_or(u64::MAX)
    }

    /// Poses to be written into Node objects, and whether to ask again soon.
    pub(crate) fn take_due(&self, most: usize) -> (Vec<(NodeName, Pose)>, bool) {
        let now = self.now();
        self.table().take_due(most, now)
    }

    /// A pose that was due is not written after all.
    pub(crate) fn not_written(&self, node: &NodeName) {
        self.table().not_written(node);
    }

    async fn ready(&self) {
        // Cannot fail: the sender is our own.
        drop(self.filled.subscribe().wait_for(|filled| *filled).await);
    }
}
