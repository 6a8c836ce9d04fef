//! Admission of tasks, and the rules of their parts.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use serde_json::{Value, json};

use super::*;
use crate::kind::{admit, admit_change, find};
use crate::phase::TaskPhase;

fn task(spec: Value) -> Value {
    json!({"apiVersion": crate::API_VERSION, "kind": "Task", "metadata": {"name": "t"}, "spec": spec})
}

fn sleep(mut spec: Value) -> Value {
    spec["run"] = json!({"process": {"command": ["sleep", "1"]}});
    task(spec)
}

fn problems(object: &Value) -> Vec<String> {
    match admit(object) {
        Ok(_) => Vec::new(),
        Err(violations) => violations.iter().map(ToString::to_string).collect(),
    }
}

#[test]
fn a_small_task_gets_its_defaults() {
    let admitted =
        admit(&sleep(json!({"resources": {"cpu": 0.5, "memory": "1073741824"}}))).expect("good");
    assert_eq!(
        admitted["spec"],
        json!({
            "priority": 0,
            "placement": {"on": "Any", "cost": "Distance"},
            "resources": {"cpu": "500m", "memory": "1Gi"},
            "run": {"process": {"command": ["sleep", "1"]}},
            "restartPolicy": "Never",
            "gracePeriodSeconds": 10,
        })
    );
    assert_eq!(admit(&admitted), Ok(admitted.clone()), "admission is idempotent");
}

#[test]
fn exactly_one_program() {
    assert_eq!(
        problems(&task(json!({"run": {}}))),
        ["spec.run: is required; give `container` or `process`"]
    );
    assert_eq!(
        problems(&task(
            json!({"run": {"container": {"image": "a"}, "process": {"command": ["a"]}}})
        )),
        ["spec.run: has both `container` and `process`; keep one of them"]
    );
    assert_eq!(
        problems(&task(json!({"run": {"process": {"command": []}}}))),
        ["spec.run.process.command: is required; for example [\"/usr/bin/env\"]"]
    );
}

#[test]
fn what_can_never_be_placed_is_refused() {
    assert_eq!(
        problems(&sleep(
            json!({"placement": {"within": -1, "on": "Cloud"}, "resources": {"sensors": ["a:b", "a:b"]}})
        )),
        [
            "spec.placement.within: -1 is not a radius in metres",
            "spec.placement.at: is required; `within` needs the position it is around: at: {x: 3.0, y: 4.0}",
            "spec.placement.on: a Cloud node has no sensors or actuators, and the task asks for some; set on: Robot",
            "spec.resources.sensors[1]: \"a:b\" is there twice",
        ]
    );
}

#[test]
fn a_task_that_stands_by_may_be_let_go_and_not_be_called_back() {
    let info = find(crate::API_VERSION, "Task").expect("served");
    let stands = admit(&sleep(json!({"standby": {"after": "8s"}}))).expect("good");
    let runs = admit(&sleep(json!({}))).expect("good");
    admit_change(info, &stands, &runs).expect("it is begun");
    let back = admit_change(info, &runs, &stands).expect_err("it runs").to_string();
    assert!(back.starts_with("spec.standby"), "{back}");
    let wrong = sleep(json!({
        "standby": {"after": "0s"}, "resources": {"actuators": ["base:Drive"]},
    }));
    let wrong: Vec<String> =
        admit(&wrong).expect_err("refused").iter().map(|v| v.path.clone()).collect();
    assert_eq!(wrong, ["spec.standby.after", "spec.standby"]);
}

#[test]
fn only_priority_grace_and_tolerations_may_change() {
    let info = find(crate::API_VERSION, "Task").expect("served");
    let old = admit(&sleep(json!({"resources": {"cpu": 1}}))).expect("good");
    let mut new = old.clone();
    new["spec"]["priority"] = json!(5);
    new["spec"]["gracePeriodSeconds"] = json!(1);
    new["spec"]["placement"]["tolerations"] = json!([{"operator": "Exists"}]);
    admit_change(info, &old, &new).expect("these may change");
    new["spec"]["resources"]["cpu"] = json!("2");
    new["spec"]["placement"]["node"] = json!("r1");
    let paths: Vec<String> = admit_change(info, &old, &new)
        .expect_err("these may not")
        .iter()
        .map(|v| v.path.clone())
        .collect();
    assert_eq!(paths, ["spec.placement.node", "spec.resources.cpu"]);
}

#[test]
fn tolerations_match_as_in_kubernetes() {
    let taint = |value: &str| Taint {
        key: "battery".into(),
        value: value.into(),
        effect: TaintEffect::NoSchedule,
    };
    let toleration = |key: &str, operator, value: &str, effect| Toleration {
        key: key.into(),
        operator,
        value: value.into(),
        effect,
    };
    use TolerationOperator::{Equal, Exists};
    for (t, tolerates) in [
        (toleration("battery", Equal, "low", None), true),
        (toleration("battery", Equal, "full", None), false),
        (toleration("battery", Exists, "", None), true),
        (toleration("", Exists, "", None), true),
        (toleration("other", Exists, "", None), false),
        (toleration("battery", Exists, "", Some(TaintEffect::PreferNoSchedule)), false),
    ] {
        assert_eq!(t.tolerates(&taint("low")), tolerates, "{t:?}");
    }
}

#[test]
fn a_task_with_actuators_stops_without_contact_unless_it_says_otherwise() {
    let spec = |extra: Value| -> TaskSpec {
        let mut full = json!({"run": {"process": {"command": ["a"]}}});
        full.as_object_mut().expect("a map").extend(extra.as_object().expect("a map").clone());
        serde_json::from_value(full).expect("a spec")
    };
    let drive = json!({"resources": {"actuators": ["base:Drive"]}});
    assert_eq!(spec(json!({})).stop_after_disconnect(), None);
    assert_eq!(spec(drive).stop_after_disconnect(), Some(DEFAULT_STOP_AFTER));
    let stop = json!({"onDisconnect": {"policy": "Stop", "after": "5s"}});
    assert_eq!(spec(stop).stop_after_disconnect(), Some(Span::from_secs(5)));
}

#[test]
fn classes_are_written_as_in_the_paper() {
    let class = |r: Value| serde_json::from_value::<Resources>(r).expect("resources").class();
    assert_eq!(class(json!({"cpu": 1, "sensors": ["k:I"], "actuators": ["b:D"]})), "AR-CR-SR");
    assert_eq!(class(json!({"sensors": ["k:I"]})), "SR");
    assert_eq!(class(json!({})), "none");
}

#[test]
fn probes_get_their_defaults_and_do_not_change() {
    let probed = sleep(json!({"readiness": {"tcp": {"port": 80}}}));
    let admitted = admit(&probed).expect("good");
    assert_eq!(
        admitted["spec"]["readiness"],
        json!({
            "tcp": {"port": 80}, "initialDelay": "0s", "period": "10s", "timeout": "1s",
            "successThreshold": 1, "failureThreshold": 3,
        })
    );
    let mut changed = admitted.clone();
    changed["spec"]["readiness"]["period"] = "5s".into();
    let info = find(crate::API_VERSION, "Task").expect("served");
    let refused = admit_change(info, &admitted, &changed).expect_err("it cannot change");
    let paths: Vec<&str> = refused.iter().map(|v| v.path.as_str()).collect();
    assert_eq!(paths, ["spec.readiness.period"]);
}

#[test]
fn only_what_runs_is_ready() {
    let time =
        |second| MicroTime(k8s_openapi::jiff::Timestamp::from_second(second).expect("in range"));
    let mut status = TaskStatus { phase: TaskPhase::Running, ..TaskStatus::default() };
    assert!(status.is_ready(), "it has no probe");
    status.set_ready(Some(false), time(1));
    assert!(!status.is_ready() && status.ready_at.is_none());
    status.set_ready(Some(true), time(2));
    status.set_ready(Some(true), time(3));
    assert!(status.is_ready());
    assert_eq!(status.ready_at, Some(time(2)), "since it became so");
    status.phase = TaskPhase::Stopping;
    status.set_ready(Some(true), time(4));
    assert_eq!((status.ready, status.ready_at.clone()), (Some(false), None));
    status.set_ready(None, time(5));
    assert_eq!(status.ready, None);
}

#[test]
fn what_cannot_be_tried_elsewhere_is_refused() {
    let tried = |policy: &str, reschedule: Value| {
        problems(&sleep(json!({"restartPolicy": policy, "reschedule": reschedule})))
    };
    assert_eq!(tried("Never", json!({})), [""; 0]);
    assert_eq!(tried("OnFailure", json!({"maxAttempts": 6, "attemptsPerNode": 3})), [""; 0]);
    assert_eq!(
        tried("Always", json!({"maxAttempts": 0, "backoff": "1h"})),
        [
            "spec.reschedule: a task that is always started again does not fail; set restartPolicy: OnFailure, or write a TaskSet with one replica",
            "spec.reschedule.maxAttempts: 0 is not between 1 and 100; 1 lets it fail once",
            "spec.reschedule.maxBackoff: 5m is less than the first wait, 1h; leave it out, or make it longer than `backoff`",
        ]
    );
    assert_eq!(
        tried("Never", json!({"attemptsPerNode": 2})),
        [
            "spec.reschedule.attemptsPerNode: with restartPolicy Never there is one attempt on a node; leave it out, or set restartPolicy: OnFailure"
        ]
    );
    let work = json!({"run": {"executor": {"task": "e"}}, "reschedule": {}});
    assert_eq!(
        problems(&task(work)),
        [
            "spec.reschedule: an executor's work runs where its executor is; leave it out; give the executor's task one"
        ]
    );
    let radius = json!({"placement": {"onOutOfRange": "Reschedule", "at": {"x": 1, "y": 2}}});
    assert_eq!(
        problems(&sleep(radius)),
        [
            "spec.placement.onOutOfRange: there is no radius to leave; give the operation position and the radius: at: {x: 3.0, y: 4.0}, within: 5"
        ]
    );
}
