//! A small world for the reconciler: nodes that run what they are given, a clock that is turned by hand, and the plan's
//! actions carried out. What must hold of every plan is checked whenever one is carried out.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use muster_api::kind::node::image::{ImagePhase, ImageStatus};
use muster_api::kind::node::{MissionLock, Node, NodeKind};
use muster_api::kind::taskset::{TaskSetSpec, TaskSetStatus, TaskTemplate, UnreachablePolicy};
use muster_api::phase::TaskPhase;
use serde_json::{Value, json};

use crate::fixtures::node;
use crate::taskset::health::{Health, health};
use crate::taskset::view::{Claim, NodeView, RevisionView, TaskView};
use crate::taskset::{Action, Ending, NewTask, Place, Plan, Snapshot, plan};

pub(super) const STEP: Duration = Duration::from_secs(2);

/// A template that runs `x`; the bad ones end at once, and are told by their number.
pub(super) fn template(number: u32) -> TaskTemplate {
    let kind = if number >= 2 { "bad" } else { "good" };
    let template = json!({
        "metadata": {"annotations": {"number": number.to_string(), "kind": kind}},
        "spec": {"run": {"process": {"command": ["x"]}}, "restartPolicy": "Always"},
    });
    serde_json::from_value(template).expect("a template")
}

/// It takes nothing now.
fn is_shut(node: &NodeView) -> bool {
    node.facts.unschedulable || node.facts.not_ready.is_some()
}

pub(super) fn is_bad(template: &TaskTemplate) -> bool {
    template.metadata.annotations["kind"] == "bad"
}

pub(super) struct World {
    pub(super) spec: TaskSetSpec,
    pub(super) generation: i64,
    pub(super) status: TaskSetStatus,
    pub(super) revisions: Vec<RevisionView>,
    pub(super) tasks: Vec<TaskView>,
    pub(super) nodes: BTreeMap<String, NodeView>,
    pub(super) taken: BTreeSet<String>,
    /// Templates are of containers, each with an image of its own.
    pub(super) containers: bool,
    /// No image can be pulled.
    pub(super) no_registry: bool,
    pub(super) now: Timestamp,
    /// Of all plans so far.
    pub(super) actions: Vec<Action>,
    pub(super) last: Option<Plan>,
}

impl World {
    pub(super) fn new(mut spec: Value, robots: usize) -> Self {
        spec["template"] = serde_json::to_value(template(0)).expect("JSON");
        if spec["minReadySeconds"].is_null() {
            spec["minReadySeconds"] = 3.into();
        }
        let mut world = World {
            spec: serde_json::from_value(spec).expect("a spec"),
            generation: 1,
            status: TaskSetStatus::default(),
            revisions: Vec::new(),
            tasks: Vec::new(),
            nodes: BTreeMap::new(),
            taken: BTreeSet::new(),
            containers: false,
            no_registry: false,
            now: Timestamp::from_second(1_000_000).expect("in range"),
            actions: Vec::new(),
            last: None,
        };
        for i in 0..robots {
            world.join(&format!("r{i}"));
        }
        world
    }

    pub(super) fn join(&mut self, name: &str) {
        let mut robot: Node = node(NodeKind::Robot, 1000, Some((0.0, 0.0)));
        robot.metadata.name = Some(name.to_owned());
        self.nodes.insert(name.to_owned(), NodeView::of(&robot));
    }

    pub(super) fn lock(&mut self, node: &str, locked: bool) {
        let lock = MissionLock { holder: "ada".to_owned(), reason: "carries a tray".to_owned() };
        self.node(node).lock = locked.then_some(lock);
    }

    pub(super) fn node(&mut self, name: &str) -> &mut NodeView {
        self.nodes.get_mut(name).expect("a node of this world")
    }

    pub(super) fn lose(&mut self, name: &str) {
        let now = self.now;
        let node = self.node(name);
        node.facts.not_ready = Some("silent".to_owned());
        node.silent_since.get_or_insert(now);
        node.ready_since = None;
        for task in self.tasks.iter_mut().filter(|t| t.node.as_deref() == Some(name)) {
            if task.phase.holds_node() {
                task.phase = TaskPhase::Unknown;
            }
        }
    }

    pub(super) fn find(&mut self, name: &str) {
        let now = self.now;
        let node = self.node(name);
        if node.facts.not_ready.take().is_some() {
            node.ready_since = Some(now);
        }
        node.silent_since = None;
        for task in self.tasks.iter_mut().filter(|t| t.node.as_deref() == Some(name)) {
            if task.phase == TaskPhase::Unknown {
                task.phase = TaskPhase::Bound;
            }
        }
    }

    /// From now on, and what is there already.
    pub(super) fn use_containers(&mut self) {
        self.containers = true;
        self.spec.template = self.template(0);
    }

    fn template(&self, number: u32) -> TaskTemplate {
        let mut template = template(number);
        if self.containers {
            let run = json!({"container": {"image": format!("img:{number}")}});
            template.spec.run = serde_json::from_value(run).expect("a run");
        }
        template
    }

    pub(super) fn set_template(&mut self, number: u32) {
        let new = self.template(number);
        if self.spec.template != new {
            self.spec.template = new;
            self.generation += 1;
        }
    }

    pub(super) fn task(&mut self, name: &str) -> &mut TaskView {
        self.tasks.iter_mut().find(|t| t.name == name).expect("a task of this world")
    }

    pub(super) fn is_available(&self, task: &TaskView) -> bool {
        let min_ready = Duration::from_secs(self.spec.min_ready_seconds.into());
        !task.ending && health(task, min_ready, self.now) == Health::Available
    }

    pub(super) fn plan(&self) -> Plan {
        let snapshot = Snapshot {
            name: "set",
            spec: &self.spec,
            generation: self.generation,
            status: &self.status,
            revisions: &self.revisions,
            tasks: &self.tasks,
            nodes: &self.nodes,
            silent: const { &BTreeMap::new() },
            taken: &self.taken,
        };
        plan(&snapshot, self.now)
    }

    /// What every node does with what it has.
    pub(super) fn agents(&mut self) {
        self.tasks.retain(|t| {
            let over = t.phase.is_terminal() || t.phase == TaskPhase::Pending;
            !(t.ending && (over || t.phase == TaskPhase::Stopping))
        });
        let (now, revisions) = (self.now, self.revisions.clone());
        let bad =
            |t: &TaskView| revisions.iter().any(|r| r.name == t.revision && is_bad(&r.template));
        for task in &mut self.tasks {
            match task.phase {
                TaskPhase::Unknown => {}
                phase if task.ending && phase.holds_node() => task.phase = TaskPhase::Stopping,
                TaskPhase::Bound => {
                    task.phase = TaskPhase::Running;
                    task.attempt = task.attempt.max(1);
                    task.started = Some(now);
                }
                TaskPhase::Running if bad(task) => {
                    task.phase = TaskPhase::Starting;
                    task.attempt += 1;
                    task.exited = Some("exited with code 1".to_owned());
                    "BackOff".clone_into(&mut task.reason);
                    "exited with code 1".clone_into(&mut task.message);
                }
                TaskPhase::Starting => {
                    task.phase = TaskPhase::Running;
                    task.started = Some(now);
                    task.reason.clear();
                }
                _ => {}
            }
        }
        self.place();
        self.pull();
    }

    /// What agents do about the images that they are told of: each takes a while.
    fn pull(&mut self) {
        let no_registry = self.no_registry;
        for (name, node) in self.nodes.iter_mut().filter(|(_, n)| n.facts.not_ready.is_none()) {
            let before = std::mem::take(&mut node.images);
            for pull in self.status.image_pulls.iter().filter(|pull| pull.node == *name) {
                let known = before.iter().find(|image| image.wish == pull.wish);
                let (phase, message) = match known.map(|image| image.phase) {
                    None => (ImagePhase::Pulling, ""),
                    Some(ImagePhase::Pulled) => (ImagePhase::Pulled, ""),
                    Some(_) if no_registry => (ImagePhase::BackOff, "no route to the registry"),
                    Some(_) => (ImagePhase::Pulled, ""),
                };
                node.images.push(ImageStatus {
                    wish: pull.wish.clone(),
                    phase,
                    reason: String::new(),
                    message: message.to_owned(),
                    failures: 0,
                });
            }
        }
    }

    /// A node has what a template needs, or it needs nothing.
    fn has_image(&self, task: &TaskView, revision: &str) -> bool {
        let image = |name: &str| {
            let revision = self.revisions.iter().find(|r| r.name == name)?;
            Some(revision.template.spec.run.container.as_ref()?.image.clone())
        };
        let node = task.node.as_ref().map(|node| &self.nodes[node]);
        let pulled = |wanted: &String| {
            let has = |i: &ImageStatus| i.wish.image == *wanted && i.phase == ImagePhase::Pulled;
            node.is_some_and(|node| node.images.iter().any(has))
        };
        image(revision)
            .is_none_or(|wanted| image(&task.revision).as_ref() == Some(&wanted) || pulled(&wanted))
    }

    /// The scheduler: each on a node of its own.
    fn place(&mut self) {
        let mut used: BTreeSet<String> = self
            .tasks
            .iter()
            .filter(|t| t.phase.holds_node())
            .filter_map(|t| t.node.clone())
            .collect();
        for task in self.tasks.iter_mut().filter(|t| t.phase == TaskPhase::Pending && !t.ending) {
            let open = |name: &String, node: &NodeView| !is_shut(node) && !used.contains(name);
            let wanted = |name: &String| task.pin.as_ref().is_none_or(|p| p == name);
            let mut takes: Vec<&String> = self
                .nodes
                .iter()
                .filter(|(name, node)| open(name, node) && wanted(name))
                .map(|(name, _)| name)
                .collect();
            takes.sort_by_key(|name| task.prefer.as_ref() != Some(name));
            let prefers = task.prefer.as_ref().filter(|_| takes.is_empty());
            task.refusal = prefers.map(|node| match is_shut(&self.nodes[node]) {
                true => "NotReady".to_owned(),
                false => "Apart".to_owned(),
            });
            if let Some(node) = takes.first() {
                task.node = Some((*node).clone());
                task.phase = TaskPhase::Bound;
                task.bound = Some(self.now);
                used.insert((*node).clone());
            }
        }
    }

    /// One decision, checked and carried out; how many actions it has.
    pub(super) fn decide(&mut self) -> usize {
        let plan = self.plan();
        self.check(&plan);
        for action in &plan.actions {
            self.carry_out(action);
        }
        self.status = plan.status.clone();
        self.actions.extend(plan.actions.iter().cloned());
        let actions = plan.actions.len();
        self.last = Some(plan);
        actions
    }

    /// Everybody acts once, and time passes.
    pub(super) fn step(&mut self) -> usize {
        let actions = self.decide();
        self.agents();
        self.now =
            self.now.checked_add(SignedDuration::try_from(STEP).expect("short")).expect("in range");
        actions
    }

    pub(super) fn steps(&mut self, n: usize) {
        for _ in 0..n {
            self.step();
        }
    }

    /// Steps until nothing is done for longer than any delay of ours; how many actions that took.
    pub(super) fn settle(&mut self) -> usize {
        let (mut quiet, mut actions) = (0, 0);
        for _ in 0..400 {
            let done = self.step();
            actions += done;
            quiet = if done == 0 { quiet + 1 } else { 0 };
            if quiet == 40 {
                assert_eq!(self.decide(), 0);
                let before = self.status.clone();
                let plan = self.plan();
                assert_eq!(plan.status, before, "an unchanged world is written once");
                assert!(plan.look_again.is_none_or(|t| t > self.now), "it would look without end");
                return actions;
            }
        }
        panic!(
            "it does not settle: {:#?}\n{:#?}",
            &self.actions[self.actions.len() - 12..],
            self.status
        );
    }

    fn wanted(&self) -> usize {
        match self.spec.replicas {
            Some(n) => n as usize,
            None => self.nodes.values().filter(|n| n.facts.kind == NodeKind::Robot).count(),
        }
    }

    /// What holds of every plan.
    fn check(&self, plan: &Plan) {
        let most = self.spec.rollout.max_unavailable.of(self.wanted()).max(1);
        let task = |name: &str| self.tasks.iter().find(|t| t.name == name);
        let mut serving: BTreeSet<&str> = self
            .tasks
            .iter()
            .filter(|t| t.claim == Claim::Mine && self.is_available(t))
            .map(|t| t.name.as_str())
            .collect();
        for action in &plan.actions {
            match action {
                Action::Delete { task: name, why } => {
                    let task = task(name).expect("it ends what is there");
                    let lock = task.node.as_ref().and_then(|n| self.nodes[n].lock.as_ref());
                    assert!(
                        lock.is_none() || *why == Ending::Over,
                        "ended on a mission: {action:?}"
                    );
                    assert!(!task.ending, "ended twice: {action:?}");
                    let served = serving.remove(name.as_str());
                    if let Ending::Outdated { revision } = why {
                        assert_ne!(task.phase, TaskPhase::Unknown, "nobody knows what it does");
                        assert_ne!(*revision, task.revision);
                        assert!(!self.spec.rollout.paused, "changed while paused");
                        let ready = !served || self.has_image(task, revision);
                        assert!(ready, "its node has not what follows: {action:?}");
                        // What has no place was not taken down.
                        let first = |t: &&TaskView| {
                            let taken = matches!(t.refusal.as_deref(), Some("Apart" | "LeaseHeld"));
                            t.phase == TaskPhase::Pending
                                && (t.prefer.is_none() || taken)
                                && !t.ending
                        };
                        let waits = self.tasks.iter().filter(first).count();
                        let down = self.wanted().saturating_sub(serving.len() + waits);
                        assert!(!served || down <= most, "{down} down, {most} allowed: {action:?}");
                    }
                }
                Action::Create(NewTask { name, place, .. }) => {
                    assert!(task(name).is_none(), "two of one name: {action:?}");
                    assert!(!self.taken.contains(name));
                    if let Place::Only(node) = place {
                        let there = self.tasks.iter().find(|t| t.place() == Some(node));
                        assert!(there.is_none(), "two on one node: {action:?}");
                    }
                }
                _ => {}
            }
        }
        let created = plan.actions.iter().filter(|a| matches!(a, Action::Create(_))).count();
        let beside = self.spec.on_unreachable.policy == UnreachablePolicy::Replace;
        let counts = |t: &&TaskView| !(beside && t.phase == TaskPhase::Unknown && !t.ending);
        let there = self.tasks.iter().filter(|t| t.claim == Claim::Mine).filter(counts).count();
        assert!(created == 0 || there + created <= self.wanted(), "more than asked for");
    }

    fn carry_out(&mut self, action: &Action) {
        match action {
            Action::CreateRevision { name, number } => self.revisions.push(RevisionView {
                name: name.clone(),
                number: *number,
                template: self.spec.template.clone(),
                mine: true,
            }),
            Action::Renumber { name, number } => {
                let revision = self.revisions.iter_mut().find(|r| r.name == *name);
                revision.expect("it is there").number = *number;
            }
            Action::AdoptRevision { name } => {
                let revision = self.revisions.iter_mut().find(|r| r.name == *name);
                revision.expect("it is there").mine = true;
            }
            Action::DeleteRevision { name } => {
                assert!(self.tasks.iter().all(|t| t.revision != *name), "it is in use");
                self.revisions.retain(|r| r.name != *name);
            }
            Action::Adopt { task } => self.task(task).claim = Claim::Mine,
            Action::Release { task } => self.tasks.retain(|t| t.name != *task),
            Action::Delete { task, .. } => {
                let found = self.task(task);
                found.ending = true;
                if found.phase.is_terminal() || found.phase == TaskPhase::Pending {
                    self.tasks.retain(|t| t.name != *task);
                }
            }
            Action::Create(new) => {
                let known = self.revisions.iter().any(|r| r.name == new.revision);
                assert!(known, "made of a template that is not kept");
                let task = self.new_task(new);
                self.tasks.push(task);
                self.tasks.sort_by(|a, b| a.name.cmp(&b.name));
            }
        }
    }

    pub(super) fn new_task(&self, new: &NewTask) -> TaskView {
        TaskView {
            name: new.name.clone(),
            claim: Claim::Mine,
            revision: new.revision.clone(),
            phase: TaskPhase::Pending,
            node: None,
            pin: match &new.place {
                Place::Only(node) => Some(node.clone()),
                _ => None,
            },
            prefer: match &new.place {
                Place::Prefer(node) => Some(node.clone()),
                Place::Only(node) => new.follows.then(|| node.clone()),
                Place::Anywhere => None,
            },
            score: None,
            created: self.now,
            bound: None,
            refusal: None,
            started: None,
            finished: None,
            attempt: 0,
            exited: None,
            ready: None,
            ready_since: None,
            ending: false,
            reason: String::new(),
            message: String::new(),
            stop_after: None,
        }
    }

    /// The numbers of the templates that the live tasks are of, by name of task.
    pub(super) fn templates(&self) -> Vec<String> {
        let number = |t: &TaskView| {
            let revision = self.revisions.iter().find(|r| r.name == t.revision);
            revision.map_or_else(
                || "?".to_owned(),
                |r| r.template.metadata.annotations["number"].clone(),
            )
        };
        self.tasks.iter().filter(|t| !t.ending && !t.phase.is_terminal()).map(number).collect()
    }

    pub(super) fn progressing(&self) -> (&'static str, String) {
        let said = &self.last.as_ref().expect("it was decided").conditions[1];
        (said.reason, said.message.clone())
    }
}
