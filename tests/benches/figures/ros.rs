//! A pose on its way: rospy publishes `/odom` at 30 Hz, the agent reads it, the controller shows it.
//!
//! Each message is stamped just before it is published; a pose at the controller has the stamp of the message that it was
//! made of. The floor is this process as a plain subscriber of the same topic.

use std::time::{Duration, Instant};

use futures::{AsyncBufReadExt as _, StreamExt as _};
use http::Request;
use kube::Client;
use muster_ros1::Node;
use muster_ros1::nav_msgs::Odometry;
use muster_ros1::node::SubscribeOptions;
use muster_tests::{AgentOptions, Cluster, Ros};
use serde_json::Value;

use crate::poses::readers::now_us;
use crate::stats::{Samples, figure, millis};

/// Poses are told ten times a second at most.
const SPAN: Duration = Duration::from_secs(30);

pub(crate) async fn pose() {
    let (ros, mut cluster) = (Ros::start().await, Cluster::start().await);
    let options =
        AgentOptions::bare("rover").flag("--kind", "robot").flag("--position", "ros1:/odom");
    cluster.join(options.flag("--ros-master", &ros.master()).flag("--ros-host", "127.0.0.1")).await;
    let mut driver = ros.script("odometry.py", &["odometry", "/odom", "30"]);
    driver.line_with("drives").await;
    let node = ros.node("floor").await;
    let until = Instant::now() + SPAN;
    let (floor, ours) = tokio::join!(subscribe(&node, until), watch(cluster.client().await, until));
    floor.line("floor: rospy to a bare subscriber");
    ours.line("rospy to the controller's watch");
    figure("p99 to the controller", millis(ours.quantile(0.99)), " ms", "<= 150 ms");
}

fn since(stamp_us: u64) -> Duration {
    Duration::from_micros(now_us().saturating_sub(stamp_us))
}

async fn subscribe(node: &Node, until: Instant) -> Samples {
    let mut topic =
        node.subscribe::<Odometry>("/odom", SubscribeOptions::default()).expect("a topic");
    let mut samples = Samples::default();
    while let Ok(next) = tokio::time::timeout_at(until.into(), topic.next()).await {
        let (odometry, _) = next.expect("an Odometry");
        let stamp = odometry.header.stamp.since_epoch();
        samples.push(since(u64::try_from(stamp.as_micros()).expect("before the year 500 000")));
    }
    samples
}

async fn watch(client: Client, until: Instant) -> Samples {
    let request = Request::get("/apis/muster.dev/v1alpha1/poses?watch=true").body(Vec::new());
    let stream = client.request_stream(request.expect("a request")).await.expect("a watch");
    let mut lines = Box::pin(stream).lines();
    let mut samples = Samples::default();
    while let Ok(line) = tokio::time::timeout_at(until.into(), lines.next()).await {
        let line = line.expect("the watch goes on").expect("readable");
        let event: Value = serde_json::from_str(&line).expect("a JSON line");
        let stamp =
            event["object"]["stamp"].as_str().and_then(|s| s.parse::<jiff::Timestamp>().ok());
        if let Some(stamp) = stamp.and_then(|s| u64::try_from(s.as_microsecond()).ok()) {
            samples.push(since(stamp));
        }
    }
    samples
}
