//! The desk with a store whose disk fails.

use muster_api::kind::node::{Node, NodeKind, NodeSpec, NodeStatus, RuntimeStatus};
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::Compute;
use muster_controller_core::offer::DEFAULT_REFUSE;
use serde_json::json;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use wire::event::Event as Tell;

use super::*;
use crate::objects::{self, FRAMEWORKS, NODES, TASKS};
use crate::store::memory;

fn node() -> Node {
    let mut node = Node::new("r1", NodeSpec::new(NodeKind::Cloud));
    let status =
        json!({"conditions": [{"type": "Ready", "status": "True", "reason": "", "message": ""}]});
    let status: NodeStatus = serde_json::from_value(status).expect("a status");
    let runtime = RuntimeStatus {
        name: "process".to_owned(),
        available: true,
        version: String::new(),
        message: String::new(),
    };
    node.status = Some(NodeStatus {
        allocatable: Compute::new(MilliCpu(1000), Bytes(1 << 30)),
        runtimes: vec![runtime],
        ..status
    });
    node
}

/// A desk with one framework, one node, and a disk that can fail.
struct Room {
    desk: Desk,
    cluster: Cluster,
    context: Arc<Context>,
    failures: memory::Failures,
    heard: mpsc::Receiver<wire::Event>,
}

const FRAMEWORK: &str = "f-1";

impl Room {
    async fn open(dir: &tempfile::TempDir) -> Room {
        let (store, writer, failures) = memory::open().await;
        // It ends with the store's last handle.
        drop(tokio::spawn(writer.run(CancellationToken::new())));
        let context = crate::context::for_tests(dir.path(), store);
        let name = NodeName::new("r1").expect("a name");
        let mut node = node();
        objects::stamp_new(&mut node.metadata, context.clock.now());
        let key = Key::cluster(NODES, "r1");
        context.store.apply_one(objects::create(key, &node)).await.expect("it is written");
        let mut cluster = Cluster::new();
        cluster.upsert_node(&name, &node);
        let (events, heard) = mpsc::channel(64);
        let outlet = Outlet::new(1, events, CancellationToken::new());
        let mut desk = Desk::new(Arc::clone(&context));
        let key = Key::namespaced(FRAMEWORKS, "default", "deliver");
        let spec = Box::default();
        let uid = FRAMEWORK.into();
        desk.take(&mut cluster, Request::Subscribe { uid, key, spec, outlet });
        let mut room = Room { desk, cluster, context, failures, heard };
        room.work().await;
        room
    }

    async fn work(&mut self) {
        self.desk.begin_pass(&mut self.cluster, false);
        self.desk.work(&mut self.cluster).await;
    }

    fn hear<T>(&mut self, of: impl Fn(Tell) -> Option<T>) -> Vec<T> {
        let mut heard = Vec::new();
        while let Ok(event) = self.heard.try_recv() {
            heard.extend(event.event.and_then(&of));
        }
        heard
    }

    fn answers(&mut self) -> Vec<wire::Answer> {
        self.hear(|event| if let Tell::Answer(answer) = event { Some(answer) } else { None })
    }

    /// Accepts the newest offer with one launch.
    async fn accept(&mut self, name: &str) {
        let offers =
            self.hear(|event| if let Tell::Offers(o) = event { Some(o.offers) } else { None });
        let offer = offers.concat().pop().expect("an offer").id.parse().expect("an id");
        let spec = json!({"resources": {"cpu": "600m"}, "run": {"process": {"command": ["true"]}}});
        let object = json!({
            "apiVersion": muster_api::API_VERSION, "kind": "Task", "spec": spec,
            "metadata": {"name": name, "namespace": "default", "uid": name},
        });
        let launch = Prepared {
            key: Key::namespaced(TASKS, "default", name),
            object,
            spec: serde_json::from_value(spec).expect("a spec"),
            uid: muster_api::id::TaskUid::new(name),
            offer,
            _pass: None,
        };
        let request = Request::Accept {
            uid: FRAMEWORK.into(),
            session: 1,
            by: Arc::new(crate::auth::Identity::Admin { name: "a".to_owned() }),
            call: name.to_owned(),
            offers: vec![offer],
            launches: vec![launch],
            refuse: Duration::ZERO,
            guard: None,
        };
        self.desk.take(&mut self.cluster, request);
        self.work().await;
    }

    async fn settle(&mut self) -> Vec<NodeName> {
        assert!(self.desk.is_unsure(), "nobody knows yet");
        self.context.store.settled().await.expect("the disk answers again");
        self.desk.resolve(&mut self.cluster)
    }
}

/// A framework is told to try again only what is surely not written.
#[tokio::test]
async fn an_accept_is_answered_when_it_is_known_what_became_of_it() {
    let dir = tempfile::tempdir().expect("a directory");
    let mut room = Room::open(&dir).await;
    room.failures.mislead_next(1);
    room.accept("written").await;
    assert_eq!(room.answers(), [], "the disk may have it");
    assert_eq!(room.settle().await, []);
    let answers = room.answers();
    assert_eq!((answers.len(), &*answers[0].id, &answers[0].refusal), (1, "written", &None));
    assert_eq!(answers[0].launched[0].name, "written");

    // What it took stays taken, and the rest is offered.
    assert!(room.cluster.node_of(&muster_api::id::TaskUid::new("written")).is_some());
    room.cluster.release(&muster_api::id::TaskUid::new("written"));
    room.work().await;
    room.failures.fail_next(1);
    room.accept("lost").await;
    assert_eq!(room.answers(), []);
    assert_eq!(room.settle().await, [NodeName::new("r1").expect("a name")]);
    let answers = room.answers();
    let refusal = answers[0].refusal.as_ref().expect("it is refused");
    assert_eq!(refusal.reason(), wire::RefusalReason::Unavailable);
    assert!(room.cluster.node_of(&muster_api::id::TaskUid::new("lost")).is_none());
    room.work().await;
    room.accept("again").await;
    assert!(room.answers()[0].refusal.is_none(), "it was told to try again");
}

/// A cluster that is made anew ends every offer and forgets no decline.
#[tokio::test]
async fn what_was_declined_is_not_offered_by_a_cluster_that_is_made_anew() {
    let dir = tempfile::tempdir().expect("a directory");
    let mut room = Room::open(&dir).await;
    let offers = room.hear(|event| if let Tell::Offers(o) = event { Some(o.offers) } else { None });
    let offers = offers.concat().iter().map(|o| o.id.parse().expect("an id")).collect();
    let decline = Request::Decline { uid: FRAMEWORK.into(), offers, refuse: DEFAULT_REFUSE * 700 };
    room.desk.take(&mut room.cluster, decline);
    room.work().await;
    let mut anew = Cluster::new();
    for name in ["r0", "r1"] {
        anew.upsert_node(&NodeName::new(name).expect("a name"), &node());
    }
    let before = std::mem::replace(&mut room.cluster, anew);
    room.desk.begin_anew(&before, &room.cluster);
    room.work().await;
    let offers = room.hear(|event| if let Tell::Offers(o) = event { Some(o.offers) } else { None });
    let nodes: Vec<String> = offers.concat().into_iter().map(|offer| offer.node).collect();
    assert_eq!(nodes, ["r0"]);
}

#[test]
fn what_comes_of_a_session_is_no_later_ones() {
    let (events, _heard) = mpsc::channel(1);
    let second = Outlet::new(2, events, CancellationToken::new());
    let key = Key::namespaced(FRAMEWORKS, "default", "deliver");
    let guest = Guest { uid: "f-1".into(), key, outlet: Some(second) };
    assert!(guest.outlet_of(1).is_none(), "its call had the same id, perhaps");
    assert_eq!(guest.outlet_of(2).map(Outlet::session), Some(2));
}
