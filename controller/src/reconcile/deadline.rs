//! Tasks whose time has come: those that have been on their node for `activeDeadlineSeconds` are ordered to end, and
//! objects of those that ended `ttlSecondsAfterFinished` ago are deleted.
//!
//! Each task with such a field has one entry in a queue by time. An entry only says when to look: what is done is decided
//! by the object as it is then, so an entry that is out of date costs a look.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use muster_api::kind::task::{DEADLINE_EXCEEDED, StopOrder, Task};
use muster_api::phase::TaskPhase;
use muster_controller_core::deadline::{Due, due};

use super::{again, next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, TASKS};
use crate::rest::delete;
use crate::store::{Change, Key, StoreError, Stored};

/// When to look at which task.
#[derive(Debug, Default)]
struct Queue {
    by_time: BTreeSet<(Timestamp, Key)>,
    times: HashMap<Key, Timestamp>,
}

impl Queue {
    fn set(&mut self, key: &Key, at: Option<Timestamp>) {
        if let Some(before) = self.times.remove(key) {
            self.by_time.remove(&(before, key.clone()));
        }
        if let Some(at) = at {
            self.times.insert(key.clone(), at);
            self.by_time.insert((at, key.clone()));
        }
    }

    fn take_in(&mut self, change: Change, stored: &Stored) {
        let concerns =
            stored.mentions("activeDeadlineSeconds") || stored.mentions("ttlSecondsAfterFinished");
        let task = (concerns && change == Change::Put).then(|| objects::read::<Task>(stored));
        self.set(&stored.key, task.flatten().as_ref().and_then(due).map(Due::at));
    }

    fn pop(&mut self, now: Timestamp) -> Option<Key> {
        let (_, key) = self.by_time.first().filter(|(at, _)| *at <= now)?.clone();
        self.set(&key, None);
        Some(key)
    }
}

/// Works until dropped.
pub async fn run(context: Arc<Context>) {
    again(&context, "deadlines are not kept yet", follow).await;
}

/// Looks at every task, then at what changes; ends when it must begin anew.
async fn follow(context: &Context) -> Result<(), StoreError> {
    let mut watcher = watch_from_now(&context.store).await;
    let mut queue = Queue::default();
    for stored in context.store.list(TASKS, None).items {
        queue.take_in(Change::Put, &stored);
    }
    loop {
        let now = context.clock.now();
        while let Some(key) = queue.pop(now) {
            act(context, &key, now).await?;
        }
        let next = queue.by_time.first().map(|(at, _)| at.duration_since(now).unsigned_abs());
        let wait = async {
            match next {
                Some(next) => tokio::time::sleep(next).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = wait => {}
            // Cancel safe: events that were not returned are returned by the next call.
            events = next_events(&mut watcher) => {
                let Some(events) = events else { return Ok(()) };
                for event in events.iter().filter(|e| e.object.key.resource == TASKS) {
                    queue.take_in(event.change, &event.object);
                }
            }
        }
    }
}

async fn act(context: &Context, key: &Key, now: Timestamp) -> Result<(), StoreError> {
    let mut stopped = None;
    objects::change_watched(&context.store, key, |stored, mut task: Task| {
        stopped = None;
        match due(&task).filter(|due| due.at() <= now)? {
            Due::Stop(_) => {
                end(&mut task, now);
                let op = objects::replace(stored, &task);
                stopped = Some(task);
                Some(vec![op])
            }
            Due::Remove(_) => Some(vec![delete::operation(now, stored)]),
        }
    })
    .await?;
    if let Some(task) = stopped {
        context.events.ordered_to_end(&task, DEADLINE_EXCEEDED);
    }
    Ok(())
}

/// Orders the end of a task whose time has passed. One that waits for another node has nothing to end: it has Failed.
fn end(task: &mut Task, now: Timestamp) {
    let seconds = task.spec.active_deadline_seconds.unwrap_or_default();
    let status = task.status.get_or_insert_default();
    let place = if status.earlier.is_empty() { "was on its node" } else { "was under way" };
    let stop = StopOrder {
        reason: DEADLINE_EXCEEDED.to_owned(),
        message: format!("{place} for {seconds} s, its activeDeadlineSeconds"),
        at: MicroTime(now),
    };
    if status.phase == TaskPhase::Pending {
        status.phase = TaskPhase::Failed;
        (status.reason, status.message) = (stop.reason.clone(), stop.message.clone());
        status.finished_at = Some(MicroTime(now));
        status.why.clear();
        status.nominated_node = None;
    }
    status.stop = Some(stop);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(text: &str) -> Timestamp {
        text.parse().expect("a time")
    }

    #[test]
    fn the_queue_gives_what_is_due_once() {
        let key = |name: &str| Key::namespaced(TASKS, "default", name);
        let (one, two) = (at("2026-01-01T00:00:01Z"), at("2026-01-01T00:00:02Z"));
        let mut queue = Queue::default();
        queue.set(&key("a"), Some(two));
        queue.set(&key("b"), Some(one));
        queue.set(&key("a"), Some(one));
        queue.set(&key("c"), Some(two));
        assert_eq!(queue.pop(one), Some(key("a")));
        assert_eq!(queue.pop(one), Some(key("b")));
        assert_eq!(queue.pop(one), None);
        queue.set(&key("c"), None);
        assert_eq!(queue.pop(two), None);
    }
}
