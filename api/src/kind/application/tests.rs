use serde_json::{Value, json};

use super::pin::{Pin, pins};
use super::*;
use crate::kind::admit;

fn application(spec: &Value) -> Value {
    json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Application",
        "metadata": {"name": "a"}, "spec": spec,
    })
}

fn part(name: &str) -> Value {
    json!({"name": name, "template": {"spec": {"run": {"process": {"command": ["x"]}}}}})
}

fn admitted(spec: &Value) -> ApplicationSpec {
    let object = admit(&application(spec)).expect("admitted");
    serde_json::from_value(object["spec"].clone()).expect("a spec")
}

fn problems(spec: &Value) -> Vec<String> {
    match admit(&application(spec)) {
        Ok(_) => Vec::new(),
        Err(violations) => violations.iter().map(ToString::to_string).collect(),
    }
}

#[test]
fn what_is_left_out_has_its_default() {
    let mut once = part("map");
    once["runs"] = "Once".into();
    let spec = admitted(&json!({"home": "r", "parts": [part("a"), once]}));
    assert_eq!(spec.objective, Objective::default());
    assert_eq!(spec.policy, Policy::Optimal);
    assert_eq!(spec.period, Span::from_secs(1));
    let policy = |i: usize| spec.parts[i].template.spec.restart_policy;
    assert_eq!(policy(0), crate::kind::task::RestartPolicy::Always);
    assert_eq!(policy(1), crate::kind::task::RestartPolicy::OnFailure);
}

#[test]
fn a_part_is_pinned_by_what_it_reads_drives_or_cannot_miss() {
    let mut camera = part("camera");
    camera["template"]["spec"]["resources"] = json!({"sensors": ["xtion:ImageGen"]});
    let spec = admitted(&json!({
        "home": "r", "parts": [camera, part("ar"), part("nav"), part("ekf")],
        "connections": [
            {"topic": "/image", "from": "camera", "to": "ar", "minHz": 1, "tolerance": "1s"},
            {"topic": "/pose", "from": "ekf", "to": "nav", "minHz": 2},
        ],
    }));
    let of = |name: &str| pins(&spec, spec.part(name).expect("a part"));
    assert_eq!(of("ar"), []);
    assert_eq!(of("camera")[0].reason(), "Sensor");
    let pinned = |other: &str| Pin::NoTolerance { topic: "/pose".into(), other: other.into() };
    assert_eq!(of("ekf"), [pinned("nav")]);
    assert_eq!(of("nav"), [pinned("ekf")]);
}

#[test]
fn a_tolerance_that_no_return_can_keep_is_refused() {
    let with = |tolerance: &str| {
        problems(&json!({
            "home": "r", "parts": [part("a"), part("b")],
            "connections": [{"topic": "/t", "from": "a", "to": "b", "minHz": 1, "tolerance": tolerance}],
        }))
    };
    assert_eq!(with("0s"), [""; 0]);
    assert_eq!(with("501ms"), [""; 0]);
    assert_eq!(
        with("500ms"),
        [
            "spec.connections[0].tolerance: 500ms is over before a part is back home, which takes 500ms; 0s keeps its \
             parts at home; or lower spec.returnTime if they start faster"
        ]
    );
}

#[test]
fn what_would_take_a_part_s_task_out_of_the_application_s_hands_is_refused() {
    let mut once = part("map");
    once["template"]["spec"]["ttlSecondsAfterFinished"] = 5.into();
    once["template"]["spec"]["standby"] = json!({"after": "5s"});
    assert_eq!(
        problems(&json!({"home": "r", "parts": [once]})),
        [
            "spec.parts[0].template.spec.standby: what stands by for a part is the Application's to say; leave it out",
            "spec.parts[0].template.spec.ttlSecondsAfterFinished: a part whose task is gone is begun again; leave it out",
        ]
    );
}

#[test]
fn a_task_s_name_is_short_enough_for_a_name() {
    let (application, part) = ("a".repeat(34), "p".repeat(22));
    assert_eq!(task_name(&application, &part, 99_999).len(), crate::name::MAX_NAME_LEN);
    assert_eq!(task_name("a", "p", 100_001), "a-p-1");
}

#[test]
fn home_does_not_change() {
    let spec = |home: &str| {
        admit(&application(&json!({"home": home, "parts": [part("a")]}))).expect("admitted")
    };
    let info = crate::kind::find_by_word("application").expect("served");
    let change = |home| crate::kind::admit_change(info, &spec("r"), &spec(home));
    assert!(change("r").is_ok());
    assert_eq!(
        change("s").expect_err("another home").to_string(),
        "spec.home: cannot change while the application exists; another robot has an Application of its own"
    );
}
