//! Keeps the master's knowledge of a node as it should be.
//!
//! Level-triggered. Every second the master is asked whether it knows this node at this address: one that was started
//! anew does not, whatever its process number, and is told everything again. Every tenth round asks for all of it: who
//! publishes what this node subscribes, and whether the master still has what the node publishes.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::{Leaving, Shared, lock};
use crate::master::MasterError;

/// Between two looks. A master that was started anew is found within it.
const EVERY: Duration = Duration::from_secs(1);
/// A look at everything, in rounds that nobody asked for: lost notices are made good within this many seconds.
const WHOLE: u32 = 10;
/// Between two rounds that somebody asked for: a burst of notices is one round.
const BREATH: Duration = Duration::from_millis(10);

/// How it stands with the master.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MasterState {
    /// It was not asked yet.
    Unknown,
    /// It does not answer, or not as a master.
    Gone {
        /// Why, with its causes.
        why: String,
    },
    /// It knows this node and all that it has.
    Registered,
}

pub(super) async fn run(shared: Arc<Shared>) {
    let mut rounds = 0u32;
    loop {
        let whole = rounds.is_multiple_of(WHOLE);
        let begun = Instant::now();
        let turn = shared.turn.lock().await;
        let asked = round(&shared, whole).await;
        drop(turn);
        let state = match asked {
            Ok(()) => MasterState::Registered,
            Err(error) => {
                forget(&shared);
                MasterState::Gone { why: chain(&error) }
            }
        };
        shared.state.send_if_modified(|old| {
            let changed = *old != state;
            match &state {
                MasterState::Gone { why } if changed => {
                    tracing::warn!(master = %shared.master.uri(), why, "the ROS master does not answer");
                }
                MasterState::Registered if changed => {
                    tracing::info!(master = %shared.master.uri(), node = shared.name, "registered with the ROS master");
                }
                _ => {}
            }
            *old = state;
            changed
        });
        tokio::time::sleep(BREATH).await;
        tokio::select! {
            () = tokio::time::sleep_until(begun + EVERY) => rounds = rounds.wrapping_add(1),
            () = shared.work.notified() => {}
        }
    }
}

/// An error with its causes, in one line.
pub(super) fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        text.push_str(": ");
        text.push_str(&cause.to_string());
        source = cause.source();
    }
    text
}

/// A master that does not answer may come back without memory.
fn forget(shared: &Shared) {
    let topics = shared.topics();
    topics.subscriptions.values().for_each(|s| s.forget());
    topics.publications.values().for_each(|p| p.set_registered(false));
    topics.params.values().for_each(|p| *lock(&p.registered) = false);
}

async fn round(shared: &Arc<Shared>, whole: bool) -> Result<(), MasterError> {
    let leaving: Vec<Leaving> = shared.topics().leaving.iter().cloned().collect();
    for one in leaving {
        take_back(shared, &one).await?;
        shared.topics().leaving.remove(&one);
    }
    let known = match shared.master.lookup_node(&shared.name).await {
        Ok(uri) => uri.trim_end_matches('/') == shared.api.to_string().trim_end_matches('/'),
        Err(error) if error.is_refusal() => false,
        Err(error) => return Err(error),
    };
    if !known {
        forget(shared);
    } else if whole {
        compare(shared).await?;
    }
    register(shared).await
}

/// What this node publishes against what the master has; who publishes what it subscribes is asked again in any case.
async fn compare(shared: &Arc<Shared>) -> Result<(), MasterError> {
    let state = shared.master.system_state().await?;
    let topics = shared.topics();
    for (topic, publication) in &topics.publications {
        let there =
            state.publishers.iter().any(|(t, nodes)| t == topic && nodes.contains(&shared.name));
        if !there {
            publication.set_registered(false);
        }
    }
    topics.subscriptions.values().for_each(|s| s.doubt());
    topics.params.values().for_each(|p| *lock(&p.registered) = false);
    Ok(())
}

async fn register(shared: &Arc<Shared>) -> Result<(), MasterError> {
    let (subscriptions, publications, params) = {
        let topics = shared.topics();
        let subscriptions = topics.subscriptions.values().filter(|s| s.is_in_doubt()).cloned();
        let publications = topics.publications.values().filter(|p| !p.is_registered()).cloned();
        let params = topics.params.iter().map(|(key, param)| (key.clone(), Arc::clone(param)));
        (
            subscriptions.collect::<Vec<_>>(),
            publications.collect::<Vec<_>>(),
            params.collect::<Vec<_>>(),
        )
    };
    for publication in publications {
        let (topic, kind) = (publication.topic(), publication.kind());
        shared.master.register_publisher(topic, kind, &shared.api).await?;
        publication.set_registered(true);
    }
    for subscription in subscriptions {
        // A notice that comes meanwhile is about something newer.
        subscription.settle();
        let (topic, kind) = (subscription.topic(), subscription.kind());
        let registered = shared.master.register_subscriber(topic, kind, &shared.api).await;
        match registered {
            Ok(publishers) => subscription.set_publishers(&publishers),
            Err(error) => {
                subscription.doubt();
                return Err(error);
            }
        }
    }
    for (key, param) in params {
        if std::mem::replace(&mut *lock(&param.registered), true) {
            continue;
        }
        shared.master.subscribe_param(&key, &shared.api).await?;
        let value = match shared.master.param(&key).await {
            Ok(value) => Some(value),
            Err(error) if error.is_refusal() => None,
            Err(error) => return Err(error),
        };
        param.value.send_if_modified(|old| {
            let changed = *old != value;
            *old = value;
            changed
        });
    }
    Ok(())
}

pub(super) async fn take_back(shared: &Shared, what: &Leaving) -> Result<(), MasterError> {
    let (master, api) = (&shared.master, &shared.api);
    match what {
        Leaving::Subscription(topic) => master.unregister_subscriber(topic, api).await.map(drop),
        Leaving::Publication(topic) => master.unregister_publisher(topic, api).await.map(drop),
        Leaving::Param(key) => master.unsubscribe_param(key, api).await.map(drop),
    }
}
