//! An application on home and two scales whose tasks start, serve and end as the plans say, and whose nodes come and go.
//!
//! What a task does and what the controller sees of it are two things: a node that is silent does what it was told before.
//! After each step it is checked that nothing is lost, twice, or moved to and fro.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use muster_api::kind::application::{
    Application, ApplicationSpec, ApplicationStatus, CutOff, MoveStage, PartStatus,
};
use muster_api::kind::node::Node;
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use serde_json::{Value, json};

use crate::offload::run::view::{NodeSeen, TaskSeen};
use crate::offload::run::{Action, Ending, NewTask, News, Plan, Snapshot, plan};

/// Of the world's clock.
pub(super) const STEP: SignedDuration = SignedDuration::from_millis(100);
/// From placed to running, and from told to end to gone.
const START: SignedDuration = SignedDuration::from_millis(300);
const STOP: SignedDuration = SignedDuration::from_millis(200);
/// From the last word of a node to being called silent.
const DETECTED: SignedDuration = SignedDuration::from_secs(2);
/// How long a part may be without a live task while its home is there: back-off, and a few steps.
const LOST_AFTER: SignedDuration = SignedDuration::from_millis(7_000);
/// How long what is away may run beside what runs on a robot that is silent, when it can be told to end: its `onDisconnect` and
/// how long it takes, and a few steps.
const TOGETHER: SignedDuration = SignedDuration::from_millis(9_000);

pub(super) struct World {
    pub(super) spec: ApplicationSpec,
    pub(super) status: ApplicationStatus,
    pub(super) tasks: BTreeMap<String, TaskSeen>,
    /// The tasks as their nodes have them.
    real: BTreeMap<String, Real>,
    pub(super) nodes: BTreeMap<String, NodeSeen>,
    pub(super) refused: BTreeMap<String, String>,
    pub(super) now: Timestamp,
    pub(super) last: Option<Plan>,
    pub(super) news: Vec<News>,
    /// Nodes without contact, and since when.
    silent: BTreeMap<String, Timestamp>,
    lost_since: BTreeMap<String, Timestamp>,
    together_since: BTreeMap<String, Timestamp>,
    moved: BTreeMap<String, (Timestamp, String)>,
}

/// A task on its node.
#[derive(Debug, Clone)]
struct Real {
    node: String,
    phase: TaskPhase,
    /// It stands by, and begins after so long without contact.
    standby: Option<Duration>,
    /// It ends after so long without contact.
    stop_after: Option<Duration>,
    /// When it runs, or is gone.
    due: Option<Timestamp>,
}

impl Real {
    /// Something of it runs.
    fn is_live(&self) -> bool {
        let begun = self.phase == TaskPhase::Starting && self.due.is_some();
        begun || matches!(self.phase, TaskPhase::Running | TaskPhase::Stopping)
    }
}

pub(super) fn task_json(process: &str) -> Value {
    json!({"metadata": {"labels": {"of": process}}, "spec": {"gracePeriodSeconds": 1, "run": {"process": {"command": [process]}}}})
}

fn admitted(spec: &Value) -> ApplicationSpec {
    let object = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Application", "metadata": {"name": "app"}, "spec": spec,
    });
    let object = muster_api::kind::admit(&object).expect("it is admitted");
    let application: Application = serde_json::from_value(object).expect("an Application");
    application.spec
}

/// A camera that stays, `amcl` that listens to it and may move, and `solo` that may move and listens to nobody.
pub(super) fn spec() -> ApplicationSpec {
    let mut camera = task_json("camera");
    camera["spec"]["resources"] = json!({"sensors": ["kinect:ImageGen"]});
    admitted(&json!({
        "home": "robot", "cooldown": "4s",
        "scales": {"gains": {"near": 3.0, "far": 2.0}},
        "parts": [
            {"name": "camera", "template": camera},
            {"name": "amcl", "cpu": "500m", "whenCutOff": "Fenced", "template": task_json("amcl")},
            {"name": "solo", "cpu": "300m", "template": task_json("solo")},
        ],
        "connections": [
            {"topic": "/image", "from": "camera", "to": "amcl", "minHz": 2.0, "tolerance": "3s"},
        ],
        "signals": [{"name": "turning", "max": 4.0, "tolerance": "1s", "parts": ["amcl"]}],
    }))
}

pub(super) fn node(name: &str, kind: &str, at: Timestamp) -> NodeSeen {
    let node: Node = serde_json::from_value(json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Node", "metadata": {"name": name},
        "spec": {"kind": kind},
        "status": {
            "allocatable": {"cpu": "4", "memory": "4Gi"}, "free": {"cpu": "4", "memory": "4Gi"},
            "sensors": ["kinect:ImageGen"], "runtimes": [{"name": "process", "available": true}],
            "conditions": [{"type": "Ready", "status": "True", "lastTransitionTime": at.to_string()}],
        },
    }))
    .expect("a Node");
    NodeSeen::of(&node)
}

impl World {
    pub(super) fn new() -> Self {
        let now = Timestamp::UNIX_EPOCH + SignedDuration::from_secs(1000);
        let nodes = [("robot", "Robot"), ("near", "Cloud"), ("far", "Cloud")];
        World {
            spec: spec(),
            status: ApplicationStatus::default(),
            tasks: BTreeMap::new(),
            nodes: nodes.map(|(name, kind)| (name.to_owned(), node(name, kind, now))).into(),
            refused: BTreeMap::new(),
            now,
            last: None,
            news: Vec::new(),
            real: BTreeMap::new(),
            silent: BTreeMap::new(),
            lost_since: BTreeMap::new(),
            together_since: BTreeMap::new(),
            moved: BTreeMap::new(),
        }
    }

    pub(super) fn part(&self, name: &str) -> &PartStatus {
        self.status.part(name).expect("a part")
    }

    pub(super) fn live_of(&self, prefix: &str) -> Vec<String> {
        let of = self.real.iter().filter(|(name, real)| name.starts_with(prefix) && real.is_live());
        of.map(|(name, _)| name.clone()).collect()
    }

    /// Where each part serves, in the order of the spec.
    pub(super) fn mapping(&self) -> Vec<&str> {
        self.status.parts.iter().map(|p| p.scale.as_deref().unwrap_or("-")).collect()
    }

    pub(super) fn task_of(&mut self, part: &str) -> &mut TaskSeen {
        let name = self.part(part).task.clone().expect("it has a task").name;
        self.tasks.get_mut(&name).expect("it is there")
    }

    pub(super) fn condition(&self, r#type: &str) -> (bool, &'static str, String) {
        let said = &self.last.as_ref().expect("it was decided").conditions;
        let said = said.iter().find(|c| c.condition == r#type).expect("it is said");
        (said.holds, said.reason, said.message.clone())
    }

    /// A node falls silent, which is seen after a while, or is back.
    pub(super) fn hear(&mut self, name: &str, heard: bool) {
        let node = self.nodes.get_mut(name).expect("a node");
        if heard {
            if self.silent.remove(name).is_some() {
                node.view.facts.not_ready = None;
                (node.view.silent_since, node.view.ready_since) = (None, Some(self.now));
            }
        } else {
            self.silent.entry(name.to_owned()).or_insert(self.now);
        }
    }

    pub(super) fn cordon(&mut self, name: &str, cordoned: bool) {
        self.nodes.get_mut(name).expect("a node").view.facts.unschedulable = cordoned;
    }

    /// Somebody deletes a task.
    pub(super) fn evict(&mut self, part: &str) {
        self.task_of(part).view.ending = true;
    }

    /// The task of a part ends for good.
    pub(super) fn fail(&mut self, part: &str) {
        let name = self.task_of(part).view.name.clone();
        self.fail_task(&name);
    }

    pub(super) fn fail_task(&mut self, name: &str) {
        self.real.get_mut(name).expect("it is there").phase = TaskPhase::Failed;
        let now = self.now;
        let view = &mut self.tasks.get_mut(name).expect("it is there").view;
        (view.finished, view.message) = (Some(now), "exited with code 7".to_owned());
    }

    pub(super) fn run(&mut self, seconds: f64) {
        let until = self.now + SignedDuration::from_secs_f64(seconds);
        while self.now < until {
            self.step();
        }
    }

    pub(super) fn step(&mut self) {
        self.now += STEP;
        self.pass_time();
        let plan = self.decide();
        self.apply(&plan);
        self.last = Some(plan);
        self.check();
    }

    pub(super) fn snapshot(&self) -> Snapshot<'_> {
        const NOTHING: &BTreeSet<String> = &BTreeSet::new();
        Snapshot {
            name: "app",
            spec: &self.spec,
            generation: 1,
            status: &self.status,
            tasks: &self.tasks,
            nodes: &self.nodes,
            taken: NOTHING,
            refused: &self.refused,
        }
    }

    pub(super) fn decide(&self) -> Plan {
        plan(&self.snapshot(), self.now)
    }

    fn pass_time(&mut self) {
        let now = self.now;
        for (name, since) in &self.silent {
            let node = self.nodes.get_mut(name).expect("a node");
            if node.view.silent_since.is_none() && now.duration_since(*since) >= DETECTED {
                node.view.facts.not_ready = Some("silent".to_owned());
                (node.view.silent_since, node.view.ready_since) = (Some(*since), None);
            }
        }
        for (name, real) in &mut self.real {
            let silent = self.silent.get(&real.node).map(|since| now.duration_since(*since));
            let task = self.tasks.get_mut(name).expect("it has an object");
            if silent.is_none() {
                hear_orders(real, task, now);
            }
            live_on(real, silent, self.nodes[&real.node].view.facts.unschedulable, now);
            let is_known = self.nodes[&real.node].view.silent_since.is_none();
            show(real, task, (silent.is_none(), is_known), now);
        }
        let gone = |(name, real): (&String, &Real)| {
            let heard = !self.silent.contains_key(&real.node);
            let stopped = real.phase == TaskPhase::Stopping && real.due.is_some_and(|d| d <= now);
            let taken_away = real.phase.is_terminal() && self.tasks[name].view.ending;
            (heard && (stopped || taken_away)).then(|| name.clone())
        };
        let gone: Vec<String> = self.real.iter().filter_map(gone).collect();
        gone.iter().for_each(|name| self.forget(name));
    }

    fn forget(&mut self, name: &str) {
        self.real.remove(name);
        self.tasks.remove(name);
    }

    fn apply(&mut self, plan: &Plan) {
        for action in &plan.actions {
            match action {
                Action::Create(new) => {
                    let known = self.tasks.insert(new.name.clone(), self.begun(new));
                    assert!(known.is_none(), "{} is there twice", new.name);
                    let real = Real {
                        node: new.node.clone(),
                        phase: TaskPhase::Pending,
                        standby: new.standby,
                        stop_after: new.stop_after,
                        due: None,
                    };
                    self.real.insert(new.name.clone(), real);
                }
                Action::Release { task } => {
                    self.tasks.get_mut(task).expect("it is there").standby = None;
                }
                Action::Delete { task, why } => {
                    if matches!(why, Ending::Moved { .. }) {
                        let serving = self.status.parts.iter().filter_map(|p| p.task.as_ref());
                        let stage =
                            self.status.parts.iter().find(|p| {
                                p.other.as_ref().is_some_and(|other| other.name == *task)
                            });
                        let written = serving.clone().all(|serving| serving.name != *task);
                        let switching =
                            self.status.parts.iter().any(|p| p.stage == Some(MoveStage::Switching));
                        assert!(
                            (written && stage.is_some()) || switching,
                            "{task} ends and nobody was written to follow"
                        );
                    }
                    self.delete(task);
                }
            }
        }
        self.status = plan.status.clone();
        self.news.extend(plan.news.iter().cloned());
    }

    fn delete(&mut self, name: &str) {
        let task = self.tasks.get_mut(name).expect("what is ended is there");
        assert!(!task.view.ending, "{name} is told twice");
        task.view.ending = true;
        if matches!(task.view.phase, TaskPhase::Failed | TaskPhase::Succeeded | TaskPhase::Pending)
        {
            self.forget(name);
        }
    }

    fn begun(&self, new: &NewTask) -> TaskSeen {
        let seconds = |after: Duration| format!("{}ms", after.as_millis());
        let mut task = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Task",
            "metadata": {
                "name": new.name, "uid": format!("uid-{}", new.name), "creationTimestamp": self.now.to_string(),
                "ownerReferences": [{
                    "apiVersion": "muster.dev/v1alpha1", "kind": "Application", "name": "app", "uid": "app-uid",
                    "controller": true,
                }],
            },
            "spec": {"placement": {"node": new.node}, "gracePeriodSeconds": 1, "run": {"process": {"command": ["x"]}}},
        });
        if let Some(after) = new.standby {
            task["spec"]["standby"] = json!({"after": seconds(after)});
        }
        if let Some(after) = new.stop_after {
            task["spec"]["onDisconnect"] = json!({"policy": "Stop", "after": seconds(after)});
        }
        let task: Task = serde_json::from_value(task).expect("a Task");
        let application = crate::owner::Owner {
            api_version: "muster.dev/v1alpha1",
            kind: "Application",
            namespace: None,
            name: "app",
            uid: "app-uid",
        };
        TaskSeen::of(&task, &application).expect("it is the application's")
    }

    fn is_in_time(&self, part: &str) -> bool {
        self.spec.part(part).is_some_and(|part| part.when_cut_off == CutOff::InTime)
    }

    /// What must hold at any time.
    fn check(&mut self) {
        let home_is_there = !self.silent.contains_key("robot");
        for part in &self.status.parts {
            let of = format!("app-{}-", part.name);
            let of = self.real.iter().filter(|(name, _)| name.starts_with(&of));
            let live: Vec<&String> =
                of.clone().filter(|(_, real)| real.is_live()).map(|(name, _)| name).collect();
            let window = part.stage.is_some_and(|stage| stage != MoveStage::Settled);
            // The robot has begun it by itself, and nobody else knows.
            let standby = part.standby.as_ref().map(|standby| &standby.name);
            let alone = !home_is_there
                && self.is_in_time(&part.name)
                && live.iter().any(|name| Some(*name) == standby);
            let twice = live.len() > 2 || (live.len() == 2 && !window && !alone);
            assert!(!twice, "{live:?} in {:?} at {}", part.stage, self.now);
            let known: Vec<&String> = part.tasks().map(|task| &task.name).collect();
            let mut all = of.filter(|(name, real)| {
                !real.phase.is_terminal() && !self.tasks[name.as_str()].view.ending
            });
            assert!(all.all(|(name, _)| known.contains(&name)), "{:?}, {known:?}", self.real);
            if live.is_empty() && home_is_there && self.refused.is_empty() {
                let since = *self.lost_since.entry(part.name.clone()).or_insert(self.now);
                let lost = self.now.duration_since(since) >= LOST_AFTER;
                assert!(!lost, "{} is lost: {:?} {part:#?}", part.name, self.real);
            } else {
                self.lost_since.remove(&part.name);
            }
            let can_be_told = |name: &&&String| {
                let node = &self.real[name.as_str()].node;
                node != "robot" && !self.silent.contains_key(node)
            };
            // What was told to end at home, and cannot hear it, is another thing: nobody can do anything about that.
            let ends = live.iter().any(|name| self.tasks[name.as_str()].view.ending);
            let both = live.len() == 2 && !home_is_there && !ends;
            if both && live.iter().any(|name| can_be_told(&name)) {
                let since = *self.together_since.entry(part.name.clone()).or_insert(self.now);
                let long = self.now.duration_since(since) >= TOGETHER;
                assert!(!long, "{live:?} run beside each other in {:?}: {part:#?}", part.stage);
            } else {
                self.together_since.remove(&part.name);
            }
        }
        self.check_moves();
    }

    /// No part leaves home within T of its last move.
    fn check_moves(&mut self) {
        let plan = self.last.as_ref().expect("it was decided");
        for news in &plan.news {
            let News::Moving { part, to, .. } = news else { continue };
            let cooldown =
                SignedDuration::try_from(self.spec.cooldown.as_duration()).expect("short");
            if let Some((at, before)) = self.moved.insert(part.clone(), (self.now, to.clone())) {
                let soon = self.now.duration_since(at) < cooldown;
                assert!(!soon || to == "robot", "{part} flaps: {before}, then {to}");
            }
        }
    }
}

/// What a Task object says has reached its node.
fn hear_orders(real: &mut Real, task: &TaskSeen, now: Timestamp) {
    let let_go = task.standby.is_none() && real.standby.take().is_some();
    if let_go && real.phase == TaskPhase::Starting {
        real.due = real.due.or(Some(now + START));
    }
    if task.view.ending && !matches!(real.phase, TaskPhase::Stopping | TaskPhase::Failed) {
        // What has not begun is gone at once.
        let stop = if real.is_live() { STOP } else { SignedDuration::ZERO };
        (real.phase, real.due) = (TaskPhase::Stopping, Some(now + stop));
    }
}

/// What a node does by itself.
fn live_on(real: &mut Real, silent: Option<SignedDuration>, cordoned: bool, now: Timestamp) {
    let without = |after: Option<Duration>| {
        let after = after.map(|after| SignedDuration::try_from(after).expect("short"));
        silent.is_some_and(|silent| after.is_some_and(|after| silent >= after))
    };
    match real.phase {
        TaskPhase::Pending if silent.is_none() && !cordoned => {
            real.phase = TaskPhase::Starting;
            real.due = real.standby.is_none().then_some(now + START);
        }
        TaskPhase::Starting if without(real.standby) => {
            real.standby = None;
            real.due = Some(now + START);
        }
        TaskPhase::Starting if real.due.is_some_and(|due| due <= now) => {
            (real.phase, real.due) = (TaskPhase::Running, None);
        }
        _ => {}
    }
    if real.is_live() && without(real.stop_after) {
        (real.phase, real.due) = (TaskPhase::Failed, None);
    }
}

/// What the controller sees of a task.
fn show(real: &Real, task: &mut TaskSeen, (heard, is_known): (bool, bool), now: Timestamp) {
    let view = &mut task.view;
    if heard {
        let begun = view.phase != TaskPhase::Running && real.phase == TaskPhase::Running;
        view.phase = real.phase;
        view.attempt = u32::from(real.is_live() || real.phase.is_terminal());
        if real.phase != TaskPhase::Pending {
            view.node = Some(real.node.clone());
        }
        if begun {
            view.started = Some(now);
        }
        if real.phase.is_terminal() {
            view.finished = view.finished.or(Some(now));
        }
    } else if !is_known && view.phase.holds_node() {
        view.phase = TaskPhase::Unknown;
    }
}
