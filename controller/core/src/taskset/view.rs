//! What of a Task, a Node and a revision matters to a set.

use std::time::Duration;

use jiff::Timestamp;
use muster_api::condition::{ConditionStatus, READY};
use muster_api::kind::node::image::ImageStatus;
use muster_api::kind::node::{MissionLock, Node};
use muster_api::kind::task::Task;
use muster_api::kind::taskset::{REVISION_LABEL, TaskTemplate};
use muster_api::kind::taskset_revision::TaskSetRevision;
use muster_api::phase::TaskPhase;
use muster_api::selector::LabelSelector;

use crate::cluster::NodeFacts;
use crate::owner::{self, Owner};

/// Whose a task is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Claim {
    /// The set controls it.
    Mine,
    /// The set controls it, but the selector does not select it any more.
    NoLongerMine,
    /// Nobody controls it, and the selector selects it.
    Nobodys,
}

/// A task.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskView {
    /// Name.
    pub name: String,
    /// Whose it is.
    pub claim: Claim,
    /// The revision that it was made of; empty: none of the set's.
    pub revision: String,
    /// Where it is in its life.
    pub phase: TaskPhase,
    /// The node it is placed on.
    pub node: Option<String>,
    /// The one node it may be on.
    pub pin: Option<String>,
    /// It follows a task that ran on this node.
    pub prefer: Option<String>,
    /// Metres or seconds.
    pub score: Option<f64>,
    /// When it was created, by the controller's clock.
    pub created: Timestamp,
    /// When it was placed, by the controller's clock.
    pub bound: Option<Timestamp>,
    /// Why the node that it follows another on does not take it, one word.
    pub refusal: Option<String>,
    /// When its attempt began, by the clock of its node.
    pub started: Option<Timestamp>,
    /// When its last attempt ended, by the clock of its node.
    pub finished: Option<Timestamp>,
    /// Number of the attempt.
    pub attempt: u32,
    /// How an attempt of it has ended by itself; none: none has.
    pub exited: Option<String>,
    /// What its start-up and readiness probes say; none: it has neither.
    pub ready: Option<bool>,
    /// Since when they say that it is ready, by the controller's clock.
    pub ready_since: Option<Timestamp>,
    /// It is being deleted.
    pub ending: bool,
    /// Why it is in its phase.
    pub reason: String,
    /// The same in a sentence.
    pub message: String,
    /// After how long without contact its node ends it.
    pub stop_after: Option<Duration>,
}

impl TaskView {
    /// The view that a set has of a task; none: it is no business of the set's.
    #[must_use]
    pub fn of(task: &Task, set: &Owner<'_>, selector: &LabelSelector) -> Option<Self> {
        let labels = task.metadata.labels.clone().unwrap_or_default();
        let is_nobodys = owner::controller(&task.metadata).is_none();
        let claim = match (set.controls(&task.metadata), selector.matches(&labels)) {
            (true, true) => Claim::Mine,
            (true, false) => Claim::NoLongerMine,
            (false, true) if is_nobodys => Claim::Nobodys,
            _ => return None,
        };
        let status = task.status.clone().unwrap_or_default();
        let placement = &task.spec.placement;
        let refusal = status.why.iter().find(|w| Some(&w.node) == placement.prefer.as_ref());
        let refusal = refusal.map(|w| w.reason.clone());
        Some(TaskView {
            name: task.metadata.name.clone()?,
            claim,
            revision: labels.get(REVISION_LABEL).cloned().unwrap_or_default(),
            phase: status.phase,
            node: status.node,
            pin: placement.node.clone(),
            prefer: placement.prefer.clone(),
            score: status.score,
            created: task.metadata.creation_timestamp.as_ref()?.0,
            bound: status.bound_at.map(|t| t.0),
            refusal,
            started: status.started_at.map(|t| t.0),
            finished: status.finished_at.map(|t| t.0),
            attempt: status.attempt,
            exited: match (status.exit_code, status.signal) {
                (_, Some(signal)) => Some(format!("ended by signal {signal}")),
                (Some(code), None) => Some(format!("exited with code {code}")),
                (None, None) => None,
            },
            ready: status.ready,
            ready_since: status.ready_at.map(|t| t.0),
            ending: task.metadata.deletion_timestamp.is_some(),
            reason: status.reason,
            message: status.message,
            stop_after: task.spec.stop_after_disconnect().map(|s| s.as_duration()),
        })
    }

    /// The node that it is on or is to be on.
    #[must_use]
    pub fn place(&self) -> Option<&str> {
        self.node.as_deref().or(self.pin.as_deref())
    }

    /// It holds a node that can be reached.
    #[must_use]
    pub fn is_placed(&self) -> bool {
        self.phase.holds_node() && self.phase != TaskPhase::Unknown
    }
}

/// A node.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeView {
    /// What it is and has.
    pub facts: NodeFacts,
    /// The mission that it is on.
    pub lock: Option<MissionLock>,
    /// When its agent was heard last; none: it is heard.
    pub silent_since: Option<Timestamp>,
    /// Since when it is ready.
    pub ready_since: Option<Timestamp>,
    /// Images that it was asked to have.
    pub images: Vec<ImageStatus>,
}

impl NodeView {
    /// The view of a node.
    #[must_use]
    pub fn of(node: &Node) -> Self {
        let ready = node.status.as_ref().and_then(|s| s.condition(READY));
        let since = |status: ConditionStatus| {
            let condition = ready.filter(|c| c.status == status);
            condition.and_then(|c| c.last_transition_time.as_ref()).map(|t| t.0)
        };
        let seen = node.status.as_ref().and_then(|s| s.last_seen.as_ref()).map(|seen| seen.0);
        let silent_since = since(ConditionStatus::Unknown).map(|since| seen.unwrap_or(since));
        let mut facts = NodeFacts::of(node);
        // Where it is and how full its battery is move all the time, and no set asks for them.
        (facts.pose, facts.battery) = (None, None);
        facts.passing.clear();
        NodeView {
            facts,
            lock: node.mission_lock(),
            silent_since,
            ready_since: since(ConditionStatus::True),
            images: node.status.as_ref().map(|s| s.images.clone()).unwrap_or_default(),
        }
    }
}

/// A template that the set has or had.
#[derive(Debug, Clone, PartialEq)]
pub struct RevisionView {
    /// Name.
    pub name: String,
    /// Number.
    pub number: u64,
    /// The template.
    pub template: TaskTemplate,
    /// The set controls it; otherwise nobody does.
    pub mine: bool,
}

impl RevisionView {
    /// The view that a set has of a revision; none: it is another's.
    #[must_use]
    pub fn of(revision: &TaskSetRevision, set: &Owner<'_>) -> Option<Self> {
        let mine = set.controls(&revision.metadata);
        if !mine && owner::controller(&revision.metadata).is_some() {
            return None;
        }
        Some(RevisionView {
            name: revision.metadata.name.clone()?,
            number: revision.spec.revision,
            template: revision.spec.template.clone(),
            mine,
        })
    }
}
