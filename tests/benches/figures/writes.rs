//! Durable writes per second, at the store and through REST.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use futures::future::join_all;
use muster_controller::store::{Key, Resource, sqlite};
use muster_tests::Cluster;
use serde_json::{Value, json};
use tokio_util::sync::CancellationToken;

use crate::floor::{Rows, between_syncs};
use crate::stats::figure;

const WRITERS: usize = 64;
const SPAN: Duration = Duration::from_secs(4);
const EVENTS: Resource = Resource::new("events");

/// An object of about 1.5 kB that nothing reacts to.
fn event(name: &str) -> Value {
    json!({
        "apiVersion": "v1", "kind": "Event",
        "metadata": { "name": name, "namespace": "default", "uid": name },
        "involvedObject": { "kind": "Task", "name": "t", "namespace": "default" },
        "reason": "Measured", "type": "Normal", "message": "x".repeat(1200),
    })
}

/// Rows per second of plain transactions of 100 rows, the floor.
async fn floor(dir: &std::path::Path) -> f64 {
    let mut rows = Rows::open(dir).await;
    let (begin, mut written) = (Instant::now(), 0_u32);
    while begin.elapsed() < SPAN / 2 {
        rows.commit(100).await;
        written += 100;
    }
    f64::from(written) / begin.elapsed().as_secs_f64()
}

/// Runs `WRITERS` writers for a while; writes per second.
async fn measure<F: Future<Output = ()>>(write: impl Fn(String) -> F) -> f64 {
    let (next, begin) = (AtomicU64::new(0), Instant::now());
    let writers = (0..WRITERS).map(|_| async {
        while begin.elapsed() < SPAN {
            write(format!("e{}", next.fetch_add(1, Ordering::Relaxed))).await;
        }
    });
    join_all(writers).await;
    next.into_inner() as f64 / begin.elapsed().as_secs_f64()
}

pub(crate) async fn store() {
    let dir = tempfile::tempdir().expect("a directory");
    between_syncs(dir.path(), async {
        let (store, writer) = sqlite::open(&dir.path().join("store.db")).await.expect("a store");
        let stop = CancellationToken::new();
        let writer = tokio::spawn(writer.run(stop.clone()));
        let before = floor(dir.path()).await;
        let store = Arc::new(store);
        let rate = measure(|name| {
            let store = Arc::clone(&store);
            async move {
                let key = Key::namespaced(EVENTS, "default", name.as_str());
                store.create(key, event(&name)).await.expect("durable");
            }
        })
        .await;
        let after = floor(dir.path()).await;
        report(rate, (before + after) / 2.0, "12 000");
        stop.cancel();
        writer.await.expect("the writer ends");
    })
    .await;
}

pub(crate) async fn rest() {
    let cluster = Cluster::start().await;
    let dir = cluster.dir().to_owned();
    between_syncs(&dir, async {
        let client = cluster.client().await;
        let before = floor(&dir).await;
        let rate = measure(|name| {
            let client = client.clone();
            async move {
                let request = http::Request::post("/api/v1/namespaces/default/events")
                    .header("content-type", "application/json")
                    .body(serde_json::to_vec(&event(&name)).expect("JSON"))
                    .expect("a request");
                client.request::<Value>(request).await.expect("durable");
            }
        })
        .await;
        let after = floor(&dir).await;
        report(rate, (before + after) / 2.0, "5 000");
    })
    .await;
}

fn report(rate: f64, floor: f64, aim: &str) {
    println!("  floor, rows of 100-row transactions: {floor:.0}/s");
    figure("durable writes", rate, "/s", &format!(">= {aim}/s on a quiet disk"));
    figure("against the floor", rate / floor, "x", ">= 0.1x");
}
