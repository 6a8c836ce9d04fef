//! Images come before their tasks: nothing is ended for what cannot be begun.

use std::collections::BTreeMap;

use futures::StreamExt as _;
use kube::api::{WatchEvent, WatchParams};
use kube::{Api, Resource};
use muster_api::kind::node::Node;
use muster_api::kind::node::image::ImagePhase;
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_tests::docker::{self, IMAGE};
use muster_tests::registry::Registry;
use muster_tests::{AgentOptions, Cluster, wait};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use crate::cli::muster;
use crate::tasksets::{complete, create, patch, says, status};

/// Two robots with a container each.
async fn two(deadline: u32) -> Cluster {
    docker::image();
    let mut cluster = Cluster::start().await;
    for (name, x) in [("near", 0.0), ("far", 10.0)] {
        cluster.join(AgentOptions::robot(name, x, 0.0)).await;
        // The canary is the nearest robot only if that one can run a container by then.
        wait::object(cluster.nodes().await, name, "able to run containers", |node| {
            let status = node.and_then(|n| n.status.as_ref());
            status.is_some_and(|s| s.runtimes.iter().any(|r| r.name == "docker" && r.available))
        })
        .await;
    }
    let spec = json!({
        "replicas": 2, "minReadySeconds": 1, "rollout": {"progressDeadlineSeconds": deadline},
        "template": {"spec": {
            "gracePeriodSeconds": 0,
            "placement": {"at": {"x": 0.0, "y": 0.0}, "on": "Robot"},
            "run": {"container": {"image": IMAGE, "command": ["sleep", "1000"], "network": "None"}},
        }},
    });
    create(&cluster, "watch", spec).await;
    complete(&cluster, "watch", 2).await;
    cluster
}

fn with_image(image: &str) -> Value {
    json!({"spec": {"template": {"spec": {"run": {"container": {"image": image}}}}}})
}

/// The uids of the tasks that run, by node.
async fn running(cluster: &Cluster) -> BTreeMap<String, String> {
    let tasks = cluster.tasks().await.list(&Default::default()).await.expect("a list");
    let row = |task: &Task| {
        let status = task.status.clone().filter(|status| status.phase == TaskPhase::Running)?;
        assert_eq!(status.attempt, 1, "{status:#?}");
        Some((status.node?, task.metadata.uid.clone()?))
    };
    tasks.items.iter().filter_map(row).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn an_image_that_cannot_be_pulled_ends_no_task_and_the_rollout_at_its_deadline() {
    let cluster = two(30).await;
    let registry = Registry::start().await;
    let before = running(&cluster).await;
    let image = registry.name("absent");
    patch(&cluster, "watch", with_image(&image)).await;
    status(&cluster, "watch", "said to fail", |s| says(s, "ImagePullBackOff")).await;
    let (_, told, _) = muster(&cluster, &["rollout", "status", "ts/watch", "--watch=false"]);
    let why = format!("near cannot have {image}: ");
    assert!(told.contains(&why) && told.contains("manifest unknown"), "{told}");
    // While it is tried again it is not backing off.
    wait::until("said under both", || async {
        let (_, set, _) = muster(&cluster, &["describe", "taskset/watch"]);
        let (_, node, _) = muster(&cluster, &["describe", "node/near"]);
        let both = set.contains(&image) && node.contains("BackOff") && node.contains(&image);
        if both { Ok(()) } else { Err(format!("{set}{node}")) }
    })
    .await;

    let back = status(&cluster, "watch", "rolled back", |s| says(s, "RolledBack")).await;
    let back = back.rolled_back_from.expect("it was given up");
    assert_eq!(back.reason, "ImagePullFailed");
    let said = format!("near did not have {image} within 30 s: ");
    assert!(back.message.contains(&said) && back.message.contains("manifest"), "{}", back.message);
    assert_eq!(running(&cluster).await, before, "nothing was touched");
    let (code, _, err) = muster(&cluster, &["rollout", "status", "ts/watch"]);
    assert!(code == 1 && err.contains(&said), "{err}");
    wait::object(cluster.nodes().await, "near", "asked for nothing", |node| {
        node.and_then(|n| n.status.as_ref()).is_some_and(|s| s.images.is_empty())
    })
    .await;
}

/// The revisions of the first changes after `from` that are as wanted on either node, by node.
async fn first<K>(
    api: &Api<K>,
    from: &str,
    wanted: impl Fn(&K) -> Option<String>,
) -> BTreeMap<String, u64>
where
    K: Resource + Clone + std::fmt::Debug + DeserializeOwned,
{
    // What has been is told at once, or as soon as a busy controller comes to it.
    let params = WatchParams::default().timeout(60);
    let mut events = api.watch(&params, from).await.expect("a watch").boxed();
    let mut found = BTreeMap::new();
    while found.len() < 2
        && let Some(event) = events.next().await
    {
        if let Ok(WatchEvent::Added(object) | WatchEvent::Modified(object)) = event
            && let Some(key) = wanted(&object)
        {
            let revision = object.meta().resource_version.clone().expect("it is stored");
            found.entry(key).or_insert_with(|| revision.parse().expect("a number"));
        }
    }
    assert_eq!(found.len(), 2, "{found:?}");
    found
}

#[tokio::test(flavor = "multi_thread")]
async fn the_image_is_on_the_robot_before_its_task_is_told_to_stop() {
    let mut cluster = two(600).await;
    let registry = Registry::start().await;
    let before = running(&cluster).await;
    let start = cluster.nodes().await.list(&Default::default()).await.expect("a list");
    let start = start.metadata.resource_version.expect("a list has one");
    let image = registry.name("late");
    patch(&cluster, "watch", with_image(&image)).await;
    status(&cluster, "watch", "said to fail", |s| says(s, "ImagePullBackOff")).await;
    // What is wanted outlives both who want it.
    cluster.kill_agent("near");
    cluster.kill_controller();
    assert_eq!(registry.put("late"), image);
    // A node that is silent for too long after that loses its turn to the other.
    cluster.spawn_agent("near", None);
    cluster.start_controller().await;
    cluster.node_ready("near").await;
    let done = complete(&cluster, "watch", 2).await;
    assert_eq!((done.updated_replicas, done.image_pulls), (2, Vec::new()));

    let pulled = first(&cluster.nodes().await, &start, |node: &Node| {
        let images = &node.status.as_ref()?.images;
        let has = images.iter().any(|i| i.wish.image == image && i.phase == ImagePhase::Pulled);
        node.metadata.name.clone().filter(|_| has)
    })
    .await;
    let stopped = first(&cluster.tasks().await, &start, |task: &Task| {
        let uid = task.metadata.uid.as_ref().filter(|_| task.metadata.deletion_timestamp.is_some());
        before.iter().find(|(_, of)| Some(*of) == uid).map(|(node, _)| node.clone())
    })
    .await;
    for node in ["near", "far"] {
        assert!(pulled[node] < stopped[node], "{node}: {pulled:?} {stopped:?}");
    }
    // The other robot was asked while the canary proved itself, and neither before that.
    assert!(pulled["near"] < pulled["far"], "{pulled:?}");
    let events = cluster.get("/api/v1/namespaces/default/events").await.to_string();
    assert!(events.contains(&format!("{image} is there before a task needs it")), "{events}");
}
