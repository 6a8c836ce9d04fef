//! The numbers and conditions that people see.

use muster_api::condition::{AVAILABLE, ConditionStatus, PROGRESSING};
use muster_api::kind::taskset::{Held, TaskSetStatus};

use super::health::Health;
use super::images;
use super::places::{Crew, Member};
use super::rollout::Course;
use super::{Plan, Snapshot};

/// What is said of one condition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Said {
    /// Which.
    pub condition: &'static str,
    /// Whether it holds.
    pub status: ConditionStatus,
    /// Why, one word.
    pub reason: &'static str,
    /// Why, in a sentence.
    pub message: String,
}

/// What is said of all conditions; nothing while it is settled who belongs to the set.
pub type Conditions = Vec<Said>;

/// Writes the numbers as they are before the plan's own actions, and what can be said about them.
pub(super) fn write(snapshot: &Snapshot<'_>, crew: &Crew<'_>, course: &Course, plan: &mut Plan) {
    let stays: Vec<&Member<'_>> = crew.live.iter().filter(|m| !plan.ends(m.task)).collect();
    let count =
        |holds: &dyn Fn(&Member<'_>) -> bool| number(stays.iter().filter(|m| holds(m)).count());
    let available = count(&|m| m.is_available());
    let (replicas, ready) = (count(&|_| true), count(&|m| m.health != Health::NotReady));
    let updated = count(&|m| m.task.revision == plan.status.update_revision);
    let arrived = count(&|m| m.task.revision == course.target);
    let down = number(crew.missing(plan));
    let status = &mut plan.status;
    status.observed_generation = snapshot.generation;
    status.selector = snapshot.spec.selects(snapshot.name).to_string();
    status.desired_replicas = number(crew.wanted());
    (status.replicas, status.ready_replicas, status.available_replicas) =
        (replicas, ready, available);
    (status.updated_replicas, status.unavailable_replicas) = (updated, down);
    let most = snapshot.spec.rollout.max_unavailable.of(crew.wanted());
    plan.conditions = vec![
        enough(status.desired_replicas, available, down > number(most)),
        progress(snapshot, course, plan, (arrived, images::awaited(crew, plan))),
    ];
}

fn number(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}

fn enough(desired: u32, available: u32, too_few: bool) -> Said {
    let (status, reason) = match too_few {
        true => (ConditionStatus::False, "TooFewAvailable"),
        false => (ConditionStatus::True, "EnoughAvailable"),
    };
    let message = format!("{available} of {desired} are available");
    Said { condition: AVAILABLE, status, reason, message }
}

/// `arrived`: tasks of the revision that all should be of; `awaited`: see [`images::awaited`].
fn progress(
    snapshot: &Snapshot<'_>,
    course: &Course,
    plan: &Plan,
    (arrived, awaited): (u32, Option<(bool, String)>),
) -> Said {
    let say =
        |status, reason, message: String| Said { condition: PROGRESSING, status, reason, message };
    let (failed, awaited) =
        awaited.map_or((false, String::new()), |(failed, text)| (failed, format!("; {text}")));
    let reason = |usual| if failed { "ImagePullBackOff" } else { usual };
    let status = &plan.status;
    let desired = status.desired_replicas;
    let behind = arrived < desired || status.replicas > arrived;
    let still = status.available_replicas < desired;
    let paused = snapshot.spec.rollout.paused;
    if let Some(back) = &status.rolled_back_from {
        let so_far = if behind {
            format!(", {arrived} of {desired} are back{awaited}")
        } else {
            String::new()
        };
        let message =
            format!("{} was given up for {}: {}{so_far}", back.revision, back.to, back.message);
        return say(ConditionStatus::False, "RolledBack", message);
    }
    if let Some((task, fault)) = course.fault.as_ref().filter(|_| course.forward || still) {
        return say(ConditionStatus::False, fault.reason(), format!("task {task} {fault}"));
    }
    if paused && behind {
        let message = format!("{arrived} of {desired} are of {}", course.target);
        return say(ConditionStatus::Unknown, "Paused", message);
    }
    let held = held(status);
    let waits = !plan.actions.is_empty() || !status.replacing.is_empty();
    match (course.passed, behind, held.is_empty()) {
        (true, true, false) if !waits => {
            say(ConditionStatus::True, "MissionLock", format!("under a mission lock: {held}"))
        }
        (false, ..) => {
            let mut message = format!("{} is tried on {} first", course.target, course.canaries);
            if !held.is_empty() {
                message.push_str(&format!("; under a mission lock: {held}"));
            }
            message.push_str(&awaited);
            say(ConditionStatus::True, reason("Canary"), message)
        }
        (true, true, _) => {
            let mut message = format!("{arrived} of {desired} are of {}", course.target);
            let most = snapshot.spec.rollout.max_unavailable;
            if !waits && status.unavailable_replicas > 0 {
                let down = status.unavailable_replicas;
                message.push_str(&format!("; {down} are down, at most {most} may be"));
            }
            message.push_str(&awaited);
            say(ConditionStatus::True, reason("Updating"), message)
        }
        (true, false, _) if still => {
            let message = format!("{} of {desired} are available", status.available_replicas);
            say(ConditionStatus::True, "Starting", message)
        }
        (true, false, _) => {
            say(ConditionStatus::True, "Complete", format!("all are of {}", course.target))
        }
    }
}

/// Who keeps which node as it is.
fn held(status: &TaskSetStatus) -> String {
    let text = |held: &Held| match held.reason.as_str() {
        "" => format!("{} by {}", held.node, held.holder),
        reason => format!("{} by {} ({reason})", held.node, held.holder),
    };
    status.held.iter().map(text).collect::<Vec<_>>().join(", ")
}
