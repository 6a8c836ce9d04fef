//! States of tasks → the mailboxes of their frameworks, and the roster; lost nodes and executors → everybody whom they concern.
//!
//! One loop for all frameworks: it reads each change of a framework's task once. What a framework misses while it is away
//! is told when it comes back, from the objects.

use std::collections::HashSet;
use std::sync::Arc;

use muster_api::kind::framework::{ACKNOWLEDGE_FINALIZER, FRAMEWORK_LABEL};
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_api::wire::framework::v1 as wire;

use super::{Frameworks, convert, subscribe};
use crate::context::Context;
use crate::objects::{self, NODES, TASKS};
use crate::reconcile::{next_events, watch_from_now};
use crate::store::{Change, Event};

/// The reason of the Ready condition of a node that is not heard.
const SILENT: &str = "AgentSilent";

/// Works until dropped.
pub async fn run(context: Arc<Context>, frameworks: Arc<Frameworks>) {
    loop {
        let mut watcher = watch_from_now(&context.store).await;
        // After having fallen behind: the present state of everything makes up for what was missed.
        let snapshot = context.store.list(TASKS, None).items;
        let there: HashSet<&str> = snapshot.iter().map(|stored| stored.uid.as_ref()).collect();
        frameworks.roster().keep_only(|uid| there.contains(uid));
        for stored in &snapshot {
            tell(&frameworks, stored, Change::Put);
        }
        while let Some(events) = next_events(&mut watcher).await {
            for event in events.iter().filter(|e| e.object.key.resource == NODES) {
                tell_of_node(&frameworks, event);
            }
            for Event { change, object, .. } in
                events.iter().filter(|e| e.object.key.resource == TASKS)
            {
                tell(&frameworks, object, *change);
            }
        }
    }
}

/// A node that fell silent or is gone, told to everybody once.
fn tell_of_node(frameworks: &Frameworks, event: &Event) {
    let is_silent = |stored: &crate::store::Stored| stored.mentions(SILENT);
    let message = match event.change {
        Change::Delete => "the node was removed",
        Change::Put if !is_silent(&event.object) => return,
        Change::Put if event.previous.as_ref().is_some_and(|p| is_silent(p)) => return,
        Change::Put => "the node cannot be reached; its tasks may still run",
    };
    let lost =
        wire::NodeLost { node: event.object.key.name.to_string(), message: message.to_owned() };
    frameworks.say_to_all(&wire::event::Event::NodeLost(lost));
}

fn tell(frameworks: &Frameworks, stored: &crate::store::Stored, change: Change) {
    if change == Change::Delete {
        frameworks.roster().remove(&stored.uid);
    }
    if !stored.mentions(FRAMEWORK_LABEL) && !stored.mentions(ACKNOWLEDGE_FINALIZER) {
        return;
    }
    let Some(task) = objects::read::<Task>(stored) else { return };
    if change == Change::Put {
        frameworks.roster().put(stored, &task);
    }
    let Some(framework) = subscribe::owner_of(&task.metadata) else { return };
    if change == Change::Put && super::session::is_open(&task) {
        frameworks.put_update(&framework, convert::update(&task, stored.revision));
    }
    let status = task.status.unwrap_or_default();
    let has_ended = change == Change::Delete
        || matches!(status.phase, TaskPhase::Succeeded | TaskPhase::Failed);
    if has_ended && frameworks.forget_executor(stored.uid.as_ref()) {
        let lost = wire::ExecutorLost {
            executor: stored.uid.to_string(),
            node: status.node.unwrap_or_default(),
            exit_code: status.exit_code,
            message: status.message,
        };
        frameworks.say(&framework, wire::event::Event::ExecutorLost(lost));
    }
}
