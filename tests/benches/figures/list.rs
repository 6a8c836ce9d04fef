//! A list of 10 000 nodes, against encoding it once and writing as many bytes over loopback; and gets of one node while such
//! lists are sent, with the lists beside them.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use http::Request;
use muster_tests::Cluster;
use serde_json::{Value, json};

use crate::stats::{Samples, figure};

const NODES: usize = 10_000;
const ROUNDS: usize = 20;
/// Lists beside the gets: their 99th percentile is that of a hundred, and not the largest of a few.
const BESIDE: usize = 200;

pub(crate) async fn nodes() {
    let cluster = Cluster::start().await;
    fill(&cluster, NODES).await;
    let client = cluster.client().await;
    let (mut floor, mut ours) = (Samples::default(), Samples::default());
    let mut size = 0;
    for _ in 0..ROUNDS {
        let request =
            Request::get("/apis/muster.dev/v1alpha1/nodes").body(Vec::new()).expect("a request");
        let begin = Instant::now();
        let text = client.request_text(request).await.expect("a list");
        ours.push(begin.elapsed());
        size = text.len();
        let value: Value = serde_json::from_str(&text).expect("JSON");
        assert_eq!(value["items"].as_array().map(Vec::len), Some(NODES));
        floor.push(encode_and_write(&value));
    }
    let (beside, gets) = gets_under_load(&cluster).await;
    println!("  {NODES} nodes are {:.1} MB", size as f64 / 1e6);
    floor.line("floor: encode + loopback write");
    ours.line("GET, until the last byte");
    beside.line("the same, while gets are sent");
    gets.line("GET of one, while lists are sent");
    println!("  load of the machine, 1 min: {}", load());
    let p99 = |samples: &Samples| samples.quantile(0.99).as_secs_f64() * 1e3;
    figure("list alone, p99", p99(&ours), " ms", "<= 100 ms on two cores");
    figure("list beside gets, p99", p99(&beside), " ms", "<= 100 ms on two cores");
    figure("get beside lists, p99", p99(&gets), " ms", "<= 5 ms");
    figure("p50 ratio", ours.median().as_secs_f64() / floor.median().as_secs_f64(), "x", "<= 2x");
}

/// Gets of one node, one after the other, while another client lists them all over and over: the lists and the gets. Each
/// client has a thread and a connection of its own: what a client has to read of a list is no part of a get.
async fn gets_under_load(cluster: &Cluster) -> (Samples, Samples) {
    let done = AtomicBool::new(false);
    let (lister, getter) = (cluster.client_config().await, cluster.client_config().await);
    std::thread::scope(|threads| {
        let lists = threads.spawn(|| {
            let lists = on_this_thread(lists(lister));
            done.store(true, Ordering::Release);
            lists
        });
        let gets = threads.spawn(|| on_this_thread(gets(getter, &done)));
        let lists = lists.join().expect("the lists are answered");
        (lists, gets.join().expect("the gets are answered"))
    })
}

fn on_this_thread<T>(work: impl Future<Output = T>) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    runtime.expect("a runtime").block_on(work)
}

async fn lists(client: kube::Config) -> Samples {
    let mut samples = Samples::default();
    let client = kube::Client::try_from(client).expect("a client");
    for _ in 0..BESIDE {
        let request = Request::get("/apis/muster.dev/v1alpha1/nodes").body(Vec::new());
        let begin = Instant::now();
        client.request_text(request.expect("a request")).await.expect("a list");
        samples.push(begin.elapsed());
    }
    samples
}

async fn gets(client: kube::Config, done: &AtomicBool) -> Samples {
    let client = kube::Client::try_from(client).expect("a client");
    let mut samples = Samples::default();
    for i in (0..NODES).cycle() {
        if done.load(Ordering::Acquire) {
            break;
        }
        let path = format!("/apis/muster.dev/v1alpha1/nodes/robot-{i:05}");
        let request = Request::get(path).body(Vec::new()).expect("a request");
        let begin = Instant::now();
        client.request_text(request).await.expect("a node");
        samples.push(begin.elapsed());
    }
    samples
}

/// What else the machine was busy with.
pub(crate) fn load() -> String {
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    load.split_whitespace().next().unwrap_or("unknown").to_owned()
}

/// Creates nodes as agents would have reported them.
pub(crate) async fn fill(cluster: &Cluster, nodes: usize) {
    let client = cluster.client().await;
    let make = |i: usize| {
        let client = client.clone();
        async move {
            let name = format!("robot-{i:05}");
            let path = "/apis/muster.dev/v1alpha1/nodes";
            let send = |request: http::request::Builder, body: Value| {
                let body = serde_json::to_vec(&body).expect("JSON");
                client.request::<Value>(
                    request
                        .header("content-type", "application/json")
                        .body(body)
                        .expect("a request"),
                )
            };
            let mut node = json!({
                "apiVersion": muster_api::API_VERSION, "kind": "Node",
                "metadata": { "name": name, "labels": { "site": "hall", "shelf": format!("{}", i % 100) } },
                "spec": { "kind": "Robot", "speed": 0.5 },
            });
            send(Request::post(path), node.clone()).await.expect("created");
            node["status"] = status(i);
            send(Request::put(format!("{path}/{name}/status")), node).await.expect("reported");
        }
    };
    let mut left = (0..nodes).collect::<Vec<_>>().into_iter();
    loop {
        let batch: Vec<_> = left.by_ref().take(128).map(make).collect();
        if batch.is_empty() {
            return;
        }
        futures::future::join_all(batch).await;
    }
}

fn status(i: usize) -> Value {
    json!({
        "allocatable": { "cpu": "4", "memory": "8Gi" }, "capacity": { "cpu": "4", "memory": "8Gi" },
        "free": { "cpu": "4", "memory": "8Gi" }, "used": { "cpu": "0", "memory": "0" },
        "sensors": ["kinect:ImageGen", "kinect:LaserGen"], "actuators": ["base:Drive"],
        "pose": { "map": "hall", "x": (i % 100) as f64, "y": (i / 100) as f64, "yaw": 0.0 },
        "conditions": [{ "type": "Ready", "status": "True", "reason": "AgentReady", "message": "its agent is connected" }],
        "runtimes": [{ "name": "process", "available": true }, { "name": "docker", "available": true, "version": "20.10" }],
    })
}

fn encode_and_write(value: &Value) -> Duration {
    let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
    let address = listener.local_addr().expect("bound");
    let reader = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().expect("one connection");
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).expect("read whole");
    });
    let mut stream = TcpStream::connect(address).expect("loopback");
    let begin = Instant::now();
    let bytes = serde_json::to_vec(value).expect("JSON");
    stream.write_all(&bytes).expect("read meanwhile");
    drop(stream);
    reader.join().expect("the reader ends");
    begin.elapsed()
}
