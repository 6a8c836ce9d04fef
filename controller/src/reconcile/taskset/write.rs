//! A plan as one transaction, and what people are told when it is done.

use std::collections::BTreeMap;
use std::sync::Arc;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{ObjectMeta, Time};
use muster_api::condition::{Condition, ConditionStatus, REPLICA_FAILURE, set_condition};
use muster_api::kind::node::Node;
use muster_api::kind::task::{Task, TaskSpec};
use muster_api::kind::taskset::{
    CHANGE_CAUSE, SET_LABEL, TaskSet, TaskSetSpec, TaskSetStatus, TaskTemplate,
};
use muster_api::kind::taskset_revision::{TaskSetRevision, TaskSetRevisionSpec};
use muster_api::name::NodeName;
use muster_controller_core::taskset::{Action, NewTask, News, Place, Plan};

use crate::context::Context;
use crate::objects::{self, REVISIONS, TASKS};
use crate::quota::Pass;
use crate::reconcile::owned::Owner;
use crate::rest::create::namespace_guard;
use crate::rest::delete;
use crate::rest::failure::Failure;
use crate::store::{Key, Op, StoreError, Stored};

/// What became of a plan.
pub(super) enum Outcome {
    /// It is so, or there was nothing to do.
    Done,
    /// Something that it relied on is not so any more.
    Raced,
    /// A node was not heard since this controller began: it may be on a mission that nobody here knows of.
    Away,
    /// Something else does not let it pass.
    Refused(String),
}

/// Why a plan has no operations.
enum Stop {
    Raced,
    Away,
    Refused(Failure),
}

impl From<Failure> for Stop {
    fn from(failure: Failure) -> Self {
        Stop::Refused(failure)
    }
}

pub(super) async fn carry_out(
    context: &Context,
    stored: &Arc<Stored>,
    set: &TaskSet,
    plan: &Plan,
) -> Result<Outcome, StoreError> {
    let mut work = Work { context, stored, set, passes: Vec::new(), kept_out: BTreeMap::new() };
    let more = match work.operations(plan) {
        Ok(more) => more,
        Err(Stop::Raced) => return Ok(Outcome::Raced),
        Err(Stop::Away) => return Ok(Outcome::Away),
        Err(Stop::Refused(failure)) => return Ok(Outcome::Refused(failure.message().to_owned())),
    };
    let refused = work.kept_out.values().next().cloned();
    let mut status = plan.status.clone();
    say_failure(&mut status, refused.as_deref(), context.clock.now());
    let same = set.status.as_ref() == Some(&status);
    let outcome = refused.map_or(Outcome::Done, Outcome::Refused);
    if same && more.is_empty() {
        return Ok(outcome);
    }
    // Everything holds only while the set is what the plan was made for.
    let mut ops = vec![match same {
        false => Op::status(stored, &status),
        true => objects::unchanged(stored),
    }];
    ops.extend(more);
    match context.store.apply(ops).await {
        Ok(_) => {
            tell(context, set, plan, &work.kept_out);
            Ok(outcome)
        }
        Err(error) if objects::is_race(&error) => {
            tracing::debug!(set = %stored.key, %error, "a look at a task set came too late");
            Ok(Outcome::Raced)
        }
        Err(error) => Err(error),
    }
}

/// Whether tasks of the set could not be created, as in Kubernetes: there while it is so.
fn say_failure(status: &mut TaskSetStatus, why: Option<&str>, now: Timestamp) {
    let Some(why) = why else {
        status.conditions.retain(|c| c.r#type != REPLICA_FAILURE);
        return;
    };
    let condition = Condition::new(REPLICA_FAILURE, ConditionStatus::True, "FailedCreate", why);
    set_condition(&mut status.conditions, condition, &Time(now));
}

/// A template's spec with the place of a task of it.
pub(crate) fn spec_at(
    set: &TaskSetSpec,
    name: &str,
    new: &NewTask,
    mut spec: TaskSpec,
) -> TaskSpec {
    let placement = &mut spec.placement;
    match &new.place {
        Place::Anywhere => {}
        Place::Prefer(node) => placement.prefer = Some(node.clone()),
        Place::Only(node) => {
            placement.node = Some(node.clone());
            placement.prefer = new.follows.then(|| node.clone());
        }
    }
    if set.spread && !set.every_node {
        placement.apart.get_or_insert_with(|| name.to_owned());
    }
    spec
}

/// What operations are made of.
struct Work<'a> {
    context: &'a Context,
    stored: &'a Stored,
    set: &'a TaskSet,
    /// Of new tasks, through their namespace's quota; kept until the commit.
    passes: Vec<Pass>,
    /// New tasks that cannot be created for now, and why: the quota, a ring of dependencies.
    kept_out: BTreeMap<String, String>,
}

impl Work<'_> {
    fn operations(&mut self, plan: &Plan) -> Result<Vec<Op>, Stop> {
        let mut ops = Vec::new();
        let mut creates = false;
        for action in &plan.actions {
            match action {
                Action::CreateRevision { name, number } => {
                    creates = true;
                    ops.push(self.new_revision(name, *number)?);
                }
                Action::Renumber { name, number } => {
                    ops.push(self.revision(name, |revision| {
                        revision.spec.revision = *number;
                        !self.is_anothers(&revision.metadata)
                    })?);
                }
                Action::AdoptRevision { name } => {
                    ops.push(self.revision(name, |r| {
                        let may = self.owner().may_adopt(&r.metadata);
                        self.owner().own(&mut r.metadata);
                        may
                    })?);
                }
                Action::DeleteRevision { name } => {
                    let present = self.get(&self.revision_key(name))?;
                    let revision: TaskSetRevision = objects::read(&present).ok_or(Stop::Raced)?;
                    if self.is_anothers(&revision.metadata) {
                        return Err(Stop::Raced);
                    }
                    ops.push(Op::remove(present.key.clone(), present.revision));
                }
                Action::Adopt { task } => ops.push(self.task(task, |t| {
                    let may = self.owner().may_adopt(&t.metadata);
                    self.owner().own(&mut t.metadata);
                    may
                })?),
                Action::Release { task } => {
                    ops.push(self.task(task, |t| {
                        let is_ours = self.owner().controls(&t.metadata);
                        self.owner().disown(&mut t.metadata);
                        is_ours
                    })?);
                }
                Action::Create(new) => {
                    let made = self.new_task(new, plan)?;
                    creates |= made.is_some();
                    ops.extend(made);
                }
                Action::Delete { task, .. } => ops.extend(self.deletion(task)?),
            }
        }
        if creates {
            ops.extend(namespace_guard(self.context, TASKS, self.namespace())?);
        }
        Ok(ops)
    }

    fn is_known(&self, node: &str) -> bool {
        let (Some(live), Ok(node)) = (self.context.live(), NodeName::new(node)) else {
            return true;
        };
        live.sessions.is_known(&node)
    }

    fn namespace(&self) -> &str {
        self.stored.key.namespace().unwrap_or_default()
    }

    fn task_key(&self, name: &str) -> Key {
        Key::namespaced(TASKS, self.namespace(), name)
    }

    fn revision_key(&self, name: &str) -> Key {
        Key::namespaced(REVISIONS, self.namespace(), name)
    }

    fn get(&self, key: &Key) -> Result<Arc<Stored>, Stop> {
        self.context.store.get(key).ok_or(Stop::Raced)
    }

    fn owner(&self) -> Owner<'_> {
        Owner { context: self.context, stored: self.stored, kind: "TaskSet" }
    }

    /// Names pass from one object to another: only what the set controls is ended.
    fn is_ours(&self, metadata: &ObjectMeta) -> Result<(), Stop> {
        if self.owner().controls(metadata) { Ok(()) } else { Err(Stop::Raced) }
    }

    /// Neither the set's nor to be taken in by it.
    fn is_anothers(&self, metadata: &ObjectMeta) -> bool {
        !self.owner().controls(metadata) && !self.owner().may_adopt(metadata)
    }

    /// Changed, unless `change` says that it is another's.
    fn task(&self, name: &str, change: impl FnOnce(&mut Task) -> bool) -> Result<Op, Stop> {
        let present = self.get(&self.task_key(name))?;
        let mut task: Task = objects::read(&present).ok_or(Stop::Raced)?;
        if !change(&mut task) {
            return Err(Stop::Raced);
        }
        Ok(objects::replace(&present, &task))
    }

    fn revision(
        &self,
        name: &str,
        change: impl FnOnce(&mut TaskSetRevision) -> bool,
    ) -> Result<Op, Stop> {
        let present = self.get(&self.revision_key(name))?;
        let mut revision: TaskSetRevision = objects::read(&present).ok_or(Stop::Raced)?;
        if !change(&mut revision) {
            return Err(Stop::Raced);
        }
        Ok(objects::replace(&present, &revision))
    }

    fn new_revision(&self, name: &str, number: u64) -> Result<Op, Stop> {
        let template = self.set.spec.template.clone();
        let mut revision =
            TaskSetRevision::new(name, TaskSetRevisionSpec { revision: number, template });
        let set = self.stored.key.name.to_string();
        let metadata = &mut revision.metadata;
        metadata.namespace = Some(self.namespace().to_owned());
        metadata.labels = Some([(SET_LABEL.to_owned(), set)].into());
        let notes = self.set.metadata.annotations.as_ref();
        let cause = notes.and_then(|notes| notes.get(CHANGE_CAUSE));
        metadata.annotations = cause.map(|c| [(CHANGE_CAUSE.to_owned(), c.clone())].into());
        self.owner().own(metadata);
        let (op, _) = self.owner().create(self.revision_key(name), &revision)?;
        Ok(op)
    }

    /// None: it is refused. Those that are not are made all the same.
    fn new_task(&mut self, new: &NewTask, plan: &Plan) -> Result<Option<Op>, Stop> {
        let template = self.template(&new.revision, plan)?;
        let set = &*self.stored.key.name;
        let labels = template.labels(set, &new.revision);
        let TaskTemplate { metadata, spec } = template;
        let mut task = Task::new(&new.name, spec_at(&self.set.spec, set, new, spec));
        task.metadata.namespace = Some(self.namespace().to_owned());
        task.metadata.labels = Some(labels);
        task.metadata.annotations = Some(metadata.annotations).filter(|notes| !notes.is_empty());
        self.owner().own(&mut task.metadata);
        let refusal = match self.owner().create(self.task_key(&new.name), &task) {
            Ok((op, Ok(pass))) => {
                self.passes.extend(pass);
                return Ok(Some(op));
            }
            Ok((_, Err(refusal))) | Err(refusal) => refusal,
        };
        self.kept_out.insert(new.name.clone(), refusal.message().to_owned());
        Ok(None)
    }

    /// That of the set itself, when the revision is the one that this plan keeps it as.
    fn template(&self, revision: &str, plan: &Plan) -> Result<TaskTemplate, Stop> {
        if revision == plan.status.update_revision {
            return Ok(self.set.spec.template.clone());
        }
        let present = self.get(&self.revision_key(revision))?;
        let revision: TaskSetRevision = objects::read(&present).ok_or(Stop::Raced)?;
        Ok(revision.spec.template)
    }

    /// The end of a task; it passes only while its node is not locked.
    fn deletion(&self, name: &str) -> Result<Vec<Op>, Stop> {
        let present = self.get(&self.task_key(name))?;
        let task: Task = objects::read(&present).ok_or(Stop::Raced)?;
        self.is_ours(&task.metadata)?;
        let mut ops = vec![delete::operation(self.context.clock.now(), &present)];
        let status = task.status.unwrap_or_default();
        let node = status.node.filter(|_| !status.phase.is_terminal());
        if let Some(node) = node.and_then(|n| self.context.store.get(&objects::node_key(&n))) {
            let Some(object) = objects::read::<Node>(&node) else { return Err(Stop::Raced) };
            if object.mission_lock().is_some() {
                return Err(Stop::Raced);
            }
            // One that is silent for longer is not ready; what it says then is heard before its tasks end.
            if object.status.is_some_and(|status| status.is_ready())
                && !self.is_known(&node.key.name)
            {
                return Err(Stop::Away);
            }
            ops.push(objects::unchanged(&node));
        }
        Ok(ops)
    }
}

/// Puts into Events what a plan did.
fn tell(context: &Context, set: &TaskSet, plan: &Plan, kept_out: &BTreeMap<String, String>) {
    // Once for as long as it is the same; which tasks they are, the next looks show.
    let known = set.status.as_ref().and_then(|status| status.condition(REPLICA_FAILURE));
    let news = kept_out.values().next().filter(|why| known.is_none_or(|c| c.message != **why));
    if let Some(why) = news {
        context.events.warn_set(set, "FailedCreate", why.clone());
    }
    for action in &plan.actions {
        match action {
            Action::Create(new) if kept_out.contains_key(&new.name) => {}
            Action::Create(new) => {
                context.events.set(
                    set,
                    "Created",
                    format!("task {} of {}", new.name, new.revision),
                );
            }
            Action::Delete { task, why } => {
                context.events.set(set, "Ended", format!("task {task}: {why}"));
            }
            Action::Adopt { task } => context.events.set(set, "Adopted", format!("task {task}")),
            Action::Release { task } => context.events.set(set, "Released", format!("task {task}")),
            Action::CreateRevision { .. }
            | Action::Renumber { .. }
            | Action::AdoptRevision { .. }
            | Action::DeleteRevision { .. } => {}
        }
    }
    for news in &plan.news {
        match news {
            News::RolledBack { from, to, task, fault } => {
                tracing::warn!(set = set.metadata.name, from, to, task, %fault, "rolled back");
                let message = format!("{from} is given up for {to}: task {task} {fault}");
                context.events.warn_set(set, "RolledBack", message);
            }
            News::RolledOut { revision } => {
                context.events.set(set, "RolledOut", format!("all are of {revision}"));
            }
        }
    }
}
