//! Who looks at the fleet meanwhile: frameworks that move, a reader of every pose, and a framework that waits for one
//! robot.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime};

use futures::io::{AsyncBufRead, Lines};
use futures::{AsyncBufReadExt as _, StreamExt as _};
use http::Request;
use kube::Client;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::task::JoinSet;

const SESSION: &str = "/framework/v1/session";

/// Microseconds since 1970, as stamps are sent.
pub(crate) fn now_us() -> u64 {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).expect("after 1970");
    u64::try_from(now.as_micros()).expect("before the year 500 000")
}

/// A framework over JSON lines.
pub(crate) struct Framework {
    client: Client,
    session: String,
    pub(crate) events: Lines<std::pin::Pin<Box<dyn AsyncBufRead + Send>>>,
}

fn position(x: f64, y: f64, radius: f64) -> Value {
    json!({ "map": "hall", "x": x, "y": y, "radius": radius })
}

impl Framework {
    pub(crate) async fn open(client: &Client, name: &str, at: (f64, f64), radius: f64) -> Self {
        let subscribe = json!({ "subscribe": {
            "name": name, "position": position(at.0, at.1, radius), "filter": { "kind": "NODE_KIND_ROBOT" },
        }});
        let request = Request::post(SESSION).body(subscribe.to_string().into_bytes());
        let stream = client.request_stream(request.expect("a request")).await.expect("a session");
        let stream: std::pin::Pin<Box<dyn AsyncBufRead + Send>> = Box::pin(stream);
        let mut framework =
            Framework { client: client.clone(), session: String::new(), events: stream.lines() };
        let first = framework.next().await;
        framework.session =
            first["subscribed"]["sessionId"].as_str().expect("subscribed first").to_owned();
        framework
    }

    pub(crate) async fn next(&mut self) -> Value {
        let line = self.events.next().await.expect("the session goes on").expect("readable");
        serde_json::from_str(&line).expect("a JSON line")
    }
}

/// Side of the hall that the robots are in, metres.
const SIDE: f64 = 1000.0;

/// `count` frameworks, each of which moves by a metre ten times a second; offers that they were made are counted.
pub(crate) async fn wander(client: &Client, count: usize, offers: Arc<AtomicU64>) -> JoinSet<()> {
    // A name stays with its framework for a while after its session: each round has others.
    static NEXT: AtomicU64 = AtomicU64::new(1);
    let mut tasks = JoinSet::new();
    for i in 0..count {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let at = (i as f64 * 97.0 % SIDE, i as f64 * 371.0 % SIDE);
        let Framework { client, session, mut events } =
            Framework::open(client, &format!("wanderer-{number}"), at, 25.0).await;
        let offers = Arc::clone(&offers);
        tasks.spawn(async move {
            while let Some(Ok(line)) = events.next().await {
                let event: Value = serde_json::from_str(&line).expect("a JSON line");
                let made = event["offers"]["offers"].as_array().map_or(0, Vec::len);
                offers.fetch_add(made as u64, Ordering::Relaxed);
            }
        });
        tasks.spawn(async move {
            let mut ticks = tokio::time::interval(Duration::from_millis(100));
            for step in 0_u32.. {
                ticks.tick().await;
                let x = (at.0 + f64::from(step)) % SIDE;
                let call = json!({ "setPosition": { "position": position(x, at.1, 25.0) } });
                let request = Request::post(format!("{SESSION}/{session}/calls"));
                let request = request.body(call.to_string().into_bytes()).expect("a request");
                // Answered 202 with nothing in it.
                drop(client.request_text(request).await.expect("it is taken"));
            }
        });
    }
    tasks
}

#[derive(Deserialize)]
struct Line<'a> {
    #[serde(borrow)]
    object: Object<'a>,
}

#[derive(Deserialize)]
struct Object<'a> {
    #[serde(default)]
    node: &'a str,
    stamp: Option<jiff::Timestamp>,
}

/// What a reader of every pose saw: robot, stamp and when, microseconds.
pub(crate) type Sightings = Vec<(u32, u64, u64)>;

/// Reads every pose until `until`.
pub(crate) async fn read_all(client: Client, until: Instant) -> Sightings {
    let request = Request::get("/apis/muster.dev/v1alpha1/poses?watch=true").body(Vec::new());
    let stream = client.request_stream(request.expect("a request")).await.expect("a watch");
    let stream: std::pin::Pin<Box<dyn AsyncBufRead + Send>> = Box::pin(stream);
    let mut lines = stream.lines();
    let mut seen = Vec::new();
    let deadline = tokio::time::sleep_until(until.into());
    tokio::pin!(deadline);
    loop {
        let line = tokio::select! {
            line = lines.next() => line.expect("the watch goes on").expect("readable"),
            () = &mut deadline => return seen,
        };
        let Line { object } = serde_json::from_str(&line).expect("a JSON line");
        let robot = object.node.strip_prefix("robot-").and_then(|n| n.parse().ok());
        let stamp = object.stamp.and_then(|s| u64::try_from(s.as_microsecond()).ok());
        if let (Some(robot), Some(stamp)) = (robot, stamp) {
            seen.push((robot, stamp, now_us()));
        }
    }
}
