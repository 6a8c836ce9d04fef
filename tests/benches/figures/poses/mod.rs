//! Poses of 10 000 robots over 100 gRPC streams, on one core, with 100 offer queries a second beside.
//!
//! The controller and the floor are processes on one core, the load is on the others. Each stream has a connection and
//! a hundred robots. An *offer query* is a framework that moves (SetPosition, over HTTP): it is looked at anew, and is told
//! what it is offered there.

mod bare;
pub(crate) mod readers;
pub(crate) mod stream;

use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures::future::join_all;
use muster_api::wire::pose::v1::NodePose;
use muster_tests::{Cluster, wait};
use tokio::task::JoinSet;

use self::readers::{Framework, now_us, read_all, wander};
use self::stream::{Stream, admin, batch};
use crate::footprint::cpu;
use crate::stats::{Samples, figure};

const ROBOTS: usize = 10_000;
const STREAMS: usize = 100;
const EACH: usize = ROBOTS / STREAMS;
/// Frameworks that move ten times a second each.
const FRAMEWORKS: usize = 10;
const ROUNDS: usize = 3;
const ROUND: Duration = Duration::from_secs(3);
/// Metres between neighbours: one robot for each 100 m² of floor, as in the benchmark of offers.
const APART: f64 = 10.0;
/// Different places that each robot is said to be at in turn.
const PLACES: usize = 8;
/// The span over which staleness is measured, after a moment for everything to settle.
const SPAN: Duration = Duration::from_secs(10);
const SETTLE: Duration = Duration::from_secs(2);
/// How often a robot is sent into a framework's range.
const VISITS: usize = 60;

/// `figures bare-stream DIR`: the floor's process.
pub(crate) fn serve_bare(pki: &Path) {
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(bare::serve(pki));
}

/// Puts a process (all of its threads) or the present thread onto cores.
fn pin(cores: &str, pid: u32, whole: bool) {
    let flags = if whole { "-apc" } else { "-pc" };
    let mut command = Command::new("taskset");
    command.args([flags, cores, &pid.to_string()]).stdout(Stdio::null());
    assert!(command.status().expect("util-linux is there").success(), "taskset {cores}");
}

struct Floor {
    child: Child,
    address: SocketAddr,
}

impl Floor {
    fn start(pki: &Path) -> Self {
        let program = std::env::current_exe().expect("a benchmark has a path");
        let mut child = Command::new(program)
            .arg("bare-stream")
            .arg(pki)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("it starts");
        let mut line = String::new();
        let stdout = child.stdout.take().expect("it is piped");
        BufReader::new(stdout).read_line(&mut line).expect("it says where it is");
        Floor { child, address: line.trim().parse().expect("an address") }
    }
}

impl Drop for Floor {
    fn drop(&mut self) {
        // It may have ended by itself.
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

fn name(robot: usize) -> String {
    format!("robot-{robot:05}")
}

fn pose(robot: usize, place: usize) -> NodePose {
    // Steps of 10 cm, as a robot does at 1 m/s when it is asked ten times a second.
    let x = (robot % 100) as f64 * APART + place as f64 * 0.1;
    NodePose { node: name(robot), x, y: (robot / 100) as f64 * APART, ..NodePose::default() }
}

/// What one stream sends in turn, `size` poses a batch, and what it sends last.
fn load(stream: usize, size: usize) -> (Vec<Bytes>, Bytes) {
    let robots: Vec<usize> = (stream * EACH..(stream + 1) * EACH).collect();
    let batches = (0..PLACES).flat_map(|place| {
        let poses = |robots: &[usize]| robots.iter().map(|r| pose(*r, place)).collect();
        robots.chunks(size).map(|r| batch(poses(r), false)).collect::<Vec<_>>()
    });
    (batches.collect(), batch(vec![pose(robots[0], 0)], true))
}

/// As many poses as the server takes for a while: poses, wall seconds, and the server's cpu seconds.
async fn flood(streams: &mut [Stream], size: usize, pid: u32) -> (f64, f64, f64) {
    let (begin, before) = (Instant::now(), cpu(pid));
    let one = async |(i, stream): (usize, &mut Stream)| {
        let (batches, last) = load(i, size);
        let mut sent = 0;
        for batch in batches.iter().cycle() {
            if begin.elapsed() >= ROUND {
                break;
            }
            stream.send(batch.clone()).await;
            sent += size;
        }
        stream.send(last).await;
        assert_eq!(stream.reply().await.taken, 1);
        sent + 1
    };
    let sent: usize = join_all(streams.iter_mut().enumerate().map(one)).await.into_iter().sum();
    (sent as f64, begin.elapsed().as_secs_f64(), (cpu(pid) - before).as_secs_f64())
}

async fn connect(address: SocketAddr, pki: &Path) -> Vec<Stream> {
    let tls = admin(pki);
    join_all((0..STREAMS).map(|_| Stream::open(address, Arc::clone(&tls)))).await
}

/// Everything about live poses.
pub(crate) async fn all() {
    let own = std::process::id();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let others = if cores > 1 { format!("1-{}", cores - 1) } else { "0".to_owned() };
    pin(&others, own, true);
    // A child begins on the cores of the thread that starts it.
    pin("0", own, false);
    let cluster = Cluster::start().await;
    let pki: PathBuf = cluster.dir().join("controller/pki");
    let floor = Floor::start(&pki);
    pin(&others, own, false);

    crate::list::fill(&cluster, ROBOTS).await;
    let address = cluster.address();
    let mut to_floor = connect(floor.address, &pki).await;
    let mut to_ours = connect(address, &pki).await;
    let client = cluster.client().await;
    for size in [EACH, 1] {
        throughput(&mut to_floor, &mut to_ours, (&floor, &cluster), size).await;
    }
    drop((to_floor, floor));

    let offers = Arc::new(AtomicU64::new(0));
    let _wanderers = wander(&client, FRAMEWORKS, Arc::clone(&offers)).await;
    staleness(&cluster, to_ours).await;
    println!("  meanwhile {} offers were made", offers.load(Ordering::Relaxed));
}

async fn throughput(
    to_floor: &mut [Stream],
    to_ours: &mut [Stream],
    (floor, cluster): (&Floor, &Cluster),
    size: usize,
) {
    let client = cluster.client().await;
    let (mut bare, mut ours) = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0));
    let add = |sum: &mut (f64, f64, f64), (n, wall, cpu): (f64, f64, f64)| {
        (sum.0, sum.1, sum.2) = (sum.0 + n, sum.1 + wall, sum.2 + cpu);
    };
    let offers = Arc::new(AtomicU64::new(0));
    for _ in 0..ROUNDS {
        add(&mut bare, flood(to_floor, size, floor.child.id()).await);
        let wanderers = wander(&client, FRAMEWORKS, Arc::clone(&offers)).await;
        add(&mut ours, flood(to_ours, size, cluster.controller_pid()).await);
        drop(wanderers);
        // Their sessions end, and what the controller does after the flood (checkpoints) is not the floor's to pay.
        wait::idle(SETTLE).await;
    }
    let line = |name: &str, (n, wall, cpu): (f64, f64, f64)| {
        let (rate, each) = (n / wall, n / cpu);
        println!(
            "  {name:34} {rate:>10.0} poses/s, {each:>10.0} per second of its cpu, {:.0} % busy",
            cpu / wall * 100.0
        );
    };
    println!("  batches of {size}:");
    line("floor: bare tonic stream", bare);
    line("controller", ours);
    println!("  and {} offers were made", offers.load(Ordering::Relaxed));
    figure("poses/s, ratio", (ours.0 / ours.1) / (bare.0 / bare.1), "x", ">= 0.25x");
    figure(
        "poses per second of cpu, ratio",
        (ours.0 / ours.2) / (bare.0 / bare.2),
        "x",
        ">= 0.25x",
    );
}

/// Every robot ten times a second: how long until a reader of all poses has it, and until a framework is offered a robot
/// that came into its range.
async fn staleness(cluster: &Cluster, streams: Vec<Stream>) {
    let client = cluster.client().await;
    let begin = Instant::now();
    let until = begin + SETTLE + SPAN;
    let settled = now_us() + u64::try_from(SETTLE.as_micros()).expect("some seconds");
    let reader = tokio::spawn(read_all(client.clone(), until));
    let mut senders = JoinSet::new();
    for (i, stream) in streams.into_iter().enumerate() {
        senders.spawn(async move {
            let offset = Duration::from_micros(1000 * i as u64);
            let mut ticks = tokio::time::interval_at(
                tokio::time::Instant::now() + offset,
                Duration::from_millis(100),
            );
            let mut stamps = Vec::new();
            for step in 0_usize.. {
                ticks.tick().await;
                if Instant::now() >= until {
                    break;
                }
                let now = now_us();
                let stamp = Some(prost_types::Timestamp {
                    seconds: i64::try_from(now / 1_000_000).expect("in range"),
                    nanos: i32::try_from(now % 1_000_000 * 1000).expect("below 10^9"),
                });
                let robots = i * EACH..(i + 1) * EACH;
                // The visitor is somebody else's.
                let robots = robots.filter(|r| *r != ROBOTS - 1);
                let poses = robots.map(|r| NodePose { stamp, ..pose(r, step % PLACES) }).collect();
                stream.send(batch(poses, false)).await;
                stamps.push(now);
            }
            (i, stamps)
        });
    }
    let cpu_before = cpu(cluster.controller_pid());
    let visits = visits(cluster, until).await;
    let mut stamps = vec![Vec::new(); STREAMS];
    let mut sent = 0;
    for (i, sent_at) in senders.join_all().await {
        sent += sent_at.len() * EACH;
        stamps[i] = sent_at;
    }
    let busy = (cpu(cluster.controller_pid()) - cpu_before).as_secs_f64();
    let span = begin.elapsed().as_secs_f64();
    println!(
        "  {:.0} poses/s offered, the controller {:.0} % busy",
        sent as f64 / span,
        busy / span * 100.0
    );
    let seen = reader.await.expect("the reader ends");
    let ages = ages(&stamps, &seen, settled);
    ages.line("sent until a watch of all shows it");
    visits.line("sent until the framework is offered it");
    let ms = |d: Duration| d.as_secs_f64() * 1e3;
    figure("staleness of a watch, p99", ms(ages.quantile(0.99)), " ms", "<= 100 ms");
    figure("staleness of offers, p99", ms(visits.quantile(0.99)), " ms", "<= 100 ms");
}

/// For each pose that was sent after `settled`: how long until the reader had it or a newer one of the robot.
fn ages(stamps: &[Vec<u64>], seen: &[(u32, u64, u64)], settled: u64) -> Samples {
    let mut ages = Samples::default();
    let mut next = vec![0; ROBOTS];
    for (robot, stamp, at) in seen {
        let robot = *robot as usize;
        let (sent, next) = (&stamps[robot / EACH], &mut next[robot]);
        while sent.get(*next).is_some_and(|s| s <= stamp) {
            if sent[*next] >= settled {
                ages.push(Duration::from_micros(at.saturating_sub(sent[*next])));
            }
            *next += 1;
        }
    }
    ages
}

/// One robot goes far away into a framework's range and out again.
async fn visits(cluster: &Cluster, until: Instant) -> Samples {
    let mut framework =
        Framework::open(&cluster.client().await, "hermit", (5000.0, 5000.0), 5.0).await;
    let pki = cluster.dir().join("controller/pki");
    let visitor = Stream::open(cluster.address(), admin(&pki)).await;
    let go = |x: f64| {
        batch(vec![NodePose { node: name(ROBOTS - 1), x, y: x, ..NodePose::default() }], false)
    };
    let mut samples = Samples::default();
    for _ in 0..VISITS {
        if Instant::now() + Duration::from_secs(1) >= until {
            break;
        }
        let begin = Instant::now();
        visitor.send(go(5000.0)).await;
        while framework.next().await.get("offers").is_none() {}
        samples.push(begin.elapsed());
        visitor.send(go(0.0)).await;
        while framework.next().await.get("rescind").is_none() {}
    }
    samples
}
