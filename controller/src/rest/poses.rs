//! Where robots are now: from the live poses, not from objects.
//!
//! ```text
//!   GET …/poses                 every robot whose place is known; ?nodes=a,b and ?map=lab leave the others out
//!   GET …/poses?watch=true      the same as ADDED, a BOOKMARK at its end, then MODIFIED and DELETED, a JSON line each
//!   GET …/nodes/NAME/pose       one robot
//! ```
//!
//! A watch has no queue: it is a cursor over the newest poses, so a reader that is slow sees each robot less often and
//! where it is then. A robot that stands still is not repeated. DELETED: the node is gone, or it left the map.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::stream;
use http::StatusCode;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use muster_api::name::NodeName;
use muster_api::pose::{Covariance, Pose};
use muster_controller_core::node_health::Monotonic;
use muster_controller_core::poses::{Cursor, Known};
use serde::Serialize;
use serde_json::json;
use tokio::sync::watch::Receiver;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::failure::Failure;
use super::path::Object;
use super::{Answer, Call};
use crate::session::poses::LivePoses;

/// Between two rounds of one reader: a robot is shown at most 40 times a second, four times as often as trackers and agents
/// say where it is, and nobody waits longer than this for a pose that is there.
const EVERY: Duration = Duration::from_millis(25);
/// Robots in a piece of an answer, some 64 KiB: what comes after it is read when the reader has taken it.
const PIECE: usize = 512;

/// Which robots are asked for.
#[derive(Debug, Default)]
struct Filter {
    nodes: Option<HashSet<String>>,
    map: Option<String>,
}

impl Filter {
    fn read(call: &Call) -> Self {
        let names = |list: &str| list.split(',').map(|n| n.trim().to_owned()).collect();
        Filter {
            nodes: call.query.text("nodes").map(names),
            map: call.query.text("map").map(str::to_owned),
        }
    }

    fn names(&self, node: &NodeName) -> bool {
        self.nodes.as_ref().is_none_or(|nodes| nodes.contains(node.as_str()))
    }

    fn takes(&self, node: &NodeName, pose: &Pose) -> bool {
        self.names(node) && self.map.as_ref().is_none_or(|map| *map == pose.map)
    }
}

/// A robot's pose as it is sent.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct Item<'a> {
    node: &'a str,
    map: &'a str,
    x: f64,
    y: f64,
    z: f64,
    yaw: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    stamp: Option<&'a MicroTime>,
    source: &'a str,
    localized: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    covariance: Option<Covariance>,
    /// Since it came, milliseconds; none: it is the checkpoint of before the controller began.
    #[serde(skip_serializing_if = "Option::is_none")]
    age_ms: Option<u64>,
}

/// A robot, copied out from under the lock.
struct Seen {
    index: usize,
    name: NodeName,
    pose: Option<Pose>,
    heard: Option<Monotonic>,
}

impl Seen {
    fn new(known: Known<'_>) -> Self {
        let Known { index, name, pose, heard } = known;
        Seen { index, name: name.clone(), pose: pose.cloned(), heard }
    }

    fn item<'a>(&'a self, pose: &'a Pose, poses: &LivePoses) -> Item<'a> {
        Item {
            node: self.name.as_str(),
            map: &pose.map,
            x: pose.x,
            y: pose.y,
            z: pose.z,
            yaw: pose.yaw,
            stamp: pose.stamp.as_ref(),
            source: &pose.source,
            localized: pose.localized,
            covariance: pose.covariance,
            age_ms: self.heard.map(|heard| poses.age_ms(heard)),
        }
    }
}

/// GET …/poses.
pub(super) fn list(call: &Call) -> Answer {
    let (poses, filter) = (&super::question::live(&call.context)?.poses, Filter::read(call));
    let mut seen = Vec::new();
    poses.read(&mut Cursor::default(), |known| {
        if known.pose.is_some_and(|pose| filter.takes(known.name, pose)) {
            seen.push(Seen::new(known));
        }
    });
    seen.sort_by(|a, b| a.name.cmp(&b.name));
    let items: Vec<Item<'_>> =
        seen.iter().filter_map(|s| Some(s.item(s.pose.as_ref()?, poses))).collect();
    let list = json!({ "apiVersion": muster_api::API_VERSION, "kind": "PoseList", "items": items });
    Ok(super::json(StatusCode::OK, &list))
}

/// GET …/nodes/NAME/pose.
pub(super) fn of_node(call: &Call, target: &Object) -> Answer {
    let key = target.key()?;
    let poses = &super::question::live(&call.context)?.poses;
    if call.context.store.get(&key).is_none() {
        return Err(Failure::not_found(target.entry, &key.name));
    }
    let seen = poses.get(&key.name, Seen::new);
    let text =
        seen.as_ref().and_then(|s| serde_json::to_value(s.item(s.pose.as_ref()?, poses)).ok());
    match text {
        Some(item) => Ok(super::json(StatusCode::OK, &item)),
        None => {
            let text = format!("nobody has said where node {} is", key.name);
            Err(Failure::new(StatusCode::NOT_FOUND, "NotFound", text))
        }
    }
}

/// GET …/poses?watch=true.
pub(super) fn watch(call: &Call) -> Answer {
    let poses = Arc::clone(&super::question::live(&call.context)?.poses);
    let following = Following {
        changed: poses.subscribe(),
        poses,
        filter: Filter::read(call),
        cursor: Cursor::default(),
        in_round: true,
        initial: true,
        shown: Vec::new(),
        not_before: Instant::now(),
        end: Instant::now() + call.query.lasts()?,
        stop: call.context.stop.clone(),
    };
    let pieces = stream::unfold(following, |mut following| async move {
        Some((following.next().await?, following))
    });
    Ok(super::raw(StatusCode::OK, call.context.streams.follow(pieces)?))
}

/// A watch in progress.
struct Following {
    poses: Arc<LivePoses>,
    changed: Receiver<u64>,
    filter: Filter,
    cursor: Cursor,
    /// A round has begun and is not at its end.
    in_round: bool,
    /// It is the first round, whose end is announced.
    initial: bool,
    /// Which robots the reader has, by their index.
    shown: Vec<bool>,
    not_before: Instant,
    end: Instant,
    stop: CancellationToken,
}

impl Following {
    /// The next piece that says anything; none: the watch is over.
    async fn next(&mut self) -> Option<Bytes> {
        loop {
            if !self.in_round {
                // Every arm is cancel safe: what changed stays to be seen, and the rest are clocks.
                tokio::select! {
                    () = LivePoses::beyond(&mut self.changed, &self.cursor) => {}
                    () = tokio::time::sleep_until(self.end) => return None,
                    () = self.stop.cancelled() => return None,
                }
                tokio::time::sleep_until(self.not_before).await;
            }
            let piece = self.piece();
            if !piece.is_empty() {
                return Some(piece.into());
            }
        }
    }

    fn piece(&mut self) -> Vec<u8> {
        let mut seen = Vec::new();
        let (filter, shown) = (&self.filter, &self.shown);
        let was_shown = |index: usize| shown.get(index).copied().unwrap_or_default();
        self.in_round = self.poses.read_some(&mut self.cursor, PIECE, |known| {
            if filter.names(known.name) && (known.pose.is_some() || was_shown(known.index)) {
                seen.push(Seen::new(known));
            }
        });
        let mut piece = Vec::with_capacity(seen.len() * 160);
        for seen in &seen {
            self.tell(seen, &mut piece);
        }
        if !self.in_round {
            self.not_before = Instant::now() + EVERY;
            if std::mem::take(&mut self.initial) {
                let end = json!({
                    "kind": "Pose",
                    "apiVersion": muster_api::API_VERSION,
                    "metadata": { "annotations": { "k8s.io/initial-events-end": "true" } },
                });
                line("BOOKMARK", &end, &mut piece);
            }
        }
        piece
    }

    fn tell(&mut self, seen: &Seen, piece: &mut Vec<u8>) {
        if self.shown.len() <= seen.index {
            self.shown.resize(seen.index + 1, false);
        }
        let pose = seen.pose.as_ref().filter(|pose| self.filter.takes(&seen.name, pose));
        let before = std::mem::replace(&mut self.shown[seen.index], pose.is_some());
        match (before, pose) {
            (false, Some(pose)) => line("ADDED", &seen.item(pose, &self.poses), piece),
            (true, Some(pose)) => line("MODIFIED", &seen.item(pose, &self.poses), piece),
            (true, None) => line("DELETED", &json!({ "node": seen.name.as_str() }), piece),
            (false, None) => {}
        }
    }
}

fn line(kind: &str, object: &impl Serialize, piece: &mut Vec<u8>) {
    piece.extend_from_slice(b"{\"type\":\"");
    piece.extend_from_slice(kind.as_bytes());
    piece.extend_from_slice(b"\",\"object\":");
    serde_json::to_writer(&mut *piece, object).expect("texts and finite numbers, into memory");
    piece.extend_from_slice(b"}\n");
}
