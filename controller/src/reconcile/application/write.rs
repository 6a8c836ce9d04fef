//! A plan as one transaction, and what people are told when it is done.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use muster_api::condition::{Condition, set_condition};
use muster_api::duration::Span;
use muster_api::kind::application::{APPLICATION_LABEL, Application, PART_LABEL};
use muster_api::kind::task::{DisconnectPolicy, OnDisconnect, Standby, Task};
use muster_controller_core::offload::run::{Action, NewTask, News, Plan};

use crate::context::Context;
use crate::objects::{self, TASKS};
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
    /// Tasks of these names are not let in; nothing is written. Without them the rest can go on.
    Refused(BTreeMap<String, String>),
}

/// Why a plan has no operations.
enum Stop {
    Raced,
    Refused(BTreeMap<String, String>),
}

pub(super) async fn carry_out(
    context: &Context,
    stored: &Arc<Stored>,
    application: &Application,
    plan: &Plan,
) -> Result<Outcome, StoreError> {
    let owner = Owner { context, stored, kind: "Application" };
    let mut work = Work { owner, application, passes: Vec::new() };
    let more = match work.operations(plan) {
        Ok(more) => more,
        Err(Stop::Raced) => return Ok(Outcome::Raced),
        Err(Stop::Refused(tasks)) => return Ok(Outcome::Refused(tasks)),
    };
    let mut status = plan.status.clone();
    for said in &plan.conditions {
        let (holds, message) = (said.holds, said.message.clone());
        let condition = Condition::new(said.condition, holds, said.reason, message);
        set_condition(&mut status.conditions, condition, &Time(context.clock.now()));
    }
    let same = application.status.as_ref() == Some(&status);
    if same && more.is_empty() {
        return Ok(Outcome::Done);
    }
    // Everything holds only while the application is what the plan was made for.
    let mut ops = vec![match same {
        false => Op::status(stored, &Some(status)),
        true => objects::unchanged(stored),
    }];
    ops.extend(more);
    match context.store.apply(ops).await {
        Ok(_) => {
            tell(context, application, plan);
            Ok(Outcome::Done)
        }
        Err(error) if objects::is_race(&error) => {
            tracing::debug!(application = %stored.key, %error, "a look at an application came too late");
            Ok(Outcome::Raced)
        }
        Err(error) => Err(error),
    }
}

/// What operations are made of.
struct Work<'a> {
    owner: Owner<'a>,
    application: &'a Application,
    /// Of new tasks, through their namespace's quota; kept until the commit.
    passes: Vec<Pass>,
}

impl Work<'_> {
    fn operations(&mut self, plan: &Plan) -> Result<Vec<Op>, Stop> {
        let (mut ops, mut refused) = (Vec::new(), BTreeMap::new());
        for action in &plan.actions {
            match action {
                Action::Create(new) => match self.new_task(new) {
                    Ok(op) => ops.push(op),
                    Err(why) => {
                        refused.insert(new.name.clone(), why.message().to_owned());
                    }
                },
                Action::Release { task } => ops.push(self.release(task)?),
                Action::Delete { task, .. } => {
                    let present = self.owner.context.store.get(&self.key(task));
                    let present = present.ok_or(Stop::Raced)?;
                    let task: Task = objects::read(&present).ok_or(Stop::Raced)?;
                    self.is_ours(&task)?;
                    ops.push(delete::operation(self.owner.context.clock.now(), &present));
                }
            }
        }
        if !refused.is_empty() {
            return Err(Stop::Refused(refused));
        }
        if plan.actions.iter().any(|action| matches!(action, Action::Create(_))) {
            let guard = namespace_guard(self.owner.context, TASKS, self.owner.namespace());
            // The namespace ends, and the application with it.
            ops.extend(guard.map_err(|_| Stop::Raced)?);
        }
        Ok(ops)
    }

    fn key(&self, task: &str) -> Key {
        Key::namespaced(TASKS, self.owner.namespace(), task)
    }

    /// Names pass from one object to another.
    fn is_ours(&self, task: &Task) -> Result<(), Stop> {
        if self.owner.controls(&task.metadata) { Ok(()) } else { Err(Stop::Raced) }
    }

    fn release(&self, name: &str) -> Result<Op, Stop> {
        let present = self.owner.context.store.get(&self.key(name)).ok_or(Stop::Raced)?;
        let mut task: Task = objects::read(&present).ok_or(Stop::Raced)?;
        self.is_ours(&task)?;
        task.spec.standby = None;
        task.metadata.generation = task.metadata.generation.map(|generation| generation + 1);
        Ok(objects::replace(&present, &task))
    }

    fn new_task(&mut self, new: &NewTask) -> Result<Op, Failure> {
        let part = self.application.spec.part(&new.part);
        let template = part.expect("tasks are begun for parts of the spec").template.clone();
        let mut spec = template.spec;
        spec.placement.node = Some(new.node.clone());
        let whole = |after: Duration| {
            Span::from_millis(u64::try_from(after.as_millis()).unwrap_or(u64::MAX))
        };
        spec.standby = new.standby.map(|after| Standby { after: whole(after) });
        if let Some(after) = new.stop_after {
            let own = spec.stop_after_disconnect().map(|span| span.as_duration());
            let after = own.map_or(after, |own| own.min(after));
            let policy = DisconnectPolicy::Stop;
            spec.on_disconnect = Some(OnDisconnect { policy, after: Some(whole(after)) });
        }
        let mut task = Task::new(&new.name, spec);
        let mut labels = template.metadata.labels;
        labels.insert(APPLICATION_LABEL.to_owned(), self.owner.stored.key.name.to_string());
        labels.insert(PART_LABEL.to_owned(), new.part.clone());
        let notes = template.metadata.annotations;
        task.metadata.namespace = Some(self.owner.namespace().to_owned());
        task.metadata.labels = Some(labels);
        task.metadata.annotations = Some(notes).filter(|notes| !notes.is_empty());
        self.owner.own(&mut task.metadata);
        let (op, pass) = self.owner.create(self.key(&new.name), &task)?;
        self.passes.extend(pass?);
        Ok(op)
    }
}

/// Puts into Events what a plan did.
fn tell(context: &Context, app: &Application, plan: &Plan) {
    for action in &plan.actions {
        if let Action::Delete { task, why } = action {
            context.events.application(app, "Ended", format!("task {task}: {why}"));
        }
    }
    for news in &plan.news {
        match news {
            News::Begun { task, node } => {
                context.events.application(app, "Begun", format!("task {task} on {node}"));
            }
            News::Moving { part, from, to, message } => {
                let message = format!("{part} from {from} to {to}: {message}");
                context.events.application(app, "Moving", message);
            }
            News::Moved { part, to, message } => {
                tracing::info!(application = app.metadata.name, part, to, message, "moved");
                context.events.application(app, "Moved", format!("{part} serves on {to}"));
            }
            News::Alone { part, task } => {
                let message = format!("{part}: its robot was cut off, and began {task} by itself");
                context.events.warn_application(app, "Alone", message);
            }
            News::Aborted { part, to, why } => {
                let message = format!("the move of {part} to {to} was given up: {why}");
                context.events.warn_application(app, "MoveAborted", message);
            }
        }
    }
}
