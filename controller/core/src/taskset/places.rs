//! How many tasks or which nodes; what is missing there, and what is too much.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::taskset::{
    DEFAULT_REPLACE_AFTER, Held, Replacing, TaskSetSpec, UnreachablePolicy, digest,
};
use muster_api::name::MAX_NAME_LEN;
use muster_api::phase::TaskPhase;

use super::health::{Health, health, is_stranded};
use super::rollout::Course;
use super::view::{Claim, NodeView, TaskView};
use super::{Action, Ending, NewTask, Place, Plan, Snapshot, after};
use crate::report::Refusal;
use crate::schedule::filter::unsuited;

/// How long a task that ended stays before another takes its place. A program whose every start ends for good would
/// otherwise be started as fast as the disk writes; by then its end has been seen.
pub const REPLACE_ENDED_AFTER: Duration = Duration::from_secs(5);
/// On top of the time after which a task without contact ends itself: its grace, and clocks that go at other speeds.
pub const STOP_MARGIN: Duration = Duration::from_secs(15);

/// What the set wants.
#[derive(Debug)]
enum Wanted<'a> {
    Number(usize),
    /// A task on each of these.
    On(BTreeSet<&'a str>),
}

/// The set's tasks, sorted by what can be done about them.
#[derive(Debug)]
pub struct Crew<'a> {
    wanted: Wanted<'a>,
    /// Those that are, and are not being ended.
    pub(super) live: Vec<Member<'a>>,
    /// Those whose end was wished for.
    ending: Vec<&'a TaskView>,
    /// Those that ended by themselves.
    pub(super) ended: Vec<Member<'a>>,
    nodes: &'a BTreeMap<String, NodeView>,
    silent: &'a BTreeMap<String, Timestamp>,
    pub(super) look_again: Option<Timestamp>,
}

/// A task and what is known of it.
#[derive(Debug, Clone, Copy)]
pub struct Member<'a> {
    pub(super) task: &'a TaskView,
    pub(super) health: Health,
    /// Another may begin beside it.
    lost: bool,
}

impl Member<'_> {
    pub(super) fn is_available(&self) -> bool {
        self.health == Health::Available
    }
}

impl<'a> Crew<'a> {
    pub(super) fn of(snapshot: &Snapshot<'a>, now: Timestamp) -> Self {
        let spec = snapshot.spec;
        let nodes = snapshot.nodes;
        let suits = |(name, node): &(&'a String, &NodeView)| {
            unsuited(name, &node.facts, &spec.template.spec).is_none()
        };
        let wanted = match spec.replicas {
            Some(replicas) => Wanted::Number(usize::try_from(replicas).unwrap_or(usize::MAX)),
            None => Wanted::On(nodes.iter().filter(suits).map(|(name, _)| name.as_str()).collect()),
        };
        let mut crew = Crew {
            wanted,
            live: Vec::new(),
            ending: Vec::new(),
            ended: Vec::new(),
            nodes,
            silent: snapshot.silent,
            look_again: None,
        };
        let min_ready = Duration::from_secs(spec.min_ready_seconds.into());
        for task in snapshot.tasks.iter().filter(|t| t.claim == Claim::Mine) {
            let health = health(task, min_ready, now);
            if let Health::Ready { available_at } = health {
                crew.look_at(available_at);
            }
            let lost = crew.is_lost(spec, task, now);
            let member = Member { task, health, lost };
            if task.ending {
                crew.ending.push(task);
            } else if task.phase.is_terminal() {
                crew.ended.push(member);
            } else {
                crew.live.push(member);
            }
        }
        crew
    }

    fn look_at(&mut self, when: Timestamp) {
        self.look_again = Some(self.look_again.map_or(when, |w| w.min(when)));
    }

    /// Whether another task may begin beside this one, whose node cannot be reached.
    fn is_lost(&mut self, spec: &TaskSetSpec, task: &TaskView, now: Timestamp) -> bool {
        let replace = spec.on_unreachable.policy == UnreachablePolicy::Replace;
        if !replace || task.ending || task.phase != TaskPhase::Unknown {
            return false;
        }
        let Some(since) = self.silent_since(task) else { return false };
        let asked = spec.on_unreachable.after.unwrap_or(DEFAULT_REPLACE_AFTER).as_duration();
        let surely = task.stop_after.map(|stop| stop.saturating_add(STOP_MARGIN));
        let due = after(since, asked.max(surely.unwrap_or_default()));
        if due > now {
            self.look_at(due);
        }
        due <= now
    }

    /// When a task's node was heard last; none: it is heard.
    pub(super) fn silent_since(&self, task: &TaskView) -> Option<Timestamp> {
        let place = task.place().or(task.prefer.as_deref())?;
        let since = self.node_named(place)?.silent_since?;
        Some(self.silent.get(place).copied().unwrap_or(since))
    }

    /// The node that a task is on, waits for, or had.
    pub(super) fn node(&self, task: &TaskView) -> Option<&'a NodeView> {
        self.node_named(task.place().or(task.prefer.as_deref())?)
    }

    /// A node by its name.
    pub(super) fn node_named(&self, name: &str) -> Option<&'a NodeView> {
        self.nodes.get(name)
    }

    /// What keeps a task where it is.
    pub(super) fn held(&self, task: &TaskView) -> Option<Held> {
        let node = task.node.as_deref()?;
        let lock = self.nodes.get(node)?.lock.as_ref()?;
        Some(Held {
            node: node.to_owned(),
            task: task.name.clone(),
            holder: lock.holder.clone(),
            reason: lock.reason.clone(),
        })
    }

    /// How many tasks there should be.
    pub(super) fn wanted(&self) -> usize {
        match &self.wanted {
            Wanted::Number(n) => *n,
            Wanted::On(nodes) => nodes.len(),
        }
    }

    /// How many of the wanted ones do not serve, when `plan` is carried out.
    pub(super) fn missing(&self, plan: &Plan) -> usize {
        self.wanted().saturating_sub(self.count(plan, Member::is_available))
    }

    /// How many of those are down: not those for which there is no place, which a rollout would wait for without end.
    pub(super) fn down(&self, plan: &Plan) -> usize {
        let waits = |m: &Member<'_>| is_stranded(m.task);
        self.missing(plan).saturating_sub(self.count(plan, waits))
    }

    /// How many of the wanted ones are so, when `plan` is carried out.
    fn count(&self, plan: &Plan, is: impl Fn(&Member<'a>) -> bool) -> usize {
        let wanted = |m: &Member<'_>| match &self.wanted {
            Wanted::Number(_) => true,
            Wanted::On(nodes) => m.task.place().is_some_and(|p| nodes.contains(p)),
        };
        self.live.iter().filter(|m| is(m) && !plan.ends(m.task) && wanted(m)).count()
    }

    /// Every name of a task that is there.
    fn has(&self, name: &str) -> bool {
        let members = self.live.iter().chain(&self.ended).map(|m| m.task);
        members.chain(self.ending.iter().copied()).any(|t| t.name == name)
    }

    fn is_ending(&self, name: &str) -> bool {
        self.ending.iter().any(|t| t.name == name)
    }
}

/// Takes tasks away that ended by themselves.
pub(super) fn clean_up(crew: &Crew<'_>, now: Timestamp, plan: &mut Plan) {
    for member in &crew.ended {
        let task = member.task;
        // By the controller's clock it cannot have ended later than now.
        let ended = task.finished.unwrap_or(task.created).min(now);
        let due = after(ended, REPLACE_ENDED_AFTER);
        if due > now {
            plan.look_at(Some(due));
        } else if !plan.is_full() {
            plan.actions.push(Action::Delete { task: task.name.clone(), why: Ending::Over });
        }
    }
}

/// Ends what is too much.
pub(super) fn shrink(snapshot: &Snapshot<'_>, crew: &Crew<'_>, course: &Course, plan: &mut Plan) {
    plan.status.held.clear();
    let mut end = |member: &Member<'_>, why: Ending| -> bool {
        if let Some(held) = crew.held(member.task) {
            plan.status.held.push(held);
            return false;
        }
        if !plan.is_full() {
            plan.actions.push(Action::Delete { task: member.task.name.clone(), why });
        }
        true
    };
    match &crew.wanted {
        Wanted::Number(n) => {
            let mut members: Vec<&Member<'_>> = crew.live.iter().filter(|m| !m.lost).collect();
            let mut surplus = members.len().saturating_sub(*n);
            members.sort_by(|a, b| dispensable(a, course).total_cmp(&dispensable(b, course)));
            for member in members {
                if surplus == 0 {
                    break;
                }
                surplus -= usize::from(end(member, Ending::TooMany));
            }
        }
        Wanted::On(nodes) => {
            let mut kept: BTreeSet<&str> = BTreeSet::new();
            let mut members: Vec<&Member<'_>> = crew.live.iter().collect();
            // The best comes first and is kept.
            members.sort_by(|a, b| dispensable(b, course).total_cmp(&dispensable(a, course)));
            for member in members {
                match member.task.place() {
                    Some(place) if nodes.contains(place) => {
                        if !kept.insert(place) {
                            end(member, Ending::TooMany);
                        }
                    }
                    place => match why_not(snapshot, place) {
                        // As its effect says: nothing new goes there.
                        Ending::Unsuited(Refusal::Tainted { .. }) => {}
                        why => drop(end(member, why)),
                    },
                }
            }
        }
    }
}

fn why_not(snapshot: &Snapshot<'_>, place: Option<&str>) -> Ending {
    let refusal = |(name, node): (&str, &NodeView)| -> Option<Refusal> {
        unsuited(name, &node.facts, &snapshot.spec.template.spec)
    };
    let node = place.and_then(|p| Some((p, snapshot.nodes.get(p)?)));
    node.and_then(refusal).map_or(Ending::NodeGone, Ending::Unsuited)
}

/// What is ended first when there are too many: what does not run, then what does not serve, then what is of an old
/// template, then what is far away, then what is young.
#[derive(Debug)]
struct Dispensable<'a> {
    serves: u8,
    is_new: bool,
    near: f64,
    created: std::cmp::Reverse<Timestamp>,
    name: std::cmp::Reverse<&'a str>,
}

impl Dispensable<'_> {
    fn total_cmp(&self, other: &Self) -> std::cmp::Ordering {
        let rest = |d: &Self| (d.serves, d.is_new);
        rest(self)
            .cmp(&rest(other))
            .then(self.near.total_cmp(&other.near))
            .then(self.created.cmp(&other.created))
            .then(self.name.cmp(&other.name))
    }
}

fn dispensable<'a>(member: &Member<'a>, course: &Course) -> Dispensable<'a> {
    let task = member.task;
    let serves = match (task.phase, member.health) {
        (TaskPhase::Pending, _) => 0,
        (TaskPhase::Unknown, _) => 1,
        (_, Health::NotReady) => 2,
        (_, Health::Ready { .. }) => 3,
        (_, Health::Available) => 4,
    };
    Dispensable {
        serves,
        is_new: task.revision == course.target,
        near: -task.score.unwrap_or(0.0),
        created: std::cmp::Reverse(task.created),
        name: std::cmp::Reverse(&task.name),
    }
}

/// Begins what is missing, places that a rollout emptied first.
pub(super) fn fill(snapshot: &Snapshot<'_>, crew: &Crew<'_>, course: &Course, plan: &mut Plan) {
    // An entry is over when its place has a task again that nobody is ending.
    plan.status.replacing.retain(|r| crew.is_ending(&r.task) || !crew.has(&r.task));
    let empty: Vec<Replacing> =
        plan.status.replacing.iter().filter(|r| !crew.has(&r.task)).cloned().collect();
    let new = match &crew.wanted {
        Wanted::Number(n) => {
            let there = crew.live.iter().filter(|m| !m.lost).count();
            let there = there + crew.ending.len() + crew.ended.len();
            somewhere(snapshot, crew, n.saturating_sub(there), &empty)
        }
        Wanted::On(nodes) => on_each(snapshot, crew, nodes, &empty),
    };
    let room = super::AT_ONCE.saturating_sub(plan.actions.len());
    let all = new.len() <= room;
    for (name, place, before) in new.into_iter().take(room) {
        let revision = match before {
            Some(before) if before.revision == course.target => course.target.clone(),
            _ => course.base.clone(),
        };
        plan.status.replacing.retain(|r| before.is_none_or(|b| *r != *b));
        let follows = before.is_some();
        plan.actions.push(Action::Create(NewTask { name, revision, place, follows }));
    }
    if all {
        // What is still empty is not wanted any more.
        plan.status.replacing.retain(|r| crew.is_ending(&r.task));
    }
}

type New<'e> = (String, Place, Option<&'e Replacing>);

fn somewhere<'e>(
    snapshot: &Snapshot<'_>,
    crew: &Crew<'_>,
    missing: usize,
    empty: &'e [Replacing],
) -> Vec<New<'e>> {
    let free = |name: &String| !crew.has(name) && !snapshot.taken.contains(name);
    let again = empty.iter().filter(|r| free(&r.task));
    let again = again.map(|r| (r.task.clone(), Place::Prefer(r.node.clone()), Some(r)));
    let ordinals = (0..).map(|i: u64| format!("{}-{i}", snapshot.name));
    let others = ordinals.filter(|name| free(name) && empty.iter().all(|r| r.task != *name));
    let others = others.map(|name| (name, Place::Anywhere, None));
    again.chain(others).take(missing).collect()
}

fn on_each<'e>(
    snapshot: &Snapshot<'_>,
    crew: &Crew<'_>,
    nodes: &BTreeSet<&str>,
    empty: &'e [Replacing],
) -> Vec<New<'e>> {
    let members = crew.live.iter().chain(&crew.ended).map(|m| m.task);
    let there: BTreeSet<&str> =
        members.chain(crew.ending.iter().copied()).filter_map(TaskView::place).collect();
    let missing = nodes.iter().filter(|node| !there.contains(**node));
    let new = |node: &&str| {
        let before = empty.iter().find(|r| r.node == **node);
        let name = names_on(snapshot.name, node)
            .find(|name| !crew.has(name) && !snapshot.taken.contains(name))
            .expect("there are fewer tasks than names");
        (name, Place::Only((*node).to_owned()), before)
    };
    missing.map(new).collect()
}

/// Names for the task of a set on a node: both names where they fit, then with letters that stand for the node.
fn names_on(set: &str, node: &str) -> impl Iterator<Item = String> {
    let plain = Some(format!("{set}-{node}")).filter(|name| name.len() <= MAX_NAME_LEN);
    plain.into_iter().chain((0..).map(move |salt| {
        let letters = digest(node.as_bytes(), salt);
        format!("{set}-{letters}")
    }))
}
