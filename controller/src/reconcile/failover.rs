//! Frameworks that are away: what they have stays until their failover timeout has passed, then they are removed, and the
//! collector of garbage ends their tasks. Only time counts in which they could have come back: none of it passes while no
//! controller runs.
//!
//! Also: a framework that is gone acknowledges nothing any more, so its tasks lose the finalizer that waits for it; and the
//! numbers in Framework status are brought up to date here, a few seconds late.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use futures::future::try_join_all;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use muster_api::kind::framework::Framework;
use muster_controller_core::node_health::Monotonic;
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::desk::{Depth, View};
use crate::context::Context;
use crate::objects::{self, FRAMEWORKS};
use crate::session::frameworks::{Frameworks, let_go, write_presence};
use crate::store::{Key, StoreError, Stored};

/// How often everything is looked at. A failover timeout is exact to this; the numbers are as old as this.
const EVERY: Duration = Duration::from_secs(1);
/// A changed share is written when it differs by this: a number that moves with every task would write without end.
const SHARE_STEP: f64 = 0.01;

/// What a framework that was connected to an earlier life of the controller has to come back, however short its failover
/// timeout is: it was not the framework that went away. SDKs wait up to 10 s between two attempts.
const RETURN_WITHIN: Duration = Duration::from_secs(20);

/// Frameworks without a session, and since when this controller has seen each so. The wall clock may be set, and counts the
/// time in which nobody could have come back.
#[derive(Debug, Default)]
struct Absences {
    since: HashMap<Box<str>, (Option<MicroTime>, Monotonic)>,
    /// Had a session in this life of the controller.
    known: HashSet<Box<str>>,
}

impl Absences {
    fn is_here(&mut self, uid: &str) {
        self.since.remove(uid);
        if !self.known.contains(uid) {
            self.known.insert(uid.into());
        }
    }

    /// The framework is away since it left at `left`, by its object. Whether that is for longer than `timeout`.
    fn is_over(
        &mut self,
        uid: &str,
        left: Option<MicroTime>,
        (timeout, now): (Duration, Monotonic),
    ) -> bool {
        let since = match self.since.get(uid) {
            Some((known, since)) if *known == left => *since,
            // It was here in between.
            _ => {
                self.since.insert(uid.into(), (left, now));
                now
            }
        };
        let least = if self.known.contains(uid) { Duration::ZERO } else { RETURN_WITHIN };
        now.saturating_sub(since) >= timeout.max(least)
    }

    fn keep_only(&mut self, present: &BTreeSet<Box<str>>) {
        self.since.retain(|uid, _| present.contains(uid));
        self.known.retain(|uid| present.contains(uid));
    }
}

/// Works until dropped.
pub async fn run(context: Arc<Context>, frameworks: Arc<Frameworks>) {
    let mut tick = interval(EVERY);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut absences, started) = (Absences::default(), Instant::now());
    loop {
        tick.tick().await;
        if let Err(error) = look(&context, &frameworks, (&mut absences, started.elapsed())).await {
            // The next look does it again.
            tracing::warn!(error = crate::app::chain(&error), "frameworks are not looked after");
        }
    }
}

async fn look(
    context: &Context,
    frameworks: &Frameworks,
    (absences, now): (&mut Absences, Monotonic),
) -> Result<(), StoreError> {
    // Before the objects: who is at the desk and has no object then has none any more.
    let views = frameworks.look(Depth::Numbers).await;
    let mut present: BTreeSet<Box<str>> = BTreeSet::new();
    for stored in context.store.list(FRAMEWORKS, None).items {
        let Some(object) = objects::read::<Framework>(&stored) else { continue };
        present.insert(stored.uid.clone());
        let status = object.status.clone().unwrap_or_default();
        let connected = frameworks.is_connected(&stored.uid);
        if status.connected != connected {
            // Its session ended with an earlier life of the controller, or what it is could not be written.
            write_presence(frameworks, &stored.key, &stored.uid).await?;
        }
        let timeout = object.spec.failover_timeout.0.as_duration();
        if connected {
            absences.is_here(&stored.uid);
        } else if !status.connected
            && absences.is_over(&stored.uid, status.disconnected_at, (timeout, now))
        {
            end(context, &stored, timeout).await;
        }
    }
    absences.keep_only(&present);
    let tasks = frameworks.roster().holding();
    let key =
        |view: &View| Key::namespaced(FRAMEWORKS, view.namespace.as_str(), view.name.as_str());
    let (there, gone): (Vec<&View>, Vec<&View>) =
        views.iter().partition(|view| present.contains(&*view.uid));
    // Together: each waits for the disk.
    try_join_all(there.into_iter().map(|view| {
        let held = tasks.get(&view.uid).copied().unwrap_or_default();
        write_view(context, key(view), view, held)
    }))
    .await?;
    for view in gone {
        tracing::info!(framework = %key(view), "framework is gone");
        frameworks.cut(&view.uid);
        frameworks.remove(&view.uid).await;
    }
    let orphans = frameworks.roster().orphans(|uid| present.contains(uid));
    if orphans.is_empty() {
        return Ok(());
    }
    // Looked at again after the tasks: a framework that came meanwhile may have launched some already.
    let items = context.store.list(FRAMEWORKS, None).items;
    let present: BTreeSet<&str> = items.iter().map(|stored| stored.uid.as_ref()).collect();
    for (key, uid, framework) in orphans {
        // Nobody is left to acknowledge its end.
        if framework.is_none_or(|framework| !present.contains(&*framework)) {
            let_go(&context.store, &key, &uid).await?;
        }
    }
    Ok(())
}

/// Removes a framework that stayed away, if it is as it was looked at.
async fn end(context: &Context, stored: &Stored, timeout: Duration) {
    let framework = &stored.key;
    match crate::rest::delete::delete_as_seen(context, stored).await {
        Ok(()) => {
            tracing::info!(%framework, ?timeout, "framework did not come back; its tasks are ended");
        }
        // It is gone, or is back: what was looked at is not so any more.
        Err(failure) if matches!(failure.code(), 404 | 409) => {}
        Err(failure) => {
            tracing::warn!(%framework, error = failure.message(), "a lost framework is not removed yet");
        }
    }
}

async fn write_view(
    context: &Context,
    key: Key,
    view: &View,
    tasks: u32,
) -> Result<(), StoreError> {
    let offers = u32::try_from(view.offered).unwrap_or(u32::MAX);
    objects::change_watched(&context.store, &key, |stored, mut object: Framework| {
        let status = object.status.get_or_insert_default();
        let same = status.offers == offers
            && status.tasks == tasks
            && status.suppressed == view.suppressed
            && (status.share - view.share).abs() < SHARE_STEP;
        if same || *stored.uid != *view.uid {
            return None;
        }
        (status.offers, status.tasks) = (offers, tasks);
        (status.suppressed, status.share) = (view.suppressed, view.share);
        Some(vec![objects::replace(stored, &object)])
    })
    .await
    .map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn at(second: i64) -> Option<MicroTime> {
        Some(MicroTime(jiff::Timestamp::from_second(second).expect("a time")))
    }

    #[test]
    fn an_absence_counts_from_when_this_controller_has_seen_it() {
        let mut absences = Absences::default();
        let hour = 3600 * SECOND;
        // It left long ago, by the wall clock, and was here in this life.
        absences.is_here("a");
        assert!(!absences.is_over("a", at(5), (3 * SECOND, hour)));
        assert!(!absences.is_over("a", at(5), (3 * SECOND, hour + 2 * SECOND)));
        assert!(absences.is_over("a", at(5), (3 * SECOND, hour + 3 * SECOND)));
        // It was back for less than a look.
        assert!(!absences.is_over("a", at(6), (3 * SECOND, hour + 4 * SECOND)));
        absences.is_here("a");
        assert!(!absences.is_over("a", at(6), (3 * SECOND, hour + 9 * SECOND)));
    }

    #[test]
    fn who_was_connected_to_an_earlier_controller_has_time_to_come_back() {
        let mut absences = Absences::default();
        let short = Duration::from_millis(200);
        assert!(!absences.is_over("a", at(5), (short, SECOND)));
        assert!(!absences.is_over("a", at(5), (short, RETURN_WITHIN)));
        assert!(absences.is_over("a", at(5), (short, SECOND + RETURN_WITHIN)));
        // One that never wrote when it left is removed, too.
        assert!(!absences.is_over("never", None, (30 * SECOND, SECOND)));
        assert!(absences.is_over("never", None, (30 * SECOND, 31 * SECOND)));
        absences.keep_only(&BTreeSet::from(["never".into()]));
        assert!(!absences.is_over("a", at(5), (short, 60 * SECOND)), "it is another life's");
    }
}
