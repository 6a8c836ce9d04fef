//! Which nodes may have a pose, and their checkpoints: kept like the store.

use std::collections::BTreeSet;
use std::sync::Arc;

use muster_api::kind::node::NodeKind;
use muster_api::name::NodeName;
use muster_api::pose::Pose;
use serde::Deserialize;

use super::LivePoses;
use crate::context::Context;
use crate::objects::{self, NODES};
use crate::reconcile::{next_events, watch_from_now};
use crate::store::{Change, Stored};

/// What of a Node matters here. Nodes change often, and most of a status is not read for this.
#[derive(Debug, Deserialize)]
struct Glance {
    spec: Spec,
    status: Option<Status>,
}

#[derive(Debug, Deserialize)]
struct Spec {
    kind: NodeKind,
}

#[derive(Debug, Deserialize)]
struct Status {
    pose: Option<Pose>,
}

/// Keeps the table like the store, until dropped.
pub async fn run(context: Arc<Context>, poses: Arc<LivePoses>) {
    loop {
        let mut watcher = watch_from_now(&context.store).await;
        let snapshot = context.store.list(NODES, None).items;
        let names: BTreeSet<&str> = snapshot.iter().map(|s| &*s.key.name).collect();
        let known: Vec<NodeName> = poses.table().nodes().cloned().collect();
        for name in known.iter().filter(|n| !names.contains(n.as_str())) {
            // One that joined since the snapshot follows as a change.
            poses.write(|table, _| table.remove_node(name));
        }
        for stored in &snapshot {
            take_in(&poses, Change::Put, stored);
        }
        poses.filled.send_replace(true);
        while let Some(events) = next_events(&mut watcher).await {
            for event in events.iter().filter(|e| e.object.key.resource == NODES) {
                take_in(&poses, event.change, &event.object);
            }
        }
    }
}

fn take_in(poses: &LivePoses, change: Change, stored: &Stored) {
    let Ok(name) = NodeName::new(&*stored.key.name) else { return };
    if change == Change::Delete {
        return poses.write(|table, _| table.remove_node(&name));
    }
    let Some(Glance { spec, status }) = objects::read::<Glance>(stored) else { return };
    let checkpoint = status.and_then(|s| s.pose);
    poses.write(|table, now| table.set_node(&name, spec.kind, checkpoint, now));
}
