//! TaskSets: what people want of them, what they may rely on since, and what must hold of a rollout.

use std::collections::{BTreeMap, BTreeSet};

use axum::body::Body;
use bytes::Bytes;
use http::Request;
use muster_api::id::TaskUid;
use muster_api::kind::task::Task;
use muster_api::kind::taskset::{TaskSet, TaskSetSpec, TaskSetStatus};
use muster_api::phase::TaskPhase;
use muster_controller::store::Key;
use serde_json::{Value, json};

use crate::action::Action;
use crate::dice::Dice;
use crate::invariant::{Invariant, Violation};
use crate::mutation::Mutation;
use crate::truth::{Cause, Truth};
use crate::users::{Asked, Users};
use crate::view::{View, controller, phase};
use crate::world::World;

const SETS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/tasksets";
/// Sets at once.
const CROWD: usize = 2;

/// What somebody asked about a set and was not answered yet.
#[derive(Debug, Clone)]
pub(crate) enum Wanted {
    /// With so many down at most.
    New(usize),
    Changed(String),
    Gone(String),
}

/// A set whose creation was answered 201.
#[derive(Debug)]
struct Wish {
    name: String,
    /// How many a rollout may take down.
    most: usize,
    /// What was answered last: the generation, and what it is.
    generation: i64,
    spec: TaskSetSpec,
    asked_to_go: bool,
    told_to_go: bool,
}

/// A task of a set, as it was at the last look: it served.
#[derive(Debug)]
struct Serving {
    uid: TaskUid,
    attempt: u32,
}

/// Everybody's sets.
#[derive(Debug, Default)]
pub(crate) struct Sets {
    wishes: BTreeMap<String, Wish>,
    /// By set and name those that served at the last look.
    serving: BTreeMap<(String, String), Serving>,
    /// By set and name those that served when a rollout ended them, until nothing is left of them.
    emptied: BTreeMap<(String, String), TaskUid>,
    /// Places of rollouts at the last look.
    replacing: BTreeSet<(String, String, String)>,
    /// At the last look the generation of each set, its replicas, and how many tasks it had.
    counted: BTreeMap<String, (i64, u32, usize)>,
}

/// The template of what a set runs, or is changed to.
fn template(dice: &mut Dice) -> Value {
    let command = if dice.one_in(4) { "crash" } else { "work" };
    json!({
        "metadata": {"annotations": {"try": dice.roll().to_string()}},
        "spec": {
            "run": {"process": {"command": [command]}},
            "gracePeriodSeconds": dice.between(0, 3),
            "resources": {"cpu": format!("{}m", dice.between(1, 3) * 100), "memory": "16Mi"},
        },
    })
}

impl Sets {
    /// What is asked, or none: there is nothing to ask it of.
    fn asks(
        &mut self,
        action: Action,
        (name, mutation): (&str, Option<Mutation>),
        dice: &mut Dice,
    ) -> Option<(Wanted, &'static str, String, Value)> {
        if action == Action::CreateSet {
            return (self.wishes.len() < CROWD).then(|| create(name, mutation, dice));
        }
        let there: Vec<String> = self.wishes.keys().cloned().collect();
        let uid = dice.pick(&there)?.clone();
        let wish = self.wishes.get_mut(&uid).filter(|wish| !wish.asked_to_go)?;
        let path = format!("{SETS}/{}", wish.name);
        Some(match action {
            Action::DeleteSet => {
                wish.asked_to_go = true;
                let options = json!({"preconditions": {"uid": uid}});
                (Wanted::Gone(uid), "DELETE", path, options)
            }
            Action::ScaleSet => {
                if wish.spec.every_node {
                    return None;
                }
                let patch = json!({"spec": {"replicas": dice.between(0, 4)}});
                (Wanted::Changed(uid), "PATCH", path, patch)
            }
            _ => {
                let patch = json!({"spec": {"template": template(dice)}});
                (Wanted::Changed(uid), "PATCH", path, patch)
            }
        })
    }

    /// Somebody was answered 2xx.
    pub(crate) fn answered(&mut self, wanted: &Wanted, body: &Bytes) {
        let object: Option<TaskSet> = serde_json::from_slice(body).ok();
        match (wanted, object) {
            (Wanted::New(most), Some(set)) => {
                let generation = set.metadata.generation.unwrap_or_default();
                let name = set.metadata.name.unwrap_or_default();
                let (asked_to_go, told_to_go) = (false, false);
                let (most, spec) = (*most, set.spec);
                let wish = Wish { name, most, generation, spec, asked_to_go, told_to_go };
                self.wishes.insert(set.metadata.uid.unwrap_or_default(), wish);
            }
            (Wanted::Changed(uid), Some(set)) => {
                let generation = set.metadata.generation.unwrap_or_default();
                let wish = self.wishes.get_mut(uid).filter(|wish| wish.generation < generation);
                wish.into_iter().for_each(|wish| {
                    (wish.generation, wish.spec) = (generation, set.spec.clone());
                });
            }
            (Wanted::Gone(uid), _) => {
                self.wishes.get_mut(uid).into_iter().for_each(|wish| wish.told_to_go = true);
            }
            (Wanted::New(_) | Wanted::Changed(_), None) => {}
        }
    }

    /// Invariant 3 of sets: what was answered is there, and is what it was, or newer.
    fn nothing_is_lost(&mut self, view: &View) -> Result<(), Violation> {
        let lost = |how: String| Err(Invariant::NothingAcknowledgedIsLost.broken(how));
        let there: BTreeMap<&str, &TaskSet> =
            view.sets.all().map(|(_, uid, set)| (uid.as_str(), set)).collect();
        for (uid, wish) in &self.wishes {
            let name = &wish.name;
            let Some(set) = there.get(uid.as_str()) else {
                if wish.asked_to_go {
                    continue;
                }
                return lost(format!("task set {name} was created, and is not there"));
            };
            if wish.told_to_go && set.metadata.deletion_timestamp.is_none() {
                return lost(format!("task set {name} was deleted, and nothing says so"));
            }
            let generation = set.metadata.generation.unwrap_or_default();
            if generation < wish.generation
                || (generation == wish.generation && set.spec != wish.spec)
            {
                return lost(format!("task set {name} is another one than was answered"));
            }
        }
        self.wishes.retain(|uid, wish| !wish.asked_to_go || there.contains_key(uid.as_str()));
        Ok(())
    }

    /// What must hold of the sets at each look.
    pub(crate) fn check(&mut self, view: &View, truth: &Truth) -> Result<(), Violation> {
        self.nothing_is_lost(view)?;
        let (mut serving, mut replacing) = (BTreeMap::new(), BTreeSet::new());
        for (key, uid, set) in view.sets.all() {
            let members: Vec<_> = members(view, uid).collect();
            let status = set.status.clone().unwrap_or_default();
            let scaled = self.never_more(uid, set, &members)?;
            self.empties((uid, set, &status), truth, scaled);
            for task in &status.replacing {
                replacing.insert((uid.to_string(), task.task.clone(), task.revision.clone()));
            }
            self.few_are_down(key, uid, &members)?;
            for (key, of, task) in members {
                let status = task.status.clone().unwrap_or_default();
                if status.phase == TaskPhase::Running && task.metadata.deletion_timestamp.is_none()
                {
                    let now = Serving { uid: of.clone(), attempt: status.attempt };
                    serving.insert((uid.to_string(), key.name.to_string()), now);
                }
            }
        }
        self.emptied.retain(|(set, _), _| view.sets.all().any(|(_, uid, _)| uid.as_str() == set));
        (self.serving, self.replacing) = (serving, replacing);
        Ok(())
    }

    /// There is never one more than the set asks for. Gives whether it may ask for another number than at the last look.
    fn never_more(
        &mut self,
        uid: &TaskUid,
        set: &TaskSet,
        members: &[(&Key, &TaskUid, &Task)],
    ) -> Result<bool, Violation> {
        let Some(replicas) = set.spec.replicas else { return Ok(false) };
        let generation = set.metadata.generation.unwrap_or_default();
        let stays =
            |task: &Task| task.metadata.deletion_timestamp.is_none() && !phase(task).is_terminal();
        let count = members.iter().filter(|(.., task)| stays(task)).count();
        let now = (generation, replicas, count);
        let (known, before, had) = self.counted.insert(uid.to_string(), now).unwrap_or(now);
        // What is too much is ended in its time; what was asked for between two looks is not seen.
        let most = had.max(before.max(replicas) as usize);
        if count > most && generation <= known + 1 {
            let how = format!("{uid} has {count} tasks, had {had}, and asks for {replicas}");
            return Err(Invariant::NothingRunsTwice.broken(how));
        }
        Ok(before != replicas || generation > known + 1)
    }

    /// Takes in which serving tasks rollouts have ended since the last look.
    fn empties(
        &mut self,
        (uid, set, status): (&TaskUid, &TaskSet, &TaskSetStatus),
        truth: &Truth,
        scaled: bool,
    ) {
        let of = uid.to_string();
        if scaled || set.spec.every_node || set.spec.min_ready_seconds > 0 {
            return self.emptied.retain(|(set, _), _| *set != of);
        }
        for task in &status.replacing {
            let known = (of.clone(), task.task.clone(), task.revision.clone());
            if self.replacing.contains(&known) {
                continue;
            }
            let place = (of.clone(), task.task.clone());
            let Some(served) = self.serving.get(&place) else { continue };
            // One that ended by itself meanwhile was not there any more.
            let live = truth.live.get(&served.uid).map(|live| live.attempt);
            let over = truth.over.get(&served.uid).filter(|over| over.cause == Cause::Order);
            let attempt = live.or_else(|| over.map(|over| over.attempt));
            if attempt == Some(served.attempt) {
                self.emptied.insert(place, served.uid.clone());
            }
        }
    }

    /// Of those that served, a rollout has no more down than it may.
    fn few_are_down(
        &mut self,
        key: &Key,
        uid: &TaskUid,
        members: &[(&Key, &TaskUid, &Task)],
    ) -> Result<(), Violation> {
        // Another one in its place may wait for room, and then the rollout goes on without it; and what was to make room for
        // others did not serve any more.
        let waits = |task: &Task| task.status.as_ref().is_some_and(|status| status.stop.is_none());
        self.emptied.retain(|(set, _), was| {
            let is = |(_, of, task): &(&Key, &TaskUid, &Task)| **of == *was && waits(task);
            set != uid.as_str() || members.iter().any(is)
        });
        let here = self.emptied.keys().filter(|(set, _)| set == uid.as_str());
        let down: Vec<&str> = here.map(|(_, name)| name.as_str()).collect();
        match self.wishes.get(uid.as_str()) {
            Some(wish) if down.len() > wish.most => {
                let (most, down) = (wish.most, down.join(", "));
                let how = format!(
                    "{key}: a rollout took {down} down, which served; at most {most} may be"
                );
                Err(Invariant::WorkOutlivesItsManagers.broken(how))
            }
            _ => Ok(()),
        }
    }
}

fn create(
    name: &str,
    mutation: Option<Mutation>,
    dice: &mut Dice,
) -> (Wanted, &'static str, String, Value) {
    let most = usize::try_from(dice.between(1, 2)).unwrap_or(1);
    let told = if mutation == Some(Mutation::HastyRollout) { 4 } else { most };
    let mut set = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "TaskSet", "metadata": {"name": name},
        "spec": {
            "template": template(dice),
            "minReadySeconds": if dice.one_in(3) { 2 } else { 0 },
            "rollout": {
                "maxUnavailable": told,
                "canary": dice.between(0, 1),
                "progressDeadlineSeconds": dice.between(30, 120),
            },
        },
    });
    if dice.one_in(4) {
        set["spec"]["everyNode"] = json!(true);
    } else {
        set["spec"]["replicas"] = json!(dice.between(2, 4));
    }
    (Wanted::New(most), "POST", SETS.to_owned(), set)
}

/// The tasks of a set.
fn members<'a>(
    view: &'a View,
    set: &'a TaskUid,
) -> impl Iterator<Item = (&'a Key, &'a TaskUid, &'a Task)> {
    view.tasks.all().filter(|(_, _, task)| controller(task, "TaskSet") == Some(set.as_str()))
}

impl Users {
    fn of_sets(
        &mut self,
        (wanted, method, path, body): (Wanted, &str, String, Value),
    ) -> (u64, Request<Body>) {
        self.ask(Asked::Set(wanted), method, path, &body)
    }
}

impl World {
    /// Somebody acts on a set.
    pub(crate) fn act_on_set(&mut self, action: Action) -> bool {
        let name = format!("s{}", self.log.step);
        let mutation = self.mutation;
        self.ask(|users, dice| {
            let asked = users.sets.asks(action, (&name, mutation), dice)?;
            Some(users.of_sets(asked))
        })
    }

    /// What is still under way in sets.
    pub(crate) fn unsettled_sets(&self, words: &mut Vec<String>) {
        for (key, uid, set) in self.view.sets.all() {
            if set.metadata.deletion_timestamp.is_some() {
                words.push(format!("{key} is deleted, and is there"));
                continue;
            }
            let status = set.status.clone().unwrap_or_default();
            if Some(status.observed_generation) != set.metadata.generation {
                words.push(format!("{key} was changed, and nobody has looked"));
                continue;
            }
            let members: Vec<&Task> = members(&self.view, uid).map(|(.., task)| task).collect();
            words.extend(unsettled(&key.to_string(), set, &status, &members));
        }
        for (key, _, task) in self.view.tasks.all() {
            let of = controller(task, "TaskSet");
            if of.is_some_and(|of| !self.view.sets.all().any(|(_, uid, _)| uid.as_str() == of)) {
                words.push(format!("{key} has lost its set"));
            }
        }
    }
}

/// Why a set is not where it should be: counted, and of the template that is wanted or of the one that it went back to.
fn unsettled(
    key: &str,
    set: &TaskSet,
    status: &TaskSetStatus,
    members: &[&Task],
) -> Option<String> {
    if status.replicas as usize != members.len() {
        return Some(format!("{key} counts {} of {} tasks", status.replicas, members.len()));
    }
    if set.spec.replicas.is_some_and(|replicas| replicas as usize != members.len()) {
        return Some(format!("{key} has {} tasks", members.len()));
    }
    let target = match &status.rolled_back_from {
        Some(_) => &status.current_revision,
        None => &status.update_revision,
    };
    let of = |task: &Task| {
        let labels = task.metadata.labels.as_ref();
        labels.and_then(|labels| labels.get("muster.dev/revision")).cloned().unwrap_or_default()
    };
    let runs = |task: &&&Task| phase(task) == TaskPhase::Running;
    let running = members.iter().filter(runs).count();
    if running as u32 != status.ready_replicas {
        return Some(format!("{key}: {running} run, {} are counted", status.ready_replicas));
    }
    // A good template is there to go back to, and a task of the new one crashes again and again.
    let crashes = |task: &&&Task| phase(task) == TaskPhase::Starting && of(task) == *target;
    let tried = !status.current_revision.is_empty() && status.current_revision != *target;
    if tried && members.iter().any(|task| crashes(&task)) {
        return Some(format!("{key}: {target} crashes, and is not given up"));
    }
    let behind = members.iter().filter(|task| of(task) != *target).count();
    if running == members.len() && behind > 0 {
        return Some(format!("{key}: {behind} of {running} are not of {target}"));
    }
    None
}
