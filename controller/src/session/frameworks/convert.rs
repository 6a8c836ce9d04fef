//! What the controller says to frameworks, as messages.

use jiff::Timestamp;
use muster_api::kind::node::NodeKind;
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::validate::Violations;
use muster_api::wire::framework::v1 as wire;
use muster_api::wire::framework_session::{compute_to_wire, pose_to_wire, time_to_wire};
use muster_controller_core::cluster::Cluster;
use muster_controller_core::offer::allocator::actuators_free;
use muster_controller_core::offer::settle::Denied;
use muster_controller_core::offer::{Offer, Rescinded};

/// Most bytes of offers in one event, roughly: clients take 4 MiB (gRPC's default), and a radio link is not held up for long.
const PART: usize = 1 << 20;

/// What goes into events in parts of about [`PART`] bytes, each of one thing at least.
pub(crate) fn parts<T>(
    all: impl IntoIterator<Item = T>,
    size: impl Fn(&T) -> usize,
) -> Vec<Vec<T>> {
    /// Tag and length of an element.
    const AROUND: usize = 8;
    let (mut parts, mut room) = (Vec::<Vec<T>>::new(), 0);
    for one in all {
        let bytes = size(&one) + AROUND;
        match parts.last_mut().filter(|_| bytes <= room) {
            Some(part) => {
                part.push(one);
                room -= bytes;
            }
            None => {
                parts.push(vec![one]);
                room = PART.saturating_sub(bytes);
            }
        }
    }
    parts
}

/// A call without an id wants no answer, unless it is refused: whoever types calls by hand is to see it.
pub(crate) fn is_wanted(answer: &wire::Answer) -> bool {
    !answer.id.is_empty() || answer.refusal.is_some()
}

/// An offer to a framework, with what the node has now, but for what its quota leaves nothing of.
pub(crate) fn offer(
    (framework, offer): (&str, &Offer),
    cluster: &Cluster,
    now: Timestamp,
) -> wire::Offer {
    let member = cluster.at(offer.slot);
    let facts = member.facts.as_ref();
    let names = |functions: Option<Vec<String>>| functions.unwrap_or_default();
    let mut free = member.ledger.open();
    if offer.spent.cpu {
        free.cpu = MilliCpu(0);
    }
    if offer.spent.memory {
        free.memory = Bytes(0);
    }
    wire::Offer {
        id: offer.id.to_string(),
        node: member.name.to_string(),
        kind: match facts.map(|f| f.kind) {
            Some(NodeKind::Robot) => wire::NodeKind::Robot,
            Some(NodeKind::Cloud) => wire::NodeKind::Cloud,
            None => wire::NodeKind::Unspecified,
        }
        .into(),
        labels: facts.map(|f| f.labels.clone().into_iter().collect()).unwrap_or_default(),
        score: offer.score,
        pose: facts.and_then(|f| f.pose.as_ref()).map(pose_to_wire),
        free: Some(compute_to_wire(&free)),
        sensors: names(facts.map(|f| f.sensors.iter().map(ToString::to_string).collect())),
        actuators: names(
            facts
                .filter(|_| actuators_free(member) && !offer.spent.leases)
                .map(|f| f.actuators.iter().map(ToString::to_string).collect()),
        ),
        runtimes: names(
            facts.map(|f| {
                f.runtimes.iter().filter(|r| r.available).map(|r| r.name.clone()).collect()
            }),
        ),
        executors: member
            .executors
            .iter()
            .filter(|executor| *executor.framework == *framework)
            .map(|e| wire::Executor { task: e.uid.to_string(), name: e.name.to_string() })
            .collect(),
        made_at: Some(time_to_wire(now)),
    }
}

/// Why an offer ended.
pub(crate) fn rescinded(why: Rescinded) -> wire::RescindReason {
    match why {
        Rescinded::Changed => wire::RescindReason::Changed,
        Rescinded::Taken => wire::RescindReason::Taken,
        Rescinded::OutOfRange => wire::RescindReason::OutOfRange,
        Rescinded::Filtered => wire::RescindReason::Filtered,
        Rescinded::NodeLost => wire::RescindReason::NodeLost,
        Rescinded::Expired => wire::RescindReason::Expired,
        Rescinded::Suppressed => wire::RescindReason::Suppressed,
        Rescinded::Closer => wire::RescindReason::Closer,
        Rescinded::Quota => wire::RescindReason::Quota,
    }
}

fn refusal(
    reason: wire::RefusalReason,
    message: String,
    causes: Vec<wire::Cause>,
) -> wire::Refusal {
    wire::Refusal { reason: reason.into(), message, causes }
}

/// Why an Accept gets nothing.
pub(crate) fn denied(denied: &Denied) -> wire::Refusal {
    use wire::RefusalReason as Reason;
    let cause = |launch: usize, message: String| {
        vec![wire::Cause { field: format!("launches[{launch}]"), message }]
    };
    match denied {
        Denied::OffersGone { offers } => offers_gone(offers.iter().map(ToString::to_string)),
        Denied::NotNamed { launch } => refusal(
            Reason::Invalid,
            format!("launch {launch} uses an offer that the call does not accept"),
            cause(*launch, "name the offer in accept.offers, too".to_owned()),
        ),
        Denied::Exceeds { launch, node, refusal: why } => {
            let message = format!("{node} {why}");
            refusal(Reason::ExceedsOffer, message.clone(), cause(*launch, message))
        }
        Denied::Refused { launch, node, refusal: why } => {
            let message = format!("{node} {why}");
            refusal(Reason::Conflict, message.clone(), cause(*launch, message))
        }
        Denied::Quota { launch, over } => {
            refusal(Reason::Quota, over.to_string(), cause(*launch, over.to_string()))
        }
    }
}

/// Offers that the framework does not have, by their ids.
pub(crate) fn offers_gone(ids: impl IntoIterator<Item = String>) -> wire::Refusal {
    let list: Vec<String> = ids.into_iter().collect();
    let message = format!("not offered (any more): {}", list.join(", "));
    refusal(wire::RefusalReason::OfferGone, message, Vec::new())
}

/// A call that means nothing.
pub(crate) fn invalid(causes: Vec<wire::Cause>) -> wire::Refusal {
    because(wire::RefusalReason::Invalid, causes)
}

/// A refusal for these causes; its message is theirs.
pub(crate) fn because(reason: wire::RefusalReason, causes: Vec<wire::Cause>) -> wire::Refusal {
    let message =
        causes.iter().map(|c| format!("{}: {}", c.field, c.message)).collect::<Vec<_>>().join("; ");
    refusal(reason, message, causes)
}

/// Violations under a prefix, as causes.
pub(crate) fn causes(prefix: &str, violations: &Violations) -> Vec<wire::Cause> {
    let cause = |v: &muster_api::validate::Violation| wire::Cause {
        field: format!("{prefix}{}", v.path),
        message: match &v.suggestion {
            Some(suggestion) => format!("{}; {suggestion}", v.reason),
            None => v.reason.clone(),
        },
    };
    violations.iter().map(cause).collect()
}

/// Nothing is wrong with the call, and it could not be done.
pub(crate) fn unavailable() -> wire::Refusal {
    not_now("the controller could not write it; try again".to_owned())
}

/// The same, with what stands in the way.
pub(crate) fn not_now(why: String) -> wire::Refusal {
    refusal(wire::RefusalReason::Unavailable, why, Vec::new())
}

/// There is no such thing.
pub(crate) fn not_found(what: String) -> wire::Refusal {
    refusal(wire::RefusalReason::NotFound, what, Vec::new())
}

/// The present state of a task.
pub(crate) fn update(task: &Task, version: u64) -> wire::Update {
    let status = task.status.clone().unwrap_or_default();
    let state = match status.phase {
        TaskPhase::Pending => wire::TaskState::Pending,
        TaskPhase::Bound => wire::TaskState::Bound,
        TaskPhase::Starting => wire::TaskState::Starting,
        TaskPhase::Running => wire::TaskState::Running,
        TaskPhase::Stopping => wire::TaskState::Stopping,
        TaskPhase::Succeeded => wire::TaskState::Succeeded,
        TaskPhase::Failed => wire::TaskState::Failed,
        TaskPhase::Unknown => wire::TaskState::Unknown,
    };
    wire::Update {
        task: task.metadata.uid.clone().unwrap_or_default(),
        name: task.metadata.name.clone().unwrap_or_default(),
        node: status.node.unwrap_or_default(),
        state: state.into(),
        reason: status.reason,
        message: status.message,
        exit_code: status.exit_code,
        attempt: status.attempt,
        version,
        started_at: status.started_at.map(|t| time_to_wire(t.0)),
        finished_at: status.finished_at.map(|t| time_to_wire(t.0)),
    }
}

/// What is said of a task that there is not.
pub(crate) fn gone(uid: &str) -> wire::Update {
    wire::Update {
        task: uid.to_owned(),
        state: wire::TaskState::Gone.into(),
        reason: "Gone".to_owned(),
        message: "the framework has no such task".to_owned(),
        ..wire::Update::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_large_goes_in_parts_and_nothing_is_left_out() {
        let all: Vec<usize> = (0..5_000).map(|i| i % 3_000).collect();
        let split = parts(all.clone(), |bytes| *bytes);
        assert!(split.len() > 1, "7 MB are more than one part");
        assert!(split.iter().all(|part| part.iter().sum::<usize>() <= PART));
        assert_eq!(split.concat(), all);
        // Larger than a part: alone.
        assert_eq!(parts([1, 2 * PART, 1], |bytes| *bytes), [vec![1], vec![2 * PART], vec![1]]);
        assert!(parts(Vec::<usize>::new(), |bytes| *bytes).is_empty());
    }
}
