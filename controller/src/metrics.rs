//! The Prometheus recorder of the process.

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use metrics_exporter_prometheus::{BuildError, PrometheusBuilder, PrometheusHandle};
use tokio_util::sync::CancellationToken;

/// Histograms keep raw samples until upkeep folds them; at this period a busy second is a few thousand samples.
const UPKEEP: Duration = Duration::from_secs(5);

/// The handle of the process's recorder, installed at the first call: several controllers in one process share it.
pub(crate) fn recorder() -> Result<PrometheusHandle, BuildError> {
    static INSTALLED: Mutex<Option<PrometheusHandle>> = Mutex::new(None);
    let mut installed = INSTALLED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(handle) = &*installed {
        return Ok(handle.clone());
    }
    let handle = PrometheusBuilder::new().install_recorder()?;
    describe();
    *installed = Some(handle.clone());
    Ok(handle)
}

fn describe() {
    metrics::describe_counter!("muster_store_writes_total", "Changes committed");
    metrics::describe_counter!(
        "muster_store_commits_total",
        "Durable commits, each of many changes"
    );
    metrics::describe_counter!("muster_store_commit_failures_total", "Commits that failed");
    metrics::describe_gauge!("muster_store_revision", "The last committed revision");
    metrics::describe_counter!(
        "muster_http_requests_total",
        "REST requests by verb, resource and code"
    );
    metrics::describe_histogram!(
        "muster_http_request_seconds",
        metrics::Unit::Seconds,
        "Time to answer a REST request, watches and logs left out"
    );
    metrics::describe_counter!(
        "muster_request_panics_total",
        "Requests that met a fault of the controller"
    );
    metrics::describe_counter!(
        "muster_stalled_readers_total",
        "Watches, logs and lists that were cut off because their readers took nothing"
    );
    metrics::describe_gauge!("muster_connections", "Open TLS connections");
    metrics::describe_counter!(
        "muster_decisions_total",
        "Looks at all waiting tasks; each decides for every one of them"
    );
    metrics::describe_counter!(
        "muster_framework_messages_total",
        "Messages between frameworks and executors that passed the controller, by direction"
    );
}

/// Keeps the recorder's memory flat until `stop`.
pub(crate) async fn upkeep(handle: PrometheusHandle, stop: CancellationToken) {
    let mut ticks = tokio::time::interval(UPKEEP);
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            _ = ticks.tick() => handle.run_upkeep(),
        }
    }
}
