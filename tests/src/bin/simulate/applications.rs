//! Applications: what people want of them, and what must hold of their parts wherever these are.
//!
//! An application has a camera, which stays on its robot, now and then what drives it, and a part that looks at the images and
//! may run on the server. What that part tells of its topic and of a signal is the world's to say.

use std::collections::BTreeMap;

use axum::body::Body;
use bytes::Bytes;
use http::Request;
use muster_api::id::TaskUid;
use muster_api::kind::application::{
    Application, ApplicationPhase, CutOff, MoveStage, PART_LABEL, PartStatus,
};
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use serde_json::{Value, json};

use crate::action::Action;
use crate::dice::Dice;
use crate::invariant::{Invariant, Violation};
use crate::truth::Truth;
use crate::users::{Asked, Users};
use crate::view::{View, controller, phase};
use crate::world::World;

const APPLICATIONS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/applications";
/// The part that may move, and the only node it may move to. Its command is this where its robot, cut off, begins it only when
/// nothing else of it runs.
pub(crate) const LOOK: &str = "look";
/// Its command where the robot begins it in time.
pub(crate) const GLANCE: &str = "glance";
const SERVER: &str = "c1";
/// How long it may run twice then, milliseconds: until what is away has surely ended, whatever happens to it, its robot and
/// the controller.
const BESIDE: u64 = 20_000;
/// How long its topic may be too slow, and its signal too high, milliseconds.
const TOLERANCE: u64 = 4_000;
/// From a heartbeat to the next one, and until what a robot keeps ready runs.
const SOON: u64 = 1_500;
/// Between two looks where it is.
const LOOK_EVERY: u64 = 250;

/// What is told of topics and signals: as it should be, or one of them not.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Told {
    pub(crate) hz: f64,
    pub(crate) tilt: f64,
}

impl Default for Told {
    fn default() -> Self {
        Told { hz: 10.0, tilt: 0.0 }
    }
}

/// What somebody asked about an application and was not answered yet.
#[derive(Debug, Clone)]
pub(crate) enum Wanted {
    New,
    Changed,
    Gone(String),
}

/// An application whose creation was answered 201.
#[derive(Debug)]
struct Wish {
    name: String,
    asked_to_go: bool,
    told_to_go: bool,
}

/// Everybody's applications.
#[derive(Debug, Default)]
pub(crate) struct Applications {
    wishes: BTreeMap<String, Wish>,
    /// Since when the part of an application runs twice.
    beside: BTreeMap<TaskUid, u64>,
}

/// The part that a task is, by its name: none of other tasks begins so.
pub(crate) fn part_of(name: &str) -> Option<&str> {
    name.starts_with('a').then(|| name.rsplit_once('-').map_or(name, |(part, _)| part))
}

fn part(name: &str, command: &str, resources: Value, dice: &mut Dice) -> Value {
    json!({
        "name": name,
        "cpu": "200m",
        "template": {"spec": {
            "gracePeriodSeconds": dice.between(0, 2),
            "resources": resources,
            "run": {"process": {"command": [command]}},
        }},
    })
}

fn create(name: &str, dice: &mut Dice) -> Value {
    let home = dice.pick(&["r1", "r2", "r3"]).copied().unwrap_or("r1");
    let tolerance = format!("{TOLERANCE}ms");
    let (look, when) = if dice.one_in(2) { (LOOK, "Fenced") } else { (GLANCE, "InTime") };
    let mut parts = vec![
        part("camera", "work", json!({"cpu": "100m", "sensors": ["kinect:ImageGen"]}), dice),
        part(LOOK, look, json!({"cpu": "200m", "memory": "16Mi"}), dice),
    ];
    parts[1]["whenCutOff"] = when.into();
    let mut connections = vec![json!({
        "topic": "/image", "from": "camera", "to": LOOK, "minHz": 5.0, "tolerance": tolerance,
    })];
    if dice.one_in(3) {
        parts.push(part(
            "drive",
            "work",
            json!({"cpu": "100m", "actuators": ["base:Drive"]}),
            dice,
        ));
        connections.push(json!({
            "topic": "/way", "from": LOOK, "to": "drive", "minHz": 1.0, "tolerance": "9s",
        }));
    }
    json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Application", "metadata": {"name": name},
        "spec": {
            "home": home,
            "scales": {"nodes": [SERVER], "gains": {SERVER: 3.0}},
            "cooldown": format!("{}s", dice.between(2, 8)),
            "objective": {"latency": if dice.one_in(2) { 1.0 } else { 0.0 }},
            "parts": parts, "connections": connections,
            "signals": [{"name": "tilt", "max": 4.0, "tolerance": tolerance, "parts": [LOOK]}],
        },
    })
}

impl Applications {
    fn asks(
        &mut self,
        action: Action,
        name: &str,
        dice: &mut Dice,
    ) -> Option<(Wanted, &'static str, String, Value)> {
        if action == Action::CreateApplication {
            let (path, body) = (APPLICATIONS.to_owned(), create(name, dice));
            return self.wishes.is_empty().then_some((Wanted::New, "POST", path, body));
        }
        let there: Vec<String> = self.wishes.keys().cloned().collect();
        let uid = dice.pick(&there)?.clone();
        let wish = self.wishes.get_mut(&uid).filter(|wish| !wish.asked_to_go)?;
        let path = format!("{APPLICATIONS}/{}", wish.name);
        if action == Action::DeleteApplication {
            wish.asked_to_go = true;
            let options = json!({"preconditions": {"uid": uid}});
            return Some((Wanted::Gone(uid), "DELETE", path, options));
        }
        let policy = dice.pick(&["Home", "Optimal", "Optimal", "Greedy"]);
        Some((Wanted::Changed, "PATCH", path, json!({"spec": {"policy": policy}})))
    }

    /// Somebody was answered 2xx.
    pub(crate) fn answered(&mut self, wanted: &Wanted, body: &Bytes) {
        match wanted {
            Wanted::New => {
                let object: Value = serde_json::from_slice(body).unwrap_or_default();
                let text = |field: &str| object["metadata"][field].as_str().unwrap_or_default();
                let name = text("name").to_owned();
                let wish = Wish { name, asked_to_go: false, told_to_go: false };
                self.wishes.insert(text("uid").to_owned(), wish);
            }
            Wanted::Gone(uid) => {
                self.wishes.get_mut(uid).into_iter().for_each(|wish| wish.told_to_go = true);
            }
            Wanted::Changed => {}
        }
    }

    /// Invariant 3 of applications.
    fn nothing_is_lost(&mut self, view: &View) -> Result<(), Violation> {
        let lost = |how: String| Err(Invariant::NothingAcknowledgedIsLost.broken(how));
        let there: BTreeMap<&str, &Application> =
            view.applications.all().map(|(_, uid, object)| (uid.as_str(), object)).collect();
        for (uid, wish) in &self.wishes {
            match there.get(uid.as_str()) {
                None if wish.asked_to_go => {}
                None => return lost(format!("application {} is not there", wish.name)),
                Some(o) if wish.told_to_go && o.metadata.deletion_timestamp.is_none() => {
                    return lost(format!("application {} was deleted in vain", wish.name));
                }
                Some(_) => {}
            }
        }
        self.wishes.retain(|uid, wish| !wish.asked_to_go || there.contains_key(uid.as_str()));
        Ok(())
    }

    /// What must hold of the parts at each look.
    pub(crate) fn check(&mut self, view: &View, truth: &Truth, now: u64) -> Result<(), Violation> {
        self.nothing_is_lost(view)?;
        for (key, uid, application) in view.applications.all() {
            let status = application.status.clone().unwrap_or_default();
            for part in &status.parts {
                let live: Vec<usize> = members(view, uid, &part.name)
                    .filter(|(uid, _)| !truth.is_written_off(uid))
                    .filter_map(|(uid, _)| truth.live.get(uid).map(|live| live.node))
                    .collect();
                let home = truth.node_named(&application.spec.home);
                let twice = live.len() > 1;
                if part.name == LOOK && !twice {
                    self.beside.remove(uid);
                }
                // Its robot was cut off, and nobody else knows that it has begun it.
                let alone = part.name == LOOK
                    && live.len() == 2
                    && home.is_some_and(|home| live.contains(&home));
                let alone = alone && begins_in_time(application);
                let mut bears = || now - *self.beside.entry(uid.clone()).or_insert(now) < BESIDE;
                let settled = matches!(part.stage, None | Some(MoveStage::Settled));
                if twice && settled && !(alone && bears()) {
                    let (name, count) = (&part.name, live.len());
                    let how = format!("{key}: {name} runs {count} times, and does not move");
                    return Err(Invariant::NothingRunsTwice.broken(how));
                }
                if part.name != LOOK && live.iter().any(|node| Some(*node) != home) {
                    let how = format!("{key}: {} is critical, and runs away from home", part.name);
                    return Err(Invariant::WorkOutlivesItsManagers.broken(how));
                }
            }
        }
        Ok(())
    }
}

fn begins_in_time(application: &Application) -> bool {
    application.spec.part(LOOK).is_some_and(|part| part.when_cut_off == CutOff::InTime)
}

/// The tasks of a part.
fn members<'a>(
    view: &'a View,
    application: &'a TaskUid,
    part: &'a str,
) -> impl Iterator<Item = (&'a TaskUid, &'a Task)> {
    let is = move |task: &Task| {
        let labels = task.metadata.labels.as_ref();
        controller(task, "Application") == Some(application.as_str())
            && labels.and_then(|labels| labels.get(PART_LABEL)).is_some_and(|of| of == part)
    };
    view.tasks.all().filter(move |(_, _, task)| is(task)).map(|(_, uid, task)| (uid, task))
}

impl Users {
    fn of_applications(
        &mut self,
        (wanted, method, path, body): (Wanted, &str, String, Value),
    ) -> (u64, Request<Body>) {
        self.ask(Asked::Application(wanted), method, path, &body)
    }
}

impl World {
    /// Somebody acts on an application, or what its part tells is not as it should be for a while.
    pub(crate) fn act_on_application(&mut self, action: Action) -> bool {
        if action == Action::Violate {
            let (hz, tilt) = if self.dice.one_in(2) { (2.0, 0.0) } else { (10.0, 9.0) };
            self.truth.told = Told { hz, tilt };
            let wait = self.dice.between(500, 20_000);
            self.agenda.at(self.now + wait, crate::agenda::Due::WellAgain);
            return true;
        }
        let name = format!("a{}", self.log.step);
        self.ask(|users, dice| {
            let asked = users.applications.asks(action, &name, dice)?;
            Some(users.of_applications(asked))
        })
    }

    /// What is still under way in applications.
    pub(crate) fn unsettled_applications(&self, words: &mut Vec<String>) {
        for (key, uid, application) in self.view.applications.all() {
            if application.metadata.deletion_timestamp.is_some() {
                words.push(format!("{key} is deleted, and is there"));
                continue;
            }
            let status = application.status.clone().unwrap_or_default();
            if Some(status.observed_generation) != application.metadata.generation {
                words.push(format!("{key} was changed, and nobody has looked"));
                continue;
            }
            let is = |part: &PartStatus, wanted: TaskPhase| {
                let mut tasks = members(&self.view, uid, &part.name);
                tasks.any(|(_, task)| phase(task) == wanted)
            };
            // What has no room waits, and says so; one that comes home is not given up for that.
            let parts = &status.parts;
            if parts.iter().any(|p| !is(p, TaskPhase::Running) || is(p, TaskPhase::Pending)) {
                continue;
            }
            let moving = status.parts.iter().find(|part| part.stage != Some(MoveStage::Settled));
            words.extend(moving.map(|part| format!("{key}: {} is {:?}", part.name, part.stage)));
            if status.phase != ApplicationPhase::Running {
                words.push(format!("{key} is {:?}, and its parts run", status.phase));
            }
        }
        for (key, _, task) in self.view.tasks.all() {
            let of = controller(task, "Application");
            let there =
                |of: &str| self.view.applications.all().any(|(_, uid, _)| uid.as_str() == of);
            if of.is_some_and(|of| !there(of)) {
                words.push(format!("{key} has lost its application"));
            }
        }
    }

    /// When all is quiet, a part that is away is on its way home before its connection's tolerance is over.
    pub(crate) fn parts_come_home(&mut self) {
        let away: Vec<(TaskUid, String)> = self
            .view
            .applications
            .all()
            .filter(|(_, _, application)| self.is_away_with_standby(application))
            .map(|(_, uid, application)| (uid.clone(), application.spec.home.clone()))
            .collect();
        if away.is_empty() {
            return;
        }
        self.log.say(self.now, format_args!("= topics are too slow"));
        self.truth.told = Told { hz: 1.0, ..Told::default() };
        let until = self.now + TOLERANCE + SOON;
        let mut late = away;
        while self.now < until && !late.is_empty() && self.broken.is_none() {
            self.run_to(self.now + LOOK_EVERY);
            self.check();
            // One that was home may leave again: its topic is not slower there.
            late.retain(|(uid, home)| !self.runs_at(uid, home));
        }
        if let Some((uid, _)) = late.first().filter(|_| self.broken.is_none()) {
            let how = format!("{uid}: its part does not come home in time");
            self.break_with(Invariant::EverythingEndsOrExplainsItself.broken(how));
        }
    }

    /// Whether the part that may move lives on this node.
    fn runs_at(&self, application: &TaskUid, node: &str) -> bool {
        let node = self.truth.node_named(node);
        members(&self.view, application, LOOK)
            .any(|(uid, _)| self.truth.live.get(uid).is_some_and(|live| Some(live.node) == node))
    }

    fn is_away_with_standby(&self, application: &Application) -> bool {
        let status = application.status.as_ref();
        let part = status.and_then(|status| status.part(LOOK));
        let standby = part.filter(|part| part.stage == Some(MoveStage::Settled));
        let standby = standby.and_then(|part| part.standby.as_ref());
        standby.is_some_and(|standby| {
            let task = self.view.task(&TaskUid::new(standby.uid.as_str()));
            let status = task.and_then(|task| task.status.as_ref());
            status.is_some_and(|status| status.reason == "Standby")
        })
    }
}
