//! Which nodes are to have the next template's image before a task there is ended, so that the time down is a stop and a
//! start and not a pull.
//!
//! ```text
//!   old tasks that are next ──ask──▶ status.imagePulls ──▶ their agents ──▶ Node.status.images ──is_there──▶ change
//!                                        └── not there by the progress deadline: fault
//! ```
//!
//! The canaries' nodes are asked first, and those of the next batch while the present one proves itself. What fails ends no
//! task: it is said under the set, tried again by the agent, and the rollout is given up at the progress deadline, which
//! counts from the wish. No more is asked for while the set is paused, nor of a robot on a mission.

use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::node::image::{ImagePhase, ImageStatus, ImageWish};
use muster_api::kind::task::{ContainerRun, PullPolicy};
use muster_api::kind::taskset::{ImagePull, Strategy, TaskTemplate};
use muster_api::phase::TaskPhase;

use super::health::Fault;
use super::places::{Crew, Member};
use super::rollout::Course;
use super::view::NodeView;
use super::{Plan, Snapshot, after};

/// Pulls that one set has under way at most: they come from one registry, over the building's radio.
pub const PULLS_AT_ONCE: usize = 8;

/// How many nodes are named where the set says what it waits for.
const NAMED: usize = 3;

fn container<'a>(snapshot: &Snapshot<'a>, plan: &Plan, revision: &str) -> Option<&'a ContainerRun> {
    let kept = || snapshot.revisions.iter().find(|r| r.name == revision).map(|r| &r.template);
    let template: &TaskTemplate = match revision == plan.status.update_revision {
        true => &snapshot.spec.template,
        false => kept()?,
    };
    template.spec.run.container.as_ref()
}

/// What the node of a task must have before it is changed; none: nothing, or nothing that it has not.
fn needed<'a>(
    snapshot: &Snapshot<'a>,
    course: &Course,
    plan: &Plan,
    member: &Member<'_>,
) -> Option<&'a ContainerRun> {
    let next = container(snapshot, plan, &course.target)?;
    let task = member.task;
    // On the way back, what does not serve is not kept waiting.
    if !task.is_placed() || !(course.forward || member.is_available()) {
        return None;
    }
    let has = container(snapshot, plan, &task.revision);
    let same = has.is_some_and(|has| has.image == next.image);
    Some(next).filter(|_| !same || next.pull_policy == PullPolicy::Always)
}

fn status<'a>(node: &'a NodeView, wish: &ImageWish) -> Option<&'a ImageStatus> {
    node.images.iter().find(|image| image.wish == *wish)
}

/// Whether a task's node has what the next one there needs.
pub(super) fn is_there(
    snapshot: &Snapshot<'_>,
    crew: &Crew<'_>,
    course: &Course,
    plan: &Plan,
    member: &Member<'_>,
) -> bool {
    if needed(snapshot, course, plan, member).is_none() {
        return true;
    }
    let mut asked = plan.status.image_pulls.iter();
    let asked = asked.find(|pull| Some(pull.node.as_str()) == member.task.place());
    let found = asked.and_then(|pull| status(crew.node(member.task)?, &pull.wish));
    found.is_some_and(|image| image.phase == ImagePhase::Pulled)
}

/// Says which nodes are to have the image now. What was asked for and is still needed stays asked for.
pub(super) fn ask(
    snapshot: &Snapshot<'_>,
    crew: &Crew<'_>,
    course: &Course,
    now: Timestamp,
    plan: &mut Plan,
) {
    let before = std::mem::take(&mut plan.status.image_pulls);
    let rollout = &snapshot.spec.rollout;
    if rollout.paused || rollout.strategy == Strategy::OnDelete {
        return;
    }
    let known = |node: &str, wish: (&str, PullPolicy)| {
        let is_it = |p: &&ImagePull| (&*p.wish.image, p.wish.pull_policy) == wish;
        before.iter().filter(is_it).find(|p| p.node == node && p.revision == course.target)
    };
    let mut next: Vec<(bool, ImagePull, &Member<'_>)> = Vec::new();
    for member in crew.live.iter().filter(|m| m.task.revision != course.target) {
        let task = member.task;
        let away = task.phase == TaskPhase::Unknown || plan.ends(task) || crew.held(task).is_some();
        let (Some(node), false) = (task.place(), away) else { continue };
        let Some(container) = needed(snapshot, course, plan, member) else { continue };
        let (image, pull_policy) = (&container.image, container.pull_policy);
        let asked = known(node, (image, pull_policy)).cloned();
        let new = || ImagePull {
            node: node.to_owned(),
            revision: course.target.clone(),
            wish: ImageWish::new(image, pull_policy, now),
        };
        next.push((asked.is_none(), asked.unwrap_or_else(new), member));
    }
    // As they are changed, and nobody is forgotten for another.
    next.sort_by_key(|(new, _, member)| (member.is_available(), *new, &member.task.name));
    let most = rollout.max_unavailable.of(crew.wanted()).max(1);
    let window = match course.allowed {
        // Canaries that are still to begin.
        allowed if !course.passed && allowed > 0 => allowed,
        _ => most,
    };
    let stuck = course.forward && course.fault.is_some();
    let (mut serving, mut under_way) = (0, 0);
    for (new, pull, member) in next {
        // What does not serve is changed whatever the others wait for, and may be what they wait for.
        serving += usize::from(member.is_available());
        if serving > window {
            break;
        }
        let had = crew.node(member.task).and_then(|node| status(node, &pull.wish));
        let open = had.is_none_or(|image| image.phase != ImagePhase::Pulled);
        if new && (stuck || under_way >= PULLS_AT_ONCE) {
            continue;
        }
        under_way += usize::from(open);
        plan.status.image_pulls.push(pull);
    }
}

/// The first wish that a node did not meet in time, as the fault of the task that waits for it there.
pub(super) fn fault(
    snapshot: &Snapshot<'_>,
    crew: &Crew<'_>,
    target: &str,
    now: Timestamp,
    plan: &mut Plan,
) -> Option<(String, Fault)> {
    let deadline: u64 = snapshot.spec.rollout.progress_deadline_seconds.into();
    let mut first = None;
    let mut look_again = None;
    for pull in plan.status.image_pulls.iter().filter(|pull| pull.revision == target) {
        let here = |m: &&Member<'_>| m.task.place() == Some(pull.node.as_str());
        let Some(member) = crew.live.iter().find(here) else { continue };
        let Some(node) = crew.node(member.task) else { continue };
        let image = status(node, &pull.wish);
        let had = image.is_some_and(|image| image.phase == ImagePhase::Pulled);
        // While a node cannot be reached, nobody knows what it has.
        if had || node.facts.not_ready.is_some() {
            continue;
        }
        let begun =
            node.ready_since.map_or(pull.wish.since.0, |ready| ready.max(pull.wish.since.0));
        let due = after(begun, Duration::from_secs(deadline));
        if due > now {
            look_again = [look_again, Some(due)].into_iter().flatten().min();
        } else if first.is_none() {
            let fault = Fault::ImageNotThere {
                image: pull.wish.image.clone(),
                node: pull.node.clone(),
                deadline,
                message: image.map(|image| image.message.clone()).unwrap_or_default(),
            };
            first = Some((member.task.name.clone(), fault));
        }
    }
    plan.look_at(look_again);
    first
}

/// What is waited for, in a clause; and whether a pull has failed.
pub(super) fn awaited(crew: &Crew<'_>, plan: &Plan) -> Option<(bool, String)> {
    let mut failed = false;
    let mut open: Vec<String> = Vec::new();
    for pull in &plan.status.image_pulls {
        let image = crew.node_named(&pull.node).and_then(|node| status(node, &pull.wish));
        let name = &pull.wish.image;
        match image {
            Some(image) if image.phase == ImagePhase::Pulled => {}
            Some(image) if !image.message.is_empty() => {
                failed = true;
                open.push(format!("{} cannot have {name}: {}", pull.node, image.message));
            }
            _ => open.push(format!("{} pulls {name}", pull.node)),
        }
    }
    let more = open.len().saturating_sub(NAMED);
    open.truncate(NAMED);
    if more > 0 {
        open.push(format!("{more} more"));
    }
    (!open.is_empty()).then(|| (failed, open.join(", ")))
}
