//! Live poses: published over gRPC and said by agents, listed and watched over HTTP, and what follows from them.

use futures::{AsyncBufReadExt as _, TryStreamExt as _};
use http::Request;
use kube::Client;
use muster_api::wire::agent::v1 as agent_wire;
use muster_api::wire::pose::v1 as wire;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

use super::agent::{self, Credential, Session, channel};
use super::support::*;

mod service {
    #![allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        missing_debug_implementations,
        unreachable_pub,
        reason = "generated"
    )]
    include!(concat!(env!("OUT_DIR"), "/client/muster.pose.v1.rs"));
}
use service::pose_service_client::PoseServiceClient;

const POSES: &str = "/apis/muster.dev/v1alpha1/poses";

struct Publisher {
    batches: mpsc::Sender<wire::PoseBatch>,
    replies: Streaming<wire::PoseReply>,
}

impl Publisher {
    async fn open(cluster: &Cluster, credential: &Credential) -> Result<Self, Status> {
        let (batches, queue) = mpsc::channel(4);
        let mut client = PoseServiceClient::new(channel(cluster, credential).await);
        let replies = client.publish(ReceiverStream::new(queue)).await?.into_inner();
        Ok(Publisher { batches, replies })
    }

    /// Publishes, and waits until that has been taken or refused.
    async fn say(
        &mut self,
        source: &str,
        map: &str,
        poses: Vec<wire::NodePose>,
    ) -> wire::PoseReply {
        self.send(source, map, poses, true).await;
        let reply = tokio::time::timeout(DEADLINE, self.replies.message()).await;
        reply.expect("a reply in time").unwrap().expect("the stream goes on")
    }

    /// Publishes; it is answered if that is asked for or something is refused.
    async fn send(
        &mut self,
        source: &str,
        map: &str,
        poses: Vec<wire::NodePose>,
        acknowledge: bool,
    ) {
        let (source, map) = (source.to_owned(), map.to_owned());
        let batch = wire::PoseBatch { sequence: 7, source, map, poses, acknowledge };
        self.batches.send(batch).await.unwrap();
    }

    async fn moves(&mut self, node: &str, x: f64) {
        let reply = self.say("mocap", "", vec![at(node, x)]).await;
        assert_eq!((reply.taken, &reply.refused[..]), (1, &[][..]));
    }

    /// Until the controller has seen that these nodes are there.
    async fn known(&mut self, nodes: &[&str]) {
        let known = async {
            let poses: Vec<_> = nodes.iter().map(|node| at(node, -1.0)).collect();
            while self.say("mocap", "", poses.clone()).await.taken < poses.len() as u32 {}
        };
        tokio::time::timeout(DEADLINE, known).await.expect("the nodes are known");
    }

    /// What another source is answered while `mocap` tells this pose.
    async fn other(&mut self, pose: &wire::NodePose) -> wire::PoseReply {
        let refused = async {
            loop {
                // One that was not heard for long has lost its place to the other, and waits until that is silent.
                if self.say("mocap", "lab", vec![pose.clone()]).await.taken == 1 {
                    let reply = self.say("uwb", "lab", vec![at(&pose.node, 9.0)]).await;
                    if reply.taken == 0 {
                        return reply;
                    }
                }
            }
        };
        tokio::time::timeout(DEADLINE, refused).await.expect("another source is refused")
    }
}

fn at(node: &str, x: f64) -> wire::NodePose {
    wire::NodePose { node: node.to_owned(), x, ..wire::NodePose::default() }
}

struct Lines(futures::io::Lines<std::pin::Pin<Box<dyn futures::AsyncBufRead + Send>>>);

impl Lines {
    async fn open(client: &Client, query: &str) -> Self {
        let request = Request::get(format!("{POSES}?watch=true{query}")).body(Vec::new()).unwrap();
        let reader = client.request_stream(request).await.unwrap();
        Self((Box::pin(reader) as std::pin::Pin<Box<dyn futures::AsyncBufRead + Send>>).lines())
    }

    async fn next(&mut self) -> Option<Value> {
        let line = tokio::time::timeout(DEADLINE, self.0.try_next()).await;
        Some(serde_json::from_str(&line.expect("a line in time").unwrap()?).unwrap())
    }

    /// `TYPE node x` of the next event.
    async fn event(&mut self) -> String {
        let event = self.next().await.expect("the watch goes on");
        let object = &event["object"];
        let x = object["x"].as_f64().map(|x| format!(" {x}")).unwrap_or_default();
        let node = object["node"].as_str().unwrap_or_default();
        format!("{} {node}{x}", event["type"].as_str().unwrap())
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn poses_are_published_listed_and_watched() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    for name in ["r1", "r2"] {
        register(&admin, name).await;
    }
    let cloud = json!({"apiVersion": "muster.dev/v1alpha1", "kind": "Node", "metadata": {"name": "cloud"}, "spec": {"kind": "Cloud"}});
    assert_eq!(send(&admin, "POST", &format!("{G}/nodes"), cloud).await.0, 201);
    let nowhere = get(&admin, &format!("{G}/nodes/r1/pose")).await;
    assert_eq!(refusal(&nowhere), (404, "NotFound"));
    let mut publisher = Publisher::open(&cluster, &agent::admin(&cluster)).await.unwrap();
    publisher.known(&["r1", "r2"]).await;

    let stamp = Some(prost_types::Timestamp { seconds: 1_700_000_000, nanos: 0 });
    let good = wire::NodePose { y: 2.0, z: 0.5, yaw: 1.5, stamp, ..at("r1", 1.0) };
    let batch = vec![good.clone(), at("nobody", 0.0), at("cloud", 0.0), at("r2", f64::NAN)];
    let reply = publisher.say("mocap", "lab", batch).await;
    assert_eq!((reply.sequence, reply.taken), (7, 1));
    let refused: Vec<_> = reply.refused.iter().map(|r| (r.node.as_str(), r.reason())).collect();
    use wire::Reason::{Invalid, NotARobot, OtherSource, UnknownNode};
    assert_eq!(refused, [("nobody", UnknownNode), ("cloud", NotARobot), ("r2", Invalid)]);
    let other = publisher.other(&good).await;
    assert_eq!(other.refused[0].reason(), OtherSource);
    assert!(other.refused[0].message.contains("mocap"), "{other:?}");

    let (code, one) = get(&admin, &format!("{G}/nodes/r1/pose")).await;
    assert_eq!(code, 200, "{one}");
    assert_eq!((&one["map"], &one["source"]), (&json!("lab"), &json!("mocap")));
    assert_eq!(
        (&one["y"], &one["yaw"], &one["localized"]),
        (&json!(2.0), &json!(1.5), &json!(true))
    );
    assert!(one["stamp"].as_str().unwrap().starts_with("2023-11-14T22:13:20"), "{one}");
    assert!(one["ageMs"].is_u64(), "{one}");
    let (_, list) = get(&admin, &format!("{POSES}?map=lab")).await;
    assert_eq!(
        (list["items"].as_array().unwrap().len(), &list["items"][0]["node"]),
        (1, &json!("r1"))
    );
    assert_eq!(get(&admin, POSES).await.1["items"].as_array().unwrap().len(), 2);

    let mut all = Lines::open(&admin, "").await;
    let mut first = [all.event().await, all.event().await];
    first.sort();
    assert_eq!(first, ["ADDED r1 1", "ADDED r2 -1"]);
    assert_eq!(all.event().await, "BOOKMARK ");
    let mut lab = Lines::open(&admin, "&map=lab&nodes=r1,r2").await;
    assert_eq!([lab.event().await, lab.event().await], ["ADDED r1 1", "BOOKMARK "]);
    let mut none = Lines::open(&admin, "&nodes=r3&timeoutSeconds=1").await;
    assert_eq!(none.event().await, "BOOKMARK ");
    assert!(none.next().await.is_none(), "its time is over");

    publisher.moves("r2", 5.0).await;
    assert_eq!(all.event().await, "MODIFIED r2 5");
    publisher.moves("r1", 3.0).await;
    assert_eq!(all.event().await, "MODIFIED r1 3");
    assert_eq!(lab.event().await, "DELETED r1", "it left the map");
    assert_eq!(send(&admin, "DELETE", &format!("{G}/nodes/r1"), Value::Null).await.0, 200);
    assert_eq!(all.event().await, "DELETED r1");
    cluster.running.shut_down().await.unwrap();
    assert!(all.next().await.is_none(), "a shutdown ends watches");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn only_administrators_publish_and_say_what_measures() {
    let cluster = Cluster::start().await;
    register(&cluster.admin().await, "r1").await;
    let credential = agent::join(&cluster, "r1").await;
    let refused = Publisher::open(&cluster, &credential).await.err().expect("an agent may not");
    assert_eq!(refused.code(), Code::PermissionDenied);
    let holder = cluster.holder(credential.certificate(), credential.key()).await;
    assert_eq!(get(&holder, POSES).await.0, 403);
    assert_eq!(
        get(&holder, &format!("{G}/nodes/r1/pose")).await.0,
        404,
        "its own, which is not known"
    );
    assert_eq!(get(&cluster.anonymous().await, POSES).await.0, 401);
    let mut publisher = Publisher::open(&cluster, &agent::admin(&cluster)).await.unwrap();
    publisher.batches.send(wire::PoseBatch::default()).await.unwrap();
    let end = publisher.replies.message().await.expect_err("no source");
    assert_eq!((end.code(), end.message().contains("batch.source")), (Code::InvalidArgument, true));
    cluster.running.shut_down().await.unwrap();
}

fn own(x: f64) -> agent_wire::Pose {
    let (map, source) = ("map".to_owned(), "file".to_owned());
    agent_wire::Pose { map, x, source, localized: true, ..agent_wire::Pose::default() }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agents_pose_is_live_and_checkpointed_and_an_ended_sessions_is_not() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let credential = agent::join(&cluster, "r1").await;
    let mut earlier = Session::open(&cluster, &credential, Vec::new()).await.unwrap();
    earlier.assignments().await.unwrap();
    let mut poses = Lines::open(&admin, "").await;
    assert_eq!(poses.event().await, "BOOKMARK ");
    earlier.say_pose(own(5.0)).await;
    assert_eq!(poses.event().await, "ADDED r1 5");
    let node = format!("{G}/nodes/r1");
    let status = |x: f64| move |node: &Value| node["status"]["pose"]["x"] == x;
    cluster.until(&node, status(5.0)).await;

    let mut later = Session::open(&cluster, &credential, Vec::new()).await.unwrap();
    later.assignments().await.unwrap();
    earlier.say_pose(own(66.0)).await;
    later.say_pose(own(7.0)).await;
    assert_eq!(poses.event().await, "MODIFIED r1 7");
    let written = cluster.until(&node, status(7.0)).await;
    assert_eq!(written["status"]["pose"]["source"], "file");

    // The checkpoint stands in after a restart, until the robot says something.
    drop((earlier, later));
    let cluster = cluster.restart().await;
    let admin = cluster.admin().await;
    let mut poses = Lines::open(&admin, "").await;
    loop {
        // The first round may come before the nodes were looked at.
        match poses.event().await.as_str() {
            "BOOKMARK " => {}
            seen => break assert_eq!(seen, "ADDED r1 7"),
        }
    }
    let (_, one) = get(&admin, &format!("{G}/nodes/r1/pose")).await;
    assert!(one["ageMs"].is_null(), "nobody has said so in this life: {one}");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_waiting_task_is_bound_when_a_robot_comes_near() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let credential = agent::join(&cluster, "r1").await;
    let mut session = Session::open(&cluster, &credential, Vec::new()).await.unwrap();
    session.assignments().await.unwrap();
    session.say_pose(own(100.0)).await;
    let mut near = task("near");
    near["spec"]["placement"] = json!({"at": {"x": 0.0, "y": 0.0}, "within": 5.0, "on": "Robot"});
    assert_eq!(send(&admin, "POST", TASKS, near).await.0, 201);
    let path = format!("{TASKS}/near");
    let far = |task: &Value| task["status"]["why"][0]["reason"] == "OutOfRange";
    cluster.until(&path, far).await;
    let mut publisher = Publisher::open(&cluster, &agent::admin(&cluster)).await.unwrap();
    publisher.moves("r1", 3.0).await;
    let bound = cluster.until(&path, |task| task["status"]["node"] == "r1").await;
    assert_eq!(bound["status"]["score"], 3.0);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_slow_reader_sees_the_latest_and_holds_nobody_up() {
    const ROBOTS: usize = 40;
    const FRAMES: usize = 300;
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let names: Vec<String> = (0..ROBOTS).map(|i| format!("r{i}")).collect();
    for name in &names {
        register(&admin, name).await;
    }
    let mut slow = Lines::open(&admin, "").await;
    let mut publisher = Publisher::open(&cluster, &agent::admin(&cluster)).await.unwrap();
    publisher.known(&names.iter().map(String::as_str).collect::<Vec<_>>()).await;
    for frame in 1..=FRAMES {
        let poses = names.iter().map(|name| at(name, frame as f64)).collect();
        // One that waited for an answer to each would be no faster than who passes them on.
        if frame % 10 == 0 {
            assert_eq!(publisher.say("mocap", "", poses).await.taken as usize, ROBOTS);
        } else {
            publisher.send("mocap", "", poses, false).await;
        }
    }
    let (mut lines, mut arrived) = (0, 0);
    while arrived < ROBOTS {
        lines += 1;
        let event = slow.next().await.expect("the watch goes on");
        arrived += usize::from(event["object"]["x"] == FRAMES as f64);
    }
    assert!(lines < ROBOTS * FRAMES / 2, "{lines} lines: frames in between are passed over");
    cluster.running.shut_down().await.unwrap();
}
