//! The people who use the cluster: what they asked for, what was answered, and what they may rely on since.

use std::collections::{BTreeMap, BTreeSet};

use axum::body::Body;
use bytes::Bytes;
use http::Request;
use muster_api::id::TaskUid;
use muster_api::kind::node::estop::EStopTier;
use muster_api::kind::task::TaskSpec;
use muster_controller::auth::Identity;
use serde_json::{Value, json};

use crate::applications::{self, Applications};
use crate::dice::Dice;
use crate::invariant::{Invariant, Violation};
use crate::sets::{self, Sets};
use crate::view::View;

const TASKS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/tasks";
const NODES: &str = "/apis/muster.dev/v1alpha1/nodes";
const LEASES: &str = "/apis/muster.dev/v1alpha1/leases";
/// Who holds robots.
const PEOPLE: [&str; 2] = ["ada", "bob"];

/// What somebody asked and was not answered yet.
#[derive(Debug, Clone)]
pub(crate) enum Asked {
    Create(String),
    Delete(TaskUid),
    /// With the tasks that are there.
    Fence(Vec<TaskUid>),
    Cordon,
    /// A node's actuators are wanted by a person.
    Hold(usize),
    Return,
    EStop,
    Set(sets::Wanted),
    Application(applications::Wanted),
}

/// A task whose creation was answered 201.
#[derive(Debug, Clone)]
pub(crate) struct Wish {
    pub(crate) name: String,
    spec: TaskSpec,
    /// Its deletion was asked; it was answered 200.
    pub(crate) asked_to_go: bool,
    told_to_go: bool,
}

/// Everybody.
#[derive(Debug, Default)]
pub(crate) struct Users {
    asked: BTreeMap<u64, Asked>,
    next: u64,
    pub(crate) wishes: BTreeMap<TaskUid, Wish>,
    pub(crate) sets: Sets,
    pub(crate) applications: Applications,
    /// Tasks that may end by order: somebody asked for it, or fenced their node.
    pub(crate) may_end: BTreeSet<TaskUid>,
    /// Nodes of which somebody ever said that they are off.
    pub(crate) fenced: BTreeSet<String>,
    pub(crate) writes: u64,
    pub(crate) refused: u64,
    pub(crate) unanswered: u64,
}

impl Users {
    pub(crate) fn ask(
        &mut self,
        asked: Asked,
        method: &str,
        path: String,
        body: &Value,
    ) -> (u64, Request<Body>) {
        self.next += 1;
        self.asked.insert(self.next, asked);
        let media =
            if method == "PATCH" { "application/merge-patch+json" } else { "application/json" };
        let request = Request::builder()
            .method(method)
            .uri(path)
            .header("content-type", media)
            .body(Body::from(body.to_string()))
            .expect("the parts are well-formed");
        (self.next, request)
    }

    pub(crate) fn create(
        &mut self,
        name: &str,
        dice: &mut Dice,
        nodes: &[&str],
    ) -> (u64, Request<Body>) {
        let task = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Task",
            "metadata": {"name": name}, "spec": self.spec(dice, nodes),
        });
        self.ask(Asked::Create(name.to_owned()), "POST", TASKS.to_owned(), &task)
    }

    pub(crate) fn delete(&mut self, uid: &TaskUid) -> Option<(u64, Request<Body>)> {
        let wish = self.wishes.get_mut(uid)?;
        wish.asked_to_go = true;
        let path = format!("{TASKS}/{}", wish.name);
        self.may_end.insert(uid.clone());
        let options = json!({"preconditions": {"uid": uid.as_str()}});
        Some(self.ask(Asked::Delete(uid.clone()), "DELETE", path, &options))
    }

    /// `tasks`: those that are there.
    pub(crate) fn fence(&mut self, node: &str, tasks: Vec<TaskUid>) -> (u64, Request<Body>) {
        let path = format!("{NODES}/{node}/fence");
        self.fenced.insert(node.to_owned());
        self.ask(Asked::Fence(tasks), "POST", path, &json!({"reason": "it is off"}))
    }

    /// Somebody wants to hold a robot: what is free, or from whoever has it.
    pub(crate) fn hold(
        &mut self,
        (index, lease): (usize, &str),
        take: bool,
        dice: &mut Dice,
    ) -> (u64, Request<Body>) {
        let person = dice.pick(&PEOPLE).copied().unwrap_or("ada");
        let verb = if take { "take" } else { "acquire" };
        self.of_lease(Asked::Hold(index), (lease, verb), person)
    }

    /// Whoever holds a robot gives it back.
    pub(crate) fn give_back(&mut self, lease: &str, person: &str) -> (u64, Request<Body>) {
        self.of_lease(Asked::Return, (lease, "return"), person)
    }

    fn of_lease(
        &mut self,
        asked: Asked,
        (lease, verb): (&str, &str),
        person: &str,
    ) -> (u64, Request<Body>) {
        let path = format!("{LEASES}/{lease}/{verb}");
        let (id, mut request) = self.ask(asked, "POST", path, &json!({"reason": "it is needed"}));
        request.extensions_mut().insert(Identity::Admin { name: person.to_owned() });
        (id, request)
    }

    /// A robot is stopped, or released up to a stop of its own.
    pub(crate) fn estop(
        &mut self,
        node: &str,
        tier: EStopTier,
        release: Option<u64>,
    ) -> (u64, Request<Body>) {
        let mut patch = json!({"spec": {"estop": tier}});
        if let Some(number) = release {
            patch["spec"]["estopRelease"] = json!(number);
        }
        self.ask(Asked::EStop, "PATCH", format!("{NODES}/{node}"), &patch)
    }

    pub(crate) fn cordon(&mut self, node: &str, on: bool) -> (u64, Request<Body>) {
        let patch = json!({"spec": {"unschedulable": on}});
        self.ask(Asked::Cordon, "PATCH", format!("{NODES}/{node}"), &patch)
    }

    /// The controller is gone: nobody knows what became of what was asked.
    pub(crate) fn left_alone(&mut self) {
        self.unanswered += self.asked.len() as u64;
        self.asked.clear();
    }

    /// An answer. Gives what was asked, for the log.
    pub(crate) fn answered(&mut self, id: u64, code: u16, body: &Bytes) -> Option<Asked> {
        let asked = self.asked.remove(&id)?;
        if !(200..300).contains(&code) {
            self.refused += 1;
            return Some(asked);
        }
        self.writes += 1;
        match &asked {
            Asked::Create(name) => {
                let object: Value = serde_json::from_slice(body).unwrap_or_default();
                let uid = TaskUid::new(object["metadata"]["uid"].as_str().unwrap_or_default());
                let Ok(spec) = serde_json::from_value(object["spec"].clone()) else {
                    return Some(asked);
                };
                let wish = Wish { name: name.clone(), spec, asked_to_go: false, told_to_go: false };
                self.wishes.insert(uid, wish);
            }
            Asked::Delete(uid) => {
                self.wishes.get_mut(uid).into_iter().for_each(|wish| wish.told_to_go = true);
            }
            Asked::Set(wanted) => self.sets.answered(wanted, body),
            Asked::Application(wanted) => self.applications.answered(wanted, body),
            Asked::Fence(_) | Asked::Cordon | Asked::Hold(_) | Asked::Return | Asked::EStop => {}
        }
        Some(asked)
    }

    /// Invariant 3, by the store as it is.
    ///
    /// # Errors
    ///
    /// What was answered and is not there.
    pub(crate) fn nothing_acknowledged_is_lost(&mut self, view: &View) -> Result<(), Violation> {
        let lost = |how: String| Err(Invariant::NothingAcknowledgedIsLost.broken(how));
        let there: BTreeMap<&TaskUid, _> =
            view.tasks.all().map(|(_, uid, task)| (uid, task)).collect();
        let mut gone = Vec::new();
        for (uid, wish) in &self.wishes {
            match there.get(uid) {
                None if wish.asked_to_go => gone.push(uid.clone()),
                None => return lost(format!("task {} was created, and is not there", wish.name)),
                Some(task) if wish.told_to_go && task.metadata.deletion_timestamp.is_none() => {
                    return lost(format!("task {} was deleted, and nothing says so", wish.name));
                }
                Some(task) if task.spec != wish.spec => {
                    return lost(format!("task {} has another spec than was stored", wish.name));
                }
                Some(_) => {}
            }
        }
        for uid in gone {
            self.wishes.remove(&uid);
        }
        Ok(())
    }
}

impl Users {
    /// What somebody wants to run, now and then after another task.
    fn spec(&self, dice: &mut Dice, nodes: &[&str]) -> Value {
        let mut spec = spec(dice, nodes);
        let names: Vec<&str> = self.wishes.values().map(|wish| &*wish.name).collect();
        if dice.one_in(6)
            && let Some(other) = dice.pick(&names)
        {
            let condition = dice.pick(&["Running", "Ready", "Succeeded"]);
            spec["dependsOn"] = json!([{"task": other, "condition": condition}]);
        }
        spec
    }
}

/// What somebody wants to run.
fn spec(dice: &mut Dice, nodes: &[&str]) -> Value {
    let restart = dice.pick(&["Never", "OnFailure", "Always"]).copied().unwrap_or("Never");
    let mut spec = json!({
        "run": {"process": {"command": ["work"]}},
        "restartPolicy": restart,
        "gracePeriodSeconds": dice.between(0, 4),
        "resources": {"cpu": format!("{}m", dice.between(1, 6) * 100), "memory": "64Mi"},
    });
    let drives = dice.one_in(2);
    if drives {
        spec["resources"]["actuators"] = json!(["base:Drive"]);
    }
    if dice.one_in(3) {
        spec["resources"]["sensors"] = json!(["kinect:ImageGen"]);
    }
    if dice.one_in(3) {
        spec["placement"]["at"] = json!({"x": dice.between(0, 30) as f64, "y": 0.0});
        spec["placement"]["within"] = json!(dice.between(5, 40) as f64);
    }
    if dice.one_in(8)
        && let Some(node) = dice.pick(nodes)
    {
        spec["placement"]["node"] = json!(node);
    }
    if dice.one_in(5) {
        spec["priority"] = json!(dice.between(1, 3));
    }
    match dice.between(0, 3) {
        0 => {
            spec["onDisconnect"] =
                json!({"policy": "Stop", "after": format!("{}s", dice.between(2, 12))})
        }
        1 if drives => spec["onDisconnect"] = json!({"policy": "Keep"}),
        _ => {}
    }
    spec
}
