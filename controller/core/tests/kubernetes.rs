//! Where a field has Kubernetes' name it means what it means there: tables of what Kubernetes documents against what the
//! controller's core decides. Where muster means something else, its row says why. The grammar of the fields is in
//! `api/tests/kubernetes.rs`.

#[path = "../../../api/tests/table/mod.rs"]
mod table;

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use muster_api::id::TaskUid;
use muster_api::kind::node::Node;
use muster_api::kind::task::{DEADLINE_EXCEEDED, Task};
use muster_api::name::NodeName;
use muster_controller_core::cluster::Cluster;
use muster_controller_core::deadline::{Due, due};
use muster_controller_core::deletion::deletion;
use muster_controller_core::schedule::{Demand, Plan, schedule};
use serde_json::{Value, json};
use table::{Differs, Row, Same, hold};

/// A server with so many cores; `spec` and `labels` are its Node's.
fn server(cores: u64, spec: Value, labels: Value, ready: &str) -> Node {
    let mut node = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Node",
        "metadata": {"name": "n", "labels": labels},
        "spec": spec,
        "status": {
            "allocatable": {"cpu": cores, "memory": "1Gi"},
            "conditions": [{"type": "Ready", "status": ready}],
            "runtimes": [{"name": "process", "available": true}],
        },
    });
    node["spec"]["kind"] = "Cloud".into();
    serde_json::from_value(node).expect("a node")
}

fn demand(uid: &str, spec: &Value, since: u64) -> Demand {
    let mut spec = spec.clone();
    spec["run"] = json!({"process": {"command": ["true"]}});
    Demand {
        uid: TaskUid::new(uid),
        title: format!("default/{uid}").into(),
        spec: Arc::new(serde_json::from_value(spec).expect("a spec")),
        since,
        avoid: Arc::default(),
        framework: None,
    }
}

fn cluster(nodes: &[(&str, Node)]) -> Cluster {
    let mut cluster = Cluster::new();
    for (name, node) in nodes {
        cluster.upsert_node(&NodeName::new(*name).expect("a name"), node);
    }
    cluster
}

/// The node of the only task, or the reason of the first refusal.
fn place(plan: &Plan) -> String {
    let reason = || plan.waits[0].why[0].reason.clone();
    plan.binds.first().map_or_else(reason, |bind| bind.node.to_string())
}

fn list(yaml_like: &str) -> Value {
    serde_json::from_str(yaml_like).expect(yaml_like)
}

const LOW: &str = r#"[{"key": "battery", "value": "low", "effect": "NoSchedule"}]"#;
const BUSY: &str = r#"[{"key": "busy", "effect": "PreferNoSchedule"}]"#;
const LOW_AND_WET: &str = r#"[{"key": "battery", "value": "low", "effect": "NoSchedule"}, {"key": "wet", "effect": "NoSchedule"}]"#;
const LOW_TWICE: &str = r#"[{"key": "battery", "effect": "NoSchedule"}, {"key": "battery", "effect": "PreferNoSchedule"}]"#;
const NONE: &str = "[]";
const EVERYTHING: &str = r#"[{"operator": "Exists"}]"#;

/// Whether a node with these taints, the only one, takes a task with these tolerations.
#[test]
fn taints_keep_away_what_does_not_tolerate_them() {
    let rows: &[Row<(&str, &str), bool>] = &[
        ((NONE, NONE), true, Same),
        ((LOW, NONE), false, Same),
        ((LOW, r#"[{"key": "battery", "value": "low"}]"#), true, Same),
        ((LOW, r#"[{"key": "battery", "value": "full"}]"#), false, Same),
        ((LOW, r#"[{"key": "battery", "operator": "Exists"}]"#), true, Same),
        ((LOW, r#"[{"operator": "Exists", "effect": "NoSchedule"}]"#), true, Same),
        ((LOW, r#"[{"operator": "Exists", "effect": "PreferNoSchedule"}]"#), false, Same),
        ((LOW, EVERYTHING), true, Same),
        // A preference keeps nothing away.
        ((BUSY, NONE), true, Same),
        // Every taint has to be tolerated, by one toleration or another.
        ((LOW_AND_WET, r#"[{"key": "battery", "operator": "Exists"}]"#), false, Same),
        (
            (LOW_AND_WET, r#"[{"key": "battery", "operator": "Exists"}, {"key": "wet"}]"#),
            true,
            Same,
        ),
        ((LOW_TWICE, r#"[{"key": "battery", "effect": "NoSchedule"}]"#), true, Same),
    ];
    hold(rows, |(taints, tolerations)| {
        let node = server(4, json!({"taints": list(taints)}), json!({}), "True");
        let spec = json!({"placement": {"tolerations": list(tolerations)}});
        let place = place(&schedule(&mut cluster(&[("n", node)]), &mut [demand("t", &spec, 0)]));
        assert!(place == "n" || place == "Tainted", "{place}");
        place == "n"
    });
}

/// What Kubernetes keeps in taints too, and muster does not: whether the node takes a task.
#[test]
fn what_is_no_taint_is_not_tolerated() {
    let tolerant = json!({"placement": {"tolerations": list(EVERYTHING)}});
    let pinned = json!({"placement": {"node": "n"}});
    let (cordoned, tainted) = (json!({"unschedulable": true}), json!({"taints": list(LOW)}));
    let rows: &[Row<(&Value, &str, &Value), &str>] = &[
        ((&json!({}), "True", &tolerant), "n", Same),
        ((&cordoned, "True", &json!({})), "Cordoned", Same),
        (
            (&cordoned, "True", &tolerant),
            "n", // It tolerates node.kubernetes.io/unschedulable.
            Differs("Cordoned", "a cordon is a person's word that nothing new begins there"),
        ),
        ((&json!({}), "False", &json!({})), "NotReady", Same),
        (
            (&json!({}), "Unknown", &tolerant),
            "n", // It tolerates node.kubernetes.io/unreachable.
            Differs("NotReady", "nobody is there to start it, and a lease would wait with it"),
        ),
        (
            (&tainted, "True", &pinned),
            "n", // nodeName passes the scheduler by.
            Differs("Tainted", "placement.node narrows the choice, and is no right to the node"),
        ),
    ];
    hold(rows, |(spec, ready, task)| {
        let node = server(4, spec.clone(), json!({}), ready);
        let plan = schedule(&mut cluster(&[("n", node)]), &mut [demand("t", task, 0)]);
        &*place(&plan).leak()
    });
}

/// Which of two nodes is taken, `better` with these taints or `other` with those. Kubernetes weighs a PreferNoSchedule
/// against its other scores; in muster such a node comes after every one without.
#[test]
fn a_preference_decides_between_nodes() {
    let rows: &[Row<(&str, &str, &str), &str>] = &[
        ((NONE, NONE, NONE), "better", Same),
        ((BUSY, NONE, NONE), "other", Same),
        ((BUSY, NONE, r#"[{"key": "busy", "operator": "Exists"}]"#), "better", Same),
        ((BUSY, NONE, r#"[{"key": "busy", "effect": "NoSchedule"}]"#), "other", Same),
        ((BUSY, BUSY, NONE), "better", Same),
        ((BUSY, LOW, NONE), "better", Same),
        ((LOW, BUSY, NONE), "other", Same),
    ];
    hold(rows, |(better, other, tolerations)| {
        let node =
            |cores, taints| server(cores, json!({"taints": list(taints)}), json!({}), "True");
        let mut cluster = cluster(&[("better", node(8, better)), ("other", node(4, other))]);
        let spec = json!({"placement": {"tolerations": list(tolerations)}});
        &*place(&schedule(&mut cluster, &mut [demand("t", &spec, 0)])).leak()
    });
}

/// Whether a node with the label `zone=a`, and one without labels, take a task with this `placement.selector`.
#[test]
fn selectors_choose_nodes() {
    let none = json!({});
    let zone = json!({"matchLabels": {"zone": "a"}});
    let part = |operator: &str, values: &[&str]| json!({"matchExpressions": [{"key": "zone", "operator": operator, "values": values}]});
    let rows: &[Row<&Value, (bool, bool)>] = &[
        (&none, (true, true), Same),
        (&zone, (true, false), Same),
        (&part("In", &["a", "b"]), (true, false), Same),
        (&part("NotIn", &["a"]), (false, true), Same),
        (&part("NotIn", &["b"]), (true, true), Same),
        (&part("Exists", &[]), (true, false), Same),
        (&part("DoesNotExist", &[]), (false, true), Same),
    ];
    hold(rows, |selector| {
        let takes = |labels: Value| {
            let node = server(4, json!({}), labels, "True");
            let task = demand("t", &json!({"placement": {"selector": selector}}), 0);
            place(&schedule(&mut cluster(&[("n", node)]), &mut [task])) == "n"
        };
        (takes(json!({"zone": "a"})), takes(json!({})))
    });
}

fn sized(priority: i32, cores: u64, preemption: &str) -> Value {
    json!({"priority": priority, "preemption": preemption, "resources": {"cpu": cores}})
}

/// Which of two waiting tasks gets the only place: (priority, created at) of `a` and of `b`.
#[test]
fn the_queue_is_by_priority_then_by_age() {
    let rows: &[Row<[(i32, u64); 2], &str>] = &[
        ([(0, 1), (0, 2)], "a", Same),
        ([(0, 2), (0, 1)], "b", Same),
        ([(0, 1), (5, 2)], "b", Same),
        ([(0, 2), (-1, 1)], "a", Same),
    ];
    hold(rows, |[a, b]| {
        let mut cluster = cluster(&[("n", server(1, json!({}), json!({}), "True"))]);
        // As with preemptionPolicy Never, which does not change the order.
        let mut tasks = [("a", a), ("b", b)]
            .map(|(uid, (priority, since))| demand(uid, &sized(priority, 1, "Never"), since));
        let plan = schedule(&mut cluster, &mut tasks);
        assert_eq!(plan.binds.len(), 1);
        &*plan.binds[0].uid.as_str().to_owned().leak()
    });
}

/// Whether a task ends one that is in its place: the priorities of both, and `preemption` (`preemptionPolicy`).
#[test]
fn a_more_important_task_takes_the_place_of_a_less_important_one() {
    let rows: &[Row<(i32, i32, &str), bool>] = &[
        ((0, 1, "LowerPriority"), true, Same),
        ((-1, 0, "LowerPriority"), true, Same),
        ((1, 1, "LowerPriority"), false, Same),
        ((2, 1, "LowerPriority"), false, Same),
        ((0, 1, "Never"), false, Same),
    ];
    hold(rows, |(holder, waiting, preemption)| {
        let mut cluster = cluster(&[("n", server(1, json!({}), json!({}), "True"))]);
        let bound = schedule(&mut cluster, &mut [demand("old", &sized(holder, 1, "Never"), 1)]);
        assert_eq!(bound.binds.len(), 1);
        let plan = schedule(&mut cluster, &mut [demand("new", &sized(waiting, 1, preemption), 2)]);
        assert_eq!(plan.binds, [], "the place is not free before the other has ended");
        plan.preemptions.iter().any(|preemption| !preemption.victims.is_empty())
    });
}

/// On which of two full nodes tasks are ended for one of priority 9 that needs all of a node: the priorities of what runs
/// on each. (kube-scheduler's `pickOneNodeForPreemption`; there are no PodDisruptionBudgets. More of the choice, against
/// brute force, is in `preempt/tests.rs`.)
#[test]
fn the_least_harm() {
    type OnBoth = (&'static [i32], &'static [i32]);
    let rows: &[Row<OnBoth, &str>] = &[
        // The least important most important one.
        ((&[5], &[1]), "b", Same),
        ((&[5], &[1, 1]), "b", Same),
        // Fewer; then the less important ones.
        ((&[1], &[1, 0]), "a", Same),
        ((&[1, 1], &[1, 0]), "b", Same),
    ];
    hold(rows, |(a, b)| {
        let mut cluster = cluster(&[]);
        for (name, priorities) in [("a", a), ("b", b)] {
            let node = NodeName::new(name).expect("a name");
            cluster.upsert_node(&node, &server(2, json!({}), json!({}), "True"));
            let each = 2 / priorities.len() as u64;
            for (i, priority) in priorities.iter().enumerate() {
                let task = demand(&format!("{name}{i}"), &sized(*priority, each, "Never"), 1);
                assert_eq!(schedule(&mut cluster, &mut [task]).binds[0].node, node);
            }
        }
        let plan = schedule(&mut cluster, &mut [demand("big", &sized(9, 2, "LowerPriority"), 2)]);
        &*plan.preemptions[0].node.to_string().leak()
    });
}

/// `seconds` after the task was placed.
fn at(seconds: i64) -> Timestamp {
    let placed: Timestamp = "2026-01-01T00:00:00Z".parse().expect("a time");
    placed + SignedDuration::from_secs(seconds)
}

/// A task that was placed at 0 s, in the phase that is said.
fn task(spec: &Value, phase: &str, status: &Value) -> Task {
    let mut object = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Task", "metadata": {"name": "t"},
        "spec": {"run": {"process": {"command": ["a"]}}},
        "status": {"phase": phase},
    });
    if phase != "Pending" {
        object["status"]["boundAt"] = time(0);
    }
    for (to, from) in [("spec", spec), ("status", status)] {
        for (field, value) in from.as_object().expect("members") {
            object[to][field] = value.clone();
        }
    }
    serde_json::from_value(object).expect("a task")
}

fn time(seconds: i64) -> Value {
    at(seconds).strftime("%Y-%m-%dT%H:%M:%S.000000Z").to_string().into()
}

/// `activeDeadlineSeconds: 30`, of a Pod: when it is ended, seconds after it was placed.
#[test]
fn active_deadlines() {
    // Its agent took it up at 2 s, and its first attempt started at 10 s.
    let (none, started) = (json!({}), json!({"startedAt": time(10), "attempt": 1}));
    let again = json!({"startedAt": time(25), "attempt": 4});
    let ordered = json!({"stop": {"reason": "Preempted", "message": "", "at": time(5)}});
    let over = json!({"finishedAt": time(20)});
    const PLACED: &str = "counts from the placement: the task has its robot and its lease from then on, and a node without contact must not win time";
    let rows: &[Row<(&str, &Value), Option<i64>>] = &[
        // Waiting for a place costs nothing.
        (("Pending", &none), None, Same),
        // From status.startTime, which the kubelet sets when it takes the Pod up; images are pulled after that.
        (("Bound", &none), Some(32), Differs(Some(30), PLACED)),
        (("Starting", &none), Some(32), Differs(Some(30), PLACED)),
        (("Running", &started), Some(32), Differs(Some(30), PLACED)),
        // A restart does not begin it anew, and back-off counts.
        (("Running", &again), Some(32), Differs(Some(30), PLACED)),
        (("Starting", &again), Some(32), Differs(Some(30), PLACED)),
        (("Unknown", &started), Some(32), Differs(Some(30), PLACED)),
        // It ends already, or has ended.
        (("Running", &ordered), None, Same),
        (("Succeeded", &over), None, Same),
        (("Failed", &over), None, Same),
    ];
    let seconds = |due: Due| match due {
        Due::Stop(at_time) => at_time.duration_since(at(0)).as_secs(),
        Due::Remove(_) => panic!("it has no ttl"),
    };
    let spec = json!({"activeDeadlineSeconds": 30});
    hold(rows, |(phase, status)| due(&task(&spec, phase, status)).map(seconds));
    let mut deleted = task(&spec, "Running", &started);
    deleted.metadata.deletion_timestamp =
        serde_json::from_value(json!("2026-01-01T00:00:20Z")).expect("a time");
    assert_eq!(due(&deleted), None, "it ends already");
    // What the task has Failed with then.
    assert_eq!(DEADLINE_EXCEEDED, "DeadlineExceeded");
}

/// `ttlSecondsAfterFinished`, of a Job: when it is deleted, seconds after it was placed. It ends at 60 s.
#[test]
fn ttl_after_finished() {
    let (running, over) = (json!({"startedAt": time(1)}), json!({"finishedAt": time(60)}));
    let exceeded = json!({"finishedAt": time(60), "reason": DEADLINE_EXCEEDED});
    let (early, none) = (json!({"finishedAt": time(-5)}), json!({}));
    type Ended<'a> = (Option<u32>, &'a str, &'a Value);
    let rows: &[Row<Ended, Option<i64>>] = &[
        ((None, "Succeeded", &over), None, Same),
        ((Some(0), "Pending", &none), None, Same),
        ((Some(0), "Running", &running), None, Same),
        ((Some(0), "Stopping", &running), None, Same),
        ((Some(0), "Unknown", &running), None, Same),
        ((Some(0), "Succeeded", &over), Some(60), Same),
        ((Some(5), "Succeeded", &over), Some(65), Same),
        ((Some(5), "Failed", &over), Some(65), Same),
        ((Some(5), "Failed", &exceeded), Some(65), Same),
        // Fenced before its node said that it started.
        ((Some(5), "Failed", &none), Some(5), Same),
        (
            (Some(5), "Succeeded", &early),
            Some(0),
            Differs(
                Some(5),
                "the end is told by the robot's clock, which may be wrong: not before the placement",
            ),
        ),
    ];
    let seconds = |due: Due| match due {
        Due::Remove(at_time) => at_time.duration_since(at(0)).as_secs(),
        Due::Stop(_) => panic!("it has no deadline"),
    };
    hold(rows, |(ttl, phase, status)| {
        due(&task(&json!({"ttlSecondsAfterFinished": ttl}), phase, status)).map(seconds)
    });
}

/// `DELETE` of a task that runs (a Pod's `rest.BeforeDelete`). Asked: at which second, with which
/// `gracePeriodSeconds`; earlier: when an earlier DELETE wants it gone. Answer: `deletionTimestamp`, in seconds, and
/// `deletionGracePeriodSeconds`; none: as before.
#[test]
fn grace_of_deletions() {
    const WHEN: &str =
        "the stamp is when it will be gone: the grace counts from the request that names it";
    const NO_LATER: &str = "5 s from now is later than what was wanted before";
    const HELD: &str = "an object goes when its processes are gone, and 0 only hurries: removing it would free its lease";
    type Request = (i64, Option<i64>, Option<i64>);
    let rows: &[Row<Request, Option<(i64, i64)>>] = &[
        // The first: what it names, also more than the task's own 10 s.
        ((0, None, None), Some((10, 10)), Same),
        ((0, Some(5), None), Some((5, 5)), Same),
        ((0, Some(60), None), Some((60, 60)), Same),
        // 0 removes a Pod at once, whatever runs.
        ((0, Some(0), None), None, Differs(Some((0, 0)), HELD)),
        // Another, after one that wants it gone at 10 s: sooner, never later.
        ((2, None, Some(10)), None, Same),
        ((2, Some(10), Some(10)), None, Same),
        ((2, Some(60), Some(10)), None, Same),
        ((2, Some(5), Some(10)), Some((5, 5)), Differs(Some((7, 5)), WHEN)),
        ((8, Some(5), Some(10)), Some((5, 5)), Differs(None, NO_LATER)),
        ((2, Some(0), Some(10)), None, Differs(Some((2, 0)), HELD)),
    ];
    hold(rows, |(now, asked, earlier)| {
        let wish = deletion(at(now), asked, 10, earlier.map(at))?;
        Some((wish.at.duration_since(at(0)).as_secs(), wish.grace))
    });
}
