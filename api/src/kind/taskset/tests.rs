use serde_json::{Value, json};

use super::*;

fn set(spec: Value) -> Value {
    json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "TaskSet",
        "metadata": {"name": "patrol"}, "spec": spec,
    })
}

fn template() -> Value {
    json!({"spec": {"run": {"process": {"command": ["x"]}}}})
}

fn problems(spec: Value) -> Vec<String> {
    match super::super::admit(&set(spec)) {
        Ok(_) => Vec::new(),
        Err(violations) => violations.iter().map(ToString::to_string).collect(),
    }
}

#[test]
fn what_is_left_out_is_filled_in() {
    let admitted =
        super::super::admit(&set(json!({"replicas": 2, "template": template()}))).expect("good");
    let typed: TaskSet = serde_json::from_value(admitted).expect("typed");
    let spec = typed.spec;
    assert_eq!(spec.template.spec.restart_policy, crate::kind::task::RestartPolicy::Always);
    assert_eq!(spec.rollout, Rollout::default());
    assert!(spec.spread);
    assert_eq!(spec.selects("patrol").to_string(), "muster.dev/taskset=patrol");
}

#[test]
fn a_set_is_of_a_number_or_of_every_node() {
    assert_eq!(
        problems(json!({"template": template()})),
        ["spec.replicas: is required; how many tasks there should be; or everyNode: true"]
    );
    assert_eq!(
        problems(json!({"replicas": 1, "everyNode": true, "template": template()})),
        ["spec.replicas: means nothing with everyNode; keep one of them"]
    );
}

#[test]
fn a_template_is_checked_as_a_task_is() {
    let bad = json!({"spec": {
        "restartPolicy": "Never", "gracePeriodSeconds": 7200, "run": {},
    }});
    assert_eq!(
        problems(json!({"replicas": 1, "template": bad})),
        [
            "spec.template.spec.run: is required; give `container` or `process`",
            "spec.template.spec.gracePeriodSeconds: 7200 is more than the longest allowed, 3600",
            "spec.template.spec.restartPolicy: a TaskSet keeps its tasks running, so they start again whenever they end; \
             leave it out, or set Always; what should end once is a Task",
        ]
    );
}

#[test]
fn templates_that_differ_have_other_digests() {
    let read = |value: Value| -> TaskTemplate { serde_json::from_value(value).expect("typed") };
    let (a, mut b) = (read(template()), read(template()));
    assert_eq!(a.digest(0), b.digest(0));
    b.metadata.annotations.insert(RESTARTED_AT.to_owned(), "now".to_owned());
    assert_ne!(a.digest(0), b.digest(0));
    assert_ne!(a.digest(0), a.digest(1));
    crate::name::check_name(&a.digest(0)).expect("a part of a name");
}

#[test]
fn what_a_set_selects_stays() {
    let labelled = |value: &str| {
        json!({
            "replicas": 1, "selector": {"matchLabels": {"app": value}},
            "template": {"metadata": {"labels": {"app": value}}, "spec": {"run": {"process": {"command": ["x"]}}}},
        })
    };
    assert_eq!(problems(labelled("a")), [""; 0]);
    let info = super::super::find_by_word("ts").expect("served");
    let changed = super::super::admit_change(info, &set(labelled("a")), &set(labelled("b")));
    let texts: Vec<String> = changed.expect_err("no").iter().map(ToString::to_string).collect();
    assert_eq!(texts.len(), 1);
    assert!(texts[0].starts_with("spec.selector: cannot change"), "{texts:?}");
}
