//! Writes live poses into `Node.status.pose`, coarsely: see [`muster_controller_core::poses::checkpoint`].

use std::sync::Arc;
use std::time::Duration;

use futures::future::join_all;
use muster_api::kind::node::Node;
use muster_api::name::NodeName;
use muster_api::pose::Pose;

use super::RETRY;
use crate::context::Context;
use crate::objects;
use crate::session::poses::LivePoses;
use crate::store::Op;

/// Between two rounds.
const PAUSE: Duration = Duration::from_millis(100);
/// Checkpoints in a round: at most 1000 a second, a tenth of what the disk of a small server takes. With more robots than
/// that on the move, each has its turn, and checkpoints come later than after a metre.
const ROUND: usize = 100;

/// Works until dropped.
pub async fn run(context: Arc<Context>, poses: Arc<LivePoses>) {
    let mut changed = poses.subscribe();
    loop {
        let (due, more) = poses.take_due(ROUND);
        let wrote = !due.is_empty();
        let results = join_all(due.into_iter().map(|pose| write(&context, pose))).await;
        let failed: Vec<NodeName> = results.into_iter().flatten().collect();
        for node in &failed {
            poses.not_written(node);
        }
        tokio::time::sleep(if failed.is_empty() { PAUSE } else { RETRY }).await;
        if !more && !wrote && failed.is_empty() && changed.changed().await.is_err() {
            return;
        }
    }
}

/// Gives the node back when the store failed.
async fn write(context: &Context, (node, pose): (NodeName, Pose)) -> Option<NodeName> {
    let key = objects::node_key(node.as_str());
    let written = objects::change(&context.store, &key, |stored, mut object: Node| {
        let status = object.status.get_or_insert_default();
        if status.pose.as_ref() == Some(&pose) {
            return None;
        }
        status.pose = Some(pose.clone());
        Some(vec![Op::status(stored, &object.status)])
    });
    match written.await {
        Ok(_) => None,
        Err(error) => {
            tracing::warn!(%node, error = crate::app::chain(&error), "a pose is not written");
            Some(node)
        }
    }
}
