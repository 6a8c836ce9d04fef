//! Level-triggered loops: each looks at what is and does what is missing. None depends on having
//! seen an event; after a restart each begins by looking at everything. One that panics ends the process.
//!
//! | loop | looks at | does |
//! |---|---|---|
//! | [`schedule`] | Nodes, Tasks, Leases, ConfigMaps, Secrets | binds Pending tasks, orders ends to make room, or writes why not |
//! | [`deadline`] | Tasks with deadlines | orders the end of those that have run long enough, removes those that ended long ago |
//! | [`radius`] | live poses, Tasks with a radius | ends those whose robot has left |
//! | [`reschedule`] | Tasks that have failed | puts new ones in their place, for another node |
//! | [`desk`] | frameworks, in [`schedule`]'s own task | shows offers, takes Accepts |
//! | [`failover`] | Frameworks | removes those that stay away, writes their numbers |
//! | `moves` | live poses, in [`schedule`]'s own task | puts robots where they are |
//! | [`checkpoints`] | live poses | writes them into Node status, coarsely |
//! | [`books`] | the scheduler's ledger | writes used, free and leases into Node status |
//! | [`quotas`] | the scheduler's ledger | writes what namespaces have into Quota status |
//! | [`health`] | heartbeats | marks silent nodes and their tasks |
//! | [`taskset`] | TaskSets, their tasks, nodes | begins and ends tasks, changes them, goes back |
//! | [`application`] | Applications, their tasks, nodes, what is measured | begins and ends the tasks of parts, moves them |
//! | [`upkeep`] | Nodes with batteries and maintenance windows | says when nothing new begins there, ends what is to be gone |
//! | [`orders`] | Nodes | tells their agents of emergency stops |
//! | [`images`] | TaskSets | tells agents which images rollouts want on their nodes |
//! | [`deletion`] | Tasks being deleted | removes those whose processes are gone |
//! | [`garbage`] | ownerReferences | deletes what lost its owner |
//! | [`history`] | Events, the store's history | forgets what is old |

pub mod application;
mod bind;
pub mod books;
pub mod checkpoints;
pub mod deadline;
pub mod deletion;
pub mod desk;
pub mod failover;
pub mod garbage;
pub mod health;
pub mod history;
pub mod images;
mod moves;
pub mod orders;
pub(crate) mod owned;
mod preempt;
pub mod quotas;
pub mod radius;
pub mod reschedule;
pub mod schedule;
pub mod taskset;
pub mod upkeep;

use std::sync::Arc;
use std::time::Duration;

use tokio_util::task::TaskTracker;

use crate::app::guard;
use crate::context::Context;
use crate::session::Sessions;
use crate::session::frameworks::{Frameworks, updates};
use crate::session::poses::{self, LivePoses};
use crate::store::{Store, StoreError, WatchEnd, WatchError, Watcher};

/// How long a loop waits after the store failed before it tries again. Commits fail when the disk
/// is full or broken; trying faster only fills the log.
const RETRY: Duration = Duration::from_secs(1);

/// What the rest of the controller may ask the loops.
#[derive(Debug, Clone)]
pub struct Reconcilers {
    /// Questions to the scheduler.
    pub scheduler: schedule::Handle,
}

/// Starts every loop; each ends when `context.stop` is cancelled.
pub fn spawn(
    context: &Arc<Context>,
    sessions: &Arc<Sessions>,
    poses: &Arc<LivePoses>,
    tasks: &TaskTracker,
) -> Reconcilers {
    let books = Arc::new(books::Books::default());
    let counts = Arc::new(quotas::Counts::default());
    let written = (Arc::clone(&books), Arc::clone(&counts));
    let (scheduler, handle) =
        schedule::Scheduler::new(Arc::clone(context), written, Arc::clone(poses));
    let loops = context.stop.clone();
    let run = |name: &'static str, work: std::pin::Pin<Box<dyn Future<Output = ()> + Send>>| {
        let stop = loops.clone();
        tasks.spawn(guard(Arc::clone(context), name, async move {
            tokio::select! {
                () = stop.cancelled() => {}
                () = work => tracing::debug!(name, "loop ended"),
            }
        }));
    };
    run("schedule", Box::pin(scheduler.run()));
    run("books", Box::pin(books::run(Arc::clone(context), books)));
    run("quotas", Box::pin(quotas::run(Arc::clone(context), counts)));
    run("health", Box::pin(health::run(Arc::clone(context), Arc::clone(sessions))));
    run("deadline", Box::pin(deadline::run(Arc::clone(context))));
    run("radius", Box::pin(radius::run(Arc::clone(context), Arc::clone(poses))));
    run("reschedule", Box::pin(reschedule::run(Arc::clone(context))));
    run("deletion", Box::pin(deletion::run(Arc::clone(context))));
    run("garbage", Box::pin(garbage::run(Arc::clone(context))));
    run("taskset", Box::pin(taskset::run(Arc::clone(context))));
    run("application", Box::pin(application::run(Arc::clone(context))));
    run("upkeep", Box::pin(upkeep::run(Arc::clone(context))));
    run("orders", Box::pin(orders::run(Arc::clone(context), Arc::clone(sessions))));
    run("images", Box::pin(images::run(Arc::clone(context), Arc::clone(sessions))));
    run("history", Box::pin(history::run(Arc::clone(context))));
    run("board", Box::pin(crate::session::board::run(Arc::clone(context), Arc::clone(sessions))));
    run("poses", Box::pin(poses::run(Arc::clone(context), Arc::clone(poses))));
    run("checkpoints", Box::pin(checkpoints::run(Arc::clone(context), Arc::clone(poses))));
    Reconcilers { scheduler: handle }
}

/// Starts the loops that look after frameworks; they end as the others.
pub fn spawn_for_frameworks(
    context: &Arc<Context>,
    frameworks: &Arc<Frameworks>,
    tasks: &TaskTracker,
) {
    let failover = failover::run(Arc::clone(context), Arc::clone(frameworks));
    let updates = updates::run(Arc::clone(context), Arc::clone(frameworks));
    let failover = context.stop.clone().run_until_cancelled_owned(failover);
    tasks.spawn(guard(Arc::clone(context), "failover", failover));
    let updates = context.stop.clone().run_until_cancelled_owned(updates);
    tasks.spawn(guard(Arc::clone(context), "updates", updates));
}

/// Follows the store, again each time when `follow` ends because it must begin anew; when the store failed, after a
/// moment, and it is said in `words` what is not done meanwhile.
pub(crate) async fn again(
    context: &Context,
    words: &'static str,
    follow: impl AsyncFn(&Context) -> Result<(), StoreError>,
) {
    loop {
        if let Err(error) = follow(context).await {
            tracing::warn!(error = crate::app::chain(&error), "{words}");
            tokio::time::sleep(RETRY).await;
        }
    }
}

/// The next changes of a watcher, or none when it must begin anew: it fell behind, and only a look
/// at everything tells what it missed. Pending for ever when the store is shutting down.
pub(crate) async fn next_events(watcher: &mut Watcher) -> Option<Vec<crate::store::Event>> {
    match watcher.next().await {
        Ok(events) => Some(events),
        Err(WatchEnd::Expired(_)) => None,
        Err(WatchEnd::Closed) => std::future::pending().await,
    }
}

/// A watcher of everything from now. The caller lists after this call, so that nothing falls
/// between; it sees some changes twice.
pub(crate) async fn watch_from_now(store: &Store) -> Watcher {
    loop {
        match store.watch_all(store.revision()) {
            Ok(watcher) => return watcher,
            // Compaction may pass the revision between the two calls.
            Err(WatchError::Expired(_) | WatchError::Ahead { .. }) => {
                tokio::task::yield_now().await
            }
        }
    }
}
