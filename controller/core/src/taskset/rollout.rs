//! How a changed template reaches the tasks: canaries first, then the others as `maxUnavailable` allows; back to the last
//! good revision when a changed task fails; done when every task that can be is changed and available.

use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::taskset::{Replacing, RolledBack, Strategy};
use muster_api::phase::TaskPhase;

use super::health::{Fault, due, fault, is_excused, is_stranded};
use super::places::{Crew, Member};
use super::revision::History;
use super::{Action, Ending, News, Plan, Snapshot, after, images};

/// Where the set is going.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Course {
    /// The revision that every task should be of.
    pub target: String,
    /// The revision of tasks that begin in places no rollout emptied: the good one until the canaries are available.
    pub base: String,
    /// A new template is being tried; it can be given up.
    pub forward: bool,
    /// The canaries are available, or none are asked for.
    pub passed: bool,
    /// Canaries that must be available first.
    pub canaries: usize,
    /// Tasks that may be changed now, beside what `maxUnavailable` says.
    pub allowed: usize,
    /// The first task of the target that failed, and how.
    pub fault: Option<(String, Fault)>,
}

/// Says where to go, and gives a rollout up that failed.
pub(super) fn decide(
    snapshot: &Snapshot<'_>,
    crew: &Crew<'_>,
    history: &History,
    now: Timestamp,
    plan: &mut Plan,
) -> Course {
    let rollout = &snapshot.spec.rollout;
    let given_up = plan.status.rolled_back_from.is_some();
    let target = match &history.good {
        Some(good) if given_up => good,
        _ => &history.update,
    };
    let is_new = history.good.as_ref().is_some_and(|good| good != target);
    let forward = is_new && rollout.strategy == Strategy::Rolling;
    // Where a fault means the way back, one that is over counts as well.
    let strict = forward && rollout.auto_rollback && !rollout.paused;
    let fault = first_fault(snapshot, crew, (target, strict), now, plan);
    let fault = fault.or_else(|| images::fault(snapshot, crew, target, now, plan));
    match (&fault, &history.good) {
        (Some((task, fault)), Some(good)) if strict => {
            give_up(target, good, (task, fault), now, plan);
            course(snapshot, crew, good, None, plan)
        }
        _ => {
            let good = history.good.as_ref().filter(|_| forward);
            let mut course = course(snapshot, crew, target, good, plan);
            course.fault = fault;
            if course.forward && course.fault.is_some() {
                course.allowed = 0;
            }
            course
        }
    }
}

fn first_fault(
    snapshot: &Snapshot<'_>,
    crew: &Crew<'_>,
    (target, strict): (&str, bool),
    now: Timestamp,
    plan: &mut Plan,
) -> Option<(String, Fault)> {
    let deadline = Duration::from_secs(snapshot.spec.rollout.progress_deadline_seconds.into());
    let mut first = None;
    for member in crew.live.iter().chain(&crew.ended) {
        let task = member.task;
        if task.revision != target || (member.is_available() && !strict) {
            continue;
        }
        let node = crew.node(task);
        if let Some(fault) = fault(task, node, deadline, now) {
            first.get_or_insert_with(|| (task.name.clone(), fault));
        }
        let due = due(task, node, deadline);
        if due > now && (task.phase != TaskPhase::Running || task.ready == Some(false)) {
            plan.look_at(Some(due));
        }
    }
    first
}

fn give_up(from: &str, to: &str, (task, fault): (&str, &Fault), now: Timestamp, plan: &mut Plan) {
    plan.status.rolled_back_from = Some(RolledBack {
        revision: from.to_owned(),
        to: to.to_owned(),
        reason: fault.reason().to_owned(),
        message: format!("task {task} {fault}"),
        at: RolledBack::stamp(now),
    });
    plan.news.push(News::RolledBack {
        from: from.to_owned(),
        to: to.to_owned(),
        task: task.to_owned(),
        fault: fault.clone(),
    });
}

/// The course to `target`; `good`: a way back, while it is being tried.
fn course(
    snapshot: &Snapshot<'_>,
    crew: &Crew<'_>,
    target: &str,
    good: Option<&String>,
    plan: &Plan,
) -> Course {
    let is_new = |m: &&Member<'_>| m.task.revision == target;
    let new = || crew.live.iter().filter(is_new);
    let old = || crew.live.iter().filter(|m| !is_new(m));
    let placed = |m: &&Member<'_>| m.task.is_placed();
    // Who may be a canary: a task that runs where it can be changed. One without a place would prove nothing.
    let free = old().filter(placed).filter(|m| crew.held(m.task).is_none()).count();
    let asked = usize::try_from(snapshot.spec.rollout.canary).unwrap_or(usize::MAX);
    let canaries = if good.is_some() { asked.min(free + new().filter(placed).count()) } else { 0 };
    let available = new().filter(|m| m.is_available()).count();
    let passed = match canaries {
        _ if good.is_none() || asked == 0 => true,
        // All that could be canaries are held or out of reach.
        0 => !old().any(|m| m.task.phase.holds_node()),
        n => available >= n,
    };
    // One that nobody sees, or that has no place and gets none now, proves nothing: another is tried.
    let tried = |m: &&Member<'_>| m.task.phase != TaskPhase::Unknown && !is_stranded(m.task);
    let begun = new().filter(tried).count()
        + plan.status.replacing.iter().filter(|r| r.revision == target).count();
    Course {
        target: target.to_owned(),
        base: good.filter(|_| !passed).map_or(target, String::as_str).to_owned(),
        forward: good.is_some(),
        passed,
        canaries,
        allowed: if passed { usize::MAX } else { canaries.saturating_sub(begun) },
        fault: None,
    }
}

/// Ends tasks of other revisions, as many as may be down.
pub(super) fn change(snapshot: &Snapshot<'_>, crew: &Crew<'_>, course: &Course, plan: &mut Plan) {
    let rollout = &snapshot.spec.rollout;
    if rollout.strategy == Strategy::OnDelete {
        return;
    }
    let most = rollout.max_unavailable.of(crew.wanted()).max(1);
    let (mut down, mut allowed) = (crew.down(plan), course.allowed);
    let mut old: Vec<&Member<'_>> =
        crew.live.iter().filter(|m| m.task.revision != course.target).collect();
    // What does not serve costs nothing to change.
    old.sort_by_key(|m| (m.is_available(), &m.task.name));
    for member in old {
        let task = member.task;
        if plan.ends(task) || task.phase == TaskPhase::Unknown {
            continue;
        }
        if let Some(held) = crew.held(task) {
            if !plan.status.held.contains(&held) {
                plan.status.held.push(held);
            }
            continue;
        }
        if rollout.paused || plan.is_full() || allowed == 0 {
            continue;
        }
        if !images::is_there(snapshot, crew, course, plan, member) {
            continue;
        }
        if task.is_placed() {
            if member.is_available() {
                if down >= most {
                    continue;
                }
                down += 1;
            }
            allowed -= 1;
        } else if !course.passed {
            continue;
        }
        let revision = course.target.clone();
        if let Some(node) = task.place().or(task.prefer.as_deref()) {
            plan.status.replacing.push(Replacing {
                task: task.name.clone(),
                node: node.to_owned(),
                revision: revision.clone(),
            });
        }
        let why = Ending::Outdated { revision };
        plan.actions.push(Action::Delete { task: task.name.clone(), why });
    }
}

/// Makes the target the good revision when it has proved itself.
pub(super) fn conclude(
    snapshot: &Snapshot<'_>,
    crew: &Crew<'_>,
    course: &Course,
    now: Timestamp,
    plan: &mut Plan,
) {
    if plan.status.current_revision == course.target
        || !is_settled(snapshot, crew, course, now, plan)
    {
        return;
    }
    plan.status.current_revision.clone_from(&course.target);
    plan.news.push(News::RolledOut { revision: course.target.clone() });
}

/// Every task is of the target and available, but for those that cannot be now: under a mission lock, without a place,
/// or on a node that has been out of reach for longer than a task gets to become available.
fn is_settled(
    snapshot: &Snapshot<'_>,
    crew: &Crew<'_>,
    course: &Course,
    now: Timestamp,
    plan: &mut Plan,
) -> bool {
    let busy = plan.actions.iter().any(|a| match a {
        Action::Create(_) => true,
        Action::Delete { why, .. } => matches!(why, Ending::Outdated { .. } | Ending::Over),
        _ => false,
    });
    let failed = course.forward && course.fault.is_some();
    if busy || failed || !plan.status.replacing.is_empty() || !crew.ended.is_empty() {
        return false;
    }
    let deadline = Duration::from_secs(snapshot.spec.rollout.progress_deadline_seconds.into());
    let mut available = 0;
    for member in &crew.live {
        let task = member.task;
        let is_new = task.revision == course.target;
        let is_done = match task.phase {
            TaskPhase::Unknown => {
                let since = crew.silent_since(task).unwrap_or(now);
                plan.look_at(Some(after(since, deadline)).filter(|due| *due > now));
                after(since, deadline) <= now
            }
            _ if is_new => member.is_available() || is_excused(task),
            _ => crew.held(task).is_some(),
        };
        if !is_done {
            return false;
        }
        available += usize::from(is_new && member.is_available());
    }
    // Where nothing runs, nothing is proved.
    available >= course.canaries.max(1)
}
