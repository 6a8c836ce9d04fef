//! Forgets what is old: Event objects after an hour, and history that no watch needs.

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde::Deserialize;

use crate::context::Context;
use crate::objects::EVENTS;
use crate::store::Precondition;

/// How long an Event stays; Kubernetes' default.
const EVENT_LIFE: Duration = Duration::from_secs(3600);
/// How often this looks.
const EVERY: Duration = Duration::from_secs(60);
/// Revisions that stay readable for watches that resume. At 100 writes/s this is the last 100 s,
/// which a reconnecting client needs; at rest it is days.
const KEEP_REVISIONS: u64 = 10_000;

/// When an Event last happened.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Dated {
    last_timestamp: Option<String>,
    metadata: Made,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Made {
    creation_timestamp: Option<String>,
}

impl Dated {
    fn stamp(&self) -> Option<Timestamp> {
        let stamps = [&self.last_timestamp, &self.metadata.creation_timestamp];
        stamps.into_iter().flatten().find_map(|text| text.parse().ok())
    }
}

/// Works until dropped.
pub async fn run(context: Arc<Context>) {
    loop {
        tokio::time::sleep(EVERY).await;
        let now = context.clock.now();
        for stored in context.store.list(EVENTS, None).items {
            let stamp = stored.parse::<Dated>().ok().and_then(|event| event.stamp());
            let old = stamp.is_none_or(|s| now.duration_since(s).unsigned_abs() > EVENT_LIFE);
            if old
                && let Err(error) = context
                    .store
                    .delete(stored.key.clone(), Precondition::revision(stored.revision))
                    .await
            {
                tracing::debug!(key = %stored.key, %error, "an old event is not removed yet");
            }
        }
        let through = context.store.revision().saturating_sub(KEEP_REVISIONS);
        if through > 0
            && let Err(error) = context.store.compact(through).await
        {
            tracing::warn!(error = crate::app::chain(&error), "history is not compacted");
        }
    }
}
