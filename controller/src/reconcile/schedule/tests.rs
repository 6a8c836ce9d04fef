//! When the scheduler decides, and when it does not.

use std::time::Duration;

use muster_api::kind::node::{NodeKind, NodeSpec};
use muster_api::kind::quota::QUOTA_NAME;
use muster_controller_core::offer::DEFAULT_REFUSE;
use serde_json::json;
use tokio_util::sync::CancellationToken;

use super::*;
use crate::objects::FRAMEWORKS;
use crate::reconcile::desk::{Depth, Outlet, Request};
use crate::store::Op;

/// No wait in a test should take this long.
const DEADLINE: Duration = Duration::from_secs(60);

fn decisions(context: &Context) -> u64 {
    let text = context.metrics.render();
    let line = text.lines().find_map(|line| line.strip_prefix("muster_decisions_total "));
    line.map_or(0, |count| count.parse().expect("a number"))
}

async fn create(context: &Context, key: Key, mut object: serde_json::Value) {
    object["metadata"]["uid"] = key.name.to_string().into();
    context.store.apply_one(objects::create(key, &object)).await.expect("it is written");
}

/// Waits until the scheduler knows everything that is stored, and has nothing more to write.
async fn quiet(context: &Context, handle: &Handle) -> u64 {
    let waited = tokio::time::timeout(DEADLINE, async {
        loop {
            let before = decisions(context);
            let (_, seen) = handle.plan(Vec::new()).await.expect("it works");
            // Answered in the next pass: what the one before decided is written.
            handle.plan(Vec::new()).await.expect("it works");
            if seen >= context.store.revision() && before == decisions(context) {
                return before;
            }
        }
    });
    waited.await.expect("it settles")
}

/// What frameworks and people ask changes no task's place: waiting tasks are not gone through again for it.
#[tokio::test]
async fn nothing_is_decided_again_when_nothing_has_changed() {
    let dir = tempfile::tempdir().expect("a directory");
    let context = crate::context::for_tests(dir.path(), crate::store::memory::start().await);
    let (scheduler, handle) =
        Scheduler::new(Arc::clone(&context), Default::default(), Arc::default());
    let _works = tokio_util::task::AbortOnDropHandle::new(tokio::spawn(scheduler.run()));
    let spec = json!({"run": {"process": {"command": ["true"]}}});
    let task = json!({"metadata": {"name": "t", "namespace": "default"}, "spec": spec});
    create(&context, Key::namespaced(TASKS, "default", "t"), task).await;
    let (events, mut heard) = mpsc::channel(64);
    let subscribe = Request::Subscribe {
        uid: "f".into(),
        key: Key::namespaced(FRAMEWORKS, "default", "deliver"),
        spec: Box::default(),
        outlet: Outlet::new(1, events, CancellationToken::new()),
    };
    handle.desk(subscribe).await.expect("it works");
    let before = quiet(&context, &handle).await;
    assert!(before > 0, "the task was looked at");

    for _ in 0..20 {
        let uid = || "f".into();
        let decline = Request::Decline { uid: uid(), offers: Vec::new(), refuse: DEFAULT_REFUSE };
        for request in [decline, Request::Suppress { uid: uid() }, Request::Revive { uid: uid() }] {
            handle.desk(request).await.expect("it works");
        }
        let (answer, answered) = oneshot::channel();
        handle.desk(Request::Look { depth: Depth::Offers, answer }).await.expect("it works");
        assert_eq!(answered.await.expect("an answer").len(), 1);
        handle.plan(Vec::new()).await.expect("it works");
    }
    assert_eq!(decisions(&context), before, "nothing has changed");
    assert!(heard.try_recv().is_err(), "there is nothing to offer");

    let node = Node::new("n", NodeSpec::new(NodeKind::Cloud));
    create(&context, Key::cluster(NODES, "n"), objects::to_value(&node)).await;
    assert!(quiet(&context, &handle).await > before, "there is a node now");
    let now = quiet(&context, &handle).await;
    let metadata = json!({"name": QUOTA_NAME, "namespace": "default"});
    let quota = json!({"metadata": metadata, "spec": {"weight": 2.0}});
    create(&context, Key::namespaced(QUOTAS, "default", QUOTA_NAME), quota).await;
    assert!(quiet(&context, &handle).await > now, "a quota may let it go");

    let now = quiet(&context, &handle).await;
    let grid = json!({"width": 1, "height": 1, "resolution": 1.0, "origin": {"x": 0.0, "y": 0.0}, "cells": "o"});
    let lab = Key::cluster(SITES, "lab");
    let site = json!({"metadata": {"name": "lab"}, "spec": {"inflation": 0.2, "grid": grid}});
    create(&context, lab.clone(), site).await;
    let walled = quiet(&context, &handle).await;
    assert!(walled > now, "a wall may be in the way");
    let stored = context.store.get(&lab).expect("it is there");
    context.store.apply_one(Op::remove(lab, stored.revision)).await.expect("it is written");
    assert!(quiet(&context, &handle).await > walled, "the wall is gone");
}
