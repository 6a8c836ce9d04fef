//! Live poses → the scheduler's cluster, at a pace of its own.
//!
//! Poses of a busy fleet come a hundred thousand times a second. They are not events here: when some have changed, the
//! scheduler takes every robot that moved since it last looked, as it is now, and decides once for all of them.
//!
//! **How old a pose may be** that a decision is made on: [`EVERY`], or [`REST`] times as long as the last look took,
//! whichever is more (at most [`REST_AT_MOST`]), and what the scheduler does meanwhile. With 10 000 robots that all move and 100 frameworks a look
//! takes some milliseconds, so the bound is some tens of milliseconds; it grows with the number of frameworks, and the
//! share of time that goes into looks does not.

use std::sync::Arc;
use std::time::Duration;

use muster_api::name::NodeName;
use muster_api::pose::Pose;
use muster_controller_core::cluster::Cluster;
use muster_controller_core::poses::Cursor;
use tokio::sync::watch;
use tokio::time::Instant;

use crate::session::poses::LivePoses;

/// Between two looks, at least. At 1.5 m/s a robot moves 15 mm in it; a trackers' frame is rarely shorter.
const EVERY: Duration = Duration::from_millis(10);
/// After a look, so many times its duration belong to everything else that the scheduler has to do …
const REST: u32 = 4;
/// … but not more than this: a look that waited for a slow disk says nothing about the next one.
const REST_AT_MOST: Duration = Duration::from_millis(500);

/// The scheduler's reader of live poses.
#[derive(Debug)]
pub(super) struct Moves {
    poses: Arc<LivePoses>,
    changed: watch::Receiver<u64>,
    cursor: Cursor,
    not_before: Instant,
}

impl Moves {
    pub(super) fn new(poses: Arc<LivePoses>) -> Self {
        let changed = poses.subscribe();
        Moves { poses, changed, cursor: Cursor::default(), not_before: Instant::now() }
    }

    /// Ready when robots moved and a look is due. Cancel safe: what changed stays to be seen.
    pub(super) async fn due(&mut self) {
        LivePoses::beyond(&mut self.changed, &self.cursor).await;
        tokio::time::sleep_until(self.not_before).await;
    }

    /// Puts every robot that moved where it is now.
    pub(super) fn take(&mut self, cluster: &mut Cluster) {
        self.poses.read(&mut self.cursor, |known| {
            // A checkpoint is known from the Node object, which may be newer here.
            if let (Some(pose), Some(_)) = (known.pose, known.heard) {
                cluster.set_pose(known.name, pose);
            }
        });
    }

    /// The cluster was made anew, with the poses of the Node objects.
    pub(super) fn begin_anew(&mut self, cluster: &mut Cluster) {
        self.cursor = Cursor::default();
        self.take(cluster);
    }

    /// The pose of a node that the cluster has not known: it was read before the node was there.
    pub(super) fn of_new(&self, node: &NodeName) -> Option<Pose> {
        self.poses.live(node)
    }

    /// A look that began then is over.
    pub(super) fn looked(&mut self, began: Instant) {
        let now = Instant::now();
        self.not_before = now + EVERY.max(((now - began) * REST).min(REST_AT_MOST));
    }
}
