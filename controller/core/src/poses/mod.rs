//! Where every robot is now: the newest pose of each, whoever said it.
//!
//! ```text
//!   agents' sessions, pose streams ──put──▶ Poses ──read(cursor)──▶ the scheduler's cluster, readers of live poses
//!   Node objects ──set_node──▶ (who may be known)  └──take_due──▶ Node.status.pose, coarse
//! ```
//!
//! Nothing is queued: a pose takes the place of the one before, and every reader has a [`Cursor`] that finds what
//! changed since it last looked. So a reader may be slow or fast, and costs the others nothing.

pub mod checkpoint;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::time::Duration;

use muster_api::kind::node::NodeKind;
use muster_api::name::NodeName;
use muster_api::pose::{Pose, PoseRef};

use crate::node_health::Monotonic;
use checkpoint::Due;

/// For how long a robot's newest pose keeps poses of other sources away, and older ones of its own. Trackers send at
/// 1 Hz or faster: one that is silent for two seconds has lost the robot, or is gone, and a clock that was set back
/// may not lock a robot out for longer.
pub const HOLDS_FOR: Duration = Duration::from_secs(2);

/// Who says where a robot is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// Its own agent.
    Agent,
    /// The building's localisation, which goes before: a robot's own odometry drifts, and a declared place is not
    /// measured at all.
    Building,
}

/// Why a pose is not taken.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NotTaken {
    /// No Node object has that name.
    #[error("there is no node of this name")]
    UnknownNode,
    /// A Cloud node is nowhere.
    #[error("is a Cloud node, which has no pose")]
    NotARobot,
    /// Somebody else tells this robot's pose.
    #[error("its poses come from {source_name:?}, which was heard within the last {} s", HOLDS_FOR.as_secs())]
    OtherSource {
        /// Whose.
        source_name: String,
    },
    /// There is a newer one of the same source.
    #[error("is older than the present pose, by {by:?}")]
    Older {
        /// By how much.
        by: Duration,
    },
}

/// One node in the table.
#[derive(Debug, Clone)]
struct Entry {
    name: NodeName,
    /// None: there is no Node object, or it has not been seen yet.
    kind: Option<NodeKind>,
    pose: Option<Pose>,
    /// Who said it, and when it came; none: it is the checkpoint of an earlier life of the controller.
    heard: Option<(Origin, Monotonic)>,
    /// `status.pose` of the Node object, and since when.
    written: Option<Pose>,
    written_at: Monotonic,
}

/// A robot's newest pose, as a reader sees it.
#[derive(Debug, Clone, Copy)]
pub struct Known<'a> {
    /// A number that stays the robot's.
    pub index: usize,
    /// Its name.
    pub name: &'a NodeName,
    /// None: the node is gone.
    pub pose: Option<&'a Pose>,
    /// When the pose came; none: it is a checkpoint that nobody has confirmed since the controller began.
    pub heard: Option<Monotonic>,
}

/// How far a reader has read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Cursor {
    /// It knows everything up to this revision.
    seen: u64,
    /// What it will know at the end of the round.
    upto: u64,
    /// Where the round goes on.
    next: usize,
}

impl Cursor {
    /// The revision up to which everything is read.
    #[must_use]
    pub fn seen(&self) -> u64 {
        self.seen
    }
}

/// The newest pose of every robot.
#[derive(Debug, Clone, Default)]
pub struct Poses {
    by_name: HashMap<NodeName, usize>,
    entries: Vec<Entry>,
    /// When each entry last changed for readers. Apart from the entries: readers scan this.
    revisions: Vec<u64>,
    revision: u64,
    /// Where [`Poses::take_due`] goes on, so that every robot has its turn.
    turn: usize,
}

impl Poses {
    /// Grows with every change that readers see.
    #[must_use]
    pub fn revision(&self) -> u64 {
        self.revision
    }

    fn index(&mut self, name: &NodeName) -> usize {
        if let Some(index) = self.by_name.get(name) {
            return *index;
        }
        let index = self.entries.len();
        self.entries.push(Entry {
            name: name.clone(),
            kind: None,
            pose: None,
            heard: None,
            written: None,
            written_at: Monotonic::ZERO,
        });
        self.revisions.push(0);
        self.by_name.insert(name.clone(), index);
        index
    }

    fn changed(&mut self, index: usize) {
        self.revision += 1;
        self.revisions[index] = self.revision;
    }

    /// A Node object is there, and `checkpoint` is its `status.pose`.
    pub fn set_node(
        &mut self,
        name: &NodeName,
        kind: NodeKind,
        checkpoint: Option<Pose>,
        now: Monotonic,
    ) {
        let index = self.index(name);
        let entry = &mut self.entries[index];
        let is_new = entry.kind.replace(kind).is_none();
        let was_there = entry.pose.is_some();
        if entry.heard.is_none() && entry.pose != checkpoint {
            entry.pose.clone_from(&checkpoint);
            self.changed(index);
        } else if is_new && was_there {
            self.changed(index);
        }
        let entry = &mut self.entries[index];
        if entry.written != checkpoint {
            (entry.written, entry.written_at) = (checkpoint, now);
        }
    }

    /// The Node object is gone.
    pub fn remove_node(&mut self, name: &NodeName) {
        let Some(index) = self.by_name.get(name).copied() else { return };
        let entry = &mut self.entries[index];
        (entry.kind, entry.pose, entry.heard, entry.written) = (None, None, None, None);
        self.changed(index);
    }

    /// The nodes that have an object, as far as the table knows.
    pub fn nodes(&self) -> impl Iterator<Item = &NodeName> {
        self.entries.iter().filter(|e| e.kind.is_some()).map(|e| &e.name)
    }

    /// The building says where a robot is. A robot that stands still changes nothing for readers.
    ///
    /// # Errors
    ///
    /// Why it is not taken; the robot's pose is as before.
    pub fn put(&mut self, node: &str, pose: PoseRef<'_>, now: Monotonic) -> Result<(), NotTaken> {
        let index = self.by_name.get(node).copied().ok_or(NotTaken::UnknownNode)?;
        match self.entries[index].kind {
            None => Err(NotTaken::UnknownNode),
            Some(NodeKind::Cloud) => Err(NotTaken::NotARobot),
            Some(NodeKind::Robot) => self.take(index, pose, (Origin::Building, now)),
        }
    }

    /// A robot's agent says where it is. The node may be so new that the table has not seen its object yet: the caller
    /// knows that it is there.
    ///
    /// # Errors
    ///
    /// As [`Poses::put`].
    pub fn put_own(
        &mut self,
        node: &NodeName,
        pose: PoseRef<'_>,
        now: Monotonic,
    ) -> Result<(), NotTaken> {
        let index = self.index(node);
        match self.entries[index].kind {
            Some(NodeKind::Cloud) => Err(NotTaken::NotARobot),
            _ => self.take(index, pose, (Origin::Agent, now)),
        }
    }

    fn take(
        &mut self,
        index: usize,
        pose: PoseRef<'_>,
        (origin, now): (Origin, Monotonic),
    ) -> Result<(), NotTaken> {
        let entry = &mut self.entries[index];
        if let (Some(heard), Some(present)) = (entry.heard, &entry.pose) {
            judge(heard, present, &pose, (origin, now))?;
        }
        entry.heard = Some((origin, now));
        let stays = entry.pose.as_ref().is_some_and(|old| old.view().is_at(&pose));
        match &mut entry.pose {
            Some(old) => old.set(pose),
            None => entry.pose = Some(pose.into()),
        }
        if !stays {
            self.changed(index);
        }
        Ok(())
    }

    /// The newest pose of one robot.
    #[must_use]
    pub fn get(&self, node: &str) -> Option<Known<'_>> {
        let index = *self.by_name.get(node)?;
        self.entries[index].kind?;
        Some(self.known(index))
    }

    /// The pose that somebody said of this node since the controller began, its object seen or not.
    #[must_use]
    pub fn live(&self, node: &NodeName) -> Option<&Pose> {
        let entry = &self.entries[*self.by_name.get(node)?];
        entry.heard.and(entry.pose.as_ref())
    }

    fn known(&self, index: usize) -> Known<'_> {
        let entry = &self.entries[index];
        let there = entry.kind.is_some();
        Known {
            index,
            name: &entry.name,
            pose: entry.pose.as_ref().filter(|_| there),
            heard: entry.heard.map(|(_, at)| at),
        }
    }

    /// Shows a reader what changed since its cursor, at most `most` robots; true: there is more of this round. A robot
    /// that moved several times is shown once, as it is now.
    pub fn read(&self, cursor: &mut Cursor, most: usize, mut show: impl FnMut(Known<'_>)) -> bool {
        if cursor.next == 0 {
            cursor.upto = self.revision;
        }
        let mut shown = 0;
        for (index, revision) in self.revisions.iter().enumerate().skip(cursor.next) {
            if *revision > cursor.seen {
                if shown == most {
                    cursor.next = index;
                    return true;
                }
                shown += 1;
                show(self.known(index));
            }
        }
        (cursor.seen, cursor.next) = (cursor.upto, 0);
        false
    }

    /// Poses to be written into Node objects now, at most `most`, and whether more may become due without another pose.
    /// They count as written; [`Poses::not_written`] says otherwise.
    #[must_use = "they count as written"]
    pub fn take_due(&mut self, most: usize, now: Monotonic) -> (Vec<(NodeName, Pose)>, bool) {
        let (mut due, mut later) = (Vec::new(), false);
        let count = self.entries.len();
        for step in 0..count {
            let index = (self.turn + step) % count;
            let entry = &mut self.entries[index];
            let (Some(NodeKind::Robot), Some(_), Some(pose)) =
                (entry.kind, entry.heard, &entry.pose)
            else {
                continue;
            };
            let since = now.saturating_sub(entry.written_at);
            match checkpoint::due(entry.written.as_ref(), pose, since) {
                Due::Never => {}
                Due::Later => later = true,
                Due::Now if due.len() == most => {
                    self.turn = index;
                    return (due, true);
                }
                Due::Now => {
                    due.push((entry.name.clone(), pose.clone()));
                    (entry.written, entry.written_at) = (Some(pose.clone()), now);
                }
            }
        }
        (due, later)
    }

    /// A pose of [`Poses::take_due`] could not be written: it is due again.
    pub fn not_written(&mut self, node: &NodeName) {
        if let Some(index) = self.by_name.get(node) {
            self.entries[*index].written = None;
        }
    }
}

/// Whether a pose may take the place of the present one.
fn judge(
    (whose, heard): (Origin, Monotonic),
    present: &Pose,
    new: &PoseRef<'_>,
    (origin, now): (Origin, Monotonic),
) -> Result<(), NotTaken> {
    if now.saturating_sub(heard) >= HOLDS_FOR {
        return Ok(());
    }
    let other = origin != whose || new.source != present.source;
    if whose == Origin::Building && other {
        return Err(NotTaken::OtherSource { source_name: present.source.clone() });
    }
    match (&present.stamp, new.stamp) {
        (Some(old), Some(new)) if !other && new < old.0 => {
            let by = old.0.duration_since(new);
            Err(NotTaken::Older { by: Duration::try_from(by).unwrap_or_default() })
        }
        _ => Ok(()),
    }
}
