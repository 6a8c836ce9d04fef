//! Ends tasks whose robot has left their radius, where they ask for it (`placement.onOutOfRange: Reschedule`).
//!
//! Which tasks those are comes from the store, where their robots are from the live poses: see
//! [`muster_controller_core::radius`]. Robots are looked at a few times a second while there is such a task. What follows
//! the end is [`super::reschedule`]'s, or the TaskSet's or the framework's.

use std::collections::BTreeMap;
use std::sync::Arc;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use muster_api::kind::node::MissionLock;
use muster_api::kind::task::reschedule::OUT_OF_RANGE;
use muster_api::kind::task::{OutOfRange, StopOrder, Task};
use muster_controller_core::radius::{LOOK_EVERY, Left, Radius, Rim, Seen};
use tokio::time::{MissedTickBehavior, interval};

use super::{RETRY, next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, Locked, TASKS};
use crate::session::poses::LivePoses;
use crate::store::{Change, Key, StoreError, Stored};

/// A task that runs on a robot and is to end when that leaves.
#[derive(Debug)]
struct Placed {
    uid: Box<str>,
    node: String,
    radius: Radius,
    rim: Rim,
    /// It was said that a mission keeps it there.
    told: bool,
}

impl Placed {
    fn of(stored: &Stored) -> Option<Placed> {
        let task = objects::read::<Task>(stored)?;
        let placement = &task.spec.placement;
        let status = task.status.as_ref()?;
        let asks = placement.on_out_of_range == OutOfRange::Reschedule;
        let ending = status.stop.is_some() || task.metadata.deletion_timestamp.is_some();
        if !asks || ending || !status.phase.holds_node() {
            return None;
        }
        Some(Placed {
            uid: stored.uid.clone(),
            node: status.node.clone()?,
            radius: Radius { at: placement.at.clone()?, within: placement.within? },
            rim: Rim::default(),
            told: false,
        })
    }
}

/// Works until dropped.
pub async fn run(context: Arc<Context>, poses: Arc<LivePoses>) {
    loop {
        if let Err(error) = follow(&context, &poses).await {
            tracing::warn!(
                error = crate::app::chain(&error),
                "robots that leave are not looked after"
            );
            tokio::time::sleep(RETRY).await;
        }
    }
}

/// Looks at every task, then at what changes and where robots are; ends when it must begin anew.
async fn follow(context: &Context, poses: &LivePoses) -> Result<(), StoreError> {
    let mut watcher = watch_from_now(&context.store).await;
    let mut placed: BTreeMap<Key, Placed> = BTreeMap::new();
    for stored in context.store.list(TASKS, None).items {
        take_in(Change::Put, &stored, &mut placed);
    }
    let mut tick = interval(LOOK_EVERY);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            // Cancel safe: events that were not returned are returned by the next call.
            events = next_events(&mut watcher) => {
                let Some(events) = events else { return Ok(()) };
                for event in events.iter().filter(|e| e.object.key.resource == TASKS) {
                    take_in(event.change, &event.object, &mut placed);
                }
            }
            // Cancel safe: a tick that was not returned stays.
            _ = tick.tick(), if !placed.is_empty() => {
                for (key, task) in &mut placed {
                    if let Some(left) = look(poses, task) {
                        end(context, key, task, &left).await?;
                    }
                }
            }
        }
    }
}

fn take_in(change: Change, stored: &Stored, placed: &mut BTreeMap<Key, Placed>) {
    let concerns = change == Change::Put && stored.mentions("onOutOfRange");
    match concerns.then(|| Placed::of(stored)).flatten() {
        // Its status changed, and where its robot was meanwhile still counts.
        Some(new) => match placed.get_mut(&stored.key) {
            Some(known) if known.uid == new.uid && known.node == new.node => {}
            _ => drop(placed.insert(stored.key.clone(), new)),
        },
        None => drop(placed.remove(&stored.key)),
    }
}

fn look(poses: &LivePoses, task: &mut Placed) -> Option<Left> {
    let now = poses.now();
    let Placed { node, radius, rim, .. } = task;
    poses
        .get(node, |known| {
            let seen = known.pose.zip(known.heard);
            rim.look(radius, seen.map(|(pose, heard)| Seen { pose, heard }), now)
        })
        .flatten()
}

/// Orders the end, unless the robot is on a mission at that moment.
async fn end(
    context: &Context,
    key: &Key,
    placed: &mut Placed,
    left: &Left,
) -> Result<(), StoreError> {
    let (mut ordered, mut kept): (Option<Task>, Option<MissionLock>) = (None, None);
    objects::change_watched(&context.store, key, |stored, mut task: Task| {
        (ordered, kept) = (None, None);
        let status = task.status.as_mut()?;
        let same = stored.uid == placed.uid && status.node.as_deref() == Some(&*placed.node);
        let ending = status.stop.is_some() || task.metadata.deletion_timestamp.is_some();
        if !same || ending || !status.phase.holds_node() {
            return None;
        }
        let unlocked = match objects::unlocked(&context.store, &placed.node) {
            Ok(check) => check,
            Err(Locked::Gone) => return None,
            Err(Locked::By(lock)) => {
                kept = Some(lock);
                return None;
            }
        };
        status.stop = Some(StopOrder {
            reason: OUT_OF_RANGE.to_owned(),
            message: format!("{} {left}", placed.node),
            at: MicroTime(context.clock.now()),
        });
        let op = objects::replace(stored, &task);
        ordered = Some(task);
        Some(vec![op, unlocked])
    })
    .await?;
    if let Some(task) = ordered {
        tracing::info!(task = %key, node = placed.node, %left, "a robot has left");
        context.events.ordered_to_end(&task, OUT_OF_RANGE);
    } else if let Some(lock) = kept
        && !std::mem::replace(&mut placed.told, true)
        && let Some(task) = context.store.get(key).and_then(|stored| objects::read::<Task>(&stored))
    {
        let message = format!(
            "{} {left}; the task stays while {} has the robot's mission lock",
            placed.node, lock.holder
        );
        context.events.warn_task(&task, OUT_OF_RANGE, message);
    }
    Ok(())
}
